"""sensor_msgs/PointCloud2 to scans."""

import struct
from collections.abc import Callable, Mapping
from functools import cache, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.sequence.scan import Scan
from adaptune.sequence.serialized import Serialized
from adaptune.sequence.timing import AUTO, TIME_FIELDS, Timing, TimingError

# The numbers of sensor_msgs/PointField's datatypes.
DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LARGEST_POINT = 1 << 20
RING_FIELDS = ("ring", "line", "channel", "laser_id")
INTENSITY_FIELDS = ("intensity", "reflectivity")


class PointCloudError(AdaptuneError):
    """A message that does not describe a point cloud."""


Field = tuple[str, int, int, int]
"""Name, offset, datatype and count, in the order of sensor_msgs/PointField."""


class PointCloud2(NamedTuple):
    """Layout of the points of a message, and their bytes."""

    stamp: int
    height: int
    width: int
    fields: tuple[Field, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: memoryview


def parse(data: bytes | memoryview, cdr: bool) -> PointCloud2:
    """Read a message, serialised as in ROS 2 if `cdr`, without a copy of its points.

    A PointCloudError reports a message that is cut short, or longer than it declares.
    """
    try:
        body = Serialized(data, cdr)
        cloud = PointCloud2(
            stamp=body.header(),
            height=body.uint32(),
            width=body.uint32(),
            fields=tuple(
                (body.text(), body.uint32(), body.uint8(), body.uint32())
                for _ in range(body.uint32())
            ),
            is_bigendian=bool(body.uint8()),
            point_step=body.uint32(),
            row_step=body.uint32(),
            data=body.block(body.uint32()),
        )
        body.uint8()  # is_dense, which drivers set as they like
        body.end()
    except (struct.error, ValueError, IndexError) as error:
        raise PointCloudError(f"not a whole PointCloud2 ({error})") from error
    return cloud


@lru_cache(maxsize=64)
def point_dtype(fields: tuple[Field, ...], is_bigendian: bool, point_step: int) -> np.dtype[Any]:
    """Structured type of one point; a PointCloudError where its fields cannot be."""
    if point_step > _LARGEST_POINT:
        raise PointCloudError(f"a point of {point_step} bytes is none")
    names, formats, offsets = [], [], []
    for name, offset, datatype, count in fields:
        if datatype not in DATATYPES:
            raise PointCloudError(f"field {name!r} has unknown datatype {datatype}")
        if name in names:
            raise PointCloudError(f"field {name!r} appears twice")
        single = np.dtype((">" if is_bigendian else "<") + DATATYPES[datatype])
        # Some drivers leave the count at zero.
        if offset + single.itemsize * max(count, 1) > point_step:
            raise PointCloudError(f"field {name!r} ends beyond the point's {point_step} bytes")
        if name:
            names.append(name)
            formats.append(single if count <= 1 else (single, (count,)))
            offsets.append(offset)
    if missing := [axis for axis in "xyz" if axis not in names]:
        there = ", ".join(names) or "none at all"
        raise PointCloudError(f"no field {', '.join(missing)}; there is {there}")
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": point_step}
    )


def read_points(cloud: PointCloud2) -> NDArray[Any]:
    """All points of a message as a structured array of shape (height * width,), without a copy.

    A PointCloudError reports a message without x, y or z, or with too few bytes.
    """
    height, width, size = cloud.height, cloud.width, len(cloud.data)
    dtype = point_dtype(cloud.fields, cloud.is_bigendian, cloud.point_step)
    if not height * width:
        return np.empty(0, dtype)
    row_step = max(cloud.row_step, width * dtype.itemsize)
    needed = (height - 1) * row_step + width * dtype.itemsize
    if size < needed:
        what = f"{height} x {width} points of {dtype.itemsize} bytes"
        raise PointCloudError(f"{what} need {needed} bytes, there are {size}")
    rows = np.ndarray((height, width), dtype, cloud.data, strides=(row_step, dtype.itemsize))
    return rows.reshape(-1)


def decode(data: bytes | memoryview, cdr: bool, timing: Timing = AUTO) -> Scan:
    """Decode a serialised sensor_msgs/PointCloud2.

    Points that are not finite are dropped, and so are those at the very origin, by which drivers
    mark rays that did not come back. See `parse` and `from_fields`.
    """
    cloud = parse(data, cdr)
    return from_fields(read_points(cloud), cloud.stamp, timing)


