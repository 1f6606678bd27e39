import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms import along_x
from scipy.spatial.transform import Rotation

from adaptune.metrics import (
    absolute_error,
    kitti_error,
    relative_error,
    sub_trajectory_rte,
    travelled,
    window_ends,
)

modest = settings(max_examples=40, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def walk(rng, n, step=1.0, turn=0.1):
    """Poses of a random walk forward, of shape (n, 4, 4)."""
    T = np.tile(np.eye(4), (n, 1, 1))
    for i in range(1, n):
        move = np.eye(4)
        move[:3, :3] = Rotation.from_rotvec(rng.normal(0, turn, 3)).as_matrix()
        move[:3, 3] = [step * rng.uniform(0.3, 1.7), *rng.normal(0, 0.1 * step, 2)]
        T[i] = T[i - 1] @ move
    return T


def drift(rng, T, size=0.02):
    """An estimate of `T` whose every step is a little wrong."""
    est = T.copy()
    for i in range(1, len(T)):
        wrong = np.eye(4)
        wrong[:3, :3] = Rotation.from_rotvec(rng.normal(0, size, 3)).as_matrix()
        wrong[:3, 3] = rng.normal(0, size, 3)
        est[i] = est[i - 1] @ np.linalg.inv(T[i - 1]) @ T[i] @ wrong
    return est


def plain_end(T_ref, start, length):
    """First frame further than `length` from `start` along the reference; None without."""
    distance = 0.0
    for j in range(start, len(T_ref)):
        if np.isnan(T_ref[j]).any():
            return None
        if j > start:
            distance += math.dist(T_ref[j, :3, 3], T_ref[j - 1, :3, 3])
        if distance > length:
            return j
    return None


def plain_error(T_ref, T_est, start, end):
    """inv(dEst) dGt."""
    d_gt = np.linalg.inv(T_ref[start]) @ T_ref[end]
    d_est = np.linalg.inv(T_est[start]) @ T_est[end]
    return np.linalg.inv(d_est) @ d_gt


def plain_rte(T_ref, T_est, length, restarted):
    errors = []
    for start in range(len(T_ref)):
        end = plain_end(T_ref, start, length)
        if end is None:
            errors.append(math.nan)
        elif any(restarted[start + 1 : end + 1]):
            errors.append(math.inf)
        else:
            t = plain_error(T_ref, T_est, start, end)[:3, 3]
            errors.append(100 * math.hypot(*t) / length)
    return errors


def plain_kitti(T_ref, T_est, lengths, stride):
    translations, rotations, used = [], [], []
    for start in range(0, len(T_ref), stride):
        for length in lengths:
            end = plain_end(T_ref, start, length)
            if end is None:
                continue
            E = plain_error(T_ref, T_est, start, end)
            translations.append(math.hypot(*E[:3, 3]) / length)
            cosine = (np.trace(E[:3, :3]) - 1) / 2
            rotations.append(math.acos(min(1, max(-1, cosine))) / length)
            used.append(length)
    return 100 * np.mean(translations), math.degrees(np.mean(rotations)), tuple(sorted(set(used)))


@modest
@given(seeds, st.integers(0, 60), st.floats(0.5, 30.0), st.booleans(), st.booleans())
def test_rte_follows_its_definition(seed, n, length, gaps, restarts):
    rng = np.random.default_rng(seed)
    T_ref = walk(rng, n)
    T_est = drift(rng, T_ref)
    if gaps:
        T_ref[rng.random(n) < 0.05] = np.nan
    restarted = rng.random(n) < (0.1 if restarts else 0.0)
    want = plain_rte(T_ref, T_est, length, restarted)
    got = sub_trajectory_rte(T_ref, T_est, length, restarted)
    np.testing.assert_allclose(got, want, rtol=1e-7, atol=1e-9)
    if not restarts:
        np.testing.assert_array_equal(got, sub_trajectory_rte(T_ref, T_est, length))


@modest
@given(seeds)
def test_kitti_error_follows_its_definition(seed):
    rng = np.random.default_rng(seed)
    T_ref = walk(rng, 80)
    T_est = drift(rng, T_ref)
    lengths, stride = (5.0, 20.0, 60.0, 1000.0), int(rng.integers(1, 12))
    want = plain_kitti(T_ref, T_est, lengths, stride)
    got = kitti_error(T_ref, T_est, lengths, stride)
    assert got.translation == pytest.approx(want[0])
    assert got.rotation == pytest.approx(want[1])
    assert got.lengths == want[2]


def test_the_end_is_the_first_frame_beyond_the_length():
    # At the length itself is not beyond it.
    T = along_x([0, 1, 2, 3, 3, 4, 6, 6.5])
    np.testing.assert_array_equal(window_ends(T, 2.0), [3, 5, 6, 6, 6, 7, -1, -1])
    np.testing.assert_array_equal(window_ends(T, 6.5), [-1] * 8)
    np.testing.assert_array_equal(window_ends(T[:0], 1.0), [])
    np.testing.assert_array_equal(window_ends(T[:1], 1.0), [-1])


def test_errors_worked_by_hand():
    T_ref, T_est = along_x([0.0, 1.0, 2.0, 3.0]), along_x([0.0, 1.1, 2.1, 3.3])
    assert relative_error(T_ref, T_est) == pytest.approx(np.sqrt((0.01 + 0.0 + 0.04) / 3))
    # Aligned on a line, what is left are the departures 0, 0.1, 0.1, 0.3 from their mean.
    assert absolute_error(T_ref, T_est) == pytest.approx(np.std([0.0, 0.1, 0.1, 0.3]))
    T_ref[2] = np.nan
    assert relative_error(T_ref, T_est) == pytest.approx(0.1)
    assert absolute_error(T_ref, T_est) == pytest.approx(np.std([0.0, 0.1, 0.3]))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_estimate_that_is_not_finite_is_a_failure(bad):
    T_ref = along_x(range(9))
    T_est = T_ref.copy()
    T_est[4, :3] = bad
    errors = sub_trajectory_rte(T_ref, T_est, 1.5)
    assert np.isinf(errors[[2, 4]]).all()
    assert np.isnan(errors).tolist() == [False] * 7 + [True] * 2


@pytest.mark.parametrize("noise", [0.0, 0.015, 0.05, 0.1])
@pytest.mark.parametrize("rate", [1, 10, 20, 100])
def test_a_robot_that_stands_travels_nothing_by_the_jitter_of_its_poses(rate, noise):
    x = np.concatenate([np.zeros(180 * rate), np.arange(0.0, 30.0, 1.5 / rate)])
    T = along_x(x)
    T[:, :3, 3] += np.random.default_rng(0).normal(0.0, noise, (len(T), 3))
    metres = travelled(T)
    assert metres[180 * rate - 1] < 1.0
    assert metres[-1] == pytest.approx(30.0, rel=0.15 if noise else 0.06)
    assert (np.diff(metres) >= 0.0).all()
    T[5:8] = np.nan
    assert travelled(T)[-1] == pytest.approx(metres[-1], abs=1.0)
