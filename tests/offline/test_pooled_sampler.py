import collections

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptune.space import ODOMETRY, Categorical, Float, Integer, ParameterSpace, PooledSpace
from offline.config import OfflineConfig
from offline.samplers import make_sampler

SPACE = PooledSpace(
    {
        "gicp": ParameterSpace.of(
            distance=Float(low=0.1, high=10.0, baseline=1.0, log=True),
            passes=Integer(low=1, high=40, baseline=20),
        ),
        "ndt": ParameterSpace.of(distance=Float(low=0.5, high=20.0, baseline=4.0, log=True)),
        "kiss": ParameterSpace.of(voxel=Float(low=0.1, high=3.0, baseline=1.0)),
    }
)


def error(parameters):
    if parameters[ODOMETRY] == "gicp":
        return 0.5 + abs(parameters["distance"] - 2.0)
    return 20.0 + (parameters.get("distance") or parameters["voxel"])


@pytest.fixture(params=["tpe", "random"])
def config(request):
    return OfflineConfig(sampler=request.param, batch=8, initial=12, seed=5)


def run(space, config, n, error):
    """Sets and values of `n` trials, or of as many as there are."""
    sampler, sets, history = make_sampler(space, config), [], []
    while len(sets) < n:
        history = [(s, error(s)) for s in sets[: max(0, len(sets) - config.batch + 1)]]
        if (proposed := sampler.propose(history, sets[len(history) :])) is None:
            break
        sets.append(proposed.parameters)
    return [(s, error(s)) for s in sets]


def labels(history):
    return [s[ODOMETRY] for s, _ in history]


def test_the_first_trials_are_the_baselines_and_then_all_take_turns(config):
    history = run(SPACE, config, 16, error)
    assert [s for s, _ in history[:3]] == SPACE.baselines
    assert labels(history[:8]) == ["gicp", "ndt", "kiss"] * 2 + ["gicp", "ndt"]
    assert min(collections.Counter(labels(history)).values()) >= 4


@given(
    n=st.integers(2, 6),
    batch=st.integers(1, 20),
    errors=st.lists(st.floats(0.0, 9.0), min_size=6, max_size=6, unique=True),
)
def test_trials_are_split_by_rank_and_nobody_is_left_out(n, batch, errors):
    of = {str(i): error for i, error in enumerate(errors[:n])}
    space = PooledSpace(dict.fromkeys(of, SPACE.spaces["kiss"]))
    config = OfflineConfig(sampler="random", batch=batch, initial=batch + n)
    history = run(space, config, batch + n + 30, lambda s: of[s[ODOMETRY]])
    counts = collections.Counter(labels(history[batch + n :]))
    ranked = [counts[label] for label in sorted(of, key=of.__getitem__)]
    assert min(ranked) >= 1
    assert ranked == sorted(ranked, reverse=True)


@pytest.mark.parametrize("batch", [1, 4, 16])
def test_a_finite_pool_is_tried_to_its_end(config, batch):
    few, many = (ParameterSpace.of(n=Integer(low=1, high=n, baseline=1)) for n in (3, 17))
    # Python takes 1 and True for equal.
    equal = ParameterSpace.of(kernel=Categorical(choices=(1, True, "x"), baseline=1))
    space = PooledSpace({"few": few, "many": many, "equal": equal})
    config = config.model_copy(update={"batch": batch, "initial": 6})
    history = run(space, config, 30, lambda _: 1.0)
    assert len(history) == len({repr(s) for s, _ in history}) == 23


def test_each_odometry_begins_with_the_sets_of_its_portfolio():
    config = OfflineConfig(batch=8, initial=4, seed=5)
    of = {"kiss": [{"voxel": 0.5}, {"voxel": 0.7}], "gicp": [{"distance": 2.0, "passes": 9}]}
    first = [{ODOMETRY: label, **own} for label, sets in of.items() for own in sets]
    sampler, sets = make_sampler(SPACE, config, first), []
    sources = []
    for _ in range(9):
        found = sampler.propose([], sets)
        sets.append(found.parameters)
        sources.append((found.parameters[ODOMETRY], found.source))
    assert sets[:3] == SPACE.baselines
    assert [s for s, (_, source) in zip(sets, sources, strict=True) if source == "portfolio"] == [
        first[2],
        *first[:2],
    ]
    assert [label for label, _ in sources] == ["gicp", "ndt", "kiss"] * 3
