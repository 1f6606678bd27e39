import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptune.model.ndt import ndt_histogram

modest = settings(max_examples=20, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def street(seed=0, n=4000, turn=0.0):
    """Points of a ground, two walls, poles and a few bushes, float32 of shape (about n, 3)."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (n, 3))
    ground = np.c_[25 * u[:, 0], 25 * u[:, 1], np.full(n, -1.73)][: n // 3]
    walls = np.c_[30 * u[:, 0], 9.3 * np.sign(u[:, 1]), 4 + 5 * u[:, 2]][: n // 3]
    at = rng.uniform(-20, 20, (12, 2))[rng.integers(0, 12, n // 6)]
    poles = np.c_[at, rng.uniform(-1.7, 5, n // 6)]
    at = rng.uniform(-15, 15, (6, 3))[rng.integers(0, 6, n // 6)]
    points = np.concatenate([ground, walls, poles, at + rng.normal(0, 0.5, at.shape)])
    points += rng.normal(0, 0.02, points.shape)
    return (points @ turn_z(turn).T).astype(np.float32)


def turn_z(angle):
    return np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )


def plain_histogram(points):
    """The same by np.linalg.eigh, a cell at a time."""
    points = np.asarray(points, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    counts = np.zeros((10, 9))
    cells = {}
    for point in points:
        cells.setdefault(tuple(np.floor(point).astype(int)), []).append(point)
    for members in cells.values():
        if len(members) < 6:
            continue
        mean = np.mean(members, axis=0)
        distance = int(np.hypot(mean[0], mean[1]) / 3.0)
        values, vectors = np.linalg.eigh(np.cov(np.transpose(members), bias=True))
        if distance >= 10 or values[2] < 1e-12:
            continue
        counts[distance, plain_shape(values, vectors)] += 1
    return counts.ravel()


def plain_shape(values, vectors):
    (l3, l2, l1), (v3, _, v1) = values, vectors.T
    if l2 / l1 < 0.1:
        return min(2, int(3 * abs(v1[2])))
    if l3 / l2 < 0.1:
        return 3 + min(2, int(3 * abs(v3[2])))
    return 6 + (0 if l2 / l1 < 0.25 else 1 if l2 / l1 < 0.5 else 2)


@modest
@given(seeds)
def test_histogram_follows_its_definition(seed):
    points = street(seed)
    histogram = ndt_histogram(points)
    assert histogram.sum() > 50
    np.testing.assert_array_equal(histogram, plain_histogram(points))


@modest
@given(seeds, st.floats(0.01, 0.3), st.floats(0.01, 1.0), st.floats(0.01, 1.0))
def test_any_shape_follows_its_definition(seed, size, second, third):
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = []
    for _ in range(20):
        cell = rng.integers([-31, -31, -20], [31, 31, 20]) + 0.5
        points.append(
            np.clip(rng.normal(size=(40, 3)) * size * np.array([1, second, third]), -0.45, 0.45)
            @ rotation.T
            * 0.55
            + cell
        )
    points = np.concatenate(points).astype(np.float32)
    np.testing.assert_array_equal(ndt_histogram(points), plain_histogram(points))


LINE, PLANE = (0.1, 0.02, 0.01), (0.1, 0.1, 0.01)


@modest
@given(seeds, st.sampled_from([1, 2, 3]))
def test_quarter_turns_change_nothing(seed, quarters):
    points = street(seed)
    x, y, z = points[(points[:, :2] % 1 != 0).all(axis=1)].T
    for _ in range(quarters):
        x, y = -y, x
    turned = np.stack([x, y, z], axis=1)
    np.testing.assert_array_equal(ndt_histogram(turned), ndt_histogram(points))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_do_not_count(bad):
    points = street()
    rows = np.repeat(points[:300], 2, axis=0)
    rows[np.arange(600), np.arange(600) % 3] = bad
    mixed = np.random.default_rng(0).permutation(np.concatenate([points, rows]))
    np.testing.assert_array_equal(ndt_histogram(mixed), ndt_histogram(points))
    assert ndt_histogram(rows).sum() == 0
