"""The statistic of pairs: what it does not depend on, and how often its intervals hold."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptune.paired import Pair, in_cell, interval_of_mean, pooled, ratio

BLOCK = 10
seeds = st.integers(0, 2**32 - 1)


def windows(rng, n_blocks, block=BLOCK, hard=0.5):
    """Errors of two runs over windows that overlap, in places that are hard for both."""
    n = (n_blocks + 1) * block
    places = np.convolve(rng.normal(size=n + 60), np.ones(60) / 60**0.5, mode="valid")[:n]
    both = []
    common = rng.normal(size=(n, 3))
    for _ in range(2):
        steps = np.exp(hard * places)[:, None] * (common + rng.normal(size=(n, 3)))
        sums = np.cumsum(steps, axis=0)
        both.append(np.linalg.norm(sums[block:] - sums[:-block], axis=1))
    return np.array(both)


@given(seeds, st.floats(1e-3, 1e3), st.integers(2, 30))
def test_the_scale_of_errors_does_not_matter(seed, factor, n_blocks):
    errors = windows(np.random.default_rng(seed), n_blocks)
    plain, scaled = (ratio([Pair(by * errors, BLOCK)]) for by in (1.0, factor))
    assert scaled.value == pytest.approx(plain.value)
    assert scaled.error == pytest.approx(plain.error)
    assert (plain.interval is None) == (n_blocks < 4)
    if plain.interval:
        assert scaled.interval == pytest.approx(plain.interval)


@given(seeds, st.integers(1, 8), st.sampled_from([None, 0.1]))
def test_runs_that_change_places_have_the_reciprocal(seed, n, own):
    rng = np.random.default_rng(seed)
    pairs = [Pair(1.0 + windows(rng, 6), BLOCK, str(i), own) for i in range(n)]
    swapped = [pair._replace(errors=pair.errors[::-1]) for pair in pairs]
    one, other = ratio(pairs), ratio(swapped)
    assert other.value == pytest.approx(1.0 / one.value)
    assert other.interval == pytest.approx((1.0 / one.interval[1], 1.0 / one.interval[0]))
    assert one.interval[0] < one.value < one.interval[1]


@given(seeds, st.integers(1, 3), st.integers(1, 60), st.sampled_from([None, 0.3]))
def test_equal_errors_are_surely_equal(seed, n, frames, own):
    errors = np.random.default_rng(seed).lognormal(size=frames)
    assert ratio([Pair(np.stack([errors] * 2), BLOCK, str(i), own) for i in range(n)]) == (
        *(1.0, (1.0, 1.0), 0.0),
    )


@given(seeds, st.floats(0.2, 5.0))
def test_a_ratio_that_is_everywhere_the_same_is_known(seed, factor):
    errors = np.random.default_rng(seed).lognormal(size=100)
    low, high = ratio([Pair(np.stack([factor * errors, errors]), BLOCK)]).interval
    assert (low, high) == pytest.approx((factor, factor))


@pytest.mark.parametrize(("n_blocks", "share"), [(4, 0.05), (10, 0.05), (40, 0.05), (10, 0.01)])
def test_intervals_along_a_recording_hold_the_truth_as_often_as_they_say(n_blocks, share):
    rng, n, held = np.random.default_rng(0), 500, 0
    for _ in range(n):
        low, high = ratio([Pair(windows(rng, n_blocks), BLOCK)], share).interval
        held += low <= 1.0 <= high
    # Three standard errors, and 2 % for what is not normal.
    assert abs(held / n - (1.0 - share)) <= 3.0 * (share * (1.0 - share) / n) ** 0.5 + 0.02


@pytest.mark.parametrize("n_recordings", [3, 6, 12])
def test_intervals_over_recordings_do_so_too(n_recordings):
    rng, n, held = np.random.default_rng(1), 300, 0
    for _ in range(n):
        # With six, recordings may differ, and the interval speaks of others like these.
        own = np.exp(0.2 * rng.normal(size=n_recordings) * (n_recordings >= 6))
        errors = [windows(rng, 6) * np.array([[by], [1.0]]) for by in own]
        pairs = [Pair(one, BLOCK, str(i)) for i, one in enumerate(errors)]
        low, high = ratio(pairs).interval
        held += low <= 1.0 <= high
    assert 0.91 <= held / n <= 0.99


def test_neighbours_that_share_their_windows_count_once():
    errors = windows(np.random.default_rng(2), 20)
    alone, together = (ratio([Pair(errors, block)]).error for block in (1, BLOCK))
    assert together > 2.0 * alone


def test_the_parts_of_one_recording_are_one():
    rng = np.random.default_rng(3)
    errors = [windows(rng, 8) * [[by], [1.0]] for by in (0.5, 0.5, 0.5, 1.0, 1.0, 1.0)]
    apart = ratio([Pair(one, BLOCK, str(i)) for i, one in enumerate(errors)])
    parts = ratio([Pair(one, BLOCK, "hall") for one in errors])
    assert parts.value == apart.value
    assert parts.error < apart.error  # of this recording alone
    short = [Pair(one[:, : 3 * BLOCK], BLOCK, "hall") for one in errors]
    assert ratio(short).interval is None
    assert ratio([p._replace(recording=str(i)) for i, p in enumerate(short)]).interval is not None
    # Six parts of each of six recordings vary as six recordings do, not as 36.
    many = [p._replace(recording=str(i)) for i, p in enumerate(short) for _ in range(6)]
    once = ratio([p._replace(recording=str(i)) for i, p in enumerate(short)])
    assert ratio(many).error == pytest.approx(once.error)


def test_a_table_says_where_an_interval_is_none():
    said = [in_cell(ends) for ends in (None, (0.5, 1.25), (0.0, math.inf), (1.0, 1.0))]
    assert said == ["too few", "0.50-1.25", "too few", "the same"]


def test_less_than_two_blocks_say_nothing_of_how_sure_it_is():
    errors = windows(np.random.default_rng(4), 1)
    assert ratio([Pair(errors, BLOCK)]).error == math.inf
    assert ratio([Pair(errors[:, :1], BLOCK)])[1:] == (None, math.inf)


INF = float("inf")


@pytest.mark.parametrize(
    ("mine", "other", "own", "ends"),
    [
        (0.8, 1.0, 0.0, (0.8, 0.8)),
        # sqrt(0.8^2 - 0.6^2) / sqrt(1 - 0.6^2); sqrt(0.8^2 + 0.6^2)
        (0.8, 1.0, 0.6, (0.5291502622 / 0.8, 1.0)),
        (1.25, 1.0, 0.6, (1.25 / 1.1661903790, 1.3865424624)),
        (3.0, 2.0, 1.2, (3.0 / 2.3323807579, 2.7495454169 / 1.6)),
        (0.5, 1.0, 0.6, (0.0, 0.7810249676)),
        (0.55, 0.5, 0.6, (0.55 / 0.7810249676, INF)),
    ],
)
def test_what_the_reference_errs_is_in_the_interval(mine, other, own, ends):
    errors = np.array([[mine] * 80, [other] * 80])
    found = ratio([Pair(errors, BLOCK, reference_error=own / 1.5)])
    assert found.value == pytest.approx(mine / other)
    assert found.interval == pytest.approx(ends)
    # Over several recordings, it is the mean of the logarithms.
    plain = Pair(errors, BLOCK, "plain")
    both = ratio([plain, Pair(errors, BLOCK, "estimated", own / 1.5)]).interval
    assert both == pytest.approx(tuple((end * mine / other) ** 0.5 for end in ends))


def test_a_mean_has_an_interval_too():
    rng = np.random.default_rng(5)
    errors = 2.0 + 0.1 * rng.normal(size=400)
    low, high = interval_of_mean(errors, 4, None)
    assert 1.9 < low < errors.mean() < high < 2.1
    wider = interval_of_mean(errors, 4, 1.0)
    # Chance is small here: the reference alone would move the mean to the first two.
    alone = (errors.mean() ** 2 - 1.5**2) ** 0.5, (errors.mean() ** 2 + 1.5**2) ** 0.5
    assert (low**2 - 1.5**2) ** 0.5 < wider[0] < alone[0] < alone[1] < wider[1]
    assert wider[1] < (high**2 + 1.5**2) ** 0.5
    assert interval_of_mean(errors, 4, 10.0)[0] == 0.0
    assert interval_of_mean(errors[:15], 4, None) is None


def test_figures_of_a_run_pool_with_their_own_errors():
    found = pooled(np.log([1.2, 1.2]), np.array([0.02, 0.02]), np.array([2.0, 2.0]), ["a", "b"])
    assert found.value == pytest.approx(1.2)
    assert found.error == pytest.approx(0.02 / 2**0.5)
    # Student's, of four degrees of freedom.
    assert math.log(found.interval[1] / 1.2) == pytest.approx(2.776 * found.error, rel=1e-3)
