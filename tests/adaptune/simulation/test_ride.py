import numpy as np
import pytest

from adaptune.geometry import invert
from adaptune.simulation import MOTIONS, SCENES
from adaptune.simulation.world import Ride, Road


@pytest.fixture(scope="module", params=MOTIONS)
def ride(request):
    road = Road([(SCENES["street"], 60.0), (SCENES["garden"], 60.0)], seed=1)
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


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("standstill", [1.0, 4.0])
def test_it_stands_first_and_then_takes_the_same_road(name, standstill):
    road, motion = Road([(SCENES["street"], 60.0)], seed=1), MOTIONS[name]
    drives, stands = Ride(road, motion, 1), Ride(road, motion, 1, standstill)
    at_rest = np.linspace(0.0, standstill - 0.7, 50)
    T = stands.poses(at_rest)
    np.testing.assert_allclose(T, np.broadcast_to(T[0], T.shape), atol=2e-3)
    for found in (*stands.velocities(at_rest), *stands.accelerations(at_rest)):
        assert np.abs(found).max() < 0.02
    assert stands.duration > drives.duration + standstill
    moving = np.linspace(standstill, stands.duration, 400)
    acceleration, _ = stands.accelerations(moving)
    assert (
        np.linalg.norm(acceleration, axis=1).max()
        < 2.0 * motion.speed
        + np.linalg.norm(
            drives.accelerations(np.linspace(0.0, drives.duration, 400))[0], axis=1
        ).max()
    )
    ends = [ride.poses(np.array([ride.duration]))[0, :3, 3] for ride in (drives, stands)]
    np.testing.assert_allclose(*ends, atol=0.3)
