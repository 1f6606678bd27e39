"""The histogram of the shapes of a scan's NDT cells.

After Magnusson, Andreasson, Nüchter and Lilienthal, *Appearance-based loop detection from 3D laser
data using the normal distributions transform*, ICRA 2009, and Koide et al., IROS 2021. The papers
leave the constants open; they are set here.
"""

import numpy as np
from numpy.typing import NDArray

from adaptune._system.compiled import compiled
from adaptune.recording.scan import Scan

CELL_SIZE = 1.0
"""Metres; a cell has an edge at the origin."""
MIN_POINTS = 6
SHAPE_RATIO = 0.1
"""Below this ratio of eigenvalues one of them counts as vanishing."""
SPHERE_CUTS = (0.25, 0.5)
"""Of l2/l1, between the three classes of spherical cells."""
DISTANCE_BIN = 3.0
N_DISTANCES = 10
N_CLASSES = 9
N_FEATURES = N_DISTANCES * N_CLASSES
SPAN = 128
"""Cells across, more than there can be within the last bin."""
Z_LIMIT = 1_000_000
"""Metres and cells; beyond it the number of a cell would overflow."""


@compiled
def _eigenvalues(c: NDArray[np.float64]) -> tuple[float, float, float]:
    """Eigenvalues, falling, of a symmetric matrix given as xx, yy, zz, xy, xz, yz."""
    q = ((c[0] + c[1]) + c[2]) / 3.0
    off = (c[3] * c[3] + (c[4] * c[4] + c[5] * c[5])) * 2.0
    xx, yy, zz = c[0] - q, c[1] - q, c[2] - q
    p = np.sqrt(((xx * xx + yy * yy) + zz * zz + off) / 6.0)
    if p <= 1e-15 * abs(q):
        return q, q, q
    determinant = (
        xx * yy * zz
        + 2.0 * c[3] * (c[4] * c[5])
        - (xx * c[5] * c[5] + yy * c[4] * c[4])
        - zz * c[3] * c[3]
    )
    r = min(1.0, max(-1.0, 0.5 * determinant / (p * p * p)))
    angle = np.arccos(r) / 3.0
    l1 = q + 2.0 * p * np.cos(angle)
    l3 = q + 2.0 * p * np.cos(angle + 2.0 * np.pi / 3.0)
    return l1, 3.0 * q - l1 - l3, l3


@compiled
def _tilt(c: NDArray[np.float64], value: float) -> float:
    """Absolute z of the unit eigenvector to a simple eigenvalue."""
    # The rows of c - value * I span the plane across the eigenvector: the longest of their cross
    # products is the best conditioned.
    xx, yy, zz = c[0] - value, c[1] - value, c[2] - value
    xy, xz, yz = c[3], c[4], c[5]
    best, tilt = -1.0, 0.0
    ax, ay, az = xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy
    bx, by, bz = xy * zz - xz * yz, xz * xz - xx * zz, xx * yz - xy * xz
    cx, cy, cz = yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz
    for x, y, z in ((ax, ay, az), (bx, by, bz), (cx, cy, cz)):
        norm = x * x + y * y + z * z
        if norm > best:
            best = norm
            tilt = abs(z) / np.sqrt(norm) if norm > 0.0 else 0.0
    return tilt


