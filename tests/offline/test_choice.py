"""The fixed set: not shown to be worse than the baseline, then good, then cheap."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptune.errors import AdaptuneError
from offline.choice import (
    BlockErrors,
    NothingUsableError,
    affordable,
    choose,
    finalists,
    front,
    left_out_ratio,
    mean_and_error,
    ratio_to_baseline,
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


def test_the_best_that_costs_no_more_is_chosen():
    errors = noisy([1.0, 0.7, 0.4])
    assert choose(blocks(errors)) == 2
    assert choose(blocks(errors, [10.0, 10.4, 30.0])) == 1  # the noise of a measurement is no cost
    assert choose(blocks(errors, [10.0, 12.0, 30.0])) == 0
    assert choose(blocks(errors, [10.0, 12.0, 30.0]), budget=12.0) == 1
    assert choose(blocks(errors, [10.0, 12.0, 30.0]), budget=np.inf) == 2
    with pytest.raises(AdaptuneError, match=r"online.budget: 5 ms .* 10.0 ms \(trial 0\)"):
        choose(blocks(errors, [10.0, 12.0, 30.0]), budget=5.0)


def test_a_budget_below_the_baseline_may_take_what_is_worse():
    found = blocks(noisy([1.0, 2.0, 3.0]), [10.0, 4.0, 4.0])
    assert choose(found) == 0
    assert choose(found, budget=5.0) == 1
    assert finalists(found, 5.0)[:2] == [0, 1]


def test_what_comes_too_late_is_not_chosen():
    found = blocks(noisy([1.0, 0.7, 0.4]), [10.0, 40.0, 60.0])
    assert choose(found, budget=100.0) == 2
    assert choose(found._replace(period=100.0), budget=100.0) == 1
    # Nor is there another way where the baseline does.
    assert choose(found._replace(period=10.0), budget=100.0) == 0


def test_of_equally_good_sets_the_cheapest_is_chosen():
    same = np.repeat(noisy([1.0]), 3, axis=1)
    assert choose(blocks(same, [10.0, 5.0, 9.0])) == 1
    # A cheaper one that is surely worse is none of them.
    same[:, 1] += 0.3
    assert choose(blocks(same, [10.0, 5.0, 8.0])) == 2


def test_who_is_restarted_more_often_than_the_baseline_is_not_chosen():
    errors = noisy([1.0, 0.5, 0.6, 0.1])
    assert choose(blocks(errors, restarts=[2, 3, 2, np.inf])) == 2
    with pytest.raises(NothingUsableError, match=r"none of 2 parameter sets gives poses .*: mend"):
        choose(blocks(errors[:, :2], restarts=[np.inf, np.inf]))


def test_a_set_whose_heading_drifts_is_not_chosen():
    errors = noisy([1.0, 0.5])
    assert choose(blocks(errors)._replace(turns=np.repeat(noisy([1.0]), 2, axis=1))) == 1
    drifting = blocks(errors)._replace(turns=noisy([1.0, 3.0]))
    assert choose(drifting) == choose(drifting.some([1, 0])) == choose(drifting.without(0)) == 0


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


def test_the_front_rises_in_cost_and_falls_in_error():
    errors = noisy([1.0, 0.8, 0.79, 0.9, 0.5, 3.0])
    found = blocks(errors, [10, 20, 40, 5, 30, 1])
    assert front(found) == [3, 1, 4]  # trial 0 costs more than 3, and is worse; 5 is surely worse
    assert finalists(found) == [0, 3, 1, 4]
    assert affordable(found, None).tolist() == [True, False, False, True, False, True]


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
    assert found.restarts[chosen] <= found.restarts[0]
    assert not surely_worse(found)[chosen]
    assert {0, *front(found)[-2:]} <= set(finalists(found, np.inf))
    assert ratio_to_baseline(found, 0)[0] == pytest.approx(1.0)


def test_what_is_left_out_tells_how_a_choice_does_elsewhere():
    # All sets are alike: the least of many errors is chance, and gone where it was not chosen.
    errors = np.random.default_rng(1).exponential(1.0, (30, 20))
    ratio, low, high = left_out_ratio(blocks(errors), lambda of: choose(of, sure=False))
    assert low < 1.0 < high
    assert ratio > errors.mean(axis=0).min() / errors[:, 0].mean()
    assert left_out_ratio(blocks(errors[:3]), choose) is None
