"""What a budget allows: sets, banks, and what is chosen where something is left out."""

import numpy as np
import pytest
from labelled_places import TRIALS, labelled, sequence, two_kinds, with_motions

from adaptune.model.registry import ADAPTIVE
from adaptune.model.rules import Costs, SetCost, allowed_sets
from adaptune.space import ODOMETRY, Float, ParameterSets, ParameterSpace, PooledSpace
from offline.choice import mean_and_error
from offline.validate import leave_one_out

ONE = ParameterSpace({"x": Float(low=0.0, high=9.0, baseline=1.0)})
POOL = PooledSpace({"gicp": ONE, "ndt": ONE})
SETS = ParameterSets(
    POOL,
    TRIALS,
    tuple(
        {ODOMETRY: odometry, "x": x}
        for odometry, x in [("gicp", 1.0), ("ndt", 1.0), ("gicp", 2.0), ("ndt", 3.0), ("gicp", 4.0)]
    ),
)
COSTS = Costs({t: SetCost(float(10 * i + 1), 1.0, i) for i, t in enumerate(TRIALS)}, 3.0)


def data(sequences, **more):
    return labelled(sequences)._replace(sets=SETS, costs=COSTS, **more)


@pytest.fixture
def places():
    """Trial 4, the third, is the best over all; the fourth is the worst."""
    return two_kinds(np.random.default_rng(0))


def test_the_best_of_several_odometries_own_parameters_is_the_baseline(places):
    blocks = data(places).blocks()
    # Both have the same mean error on all places but noise: the least one counts.
    own, _ = mean_and_error(blocks.errors[:, :2], blocks.sequence)
    assert blocks.baseline == int(own.argmin())
    assert labelled(places)._replace(costs=COSTS).blocks().baseline == 0


def test_a_budget_bounds_the_fixed_set_and_what_is_selected():
    rng = np.random.default_rng(0)
    places = [sequence(f"s{i}", [2.0, 1.9, 1.0, 1.5, 3.0], 0, rng) for i in range(8)]
    # Twice what the better one of the odometries' own parameters takes, and a tenth more.
    assert data(places).fixed() == TRIALS[2]
    dear = COSTS.sets | {TRIALS[2]: SetCost(26.0, 1.0, 2)}
    assert data(places)._replace(costs=Costs(dear, 3.0)).fixed() in TRIALS[:2]
    assert data(places, budget=100.0).fixed() == TRIALS[2]
    cheap = data(places, budget=15.0)
    assert cheap.fixed() in TRIALS[:2]
    # Live evidence does not fit beside the second one.
    frugal = data(places, budget=12.0)
    assert allowed_sets(frugal.costs, frugal.budget, frugal.sets, TRIALS[1]) == TRIALS[:2]
    assert data(places, cores=4).can_pay(TRIALS)
    assert not frugal.can_pay(TRIALS[:2])


def test_a_bank_stays_within_the_budget():
    rng = np.random.default_rng(7)
    rich = data([with_motions(f"s{i}", rng, 100) for i in range(4)])
    fixed = rich.costs.alone(rich.fixed())
    for budget in (fixed, 40.0, 200.0):
        found = leave_one_out(rich._replace(budget=budget), bank=2)
        assert found.cost(ADAPTIVE) <= budget + 1e-6
