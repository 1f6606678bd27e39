import numpy as np
from tables import table

from adaptune.model.rules import Costs, SetCost, TrainingData, complementary
from adaptune.model.weights import choose_members
from adaptune.space import ParameterSets, ParameterSpace


def chosen(errors, sequence, size):
    errors, sequence = np.array(errors, np.float32), np.array(sequence)
    sets = table(np.zeros((errors.shape[1], 1)))
    return complementary(TrainingData(np.zeros((len(errors), 1)), sequence, errors, sets, 0), size)


def test_the_next_set_is_good_where_those_before_are_not():
    errors = [
        # fixed, as good elsewhere, good where fixed is bad, a little better everywhere
        [1.0, 1.0, 9.0, 0.9],
        [1.0, 1.0, 9.0, 0.9],
        [8.0, 8.0, 1.0, 7.5],
        [np.inf, np.inf, 1.0, np.inf],
    ]
    sequence = [0, 0, 0, 1]
    assert chosen(errors, sequence, 2) == [0, 2]
    assert chosen(errors, sequence, 3) == [0, 2, 3]
    # The second one adds nothing at all.
    assert chosen(errors, sequence, 4) == [0, 2, 3]


def test_sequences_weigh_the_same_however_long():
    errors = [[5.0, 4.0, 5.0]] * 9 + [[5.0, 5.0, 3.0]]
    assert chosen(errors, [0] * 9 + [1], 2) == [0, 2]


def test_a_set_that_was_not_run_everywhere_is_not_chosen():
    nan = np.nan
    errors = [[5.0, 1.0, 4.0, 0.5], [5.0, nan, 4.0, 0.6], [9.0, 1.0, 9.0, nan]]
    assert chosen(errors, [0, 0, 1], 4) == [0, 1, 2]


OF_SETS = {0: (3.0, 5.0, 0), 4: (4.0, 5.0, 0), 7: (30.0, 0.0, 1), 9: (2.0, 9.0, 2)}
COSTS = Costs({trial: SetCost(*cost) for trial, cost in OF_SETS.items()}, evidence=2.5)
NONE = ParameterSpace({})


def sets(n):
    return ParameterSets(NONE, tuple(range(n)), tuple({} for _ in range(n)))


def test_costs_are_of_all_that_is_driven():
    # A set alone has no live evidence; members share prepared scans.
    assert COSTS.alone(4) == 9.0
    assert [COSTS.adaptive(of) for of in ([4], [0, 4], [0, 4, 7, 9])] == [11.5, 14.5, 55.5]
    assert np.isnan([COSTS.alone(5), COSTS.adaptive([0, 5])]).all()
    assert COSTS.allow([0, 4], 14.5)
    assert not COSTS.allow([0, 4], 14.4)
    assert not COSTS.allow([0, 5], np.inf)  # of unknown cost
    assert COSTS.allow([0, 5], None)


def members(size=3, **allow):
    """Of four sets, the third cancels the first's error, and the second a half of it."""
    rng = np.random.default_rng(0)
    x = rng.normal(0.0, 1.0, (50, 3)).astype(np.float32)
    other = rng.normal(0.0, 1.0, (50, 3)).astype(np.float32)
    vectors = np.stack([x, -0.5 * x + other, -x + 0.1 * other, x + 0.2 * other], axis=1)
    return choose_members(vectors, np.zeros(50, np.intp), range(4), size, **allow)


def within(budget, *register):
    costs = Costs({i: SetCost(ms, 0.0, i) for i, ms in enumerate(register)}, 0.0)
    return {"allow": lambda trials: costs.allow(trials, budget)}


def test_members_stay_within_a_budget():
    assert members()[:2] == [0, 2]
    assert members(**within(5.0, 1.0, 1.0, 9.0, 1.0))[:2] == [0, 1]
    assert members(**within(5.0, 1.0, 9.0, 9.0, 9.0)) == [0]


def test_complementary_sets_stay_within_a_budget():
    errors = np.array([[2.0, 1.0, 1.2], [2.0, 3.0, 3.0]], np.float32)
    data = TrainingData(np.empty((2, 0)), np.zeros(2, np.intp), errors, sets(3), 0)
    assert complementary(data, 2) == [0, 1]
    assert complementary(data, 2, **within(4.0, 1.0, 9.0, 2.0)) == [0, 2]
    assert complementary(data, 2, **within(4.0, 1.0, 9.0, 9.0)) == [0]
