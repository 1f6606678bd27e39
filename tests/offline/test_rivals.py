import numpy as np
import pytest
from labelled_places import TRIALS, labelled, sequence, two_kinds, with_motions

from adaptune.errors import AdaptuneError
from adaptune.model import BankSettings
from adaptune.model.registry import ADAPTIVE
from adaptune.model.rules import Costs, SetCost, allowed_sets
from adaptune.space import ODOMETRY, Float, ParameterSets, ParameterSpace, PooledSpace
from adaptune.study.driven import BEST_DEFAULT, EQUAL_COST
from offline.tuning import NO_BANK, Policy, driven_cost, rivals
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


def test_the_best_default_is_the_best_of_the_odometries_baselines(places):
    found = rivals(data(places), 100.0)
    # Both have the same mean error, and the second the less in the geometric mean.
    assert found[BEST_DEFAULT] == TRIALS[1]
    # One odometry's is the baseline.
    assert BEST_DEFAULT not in rivals(labelled(places)._replace(costs=COSTS), 100.0)


def test_the_rival_of_equal_cost_costs_no_more(places):
    assert rivals(data(places), 100.0)[EQUAL_COST] == TRIALS[2]
    assert rivals(data(places), 12.0)[EQUAL_COST] in TRIALS[:2]
    assert EQUAL_COST not in rivals(data(places), np.nan)
    with pytest.raises(AdaptuneError, match=r"online.budget: 1 ms .* 2.0 ms \(trial 0\)"):
        rivals(data(places), 1.0)


def test_what_is_driven_costs_what_all_of_it_costs(places):
    members = [TRIALS[2], TRIALS[0]]
    bank = Policy(BankSettings(), members, None)
    assert driven_cost(data(places), bank, TRIALS[2]) == 21.0 + 1.0 + 1.0 + 1.0 + 3.0
    fixed = Policy(NO_BANK, members, None)
    assert driven_cost(data(places), fixed, TRIALS[2]) == 22.0
    assert np.isnan(driven_cost(labelled(places), bank, TRIALS[2]))


def test_a_budget_bounds_the_fixed_set_and_what_is_selected():
    rng = np.random.default_rng(0)
    places = [sequence(f"s{i}", [2.0, 1.9, 1.0, 1.5, 3.0], 0, rng) for i in range(8)]
    assert data(places).fixed() == TRIALS[0]  # all others cost more
    assert data(places, budget=100.0).fixed() == TRIALS[2]
    cheap = data(places, budget=15.0)
    assert cheap.fixed() in TRIALS[:2]
    # Live evidence does not fit beside the second one.
    frugal = data(places, budget=12.0)
    assert allowed_sets(frugal.costs, frugal.budget, frugal.sets, TRIALS[1]) == TRIALS[:2]
    assert data(places).can_pay(TRIALS)
    assert not frugal.can_pay(TRIALS[:2])


@pytest.fixture(scope="module")
def validation():
    rng = np.random.default_rng(7)
    known = data([with_motions(f"s{i}", rng, 150) for i in range(7)])
    return known, leave_one_out(known, bank=2)


def test_rivals_are_left_out_too(validation):
    _, found = validation
    assert {BEST_DEFAULT, EQUAL_COST, ADAPTIVE} <= set(found.ratios)
    assert found.cost("baseline") == 2.0
    assert found.cost(ADAPTIVE) > found.cost("fixed")
    assert found.cost(EQUAL_COST) <= found.cost(ADAPTIVE)
    said = found.against_rivals()
    assert len(said) == 2
    assert "of CPU time a scan against" in said[0]
    assert "ms" in said[1]


def test_a_bank_stays_within_the_budget():
    rng = np.random.default_rng(7)
    rich = data([with_motions(f"s{i}", rng, 100) for i in range(4)])
    fixed = rich.costs.alone(rich.fixed())
    for budget in (fixed, 40.0, 200.0):
        found = leave_one_out(rich._replace(budget=budget), bank=2)
        assert found.cost(ADAPTIVE) <= budget + 1e-6
