"""LiDARs: their rays, rates and noise."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Sensor:
    """A LiDAR."""

    # Radians above the sensor's horizon, by the ring number its driver gives: upwards on Velodynes,
    # downwards on Ousters. On a Livox, the offset of each of its lines, of shape (n_rings,).
    elevations: NDArray[np.float64]
    columns: int  # firings in a turn; all rings fire at once
    rate: float  # turns in a second
    # Least and greatest range in metres. The greatest holds for a target that reflects a tenth of
    # the light or more and is met squarely.
    range: tuple[float, float]
    noise: float  # standard deviation of a range in metres
    dropout: float  # share of echoes lost for no reason
    # Whether it turns about its vertical axis, or draws a rosette ahead which never repeats.
    pattern: Literal["spin", "rosette"] = "spin"

    @property
    def rings(self) -> int:
        """Lasers that fire at once."""
        return len(self.elevations)


def _hdl64e() -> NDArray[np.float64]:
    """Two blocks of 32 lasers: a third of a degree apart above, half a degree below."""
    upper = 2.0 - np.arange(32) / 3.0
    lower = -8.83 - 0.5 * np.arange(32)
    elevations: NDArray[np.float64] = np.radians(np.concatenate([upper, lower])[::-1])
    return elevations


SENSORS: Mapping[str, Sensor] = MappingProxyType(
    {
        "vlp16": Sensor(
            np.radians(np.arange(-15.0, 16.0, 2.0)), 1800, 10.0, (0.5, 100.0), 0.015, 0.005
        ),
        # 900 columns, half of what it can do, keep a scan at 28,800 rays.
        "hdl32e": Sensor(
            np.radians(10.67 - (4.0 / 3.0) * np.arange(31, -1, -1)),
            900,
            10.0,
            (1.0, 100.0),
            0.015,
            0.005,
        ),
        "hdl64e": Sensor(_hdl64e(), 2083, 10.0, (0.9, 120.0), 0.015, 0.005),
        "os0-64": Sensor(
            np.radians(np.linspace(45.0, -45.0, 64)), 1024, 10.0, (0.3, 50.0), 0.015, 0.005
        ),
        "os1-128": Sensor(
            np.radians(np.linspace(22.5, -22.5, 128)), 1024, 10.0, (0.5, 120.0), 0.015, 0.005
        ),
        "avia": Sensor(
            np.radians((np.arange(6) - 2.5) * 0.6), 4000, 10.0, (1.0, 190.0), 0.02, 0.005, "rosette"
        ),
    }
)
"""LiDARs by name."""

_PRISMS = (7294.0 / 60.0, -4664.0 / 60.0)
"""Turns in a second of the two prisms of a Livox. Their ratio closes no rosette within hours."""

_FIELD = np.radians((70.4, 77.2)) / 2.0
"""Half of the Avia's horizontal and vertical field of view."""


@cache
def _spin(name: str, columns: int) -> NDArray[np.float32]:
    elevations = SENSORS[name].elevations
    # A Velodyne turns clockwise seen from above. The seam lies behind, away from what is ahead.
    azimuth = np.pi - 2.0 * np.pi * np.arange(columns) / columns
    directions = np.empty((columns, len(elevations), 3), np.float32)
    directions[..., 0] = np.cos(azimuth)[:, None] * np.cos(elevations)
    directions[..., 1] = np.sin(azimuth)[:, None] * np.cos(elevations)
    directions[..., 2] = np.sin(elevations)
    directions.setflags(write=False)
    return directions


def _rosette(sensor: Sensor, times: NDArray[np.float64]) -> NDArray[np.float32]:
    first, second = (2.0 * np.pi * f * times for f in _PRISMS)
    lines = sensor.elevations - sensor.elevations.mean()
    azimuth = _FIELD[0] * (np.cos(first) + np.cos(second)) / 2.0
    elevation = (_FIELD[1] - lines.max()) * (np.sin(first) + np.sin(second)) / 2.0
    elevation = elevation[:, None] + lines
    directions = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth)[:, None],
            np.cos(elevation) * np.sin(azimuth)[:, None],
            np.sin(elevation),
        ],
        axis=-1,
    )
    return directions.astype(np.float32)


def directions(name: str, columns: int, start: float, rate: float) -> NDArray[np.float32]:
    """Where a sensor looks during one scan.

    Parameters
    ----------
    name
        A name from `SENSORS`.
    columns
        Firings in the scan.
    start
        Seconds since the recording's start at which the scan starts.
    rate
        Scans in a second.

    Returns
    -------
    ndarray of shape (columns, n_rings, 3)
        float32 unit vectors in the sensor's frame: x ahead, y to the left, z up.
    """
    sensor = SENSORS[name]
    if sensor.pattern == "spin":
        return _spin(name, columns)
    return _rosette(sensor, start + np.arange(columns) / (columns * rate))
