import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rooms import moved, scan_at, street, tunnel

from adaptune.live.hops import (
    CLIP,
    METRES,
    NOISE,
    SECONDS,
    HopCloud,
    HopErrors,
    HopSquares,
    blend,
    clip_to_best,
    hop_squares,
    register,
)
from adaptune.model import weights
from adaptune.model.weights import minimum_variance_weights
from adaptune.recording.scan import Scan

ERRORS = arrays(np.float64, (6, 4, 3), elements=st.floats(-1.0, 1.0))
OFFSETS = arrays(np.float64, (6, 1, 3), elements=st.floats(-0.2, 0.2))


def hops(errors, start=None, length=10.0):
    n = len(errors)
    start = 10.0 * np.arange(n) if start is None else np.asarray(start, float)
    return HopErrors(np.asarray(errors, float), start, start + length, np.arange(n, dtype=float))


def empty(n_members):
    return HopErrors(np.empty((0, n_members, 3)), *np.empty((3, 0)))


@settings(deadline=None)  # SciPy is imported when it is first needed
@given(ERRORS, st.floats(0.0, 2.0))
def test_what_all_members_share_changes_no_weights(errors, constant):
    """Such as the registration's own error."""
    products = hop_squares(hops(errors)).products + 0.1 * np.eye(4)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(weights, "EVEN_SHARE", 0.0)
        plain, shifted = map(minimum_variance_weights, (products, products + constant))
    np.testing.assert_allclose(shifted, plain, atol=1e-5)


@given(ERRORS, OFFSETS)
def test_an_offset_of_a_hop_moves_all_errors_and_none_is_clipped_for_it(errors, offset):
    apart, missing = clip_to_best(errors + offset)
    np.testing.assert_allclose(apart, errors + offset, atol=1e-12)
    assert not missing.any()


def test_products_are_means_over_hops():
    errors = np.zeros((2, 2, 3))
    errors[0, 0], errors[0, 1], errors[1, 1] = [1.0, 2.0, 0.0], [2.0, 0.0, 1.0], [0.0, 2.0, 0.0]
    found = hop_squares(hops(errors))
    np.testing.assert_allclose(found.products, [[2.5, 1.0], [1.0, 4.5]])
    assert hop_squares(empty(2)) is None


def test_a_member_that_departs_from_the_others_counts_up_to_a_limit():
    errors = np.zeros((1, 3, 3))
    errors[:, 2, 0] = 40.0
    kept, _ = clip_to_best(errors)
    np.testing.assert_allclose(kept[0, :, 0], [0.0, 0.0, CLIP])
    # If all err alike it is the place, or the registration, and nobody is clipped.
    kept, _ = clip_to_best(errors * 0.0 + 40.0)
    np.testing.assert_allclose(kept, 40.0)


def test_a_member_without_a_pose_counts_as_lost():
    errors = np.ones((2, 3, 3))
    errors[1, 1] = np.nan
    found = hop_squares(hops(errors))
    np.testing.assert_allclose(found.products.diagonal(), [3.0, 3.0 + CLIP**2 / 2, 3.0])
    np.testing.assert_allclose(found.products[0, 2], 3.0)
    # Nobody had one.
    found = hop_squares(hops(np.full((1, 2, 3), np.nan)))
    np.testing.assert_allclose(found.products, CLIP**2 * np.eye(2))


@pytest.mark.parametrize(
    ("start", "windows"),
    [
        ([0.0], 1.0),
        ([0.0, 10.0, 20.0], 3.0),
        ([0.0, 5.0], 1.5),
        ([0.0, 1.0, 2.0, 3.0, 4.0, 5.0], 1.5),
        ([30.0, 0.0], 2.0),  # what lies between them was not driven
        ([0.0, 0.0, 0.0], 1.0),
    ],
)
def test_windows_are_counted_by_the_path_that_they_cover(start, windows):
    assert hop_squares(hops(np.ones((len(start), 2, 3)), start)).windows == pytest.approx(windows)


@pytest.mark.parametrize("length", [10.0, 5.0])
def test_the_registrations_own_part_grows_with_shorter_hops(length):
    found = hop_squares(hops(np.ones((3, 2, 3)), length=length))
    assert found.noise == pytest.approx((100.0 * NOISE / length) ** 2)


def test_a_hop_counts_while_it_is_young_or_near():
    old = hops(np.zeros((1, 1, 3)))
    kept = old.recent(METRES, SECONDS + 9.0)
    assert len(kept.errors) == 1
    assert len(old.recent(METRES + 1.0, SECONDS).errors) == 1
    assert [len(a) for a in old.recent(METRES + 1.0, SECONDS + 1.0)] == [0, 0, 0, 0]
    every = empty(1)
    for i in range(500):
        every = every.with_hop(np.full((1, 3), float(i)), 1.0 * i, 1.0 * i + 10.0, 1.0 * i)
    assert len(every.errors) <= SECONDS + 1
    assert every.errors[-1, 0, 0] == 499.0


