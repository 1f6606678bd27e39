"""sensor_msgs/PointCloud2 to scans."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.sequence.scan import Scan

# The numbers of sensor_msgs/PointField's datatypes.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_TIME_FIELDS = ("time", "t", "timestamp", "timestamps", "time_stamp")


class PointCloudError(AdaptuneError):
    """A PointCloud2 message that does not describe a point cloud."""


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
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for field in message.fields:
        if field.datatype not in _DATATYPES:
            raise PointCloudError(f"field {field.name!r} has unknown datatype {field.datatype}")
        if field.name in names:
            raise PointCloudError(f"field {field.name!r} appears twice")
        single = np.dtype(order + _DATATYPES[field.datatype])
        count = max(int(field.count), 1)
        if field.offset + single.itemsize * count > message.point_step:
            raise PointCloudError(
                f"field {field.name!r} ends beyond the point's {message.point_step} bytes"
            )
        names.append(field.name)
        formats.append(single if count == 1 else (single, (count,)))
        offsets.append(int(field.offset))
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step}
    )


def read_points(message: Any) -> NDArray[Any]:
    """All points of a message as a structured array of shape (height * width,), without a copy.

    Raises
    ------
    PointCloudError
        If the message holds fewer bytes than it declares.
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


def decode(message: Any) -> Scan:
    """Decode a message.

    Points that are not finite are dropped, and so are those at the very origin, by which drivers
    mark rays that did not come back.

    Parameters
    ----------
    message
        A sensor_msgs/PointCloud2 as rosbags gives it.

    Raises
    ------
    PointCloudError
        If the message is malformed or lacks x, y or z.
    """
    raw = read_points(message)
    names = raw.dtype.names or ()
    if missing := [axis for axis in "xyz" if axis not in names]:
        raise PointCloudError(
            f"no field {', '.join(missing)}; there is {', '.join(names) or 'none at all'}"
        )
    points = np.empty((len(raw), 3), np.float32)
    with np.errstate(over="ignore"):
        for column, axis in enumerate("xyz"):
            points[:, column] = raw[axis]
    x, y, z = points.T
    keep = np.isfinite(x) & np.isfinite(y) & np.isfinite(z) & ((x != 0) | (y != 0) | (z != 0))
    stamp = stamp_ns(message.header)
    times = _times(raw, stamp)
    if not keep.all():
        points = points[keep]
        times = None if times is None else times[keep]
    return Scan(stamp, points, times)


def _times(raw: NDArray[Any], stamp: int) -> NDArray[np.float32] | None:
    """Seconds since `stamp`, from the field that the sensors' drivers write them to."""
    name = next((name for name in _TIME_FIELDS if name in (raw.dtype.names or ())), None)
    if name is None or not len(raw):
        return None
    values = raw[name]
    if values.dtype.kind in "iu":
        return (values * 1e-9).astype(np.float32)
    if values.dtype.itemsize == 4:
        return values.astype(np.float32)
    # Hesai writes absolute seconds, Livox absolute nanoseconds.
    seconds = values * 1e-9 if np.nanmax(np.abs(values)) > 1e14 else values
    if np.nanmax(np.abs(seconds)) > 1e6:
        seconds = seconds - stamp * 1e-9
    return seconds.astype(np.float32)
