"""sensor_msgs/PointCloud2 to scans."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.sequence.scan import Scan
from adaptune.sequence.timing import AUTO, TIME_FIELDS, Timing, TimingError

# The numbers of sensor_msgs/PointField's datatypes.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
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
    columns = {
        "times": next((raw[name] for name in TIME_FIELDS if name in names), None),
        "rings": next((raw[name] for name in RING_FIELDS if name in names), None),
    }
    xyz = [raw[axis] for axis in "xyz"]
    for column in (*xyz, *columns.values()):
        if column is not None and (column.ndim != 1 or column.dtype.kind not in "iuf"):
            raise PointCloudError("a coordinate, time or ring of a point is not a single number")
    points = np.empty((len(xyz[0]), 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for i, column in enumerate(xyz):
            points[:, i] = column
        # One number tells all: NaN or infinite if any coordinate is, zero if all of them are.
        squares = np.einsum("ij,ij->i", points, points)
    valid = (squares > 0) & (squares < np.inf)
    times, rings = columns["times"], columns["rings"]
    if times is not None and times.dtype.kind == "f":
        valid &= np.isfinite(times)
    if not valid.all():
        index = np.flatnonzero(valid)
        points = points.take(index, axis=0)
        times = None if times is None else times.take(index)
        rings = None if rings is None else rings.take(index)
    try:
        start, seconds = timing.resolve(stamp, times)
    except TimingError as error:
        raise PointCloudError(str(error)) from error
    with np.errstate(invalid="ignore"):
        return Scan(start, points, seconds, None if rings is None else rings.astype(np.uint16))
