"""Simulated measurements of an inertial measurement unit."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import invert
from adaptune.simulation.ride import Ride
from adaptune.simulation.rig import NOISE, T_IMU_LIDAR

GRAVITY = 9.80665
"""m/s^2, downwards along the world's z axis."""


class Inertial(NamedTuple):
    """Angular velocities (rad/s) and specific forces (m/s^2) in the IMU's frame, of shape (n, 3).

    The specific force points up at rest.
    """

    gyro: NDArray[np.float64]
    accel: NDArray[np.float64]


def ideal(ride: Ride, times: NDArray[np.float64]) -> Inertial:
    """Measure without any error, at seconds since the recording's start, of shape (n,)."""
    T_lidar_imu = invert(T_IMU_LIDAR)
    R_lidar_imu, lever = T_lidar_imu[:3, :3], T_lidar_imu[:3, 3]
    R_world_lidar = ride.poses(times)[:, :3, :3]
    _, turn = ride.velocities(times)
    acceleration, turn_rate = ride.accelerations(times)
    # Rotation accelerates the IMU, which is not at the LiDAR's origin.
    round_ = np.cross(turn_rate, lever) + np.cross(turn, np.cross(turn, lever))
    force = acceleration + np.array([0.0, 0.0, GRAVITY])
    force = np.einsum("nji,nj->ni", R_world_lidar, force) + round_
    return Inertial(turn @ R_lidar_imu, force @ R_lidar_imu)


def measure(ride: Ride, times: NDArray[np.float64], rate: float, seed: int) -> Inertial:
    """Measure with biases that wander, and white noise, at times that are `rate` a second.

    `seed` is that of the errors; see `ideal`.
    """
    rng = np.random.default_rng([seed, 5])
    truth = ideal(ride, times)

    def error(start: float, walk: float, noise: float) -> NDArray[np.float64]:
        shape = (len(times), 3)
        bias = rng.normal(0.0, start, 3)
        bias = bias + np.cumsum(rng.normal(0.0, walk / np.sqrt(rate), shape), axis=0)
        return np.asarray(bias + rng.normal(0.0, noise * np.sqrt(rate), shape))

    gyro = truth.gyro + error(2e-3, NOISE.gyroscope_walk, NOISE.gyroscope)
    return Inertial(gyro, truth.accel + error(2e-2, NOISE.accelerometer_walk, NOISE.accelerometer))
