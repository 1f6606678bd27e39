from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_passes import straight

from adaptune.metrics import window_ends
from adaptune.reference.stored import (
    BREAK,
    HALVES_TO_WHOLE,
    OF_BOTH,
    EstimatedReference,
    Registrations,
)

NONE = np.zeros(0, np.intp)
NO_REGISTRATIONS = Registrations(NONE, NONE, NONE.astype(bool), NONE.astype(float))


def reference(n=101, seconds=0.1, lost=(), step=0.3, halves=None):
    """A straight path; `seconds` from scan to scan; motions in `lost` cannot be trusted."""
    intervals = np.broadcast_to(np.round(np.multiply(seconds, 1e9)).astype(np.int64), n - 1)
    stamps = 10**18 + np.concatenate([[0], np.cumsum(intervals)])
    trusted = np.ones(n - 1, bool)
    trusted[list(lost)] = False
    T = straight(n, step)
    halves = np.stack([T, T]) if halves is None else halves
    return EstimatedReference(stamps, T, trusted, halves, NO_REGISTRATIONS)


@st.composite
def references(draw):
    """At any rate, with pauses, and with motions that cannot be trusted."""
    n = draw(st.integers(2, 60))
    usual = draw(st.sampled_from([0.02, 0.1, 0.5, 1.0, 1.1, 3.0]))
    lost = draw(st.sets(st.integers(0, n - 2), max_size=6))
    pauses = draw(st.dictionaries(st.integers(0, n - 2), st.floats(0.001, 20.0), max_size=4))
    seconds = np.full(n - 1, usual)
    seconds[list(pauses)] = list(pauses.values())
    return reference(n, seconds, lost)


@given(references())
@settings(max_examples=200, deadline=None)
def test_a_motion_that_is_not_trusted_leaves_a_gap(found):
    known = np.flatnonzero(found.known)
    for i in np.flatnonzero(~found.trusted):
        before, after = known[known <= i][-1], known[known > i]
        if len(after):
            assert after[0] - before >= 2
            assert found.stamps[after[0]] - found.stamps[before] > BREAK * 1e9


@given(references())
@settings(max_examples=200, deadline=None)
def test_no_more_is_left_out_than_must_be(found):
    known = found.known
    assert known[0]
    for i in np.flatnonzero(~known):
        lost = np.flatnonzero(~found.trusted[:i])
        assert len(lost)
        last = lost[-1]
        assert i == last + 1 or found.stamps[i] - found.stamps[last] <= BREAK * 1e9


@given(references(), st.sampled_from([0.1, 0.3, 1.0, 5.0]))
@settings(max_examples=200, deadline=None)
def test_no_sub_trajectory_crosses_a_motion_that_is_not_trusted(found, length):
    ends = window_ends(found.trajectory().at(found.stamps), length)
    untrusted = np.flatnonzero(~found.trusted)
    for start in np.flatnonzero(ends >= 0):
        assert not ((untrusted >= start) & (untrusted < ends[start])).any()


@given(references())
@settings(max_examples=200, deadline=None)
def test_gaps_are_where_poses_are_unknown(found):
    seconds = (found.stamps - found.stamps[0]) * 1e-9
    gaps, inside = found.gaps(), np.zeros(len(seconds), bool)
    for first, stop, _ in gaps:
        assert first < stop
        inside |= (seconds > first) & (seconds < stop)
    assert all(stop <= first for (_, stop, _), (first, *_) in pairwise(gaps))
    inside[-1] |= bool(gaps) and gaps[-1][1] == seconds[-1] and not found.known[-1]
    np.testing.assert_array_equal(inside, ~found.known)


def test_a_gap_lasts_from_the_last_known_pose_to_the_next():
    found = reference(lost=[20, 25])
    assert found.gaps()[0][:2] == pytest.approx((2.0, 3.6))
    assert found.unknown_share() == pytest.approx(15 / 101)
    assert reference(lost=[99]).gaps()[0][:2] == pytest.approx((9.9, 10.0))
    assert reference(lost=[0]).gaps()[0][:2] == pytest.approx((0.0, 1.1))
    assert reference().gaps() == []
    assert reference().unknown_share() == 0.0


def test_the_path_counts_as_far_as_it_is_known():
    assert reference().path() == pytest.approx(30.0)
    # Ten poses are left out, and so eleven motions.
    assert reference(lost=[20]).path() == pytest.approx(30.0 - 11 * 0.3)


def too_long(n, share, step=0.3):
    return np.stack([straight(n, step), straight(n, step * (1.0 + share))])


@pytest.mark.parametrize(("share", "length"), [(0.01, 5.0), (0.002, 20.0), (0.0, 5.0)])
def test_the_error_follows_from_how_the_halves_differ(share, length):
    found = reference(halves=too_long(101, share))
    # A sub-trajectory ends at the first pose beyond its length.
    way = 0.3 * np.floor(length / 0.3 + 1.0)
    differ = 100.0 * share * way / length
    expected = np.hypot(HALVES_TO_WHOLE * differ, OF_BOTH)
    assert found.error(length) == pytest.approx(expected, rel=1e-6)


def test_the_error_does_not_count_where_poses_are_unknown():
    halves = too_long(101, 0.01)
    halves[1, 21:, 1, 3] += 5.0  # they part where the reference is lost
    found = reference(lost=[20], halves=halves)
    assert found.error(5.0) == pytest.approx(reference(halves=too_long(101, 0.01)).error(5.0))
    assert reference(halves=halves).error(5.0) > 5 * found.error(5.0)


@pytest.mark.parametrize(("lost", "length"), [([], 31.0), ([30, 60], 12.0), ([0], 30.0)])
def test_the_error_is_unknown_over_more_than_the_path(lost, length):
    assert np.isnan(reference(lost=lost).error(length))
    assert np.isfinite(reference(lost=lost).error(5.0))
