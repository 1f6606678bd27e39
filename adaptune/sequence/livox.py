"""livox_ros_driver/CustomMsg to scans."""

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from adaptune.sequence.pointcloud2 import PointCloudError, from_fields
from adaptune.sequence.scan import Scan
from adaptune.sequence.serialized import Serialized
from adaptune.sequence.timing import Timing

TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")

_POINT = """uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z
uint8 reflectivity\nuint8 tag\nuint8 line\n"""
_MESSAGE = """std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id
uint8[3] rsvd\nCustomPoint[] points\n"""
# For ROS 2 bags without definitions; all others bring their own.
DEFINITIONS = {
    f"{package}/msg/{name}": text
    for package in ("livox_ros_driver", "livox_ros_driver2")
    for name, text in (("CustomPoint", _POINT), ("CustomMsg", _MESSAGE))
}

_Fields = Sequence[tuple[str, Any]]


def decode(
    data: bytes | memoryview, message: _Fields, point: _Fields, cdr: bool, timing: Timing
) -> Scan:
    """Decode a serialised message without an object for each of its points.

    Parameters
    ----------
    data, cdr
        The message as it lies in the bag, and whether it is serialised as in ROS 2.
    message, point
        Fields of the message and of one point, as rosbags gives them.
    timing
        Meaning of its stamps. The points' offsets count from the time base. The stamp marks the
        same moment, unless it is set to mark the scan's end.

    Raises
    ------
    PointCloudError
        If the message does not match its definition.
    """
    try:
        stamp, raw = _parse(Serialized(data, cdr), tuple(message), tuple(point), cdr)
    except (struct.error, KeyError, ValueError, IndexError) as error:
        raise PointCloudError(f"a Livox message unlike its definition ({error})") from error
    return from_fields(raw, stamp, timing)


def _parse(
    body: Serialized, message: _Fields, point: _Fields, cdr: bool
) -> tuple[int, NDArray[Any]]:
    if message[0][0] != "header":
        raise ValueError("it does not begin with a header")
    stamp = body.header()
    for name, description in message[1:]:
        if name == "points":
            break
        size, number = _extent(description)
        body.align(size)
        body.block(size * number)
    else:
        raise KeyError("points")
    count = body.uint32()
    dtype, used = _point_dtype(point, cdr, body.order)
    if not count:
        return stamp, np.empty(0, dtype)
    data = body.block((count - 1) * dtype.itemsize + used)
    raw = np.ndarray((count - 1,), dtype, data)
    last = np.zeros(1, dtype)
    last.view(np.uint8)[:used] = np.frombuffer(data[-used:], np.uint8)
    return stamp, np.concatenate([raw, last])


@lru_cache(maxsize=8)
def _point_dtype(point: _Fields, cdr: bool, order: str) -> tuple[np.dtype[Any], int]:
    """Type of a point, padded to the next one, and where its last byte ends."""
    names, formats, offsets, at, widest = [], [], [], 0, 1
    for name, description in point:
        size, number = _extent(description)
        kind = description[1][0][:1]
        if number != 1 or kind not in ("u", "i", "f"):
            raise ValueError(f"a point's {name} is not a number")
        at = _aligned(at, size if cdr else 1)
        widest = max(widest, size)
        names.append(name)
        formats.append(f"{order}{kind}{size}")
        offsets.append(at)
        at += size
    if missing := {"x", "y", "z", "offset_time"} - set(names):
        raise KeyError(", ".join(sorted(missing)))
    itemsize = _aligned(at, widest if cdr else 1)
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": itemsize})
    # Behind the last point there is no padding.
    return dtype, at


def _extent(description: Any) -> tuple[int, int]:
    """Bytes of an element and number of elements of a field of fixed size."""
    if description[0] == Nodetype.ARRAY:
        inner, number = description[1]
        return _extent(inner)[0], number
    if description[0] != Nodetype.BASE or description[1][0] == "string":
        raise ValueError("a field before the points has no fixed size")
    name = description[1][0]
    return {"bool": 1, "byte": 1, "char": 1, "octet": 1}.get(name) or np.dtype(name).itemsize, 1


def _aligned(at: int, to: int) -> int:
    return -(-at // to) * to
