import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms import moved
from scipy.spatial.transform import Rotation

from adaptune.geometry import (
    from_quaternions,
    invert,
    mean_motion,
    rectify,
    rotation_angle,
    scale,
    to_quaternions,
)
from adaptune.trajectory import Trajectory

modest = settings(max_examples=40, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def random_poses(seed, *shape, size=50.0):
    """Rigid transforms of shape (*shape, 4, 4)."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (*shape, 1, 1))
    count = int(np.prod(shape))
    T[..., :3, :3] = Rotation.random(count, rng=rng).as_matrix().reshape(*shape, 3, 3)
    T[..., :3, 3] = rng.uniform(-size, size, (*shape, 3))
    return T


@modest
@given(seeds)
def test_inverse_undoes(seed):
    T = random_poses(seed, 2, 3)
    identity = np.broadcast_to(np.eye(4), T.shape)
    np.testing.assert_allclose(invert(T) @ T, identity, atol=1e-12)
    np.testing.assert_allclose(T @ invert(T), identity, atol=1e-12)
    np.testing.assert_allclose(invert(T), np.linalg.inv(T), atol=1e-12)
    np.testing.assert_array_equal(invert(T)[1, 2], invert(T[1, 2]))


@modest
@given(seeds, st.floats(1e-12, 1e-4))
def test_rectified_rotations_are_rotations(seed, noise):
    exact = random_poses(seed, 4)
    T = exact.copy()
    T[:, :3, :3] += np.random.default_rng(seed).uniform(-noise, noise, (4, 3, 3))
    before = T.copy()
    R = rectify(T)[:, :3, :3]
    # The error is squared.
    excess = R @ np.swapaxes(R, 1, 2) - np.eye(3)
    assert np.abs(excess).max() < 30 * noise**2 + 1e-14
    assert np.abs(R - exact[:, :3, :3]).max() < 4 * noise
    np.testing.assert_array_equal(T, before)
    np.testing.assert_array_equal(rectify(T)[:, :, 3], T[:, :, 3])


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-8, 1e-3, 1.0, np.pi / 2, 3.0, np.pi - 1e-9, np.pi]
)
def test_rotation_angle(angle):
    rng = np.random.default_rng(3)
    for _ in range(5):
        axis = rng.normal(size=3)
        T = moved(x=3.0)
        T[:3, :3] = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
        assert rotation_angle(T) == pytest.approx(angle, rel=1e-7, abs=1e-14)
    assert rotation_angle(np.tile(T, (2, 3, 1, 1))).shape == (2, 3)


@modest
@given(seeds)
def test_quaternions_and_back(seed):
    T = random_poses(seed, 5)
    q = to_quaternions(T)
    assert (q[:, 3] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(from_quaternions(T[:, :3, 3], q), T, atol=1e-12)


# Of the present day, where a double no longer holds nanoseconds.
BEGIN = 1_700_000_000_123_456_789


@modest
@given(seeds, st.integers(0, 5 * 10**8))
def test_interpolation_follows_a_screw_free_motion(seed, offset):
    T = random_poses(seed, 2)
    stamps = BEGIN + np.array([0, 5 * 10**8])
    got = Trajectory(stamps, T).at(stamps[:1] + offset)[0]
    share = offset / (5 * 10**8)
    np.testing.assert_allclose(
        got[:3, 3], (1 - share) * T[0, :3, 3] + share * T[1, :3, 3], atol=1e-6
    )
    turn = Rotation.from_matrix(T[0, :3, :3]).inv() * Rotation.from_matrix(T[1, :3, :3])
    R = Rotation.from_matrix(T[0, :3, :3]) * Rotation.from_rotvec(share * turn.as_rotvec())
    np.testing.assert_allclose(got[:3, :3], R.as_matrix(), atol=1e-6)
    np.testing.assert_array_equal(got[3], [0, 0, 0, 1])


def test_nothing_is_interpolated_outside_or_in_gaps():
    stamps = np.array([0, 10, 20, 50, 60])
    T = np.array([moved(x=float(s)) for s in stamps])
    at = np.array([-1, 0, 5, 15, 20, 21, 35, 49, 50, 55, 60, 61])
    x = Trajectory(stamps, T).at(at, 10e-9)[:, 0, 3]
    nan = np.nan
    np.testing.assert_allclose(x, [nan, 0, 5, 15, 20, nan, nan, nan, 50, 55, 60, nan])
    x = Trajectory(stamps, T).at(at, 30e-9)[:, 0, 3]
    np.testing.assert_allclose(x, [nan, 0, 5, 15, 20, 21, 35, 49, 50, 55, 60, nan])
    x = Trajectory(stamps, T).at(at, 9e-9)[:, 0, 3]
    np.testing.assert_allclose(x, [nan, 0, nan, nan, 20, nan, nan, nan, 50, nan, 60, nan])


@modest
@given(seeds, st.integers(1, 5))
def test_a_motion_scaled_is_a_motion_repeated(seed, n):
    T = random_poses(seed, size=1.0)
    np.testing.assert_allclose(np.linalg.matrix_power(scale(T, 1.0 / n), n), T, atol=1e-9)
    assert scale(T, 1.0) is T
    np.testing.assert_allclose(scale(T, 0.0), np.eye(4), atol=1e-12)
    rounded = T.copy()
    rounded[3, 3] -= 1e-13
    np.testing.assert_array_equal(scale(rounded, 0.5), scale(T, 0.5))


def test_the_mean_of_motions_is_a_motion_between_them():
    screws = np.array([[0.1, 0.2, 0.3, 1.0, 2.0, 3.0], [0.1, 0.2, 0.5, 3.0, 2.0, 1.0]])
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(screws[:, :3]).as_matrix()
    T[:, :3, 3] = screws[:, 3:]
    for weights, expected in (([3.0, 1.0], [1.5, 2.0, 2.5]), ([0.0, 2.0], screws[1, 3:])):
        mean = mean_motion(T, np.array(weights))
        assert mean[3].tolist() == [0.0, 0.0, 0.0, 1.0]
        np.testing.assert_allclose(mean[:3, 3], expected)
        np.testing.assert_allclose(mean[:3, :3] @ mean[:3, :3].T, np.eye(3), atol=1e-12)
        turn = Rotation.from_matrix(mean[:3, :3]).as_rotvec()
        between = weights @ screws[:, :3] / np.sum(weights)
        np.testing.assert_allclose(turn, between, atol=2e-4)
    # Far apart: half of a right turn.
    right = np.tile(np.eye(4), (2, 1, 1))
    right[1, :3, :3] = Rotation.from_rotvec([0.0, 0.0, np.pi / 2]).as_matrix()
    half = Rotation.from_matrix(mean_motion(right, np.ones(2))[:3, :3]).as_rotvec()
    np.testing.assert_allclose(half, [0.0, 0.0, np.pi / 4], atol=1e-9)
