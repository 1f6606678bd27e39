"""Turns of a spinning LiDAR that drives straight ahead through a street of columns."""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from adaptune.recording import Imu, Scan

STEP = 0.4
"""Metres that the sensor moves along x between scans, and during one."""
PERIOD = 0.1
ROWS, COLUMNS = 32, 450
GRAVITY = 9.80665
T_SENSOR_IMU = np.array([[0.0, 1, 0, 0.3], [-1, 0, 0, -0.2], [0, 0, 1, 0.1], [0, 0, 0, 1]])


@cache
def turn(i: int, rows: int = ROWS, columns: int = COLUMNS, gain: float = 0.0) -> Scan:
    """Scan `i`, distorted by the motion, with the time and the laser of every point.

    With a `gain` the sensor gets faster: by so many metres a scan from one to the next.
    """
    rng = np.random.default_rng(i)
    share = np.arange(columns) / columns
    azimuth = np.pi - 2 * np.pi * (share + 0.5 / columns)
    elevation = np.radians(np.linspace(-16.0, 16.0, rows))
    direction = np.stack(
        np.broadcast_arrays(
            np.cos(elevation)[:, None] * np.cos(azimuth),
            np.cos(elevation)[:, None] * np.sin(azimuth),
            np.sin(elevation)[:, None],
        ),
        axis=-1,
    )
    origin = np.broadcast_to(way(i + share, gain), (rows, columns))
    distance = cast(origin, direction) + rng.normal(0.0, 0.01, (rows, columns))
    hit = distance < 60.0
    ring, _ = np.nonzero(hit)
    return Scan(
        i * round(PERIOD * 1e9),
        (distance[..., None] * direction)[hit].astype(np.float32),
        np.broadcast_to(PERIOD * share, hit.shape)[hit].astype(np.float32),
        ring.astype(np.uint16),
    )


def way(scans: NDArray[np.float64], gain: float) -> NDArray[np.float64]:
    """Metres driven in a time, in scans."""
    return STEP * scans + 0.5 * gain * scans**2


def measured(i: int, rows: int = 16, columns: int = 300) -> Scan:
    """Scan `i`, with what an IMU measured that lies turned beside the LiDAR."""
    stamps = np.arange(i * 10**8 + (0 if i == 0 else 10**7), (i + 1) * 10**8 + 1, 10**7)
    noise = np.random.default_rng(i).normal(0.0, 1e-3, (2, len(stamps), 3))
    imu = Imu(stamps, noise[0], noise[1] + [0.0, 0.0, GRAVITY], T_SENSOR_IMU)
    return replace(turn(i, rows, columns), imu=imu)


def cast(x: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Metres to the ground, two walls, two ends and columns, from (x, 0, 0)."""
    with np.errstate(divide="ignore"):
        planes = [
            -1.7 / np.minimum(direction[..., 2], -1e-9),
            9.0 / np.abs(direction[..., 1]),
            np.where(direction[..., 0] > 0, 30.0 - x, x + 20.0) / np.abs(direction[..., 0]),
        ]
    nearest = np.minimum.reduce(planes)
    rng = np.random.default_rng(7)
    for at, side, radius in zip(
        rng.uniform(-20.0, 30.0, 60),
        rng.choice([-1.0, 1.0], 60) * rng.uniform(4.0, 10.0, 60),
        rng.uniform(0.4, 1.5, 60),
        strict=True,
    ):
        a = direction[..., 0] ** 2 + direction[..., 1] ** 2
        b = direction[..., 0] * (x - at) - direction[..., 1] * side
        root = b**2 - a * ((x - at) ** 2 + side**2 - radius**2)
        far = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        nearest = np.where((root > 0) & (far > 0), np.minimum(nearest, far), nearest)
    return nearest
