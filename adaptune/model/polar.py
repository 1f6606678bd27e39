"""Descriptors of a scan laid out around the sensor, which turning about z does not change.

Points are sorted into rows and, by azimuth, into columns; each row is described by the share of
its cells that are filled, by their mean and standard deviation, and by the mean step from a cell
to the next. After the ring key of Kim and Kim, *Scan Context*, IROS 2018, and statistics of range
images as in Cop, Borges and Dubé, *DELIGHT*, ICRA 2018.
"""

import numba
import numpy as np
from numpy.typing import NDArray

from adaptune.recording import Scan

RING = 3.0
"""Metres between rings."""
N_RINGS = 10
N_SECTORS = 60
ELEVATIONS = (-0.5, 0.5)
"""Radians; points beyond are left out."""
N_ELEVATIONS = 16
N_COLUMNS = 180
MIN_RANGE = 0.1
"""Metres; nearer points are on the sensor itself."""


@numba.njit(cache=True, nogil=True)
def _greatest(
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    values: NDArray[np.float64],
    shape: tuple[int, int],
) -> NDArray[np.float64]:
    """Greatest value in each cell, NaN in empty ones; values outside are left out."""
    grid = np.full(shape, np.nan)
    for i in range(len(values)):
        r, c = rows[i], columns[i] % shape[1]
        if 0 <= r < shape[0] and not values[i] <= grid[r, c]:
            grid[r, c] = values[i]
    return grid


def _statistics(grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share filled, mean, standard deviation and mean step of each row, one after the other."""
    filled = ~np.isnan(grid)
    known = np.where(filled, grid, 0.0)
    n = np.maximum(filled.sum(axis=1), 1)
    mean = known.sum(axis=1) / n
    variance = np.where(filled, (grid - mean[:, None]) ** 2, 0.0).sum(axis=1) / n
    # Rows are closed: the last cell is next to the first.
    pairs = filled & np.roll(filled, -1, axis=1)
    steps = np.where(pairs, np.abs(np.roll(grid, -1, axis=1) - grid), 0.0)
    step = steps.sum(axis=1) / np.maximum(pairs.sum(axis=1), 1)
    return np.concatenate([filled.mean(axis=1), mean, np.sqrt(variance), step])


def _columns(points: NDArray[np.float64], n: int) -> NDArray[np.int64]:
    share = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * np.pi) + 0.5
    return (share * n).astype(np.int64)


def ring_heights(scan: Scan) -> NDArray[np.float64]:
    """Heights of what stands around the sensor: the highest point of each sector of each ring.

    `_statistics` of ten rings of 3 m, in metres above the sensor, of shape (40,).
    """
    points = scan.points.astype(np.float64)
    rings = (np.hypot(points[:, 0], points[:, 1]) / RING).astype(np.int64)
    grid = _greatest(rings, _columns(points, N_SECTORS), points[:, 2].copy(), (N_RINGS, N_SECTORS))
    return _statistics(grid)


def range_image(scan: Scan) -> NDArray[np.float64]:
    """Logarithms of the ranges to what is nearest in each direction.

    `_statistics` of 16 rows from 0.5 rad below the horizon to 0.5 rad above it, of shape (64,).
    """
    points = scan.points.astype(np.float64)
    distance = np.linalg.norm(points, axis=1)
    points, distance = points[distance > MIN_RANGE], distance[distance > MIN_RANGE]
    low, high = ELEVATIONS
    elevation = np.arcsin(points[:, 2] / distance)
    rows = np.floor((elevation - low) / (high - low) * N_ELEVATIONS).astype(np.int64)
    shape = (N_ELEVATIONS, N_COLUMNS)
    return _statistics(-_greatest(rows, _columns(points, N_COLUMNS), -np.log(distance), shape))
