import numpy as np
import pytest

from adaptune.geometry import from_quaternions
from adaptune.simulation import SCENES, kernels
from adaptune.simulation.world import APRON, Road


@pytest.fixture(scope="module")
def road():
    return Road([(SCENES[n], 40.0) for n in ("cave", "street", "garden", "open")], seed=3)


def test_stations_and_coordinates_are_inverse(road):
    s = np.linspace(-APRON, road.length + APRON, 500)
    x, _ = road.plane(s, np.zeros_like(s))
    assert np.all(np.diff(x) > 0.0)
    np.testing.assert_allclose(road.station(x), s, atol=1e-9)


def test_scenes_share_the_ground_without_a_step(road):
    s = np.linspace(-30.0, 190.0, 4401)
    np.testing.assert_allclose(sum(share for _, share in road.shares(s)), 1.0)
    for d in (0.0, 8.0, -20.0):
        z = road.ground(*road.plane(s, np.full_like(s, d)))
        # A kerb and a river bank are steep; a step would be more.
        assert np.abs(np.diff(z)).max() < 0.2, d


AHEAD = np.array([[1.0, 0.0, 0.0]], np.float32)


def receive(distance, *, cosine=1.0, reflectivity=0.5, dropout=0.0, n=2000, noise=0.0):
    rng = np.random.default_rng(0)
    looks = np.repeat(AHEAD, n, axis=0)
    normals = np.repeat([[-cosine, (1.0 - cosine**2) ** 0.5, 0.0]], n, axis=0).astype(np.float32)
    return kernels.receive(
        looks,
        kernels.Cast(
            np.column_stack([np.zeros((n, 3), np.float32), looks]),
            np.full(n, distance, np.float32),
            normals,
            np.full(n, reflectivity, np.float32),
        ),
        (1.0, 100.0, noise, dropout),
        rng.random(n, np.float32),
        rng.standard_normal(n, np.float32),
    )


def test_each_column_is_cast_from_its_own_pose():
    T = from_quaternions([[10.0, 0.0, 1.0], [11.0, 2.0, 1.0]], [[0, 0, 0, 1], [0, 0, 1, 1]])
    looks = np.array([[[1.0, 0, 0], [0, 0, 1]], [[1.0, 0, 0], [0, 1, 0]]], np.float32)
    rays = kernels.aim(looks, T, np.array([10.0, 0.0, 0.0]))
    expected = [
        [0, 0, 1, 1, 0, 0],
        [0, 0, 1, 0, 0, 1],
        [1, 2, 1, 0, 1, 0],
        [1, 2, 1, -1, 0, 0],
    ]
    np.testing.assert_allclose(rays, expected, atol=1e-6)


def test_noise_lies_along_the_ray():
    points, _, kept = receive(20.0, noise=0.02)
    assert len(kept) == 2000
    np.testing.assert_allclose(points[:, 0].mean(), 20.0, atol=2e-3)
    np.testing.assert_allclose(points[:, 0].std(), 0.02, rtol=0.1)
    assert not points[:, 1:].any()


def test_intensity_follows_material_and_incidence():
    assert receive(5.0)[1][0] == np.rint(255 * 0.5)
    assert receive(5.0, cosine=0.5)[1][0] == np.rint(255 * 0.25)


def test_range_limits_and_weak_echoes():
    assert len(receive(0.9)[2]) == 0
    assert len(receive(99.0, reflectivity=0.1)[2]) == 2000
    assert len(receive(101.0)[2]) == 0
    # A dark or grazing target is seen half as far for a quarter of the light.
    assert len(receive(51.0, reflectivity=0.025)[2]) == 0
    assert len(receive(49.0, reflectivity=0.025)[2]) == 2000
    assert len(receive(np.inf)[2]) == 0


def test_dropouts():
    assert 0.08 < 1.0 - len(receive(5.0, dropout=0.1)[2]) / 2000 < 0.12
