import numpy as np
import pytest

from adaptune.geometry import from_quaternions, invert
from adaptune.simulation import MOTIONS, kernels
from adaptune.simulation.scenes import SCENES
from adaptune.simulation.world import APRON, Ride, Road


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
CLEAR = (0.0, 0.0, 0.0)


def receive(distance, *, cosine=1.0, reflectivity=0.5, air=CLEAR, dropout=0.0, n=2000, noise=0.0):
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
        kernels.Receiver(1.0, 100.0, noise, dropout),
        air,
        rng.random((2, n), np.float32),
        rng.standard_normal(n, np.float32),
    )


def test_each_column_is_cast_from_its_own_pose():
    T = from_quaternions([[10.0, 0.0, 1.0], [11.0, 2.0, 1.0]], [[0, 0, 0, 1], [0, 0, 1, 1]])
    looks = np.array([[[1.0, 0, 0], [0, 0, 1]], [[1.0, 0, 0], [0, 1, 0]]], np.float32)
    rays = kernels.aim(looks, T, np.array([10.0, 0.0, 0.0]))
    expected = [[0, 0, 1, 1, 0, 0], [0, 0, 1, 0, 0, 1], [1, 2, 1, 0, 1, 0], [1, 2, 1, -1, 0, 0]]
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


def test_fog_sends_echoes_of_its_own_and_hides_what_is_far():
    fog = (0.03, 0.02, 10.0)
    points, intensities, _ = receive(40.0, air=fog)
    early = points[:, 0] < 39.0
    # Chance of an echo between the sensor and ten metres, less those too near to be seen.
    np.testing.assert_allclose(early.sum() / 2000, np.exp(-0.02) - np.exp(-0.2), atol=0.03)
    assert intensities[early].max() < 5.0
    assert len(receive(80.0, air=(0.03, 0.0, 0.0))[2]) == 0


def test_rays_towards_a_moving_thing_are_seen_from_it():
    rays = np.array([[0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 1, 0], [0, 0, 0, -1, 0, 0]], np.float32)
    centres = np.repeat([[5.0, 0.5, 0.0]], 3, axis=0)
    picked, local = kernels.towards(rays, 1, centres, np.full(3, np.pi / 2), 1.0)
    assert picked.tolist() == [0]
    np.testing.assert_allclose(local[0], [-0.5, 5.0, 0.0, 0.0, -1.0, 0.0], atol=1e-6)


@pytest.fixture(scope="module", params=MOTIONS)
def ride(request):
    road = Road([(SCENES["street"], 60.0), (SCENES["field"], 60.0)], seed=1)
    return Ride(road, MOTIONS[request.param], seed=1), MOTIONS[request.param], road


def test_derivatives_belong_to_the_poses(ride):
    ride, _, _ = ride
    t, h = np.linspace(1.0, ride.duration - 1.0, 400), 1e-4
    before, now, after = ride.poses(t - h), ride.poses(t), ride.poses(t + h)
    velocity, turn = ride.velocities(t)
    np.testing.assert_allclose((after - before)[:, :3, 3] / (2 * h), velocity, atol=1e-5)
    R = invert(now) @ (after - before) / (2 * h)
    found = np.stack([R[:, 2, 1], R[:, 0, 2], R[:, 1, 0]], axis=1)
    np.testing.assert_allclose(found, turn, atol=1e-5)
    (v0, w0), (v1, w1) = ride.velocities(t - h), ride.velocities(t + h)
    acceleration, turn_rate = ride.accelerations(t)
    np.testing.assert_allclose((v1 - v0) / (2 * h), acceleration, atol=1e-4)
    np.testing.assert_allclose((w1 - w0) / (2 * h), turn_rate, atol=1e-4)


@pytest.mark.parametrize("name", MOTIONS)
def test_it_stands_before_it_drives_off(name):
    road, motion = Road([(SCENES["garden"], 60.0)], seed=1), MOTIONS[name]
    ride, before = Ride(road, motion, 1, 3.0), Ride(road, motion, 1)
    rest, t = np.arange(0.0, 2.3, 0.02), np.arange(0.0, ride.duration, 0.02)
    assert np.abs(ride.poses(rest) - ride.poses(rest[:1])).max() < 1e-6
    assert np.abs(np.concatenate(ride.accelerations(rest))).max() < 1e-3
    accelerations = np.linalg.norm(ride.accelerations(t)[0][:, :2], axis=1)
    assert accelerations[t < 6.0].max() < 1.5 * motion.acceleration + 1.0
    ends = ride.poses(np.array([ride.duration])), before.poses(np.array([before.duration]))
    assert np.abs(ends[0] - ends[1])[0, :3, 3].max() < 0.2
    assert ride.duration > before.duration + 3.0


def test_vehicle_keeps_to_its_limits_and_the_road(ride):
    ride, motion, road = ride
    t = np.arange(0.0, ride.duration, 0.02)
    T = ride.poses(t)
    speed = np.linalg.norm(np.diff(T[:, :2, 3], axis=0), axis=1) / 0.02
    assert speed.max() < 1.5 * motion.speed
    assert speed.min() > 0.2 * motion.speed
    s = road.station(T[:, 0, 3])
    x, y = road.plane(s, np.zeros_like(s))
    assert np.hypot(T[:, 0, 3] - x, T[:, 1, 3] - y).max() < 5.0 * motion.weave + 0.1
    height = T[:, 2, 3] - road.ground(x, y)
    assert np.abs(height - motion.height).max() < 0.35
    # It looks where it goes.
    ahead = np.einsum("ni,ni->n", T[:-1, :3, 0], np.diff(T[:, :3, 3], axis=0)) / 0.02 / speed
    assert ahead.min() > 0.9