@compiled
def _accumulate(points: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Sum up the points of every cell.

    Returns (n_cells, 10) sums of 1, x, y, z, xx, yy, zz, xy, xz, yz about the cell's centre, and
    the number of each cell.
    """
    n = len(points)
    size = 1024
    while size < 2 * n:
        size *= 2
    mask = size - 1
    slots = np.full(size, -1, np.int32)
    keys = np.empty(n, np.int64)
    sums = np.empty((n, 10), np.float64)
    cells, cell, last = 0, -1, -1
    # A cell with its mean within the last bin has no point further out than this.
    reach = DISTANCE_BIN * N_DISTANCES + 1.5 * CELL_SIZE
    limit = reach * reach
    for i in range(n):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        # Also false for what is not a number.
        if not (x * x + y * y <= limit and abs(z) <= Z_LIMIT):
            continue
        kx, ky = int(np.floor(x / CELL_SIZE)), int(np.floor(y / CELL_SIZE))
        kz = int(np.floor(z / CELL_SIZE))
        key = (kz + 2 * Z_LIMIT) * SPAN * SPAN + (ky + SPAN // 2) * SPAN + (kx + SPAN // 2)
        # Neighbours in a scan often share their cell.
        if key != last:
            last = key
            slot = ((key * 0x9E3779B97F4A7C1) >> 24) & mask
            while True:
                cell = slots[slot]
                if cell < 0:
                    cell = cells
                    slots[slot] = cell
                    keys[cell] = key
                    sums[cell] = 0.0
                    cells += 1
                    break
                if keys[cell] == key:
                    break
                slot = (slot + 1) & mask
        x, y = x - (kx + 0.5) * CELL_SIZE, y - (ky + 0.5) * CELL_SIZE
        z -= (kz + 0.5) * CELL_SIZE
        s = sums[cell]
        s[0] += 1.0
        s[1] += x
        s[2] += y
        s[3] += z
        s[4] += x * x
        s[5] += y * y
        s[6] += z * z
        s[7] += x * y
        s[8] += x * z
        s[9] += y * z
    return sums[:cells], keys[:cells]


@compiled
def _histogram(points: NDArray[np.float32]) -> NDArray[np.float64]:
    counts = np.zeros(N_FEATURES)
    sums, keys = _accumulate(points)
    c = np.empty(6)
    for cell in range(len(sums)):
        s = sums[cell]
        n = s[0]
        if n < MIN_POINTS:
            continue
        mx, my, mz = s[1] / n, s[2] / n, s[3] / n
        x = (keys[cell] % SPAN - SPAN // 2 + 0.5) * CELL_SIZE + mx
        y = (keys[cell] // SPAN % SPAN - SPAN // 2 + 0.5) * CELL_SIZE + my
        distance = np.hypot(x, y)
        distance_bin = int(distance / DISTANCE_BIN)
        if distance_bin >= N_DISTANCES:
            continue
        c[0] = s[4] / n - mx * mx
        c[1] = s[5] / n - my * my
        c[2] = s[6] / n - mz * mz
        c[3] = s[7] / n - mx * my
        c[4] = s[8] / n - mx * mz
        c[5] = s[9] / n - my * mz
        l1, l2, l3 = _eigenvalues(c)
        if l1 < 1e-12:
            continue  # one point, seen many times, has no shape
        if l2 < SHAPE_RATIO * l1:
            shape = min(2, int(3.0 * _tilt(c, l1)))
        elif l3 < SHAPE_RATIO * l2:
            shape = 3 + min(2, int(3.0 * _tilt(c, l3)))
        else:
            ratio = l2 / l1
            shape = 6 + (ratio >= SPHERE_CUTS[0]) + (ratio >= SPHERE_CUTS[1])
        counts[distance_bin * N_CLASSES + shape] += 1.0
    return counts


def ndt_histogram(points: NDArray[np.float32]) -> NDArray[np.float64]:
    """Count the NDT cells of a scan by distance and shape.

    The feature vector of Magnusson et al. (2009), and the environment descriptor ``E_i`` of Koide
    et al. (2021) before its principal components.

    Cells are linear (l2/l1 < 0.1), planar (l3/l2 < 0.1) or spherical, where l1 >= l2 >= l3 are the
    eigenvalues of the points' covariance. Linear cells are classified by thirds of abs(z) of their
    direction, planar cells by thirds of abs(z) of their normal, spherical cells by l2/l1. A turn
    of the sensor about z changes nothing. Points (n, 3) that are not finite do not count.

    Returns shape (90,): nine classes for each of ten distances, the distance running slowest.
    """
    return np.asarray(_histogram(np.ascontiguousarray(points, np.float32)))


def describe(scan: Scan) -> NDArray[np.float64]:
    """`ndt_histogram` of a scan."""
    return ndt_histogram(scan.points)
