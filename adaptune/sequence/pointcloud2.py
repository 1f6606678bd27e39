"""sensor_msgs/PointCloud2 to scans."""

from collections.abc import Callable, Mapping
from functools import cache, lru_cache
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.sequence.scan import Scan
from adaptune.sequence.timing import AUTO, TIME_FIELDS, Timing, TimingError

# The numbers of sensor_msgs/PointField's datatypes.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LARGEST_POINT = 1 << 20
RING_FIELDS = ("ring", "line", "channel", "laser_id")


class PointCloudError(AdaptuneError):
    """A message that does not describe a point cloud."""


def stamp_ns(header: Any) -> int:
    """Stamp of a std_msgs/Header in nanoseconds."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def point_dtype(message: Any) -> np.dtype[Any]:
    """Structured type of one point of a message.

    Raises
    ------
    PointCloudError
        If fields are of an unknown type, repeat themselves or lie outside the point.
    """
    fields = tuple((f.name, f.datatype, f.offset, f.count) for f in message.fields)
    return _point_dtype(fields, bool(message.is_bigendian), int(message.point_step))


@lru_cache(maxsize=64)
def _point_dtype(
    fields: tuple[tuple[str, int, int, int], ...], bigendian: bool, point_step: int
) -> np.dtype[Any]:
    if point_step > _LARGEST_POINT:
        raise PointCloudError(f"a point of {point_step} bytes is none")
    names, formats, offsets = [], [], []
    for name, datatype, offset, count in fields:
        if datatype not in _DATATYPES:
            raise PointCloudError(f"field {name!r} has unknown datatype {datatype}")
        if name in names:
            raise PointCloudError(f"field {name!r} appears twice")
        single = np.dtype((">" if bigendian else "<") + _DATATYPES[datatype])
        # Some drivers leave the count at zero.
        if offset + single.itemsize * max(count, 1) > point_step:
            raise PointCloudError(f"field {name!r} ends beyond the point's {point_step} bytes")
        if name:
            names.append(name)
            formats.append(single if count <= 1 else (single, (count,)))
            offsets.append(offset)
    if missing := [axis for axis in "xyz" if axis not in names]:
        raise PointCloudError(
            f"no field {', '.join(missing)}; there is {', '.join(names) or 'none at all'}"
        )
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": point_step}
    )


def read_points(message: Any) -> NDArray[Any]:
    """All points of a message as a structured array of shape (height * width,), without a copy.

    Raises
    ------
    PointCloudError
        If the message lacks x, y or z, or holds fewer bytes than it declares.
    """
    height, width = int(message.height), int(message.width)
    dtype = point_dtype(message)
    if not height * width:
        return np.empty(0, dtype)
    row_step = max(int(message.row_step), width * dtype.itemsize)
    needed = (height - 1) * row_step + width * dtype.itemsize
    if len(message.data) < needed:
        raise PointCloudError(
            f"{height} x {width} points of {dtype.itemsize} bytes need {needed} bytes, "
            f"there are {len(message.data)}"
        )
    rows = np.ndarray(
        (height, width), dtype, buffer=message.data, strides=(row_step, dtype.itemsize)
    )
    return rows.reshape(-1)


def decode(message: Any, timing: Timing = AUTO) -> Scan:
    """Decode a message.

    Points that are not finite are dropped, and so are those at the very origin, by which drivers
    mark rays that did not come back.

    Parameters
    ----------
    message
        A sensor_msgs/PointCloud2 as rosbags gives it.
    timing
        What its stamps mean.

    Raises
    ------
    PointCloudError
        If the message is malformed, lacks x, y or z, or has times that cannot be.
    """
    return from_fields(read_points(message), stamp_ns(message.header), timing)


def from_fields(raw: NDArray[Any] | Mapping[str, NDArray[Any]], stamp: int, timing: Timing) -> Scan:
    """Make a scan of points given field by field.

    Parameters
    ----------
    raw
        A structured array of shape (n,), or arrays of shape (n,) by name, with x, y and z.
    stamp
        The header's, in nanoseconds.
    timing
        What the stamps mean.

    Raises
    ------
    PointCloudError
        If x, y or z are not single numbers, or the times cannot be.
    """
    names = raw.dtype.names or () if isinstance(raw, np.ndarray) else tuple(raw)
    time = next((name for name in TIME_FIELDS if name in names), None)
    ring = next((name for name in RING_FIELDS if name in names), None)
    columns = {name: raw[name] for name in (*"xyz", time, ring) if name}
    for name, column in columns.items():
        if column.ndim != 1 or column.dtype.kind not in "iuf":
            raise PointCloudError(f"field {name!r} is not one number for each point")
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = (np.asarray(columns[axis], np.float32) for axis in "xyz")
        times = None if time is None else _native(columns[time])
        rings = None if ring is None else np.ascontiguousarray(columns[ring], np.uint16)
    points = np.empty((len(x), 3), np.float32)
    gather, compact = _kernels()
    if invalid := gather(x, y, z, points):
        index = np.empty(len(points), np.int64)
        compact(points, index)
        count = len(points) - invalid
        points, index = points[:count].copy(), index[:count]
        times = None if times is None else times.take(index)
        rings = None if rings is None else rings.take(index)
    extent = _extent(times)
    # The least and the greatest are not numbers if any is not.
    if times is not None and not isfinite(extent[1] - extent[0]):
        known = np.isfinite(times)
        points, times = points[known], times[known]
        rings = None if rings is None else rings[known]
        extent = _extent(times)
    try:
        start, seconds = timing.resolve(stamp, times, extent)
    except TimingError as error:
        raise PointCloudError(str(error)) from error
    return Scan(start, points, seconds, rings)


def _extent(times: NDArray[Any] | None) -> tuple[float, float]:
    """The least and the greatest, zeros where there is none."""
    if times is None or not len(times):
        return 0.0, 0.0
    return times.min().item(), times.max().item()


def _native(values: NDArray[Any]) -> NDArray[Any]:
    """Values in the machine's byte order, without gaps."""
    return np.ascontiguousarray(values, values.dtype.newbyteorder("="))


