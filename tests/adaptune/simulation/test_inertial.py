import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adaptune.geometry import invert
from adaptune.simulation import MOTIONS, SCENES
from adaptune.simulation.record import GRAVITY, T_IMU_LIDAR, ideal, measure
from adaptune.simulation.world import Ride, Road

RATE = 400


@pytest.fixture(scope="module")
def ride():
    return Ride(Road([(SCENES["garden"], 60.0)], seed=2), MOTIONS["robot"], seed=2)


def test_integrating_the_measurements_gives_the_truth_back(ride):
    # At the middle of each interval, so that the sums are exact to second order.
    n = 10 * RATE
    gyro, accel = ideal(ride, (np.arange(n) + 0.5) / RATE)
    borders = np.arange(n + 1) / RATE
    T_world_imu = ride.poses(borders) @ invert(T_IMU_LIDAR)
    R = Rotation.from_matrix(T_world_imu[0, :3, :3])
    velocity = (T_world_imu[1] - T_world_imu[0])[:3, 3] * RATE
    position = T_world_imu[0, :3, 3].copy()
    for i in range(n):
        half = Rotation.from_rotvec(gyro[i] * (0.5 / RATE))
        force = (R * half).apply(accel[i]) - [0.0, 0.0, GRAVITY]
        position += velocity / RATE + force * (0.5 / RATE**2)
        velocity += force / RATE
        R = R * half * half
    drift = (R.inv() * Rotation.from_matrix(T_world_imu[-1, :3, :3])).magnitude()
    assert drift < 1e-4
    # The first velocity is only known to half an interval's acceleration: ten seconds of it.
    assert np.linalg.norm(position - T_world_imu[-1, :3, 3]) < 0.05


def test_errors_are_biases_and_noise_of_the_said_density(ride):
    times = np.arange(20 * RATE) / RATE
    truth, measured = ideal(ride, times), measure(ride, times, RATE, seed=4)
    again = measure(ride, times, RATE, seed=4)
    np.testing.assert_array_equal(measured[0], again[0])
    for found, ideal_, noise, bias in (
        (measured[0], truth[0], 5.2e-5, 2e-3),
        (measured[1], truth[1], 5.9e-4, 2e-2),
    ):
        error = found - ideal_
        np.testing.assert_allclose(
            np.diff(error, axis=0).std() / 2**0.5, noise * RATE**0.5, rtol=0.05
        )
        assert 0.05 * bias < np.abs(error.mean(axis=0)).max() < 4.0 * bias
