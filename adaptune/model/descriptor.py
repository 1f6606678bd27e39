"""Descriptors by name, one or several of them."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, BinaryIO, Self

import numba
import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.decomposition import PCA

from adaptune import plugins, processes
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses, invert, rotation_angle
from adaptune.odometry import wire
from adaptune.recording import Scan

# The motion of the sensor, computed from the poses of the scans before.


MOTION = "motion"
"""Name of the descriptor that is filled in from poses."""
SECOND = 10**9
"""Nanoseconds over which motion is measured."""


def unknown(scan: Scan) -> NDArray[np.float64]:  # noqa: ARG001 - poses give it
    """Zeros in place of the motion until the poses are known, of shape (2,)."""
    return np.zeros(2)


def speed_and_turn_rate(stamps: NDArray[np.int64], T_odom_sensor: Poses) -> NDArray[np.float64]:
    """Metres and radians a second over the last second before each pose, of shape (n, 2).

    Stamps are rising nanoseconds. The motion is zero at the first pose. Unknown poses (NaN) take
    the motion of the last known one.
    """
    known = np.flatnonzero(np.isfinite(T_odom_sensor).all(axis=(1, 2)))
    if not len(known):
        return np.zeros((len(stamps), 2))
    at, T = stamps[known], T_odom_sensor[known]
    before = np.maximum(np.searchsorted(at, at - SECOND, side="right") - 1, 0)
    T_before_now = invert(T[before]) @ T
    seconds = np.maximum((at - at[before]) * 1e-9, 1e-9)
    moved = np.linalg.norm(T_before_now[:, :3, 3], axis=1)
    motion = np.column_stack([moved, rotation_angle(T_before_now)]) / seconds[:, None]
    latest = np.searchsorted(known, np.arange(len(stamps)), side="right") - 1
    return np.asarray(motion[np.maximum(latest, 0)])


def fill_in(
    descriptors: NDArray[np.float32], blocks: Mapping[str, int], motion: NDArray[np.float64]
) -> None:
    """Write the motion (..., 2) into the block of the motion descriptor, if there is one.

    Descriptors are of shape (..., n_features); `blocks` are their numbers by name, in order.
    """
    begin = 0
    for name, size in blocks.items():
        if name == MOTION:
            descriptors[..., begin : begin + size] = motion
        begin += size


Descriptor = Callable[[Scan], NDArray[np.floating]]
"""Describes any scan, even an empty one, by the same number of finite numbers."""

ENTRY_POINTS = "adaptune.descriptors"
"""Group in which other packages announce their descriptors, each by its name."""

DESCRIPTORS = {
    "ndt": "adaptune.model.descriptor:describe",
    "ring_heights": "adaptune.model.polar:ring_heights",
    "range_image": "adaptune.model.polar:range_image",
    "fpfh": "adaptune.model.fpfh:fpfh",
    "intensity": "adaptune.model.intensity:intensity",
    MOTION: "adaptune.model.descriptor:unknown",
}


class DescriptorError(AdaptuneError):
    """A descriptor that does not exist or does not describe a scan."""


_SERVICE = processes.Service("adaptune.model.descriptor")
_SECONDS = 60.0
"""A descriptor of the user may take so long for a scan."""


def where(name: str) -> str:
    """Where the function of a descriptor is, as ``module:function``, without importing it.

    `name` is one of `DESCRIPTORS`, one that an installed package announces in the entry-point group
    ``adaptune.descriptors``, or ``module:function``; else there is a DescriptorError.
    """
    try:
        return plugins.path_of(name, "descriptor", DESCRIPTORS, ENTRY_POINTS, "function")
    except plugins.PluginError as error:
        raise DescriptorError(str(error)) from error


def descriptor(name: str) -> Descriptor:
    """Function of a descriptor, see `where`; a DescriptorError if there is none."""
    try:
        found = plugins.load(name, where(name), "function")
    except plugins.PluginError as error:
        raise DescriptorError(str(error)) from error
    if not callable(found):
        raise DescriptorError(f"{name}: is not a function from a scan to an array")
    describe: Descriptor = found
    return describe


def check_descriptor(name: str) -> None:
    """Refuse a name that leads to no descriptor; the user's are imported elsewhere."""
    path = where(name)
    if name not in DESCRIPTORS:
        try:
            processes.server(_SERVICE, path)
        except processes.HostError as error:
            raise DescriptorError(str(error)) from error