# Single precision keeps the loops fast.
_ZERO, _INFINITE = np.float32(0.0), np.float32(np.inf)


def _gather(
    x: NDArray[np.float32], y: NDArray[np.float32], z: NDArray[np.float32], out: NDArray[np.float32]
) -> int:
    """Put coordinates side by side, and count the points that are not valid."""
    count = 0
    for i in range(len(x)):
        a, b, c = x[i], y[i], z[i]
        out[i, 0] = a
        out[i, 1] = b
        out[i, 2] = c
        # Not a number or infinite if any coordinate is, zero if all of them are.
        square = a * a + b * b + c * c
        if not (square > _ZERO and square < _INFINITE):
            count += 1
    return count


def _compact(points: NDArray[np.float32], index: NDArray[np.int64]) -> None:
    """Move the valid points, and where they were, to the front."""
    count = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        points[count, 0] = x
        points[count, 1] = y
        points[count, 2] = z
        index[count] = i
        square = x * x + y * y + z * z
        # The next point takes the place of one that is not valid.
        if _ZERO < square < _INFINITE:
            count += 1


@cache
def _kernels() -> tuple[Callable[..., int], Callable[..., None]]:
    # Importing numba takes a while, and a bag may never be read.
    import numba

    # Fields lie at any offset; what is aligned may be taken for what is not.
    column = numba.types.Array(numba.float32, 1, "A", readonly=True, aligned=False)
    points = numba.types.Array(numba.float32, 2, "C")
    index = numba.types.Array(numba.int64, 1, "C")
    gather: Any = numba.njit(numba.int64(column, column, column, points), nogil=True, cache=True)
    compact: Any = numba.njit(numba.void(points, index), nogil=True, cache=True)
    return gather(_gather), compact(_compact)
