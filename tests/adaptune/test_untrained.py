import numpy as np

from adaptune.live.evidence import LiveEvidence
from adaptune.live.hops import HopSquares
from adaptune.odometry.base import Motions
from adaptune.recording.scan import Scan
from adaptune.selector import CANDIDATES, UntrainedSelector, untrained_sets
from adaptune.space import ODOMETRY, Categorical, Float, Integer, ParameterSpace, PooledSpace

SPACE = ParameterSpace.of(
    distance=Float(low=0.1, high=10.0, baseline=2.0, log=True),
    size=Integer(low=1, high=9, baseline=4),
    kernel=Categorical(choices=("none", "huber", "cauchy"), baseline="none"),
)


def test_the_baseline_is_the_first_and_the_others_are_around_it():
    sets = untrained_sets(SPACE)
    assert sets.trials == (0, 1, 2, 3)
    assert sets[0] == SPACE.baseline
    for trial in sets:
        SPACE.check(sets[trial])
    assert untrained_sets(SPACE).parameters == sets.parameters
    # Half-way: no further from the baseline than half of the cube.
    space = ParameterSpace.of(a=Float(low=0.0, high=1.0, baseline=0.0))
    values = [one["a"] for one in untrained_sets(space, CANDIDATES).parameters]
    assert max(values) <= 0.5
    assert max(values) > 0.4


def test_the_baseline_has_all_the_weight_until_others_are_confirmed(monkeypatch):
    sets = untrained_sets(SPACE)
    selector = UntrainedSelector(sets, 25.0)
    assert (selector.fixed, selector.members) == (0, (0, 1, 2, 3))
    selector.observe(0, Scan(0, np.zeros((0, 3), np.float32)), Motions(np.eye(4), {}))
    selection = selector.select()
    assert selection.weights == {0: 1.0, 1: 0.0, 2: 0.0, 3: 0.0}
    assert (selection.trial, selection.parameters) == (0, SPACE.baseline)
    assert np.isnan(selection.estimated_error)
    assert not selection.lost
    selector.measure()  # a single scan
    selector.reset()
    assert selector.select() == selection
    # The second does as well as the baseline, the others are far off.
    squares = HopSquares(np.diag([1.0, 1.0, 100.0, 100.0]), 0.0, 6.0)
    monkeypatch.setattr(LiveEvidence, "squares", lambda _: squares)
    weights = selector.select().weights
    assert weights[0] > weights[1] > 0.3
    assert max(weights[2], weights[3]) < 0.1


def test_of_several_odometries_all_baselines_are_in_the_bank():
    other = ParameterSpace.of(voxel=Float(low=0.1, high=3.0, baseline=1.0))
    space = PooledSpace({"first": SPACE, "second": other})
    sets = untrained_sets(space)
    assert sets.trials == (0, 1, 2, 3)
    assert list(sets.parameters[:2]) == space.baselines
    # What is left is filled up as if there was the first one alone.
    alone = untrained_sets(SPACE, 3).parameters[1:]
    assert sets.parameters[2:] == tuple({ODOMETRY: "first", **own} for own in alone)
    for one in sets.parameters:
        space.check(one)
    assert list(untrained_sets(space, 1).parameters) == space.baselines[:1]


def test_a_portfolio_gives_the_members():
    first = [{**SPACE.baseline, "size": n} for n in (2, 7, 9)]
    assert untrained_sets(SPACE, 4, first).parameters == (SPACE.baseline, first[0])
    space = PooledSpace({"first": SPACE, "second": SPACE})
    of_second = [{ODOMETRY: "second", **one} for one in first]
    assert list(untrained_sets(space, 4, of_second).parameters) == [*space.baselines, of_second[0]]
    assert list(untrained_sets(space, 2, of_second).parameters) == space.baselines