# What runs in a process of its own for a descriptor of the user, see `adaptune.processes`.


def load(name: str) -> None:
    """Import a descriptor."""
    descriptor(name)


def serve(reader: processes.Readable, writer: BinaryIO, name: str) -> None:
    """Describe scan after scan."""
    describe = descriptor(name)

    def answer(message: processes.Message) -> dict[str, Any]:
        return {"described": np.asarray(describe(wire.to_scan(message)), np.float32)}

    processes.answer_all(reader, writer, answer)


def _elsewhere(name: str) -> Descriptor:
    """Function of a descriptor of the user that runs in a process of its own."""
    bounds = processes.Bounds(_SECONDS, late=f"a scan took longer than {_SECONDS:g} s")
    process = processes.Hosted(_SERVICE, where(name), "serve", bounds)

    def describe(scan: Scan) -> NDArray[np.float32]:
        try:
            header = {"type": "describe", "stamp": scan.stamp}
            return process.ask(header, **wire.scan_arrays(scan)).arrays["described"]
        except processes.HostError as error:
            raise DescriptorError(f"{error}; this was scan {scan.stamp}") from error

    return describe


class Describer:
    """Describes scans by one or several descriptors, of these names (see `descriptor`).

    The motion descriptor stays zero. `adaptune.model.descriptor.fill_in` fills it in.

    Attributes
    ----------
    blocks : dict
        By name, in order, how many numbers each descriptor has.
    """

    def __init__(self, names: Iterable[str]):
        self._functions = {
            name: descriptor(name) if name in DESCRIPTORS else _elsewhere(name) for name in names
        }
        self.blocks: dict[str, int] = {}
        # This also loads compiled code before the first scan.
        nothing = Scan(0, np.empty((0, 3), np.float32))
        self.blocks = {name: len(self._describe(name, nothing)) for name in self._functions}

    def __call__(self, scan: Scan) -> NDArray[np.float32]:
        """The descriptors one after the other, of shape (n_features,).

        A DescriptorError names one that is not finite or has another shape than for other scans.
        """
        return np.concatenate([self._describe(name, scan) for name in self._functions])

    def _describe(self, name: str, scan: Scan) -> NDArray[np.float32]:
        found = np.asarray(self._functions[name](scan), np.float32)
        if found.ndim != 1 or len(found) != self.blocks.get(name, len(found)):
            want = f"({self.blocks[name]},)" if name in self.blocks else "one axis"
            what = f"by an array of shape {found.shape}, instead of {want}"
            raise DescriptorError(f"{name}: described scan {scan.stamp} {what}")
        if not np.isfinite(found).all():
            raise DescriptorError(f"{name}: described scan {scan.stamp} by NaN or infinity")
        return found


