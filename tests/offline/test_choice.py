"""The fixed set: the least bound of the error within a budget."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptune.errors import AdaptuneError
from offline.choice import (
    BlockErrors,
    NothingUsableError,
    affordable,
    bounds,
    choose,
    elsewhere,
    finalists,
    front,
    mean_and_error,
    surely_restarted,
    surely_worse,
)


def blocks(errors, costs=None, restarts=None, sequence=None):
    """Trials 0, 1, ... with a column of errors each."""
    errors = np.array(errors, float)
    n_blocks, n = errors.shape
    return BlockErrors(
        list(range(n)),
        errors,
        np.zeros(n_blocks, int) if sequence is None else np.array(sequence),
        np.full(n, 10.0) if costs is None else np.array(costs, float),
        np.zeros(n) if restarts is None else np.array(restarts, float),
    )


def noisy(means, n=12, seed=0, spread=0.05):
    rng = np.random.default_rng(seed)
    return np.array(means) * rng.uniform(0.8, 1.2, (n, 1)) + rng.normal(0, spread, (n, len(means)))


def test_the_best_within_the_budget_is_chosen():
    errors = noisy([1.0, 0.7, 0.4])
    assert choose(blocks(errors)) == 2
    # Twice the baseline's cost; its edge is soft, that of a user's budget is hard.
    assert choose(blocks(errors, [10.0, 15.0, 21.9])) == 2
    assert choose(blocks(errors, [10.0, 15.0, 22.1])) == 1
    assert choose(blocks(errors, [10.0, 15.0, 20.1]), budget=20.0) == 1
    assert choose(blocks(errors, [10.0, 12.0, 30.0]), budget=np.inf) == 2
    with pytest.raises(AdaptuneError, match=r"\(--budget\): 7.99 ms .* 10.0 ms \(trial 0\)"):
        choose(blocks(errors, [10.0, 12.0, 30.0]), budget=7.98637)


def test_cheapness_earns_nothing():
    errors = noisy([1.0, 0.7, 0.69])
    assert choose(blocks(errors, [10.0, 2.0, 19.0])) == 2
    same = np.repeat(noisy([1.0]), 3, axis=1)
    assert choose(blocks(same, [10.0, 5.0, 9.0])) == 0


def test_what_may_be_chance_is_not_chosen():
    errors = noisy([1.0, 0.97], 8, spread=0.5)
    assert choose(blocks(errors)) == 0
    assert choose(blocks(noisy([1.0, 0.9], 100, spread=0.05))) == 1
    # One block has a standard error, too: of 0.3.
    assert choose(blocks([[1.0, 0.6]])) == 0
    assert choose(blocks([[1.0, 0.4]])) == 1


def test_recordings_that_disagree_are_doubted():
    errors, places = np.ones((24, 2)), np.repeat([0, 1, 2], 8)
    errors[:, 1] = np.repeat([0.3, 1.05, 1.05], 8)
    assert choose(blocks(errors)) == 1
    assert choose(blocks(errors, sequence=places)) == 0
    assert bounds(blocks(errors, sequence=places))[1] > bounds(blocks(errors))[1]
    # Several that agree say more than one that is as long.
    errors = np.repeat([[1.0, 0.8], [1.0, 1.1]], 12, axis=0)[np.tile([0, 12], 12)]
    assert choose(blocks(errors)) == 0
    assert choose(blocks(errors, sequence=places)) == 1


def test_a_budget_below_the_baseline_may_take_what_is_worse():
    found = blocks(noisy([1.0, 2.0, 3.0]), [10.0, 4.0, 4.0])
    assert choose(found) == 0
    assert choose(found, budget=5.0) == 1
    assert finalists(found, 5.0)[:2] == [0, 1]


def test_where_nothing_keeps_track_the_baseline_is_kept():
    errors = noisy([20.0, 10.0])
    assert choose(blocks(errors)) == 0
    assert choose(blocks(errors)._replace(lost_above=np.inf)) == 1
    assert choose(blocks(noisy([20.0, 4.0]))) == 1
    assert choose(blocks(errors, [10.0, 5.0]), budget=6.0) == 1  # the baseline costs too much
    # Other recordings count.
    both = np.concatenate([errors, noisy([1.0, 0.5])])
    assert choose(blocks(both, sequence=np.repeat([0, 1], 12))) == 1
    both[:12] = noisy([10.0, 20.0])
    assert choose(blocks(both, sequence=np.repeat([0, 1], 12))) == 1


def test_what_comes_too_late_is_not_chosen():
    found = blocks(noisy([1.0, 0.7, 0.4]), [10.0, 40.0, 60.0])
    assert choose(found, budget=100.0) == 2
    assert choose(found._replace(period=100.0), budget=100.0) == 1
    # Nor is there another way where the baseline does.
    assert choose(found._replace(period=10.0), budget=100.0) == 0


def test_who_is_restarted_more_often_than_the_baseline_is_not_chosen():
    errors = noisy([1.0, 0.5, 0.6, 0.1])
    assert choose(blocks(errors, restarts=[2, 20, 2, np.inf])) == 2
    # A restart more may be chance.
    assert choose(blocks(errors, restarts=[2, 3, 2, np.inf])) == 1
    often = blocks(errors, restarts=[0, 5, 4, np.inf])
    assert surely_restarted(often).tolist() == [False, True, False, True]
    with pytest.raises(NothingUsableError, match=r"none of 2 parameter sets gives poses .*: mend"):
        choose(blocks(errors[:, :2], restarts=[np.inf, np.inf]))


def test_a_set_whose_heading_drifts_is_not_chosen():
    errors = noisy([1.0, 0.5])
    assert choose(blocks(errors)._replace(turns=np.repeat(noisy([1.0]), 2, axis=1))) == 1
    drifting = blocks(errors)._replace(turns=noisy([1.0, 3.0]))
    assert choose(drifting) == choose(drifting.some([1, 0])) == 0


def test_a_set_that_is_surely_worse_on_one_recording_is_not_chosen():
    errors, places = noisy([1.0, 0.5], 24), np.repeat([0, 1], 12)
    errors[12:, 1] += 0.8
    found = surely_worse(blocks(errors, sequence=places))
    assert found.tolist() == [False, True]
    assert choose(blocks(errors, sequence=places)) == 0
    # A single bad block may be chance.
    errors = noisy([1.0, 0.5], 24)
    errors[3, 1] = 5.0
    assert not surely_worse(blocks(errors, sequence=places)).any()


def test_the_front_has_a_set_for_each_budget():
    errors = noisy([1.0, 0.8, 0.6, 0.9, 0.5, 3.0, 0.4])
    found = blocks(errors, [10, 10.9, 17, 5, 21, 1, 40])
    assert front(found, None) == (0, 4, 1, 6, 2)
    assert front(found, 18.0) == (0, 2, 1, 6, 2)
    assert front(found._replace(period=60.0), None).any_cost == 4  # the dearest may come too late
    assert {0, 1, 2, 4, 6} <= set(finalists(found))
    assert affordable(found, None).tolist() == [True, True, True, True, True, True, False]


def test_the_best_odometry_with_its_own_parameters_is_the_baseline():
    errors = noisy([2.0, 1.0, 1.1, 0.4])
    several = blocks(errors, [10, 60, 20, 30])._replace(defaults=(0, 1, 2), period=100.0)
    assert several.baseline == 2  # the second takes more than half of the time
    assert several._replace(period=np.inf).baseline == 1
    # The order of names changes nothing.
    order = [2, 0, 1, 3]
    swapped = several._replace(
        errors=errors[:, order], costs=several.costs[order], restarts=several.restarts[order]
    )
    assert order[choose(swapped)] == choose(several) == 3
    assert swapped.baseline == 0


def test_recordings_have_equal_weights():
    values = np.array([[1.0], [1.0], [1.0], [5.0]])
    mean, error = mean_and_error(values, np.array([0, 0, 0, 1]))
    assert mean == pytest.approx(3.0)
    assert np.isfinite(error).all()
    assert np.isinf(mean_and_error(values[:1], np.zeros(1))[1]).all()


@given(st.integers(2, 6), st.integers(1, 20), st.integers(0, 2**32 - 1))
def test_what_is_chosen_may_be_chosen(n, n_blocks, seed):
    rng = np.random.default_rng(seed)
    found = blocks(
        rng.exponential(1.0, (n_blocks, n)),
        rng.uniform(1.0, 50.0, n),
        rng.integers(0, 3, n),
        np.sort(rng.integers(0, 3, n_blocks)),
    )
    chosen = choose(found)
    assert affordable(found, None)[chosen]
    assert not surely_restarted(found)[chosen]
    assert not surely_worse(found)[chosen]
    assert {0, chosen, *front(found, None)} <= set(finalists(found))
    assert elsewhere(found, 0) == (1.0, 1.0, 1.0)


def test_another_drive_is_less_sure_than_this_one():
    errors = noisy([1.0, 0.5], 40)
    ratio, low, high = elsewhere(blocks(errors), 1)
    assert low < 0.4 < ratio < 0.6 < high < 3.0
    # Several drives that agree say more, and those that disagree less.
    places = np.repeat(np.arange(8), 5)
    agree = elsewhere(blocks(errors, sequence=places), 1)
    assert agree.high / agree.low < high / low
    errors[:, 1] *= np.repeat([0.2, 3.0] * 4, 5)
    apart = elsewhere(blocks(errors, sequence=places), 1)
    assert apart.high / apart.low > high / low


def test_what_a_bank_does_on_another_drive_is_no_surer_than_what_its_set_does():
    errors = noisy([1.0, 0.5], 40)
    alone, even = elsewhere(blocks(errors), 1), elsewhere(blocks(errors), 1, (0.8, 0.0))
    assert np.allclose(np.array(even) / alone, 0.8)
    # One segment, or two that differ, say little; they leave no limits that say nothing.
    for error in (0.6, np.inf):
        unsure = elsewhere(blocks(errors), 1, (0.8, error))
        assert alone.high / alone.low < unsure.high / unsure.low < 60.0
    # Where the set is the baseline, drives differ, too.
    assert elsewhere(blocks(errors), 0, (0.8, 0.1)).high > 1.0