def test_a_prior_and_measurements_weigh_by_their_windows():
    prior = np.array([[1.0, 0.5], [0.5, 4.0]])
    # Squares of 3 and 12 without noise: the same comparison as the prior, at a harder place.
    measured = HopSquares(3.0 * prior + 1.0, 1.0, 2.0)
    np.testing.assert_allclose(blend(prior, 2.0, measured), prior + 1.0 / 6.0)
    other = HopSquares(prior[::-1, ::-1], 0.0, 6.0)
    np.testing.assert_allclose(blend(prior, 2.0, other), 0.25 * prior + 0.75 * prior[::-1, ::-1])
    np.testing.assert_array_equal(blend(prior, 2.0, None), prior)


def test_measurements_without_error_and_with_nothing_but_noise_are_finite():
    for products, noise in ((np.zeros((2, 2)), 0.0), (np.full((2, 2), 0.01), 5.0)):
        found = blend(np.eye(2), 3.0, HopSquares(products, noise, 4.0))
        assert np.isfinite(found).all()
        assert (found.diagonal() > 0.0).all()
    assert np.isfinite(blend(np.zeros((2, 2)), 3.0, HopSquares(np.eye(2), 0.0, 1.0))).all()


def test_where_a_member_had_no_pose_it_may_count_as_the_worst():
    errors = np.zeros((2, 3, 3))
    errors[:, 1, 0] = 2.0
    errors[0, 2] = np.nan
    found = hops(errors).filled(np.array([False, False, True]))
    np.testing.assert_array_equal(found.errors[0, 2], [2.0, 0.0, 0.0])
    np.testing.assert_array_equal(found.errors[1], errors[1])
    # Others are not, and nobody is where there is nobody to compare with.
    for known, who in ((errors, [True, True, False]), (np.full((1, 3, 3), np.nan), [True] * 3)):
        np.testing.assert_array_equal(hops(known).filled(np.array(who)).errors, known)


def cloud(scan):
    return HopCloud(scan, np.eye(4), 0.0)


def hop(world, far=10.0, guess=None, other=None):
    guess = moved(far + 0.4, 0.1) if guess is None else guess
    end = scan_at(world if other is None else other, far)
    return register(cloud(scan_at(world, 0.0)), cloud(end), [guess])


def test_it_finds_the_motion():
    found = hop(street())
    np.testing.assert_allclose(found.T_start_end, moved(10.0), atol=0.03)
    np.testing.assert_allclose(found.projection, np.eye(3), atol=1e-6)


def test_the_first_sound_guess_wins():
    start, end = (cloud(scan_at(street(), x)) for x in (0.0, 10.0))
    far_off = moved(10.0, 0.0, 60.0)
    assert register(start, end, [far_off]) is None
    found = register(start, end, iter([far_off, moved(10.3)]))
    np.testing.assert_allclose(found.T_start_end, moved(10.0), atol=0.03)
    assert register(start, end, []) is None


def test_scans_that_share_no_place_are_rejected():
    elsewhere = np.random.default_rng(0).uniform(-5.0, 25.0, (3000, 3)) - np.array([0.0, 10, 10])
    assert hop(street(), other=elsewhere) is None


@pytest.mark.parametrize("n", [0, 3, 99])
def test_a_scan_of_few_points_is_rejected(n):
    whole = scan_at(street(), 10.0)
    few = Scan(0, whole.points[:n])
    for pair in ((whole, few), (few, whole)):
        assert register(*map(cloud, pair), [np.eye(4)]) is None


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_a_tunnel_says_nothing_along_itself(yaw):
    """The projection is in the frame of the start."""
    turn = moved(yaw=yaw)
    start, end = (scan_at(tunnel(seed=seed), x) for seed, x in enumerate((0.0, 10.0)))
    turned = Scan(0, (end.points @ turn[:3, :3]).astype(np.float32))
    found = register(cloud(start), cloud(turned), [moved(10.5, 0.1, yaw=yaw)])
    np.testing.assert_allclose(found.projection, np.diag([0.0, 1.0, 1.0]), atol=0.05)
    error = found.T_start_end[:3, 3] - [10.0, 0.0, 0.0]
    assert np.linalg.norm(found.projection @ error) < 0.05


def test_points_with_times_are_compensated():
    whole = scan_at(street(), 10.0)
    times = np.linspace(-0.1, 0.0, len(whole.points)).astype(np.float32)
    # The sensor moved 2 m while it scanned: points were seen from farther behind.
    smeared = whole.points - np.outer(times / 0.1 * 2.0, [1.0, 0.0, 0.0])
    scan = Scan(0, smeared.astype(np.float32), times=times)
    start = cloud(scan_at(street(), 0.0))
    plain, compensated = (
        register(start, HopCloud(scan, moved(2.0), seconds), [moved(10.0)])
        for seconds in (0.0, 0.1)
    )
    np.testing.assert_allclose(compensated.T_start_end, moved(10.0), atol=0.04)
    assert plain is None or abs(plain.T_start_end[0, 3] - 10.0) > 0.1