def lowest_elevation(scan: Scan) -> float:
    """Elevation in degrees below which one point in a hundred lies; NaN for an empty scan.

    The lowest beam ends on the ground almost everywhere. Its elevation thus identifies the sensor
    and its mount, not the place.
    """
    if not len(scan):
        return math.nan
    x, y, z = scan.points[:: max(1, len(scan) // 2000)].T
    return math.degrees(math.atan(np.quantile(z / np.maximum(np.hypot(x, y), 1e-3), 0.01)))


def averaged(
    descriptors: NDArray[np.float32], stamps: NDArray[np.int64], n: int, period: float
) -> NDArray[np.float32]:
    """Mean of each frame's descriptor and of those one period before, two before, and so on.

    A selector that describes one scan each period and remembers the last `n` has the same mean. It
    is of fewer near the sequence's start. Descriptors and means are of shape (n_frames,
    n_features), stamps are rising nanoseconds, and the period is in seconds.
    """
    total = descriptors.astype(np.float64)
    number = np.ones(len(stamps))
    for k in range(1, n):
        before = np.searchsorted(stamps, stamps - round(k * period * 1e9), side="right") - 1
        there = before >= 0
        total[there] += descriptors[before[there]]
        number += there
    return (total / number[:, None]).astype(np.float32)


# The histogram of the shapes of a scan's NDT cells.
#
# After Magnusson, Andreasson, Nüchter and Lilienthal, *Appearance-based loop detection from 3D
# laser
# data using the normal distributions transform*, ICRA 2009, and Koide et al., IROS 2021. The
# papers
# leave the constants open; they are set here.


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


@numba.njit(cache=True)
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


@numba.njit(cache=True)
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


@numba.njit(cache=True)
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


@numba.njit(cache=True)
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

    Cells are linear (l2/l1 < 0.1), planar (l3/l2 < 0.1) or spherical, where l1 >= l2 >= l3 are the
    eigenvalues of the points' covariance. Linear cells are classified by thirds of abs(z) of their
    direction, planar cells by thirds of abs(z) of their normal, spherical cells by l2/l1. A turn
    of the sensor about z changes nothing. Points (n, 3) that are not finite do not count.

    Returns
    -------
    ndarray of shape (90,)
        Nine classes for each of ten distances, the distance running slowest.
    """
    return np.asarray(_histogram(np.ascontiguousarray(points, np.float32)))


def describe(scan: Scan) -> NDArray[np.float64]:
    """`ndt_histogram` of a scan."""
    return ndt_histogram(scan.points)


# Principal components by which descriptors are compared.


class ScaledPCA(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Principal components, divided by the mean of their standard deviations.

    One divisor for all keeps the components' shares in a distance, and gives distances a size that
    does not depend on the sensor's number of points. Each of the `blocks` of a descriptor (one if
    left out) has up to `n_components` components and a divisor of its own.

    Attributes
    ----------
    mean_ : ndarray of shape (n_features,)
    components_ : ndarray of shape (n_components, n_features)
        Those of each block, zero elsewhere.
    scale_ : ndarray of shape (n_components,)
    """

    def __init__(self, n_components: int = 10, blocks: Sequence[int] | None = None):
        self.n_components = n_components
        self.blocks = blocks

    def fit(self, X: NDArray[np.floating], y: Any = None) -> Self:  # noqa: ARG002
        """Learn from descriptors of shape (n_scans, n_features)."""
        X = np.asarray(X, np.float64)
        ends = np.cumsum(X.shape[1:] if self.blocks is None else self.blocks)
        self.mean_ = np.empty(X.shape[1])
        components, scales = [], []
        for begin, end in zip([0, *ends[:-1]], ends, strict=True):
            block = X[:, begin:end]
            # Many scans take a tenth of the time by their covariance; few have none.
            solver = "covariance_eigh" if len(block) > block.shape[1] else "full"
            pca = PCA(min(self.n_components, *block.shape), svd_solver=solver)
            with np.errstate(invalid="ignore"):  # a block may be constant
                deviations = pca.fit_transform(block).std(axis=0)
            self.mean_[begin:end] = pca.mean_
            components.append(np.zeros((len(deviations), X.shape[1])))
            components[-1][:, begin:end] = pca.components_
            scales.append(np.full(len(deviations), float(deviations.mean()) or 1.0))
        self.components_ = np.concatenate(components)
        self.scale_ = np.concatenate(scales)
        return self

    def transform(self, X: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map descriptors to shape (n_scans, n_components)."""
        return np.asarray((X - self.mean_) @ self.components_.T / self.scale_)
