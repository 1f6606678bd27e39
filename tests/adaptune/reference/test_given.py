import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_passes import straight
from rooms import moved, scan_at, street

from adaptune.live.hops import Hops
from adaptune.reference.check import MeasuredReference, mean_difference, measure_reference
from adaptune.trajectory import Trajectory

WORLD = street()


def hops_of(T, starts, reach=10):
    ends = [start + reach for start in starts]
    true = [np.linalg.inv(T[start]) @ T[end] for start, end in zip(starts, ends, strict=True)]
    return Hops(
        np.array(starts, np.intp),
        np.array(ends, np.intp),
        np.array(true).reshape(-1, 4, 4),
        np.tile(np.eye(3), (len(starts), 1, 1)),
    )


def measured(T_ref, T_true, starts):
    stamps = 10**8 * np.arange(len(T_ref), dtype=np.int64)
    return MeasuredReference(stamps, T_ref, hops_of(T_true, starts))


@given(st.floats(0.9, 1.1), st.sampled_from([10.0, 20.0, 40.0]))
@settings(max_examples=30, deadline=None)
def test_a_reference_of_wrong_scale_is_wrong_by_it_over_every_length(scale, length):
    T = straight(121, 1.0)
    T_ref = straight(121, scale)
    found = measured(T_ref, T, range(110)).error(length)
    # The share of what it says, not of what is true.
    assert found.mean == pytest.approx(100.0 * abs(1.0 - 1.0 / scale), rel=0.05, abs=1e-9)
    assert found.low <= found.mean <= found.high


def test_noise_counts_less_over_a_longer_way():
    T, rng = straight(400, 1.0), np.random.default_rng(0)
    T_ref = T.copy()
    T_ref[:, :3, 3] += rng.normal(0.0, 0.1, (400, 3))
    of = measured(T_ref, T, range(0, 390, 5))
    errors = [of.error(length).mean for length in (10.0, 25.0, 50.0, 100.0)]
    assert errors == sorted(errors, reverse=True)
    # Two ends, three axes.
    assert errors[0] == pytest.approx(10.0 * 0.1 * np.sqrt(2.0 * 3.0), rel=0.15)
    # Over less than a registration, as many metres.
    assert of.error(5.0).mean == pytest.approx(2.0 * errors[0])


def test_no_chain_leads_over_poses_that_are_unknown():
    T = straight(60, 1.0)
    T_ref = T.copy()
    T_ref[30:, 1, 3] += 5.0
    T_ref[30] = np.nan
    starts = [*range(0, 20, 2), *range(31, 49, 2)]
    of = measured(T_ref, T, starts)
    assert of.error(25.0).mean == pytest.approx(0.0, abs=1e-6)
    # Neither part is as long.
    assert of.error(50.0) is None


def recording(n, every=10**8):
    class Scans(list):
        n_messages = n - 2  # about

    return Scans(scan_at(WORLD, i, 10**9 + every * i, i) for i in range(n))


def test_scans_tell_how_wrong_a_reference_is():
    scans, told = recording(55), []
    stamps = np.array([scan.stamp for scan in scans])
    right, wrong = straight(55, 1.0), straight(55, 1.02)
    errors = []
    for T in (right, wrong):
        # Stamps between those of the scans: poses are interpolated.
        late = Trajectory(np.append(stamps[0], stamps[1:] - 5 * 10**7), _half_a_step_back(T))
        of = measure_reference(scans, late, lambda done, n: told.append((done, n)))
        assert np.isnan(of.T_ref_sensor[-1]).all()
        np.testing.assert_allclose(of.T_ref_sensor[:-1], T[:-1], atol=1e-6)
        errors.append(of.error(10.0).mean)
    assert errors[0] < 0.5
    assert errors[1] == pytest.approx(2.0, abs=0.5)
    assert told[0] == (1, 53)
    assert told[54] == (53, 53)
    assert told[55] == (55, 55)


def _half_a_step_back(T):
    back = T.copy()
    back[1:, 0, 3] -= 0.5 * (T[1, 0, 3] - T[0, 0, 3])
    return back


def test_the_difference_of_two_is_their_mean_error_where_both_are_known():
    one = straight(50, 1.0)
    other = moved(x=3.0, y=1.0, yaw=0.4) @ straight(50, 1.03)
    assert mean_difference(one, other, 10.0) == pytest.approx(3.3, abs=0.01)  # over 11 m
    other[20] = np.nan
    assert mean_difference(one, other, 10.0) == pytest.approx(3.3, abs=0.01)
    assert mean_difference(other, one, 10.0) == pytest.approx(3.3, abs=0.4)
    assert np.isnan(mean_difference(one, other, 40.0))
    assert np.isfinite(one).all()