def from_fields(raw: NDArray[Any] | Mapping[str, NDArray[Any]], stamp: int, timing: Timing) -> Scan:
    """Make a scan of points given field by field.

    Parameters
    ----------
    raw
        A structured array of shape (n,), or arrays of shape (n,) by name, with x, y and z.
    stamp
        The header's, in nanoseconds.
    timing
        Meaning of the stamps.

    Raises
    ------
    PointCloudError
        If x, y or z are not single numbers, or the times cannot be.
    """
    names = raw.dtype.names or () if isinstance(raw, np.ndarray) else tuple(raw)
    time = next((name for name in TIME_FIELDS if name in names), None)
    ring = next((name for name in RING_FIELDS if name in names), None)
    # An odd intensity field is ignored: nothing needs it.
    numbers = (n for n in INTENSITY_FIELDS if n in names and raw[n].ndim == 1)
    intensity = next((name for name in numbers if raw[name].dtype.kind in "iuf"), None)
    columns = {name: raw[name] for name in (*"xyz", time, ring, intensity) if name}
    for name, column in columns.items():
        if column.ndim != 1 or column.dtype.kind not in "iuf":
            raise PointCloudError(f"field {name!r} is not one number for each point")
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = (np.asarray(columns[axis], np.float32) for axis in "xyz")
        given = (
            _NO_TIMES if time is None else _native(columns[time]),
            _NO_RINGS if ring is None else np.asarray(columns[ring], np.uint16),
            _NO_INTENSITIES if intensity is None else np.asarray(columns[intensity], np.float32),
        )
    n = len(x)
    made = (np.empty((n, 3), np.float32), *(np.empty(len(v), v.dtype) for v in given))
    gather, compact = _kernels(given[0].dtype.str)
    valid, low, high = gather(x, y, z, given, made)
    if valid < n:
        _, low, high = compact(*made)
        # A copy, so that the other points are not kept in memory with them.
        made = tuple(values[:valid].copy() for values in made)
    points, times, rings, intensities = made
    try:
        start, seconds = timing.resolve(stamp, None if time is None else times, (low, high))
    except TimingError as error:
        raise PointCloudError(str(error)) from error
    given_rings, lights = rings if ring else None, intensities if intensity else None
    return Scan(start, points, seconds, given_rings, intensities=lights)


_NO_TIMES, _NO_RINGS = np.empty(0, np.float32), np.empty(0, np.uint16)
_NO_INTENSITIES = np.empty(0, np.float32)


def _native(values: NDArray[Any]) -> NDArray[Any]:
    """Values in the machine's byte order."""
    return values.astype(values.dtype.newbyteorder("="), copy=False)


# Single precision keeps the loops fast.
_ZERO, _INFINITE = np.float32(0.0), np.float32(np.inf)


def _gather(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    z: NDArray[np.float32],
    given: tuple[NDArray[Any], NDArray[np.uint16], NDArray[np.float32]],
    made: tuple[NDArray[np.float32], NDArray[Any], NDArray[np.uint16], NDArray[np.float32]],
) -> tuple[int, Any, Any]:
    """Put each field side by side; count the valid points, and find the extent of times."""
    given_times, given_rings, given_intensities = given
    points, times, rings, intensities = made
    timed, ringed, lit = len(given_times) > 0, len(given_rings) > 0, len(given_intensities) > 0
    low = high = given_times[0] if timed else times.dtype.type(0)
    valid = 0
    for i in range(len(x)):
        a, b, c = x[i], y[i], z[i]
        points[i, 0] = a
        points[i, 1] = b
        points[i, 2] = c
        # Not a number or infinite if any coordinate is, zero if all of them are.
        square = a * a + b * b + c * c
        good = (square > _ZERO) & (square < _INFINITE)
        if timed:
            t = given_times[i]
            times[i] = t
            low, high = min(low, t), max(high, t)
            good &= t - t == 0
        if ringed:
            rings[i] = given_rings[i]
        if lit:
            light = given_intensities[i]
            intensities[i] = light if light - light == _ZERO else _ZERO
        valid += good
    return valid, low, high


def _compact(
    points: NDArray[np.float32],
    times: NDArray[Any],
    rings: NDArray[np.uint16],
    intensities: NDArray[np.float32],
) -> tuple[int, Any, Any]:
    """Move the valid points to the front; count them, and find the extent of their times."""
    timed, ringed, lit = len(times) > 0, len(rings) > 0, len(intensities) > 0
    low = high = times.dtype.type(0)
    count = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        square = x * x + y * y + z * z
        good = (square > _ZERO) & (square < _INFINITE)
        if timed:
            t = times[i]
            good &= t - t == 0
        if not good:
            continue
        points[count, 0] = x
        points[count, 1] = y
        points[count, 2] = z
        if timed:
            times[count] = t
            low, high = (min(low, t), max(high, t)) if count else (t, t)
        if ringed:
            rings[count] = rings[i]
        if lit:
            intensities[count] = intensities[i]
        count += 1
    return count, low, high


@cache
def _kernels(kind: str) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Gather and compact clouds whose times are of this type."""
    # Importing numba takes time, and a bag may never be read.
    import numba

    # Fields lie at any offset. Unaligned types accept aligned arrays, too.
    def column(scalar: Any) -> Any:
        return types.Array(scalar, 1, "A", readonly=True, aligned=False)

    types: Any = numba.types
    real, whole, time = numba.float32, numba.uint16, numba.from_dtype(np.dtype(kind))
    kinds = ((real, 2), (time, 1), (whole, 1), (real, 1))
    scan = tuple(types.Array(scalar, axes, "C") for scalar, axes in kinds)
    result = types.Tuple((numba.int64, time, time))
    compiled = partial(numba.njit, nogil=True, cache=True)
    given = types.Tuple((column(time), column(whole), column(real)))
    gather = result(*3 * (column(real),), given, types.Tuple(scan))
    return compiled(gather)(_gather), compiled(result(*scan))(_compact)
