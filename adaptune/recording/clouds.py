"""Messages of point clouds to scans: sensor_msgs/PointCloud2, and CustomMsg of Livox's drivers."""

import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system.compiled import compiled
from adaptune.errors import AdaptuneError
from adaptune.recording.scan import Scan
from adaptune.recording.timing import AUTO, TIME_FIELDS, Timing, TimingError, Unit

_WORD = {order: struct.Struct(f"{order}I").unpack_from for order in "<>"}


class _Serialized:
    """Reads a message from its beginning, serialised as in ROS 2 if `cdr`: with aligned numbers.

    All methods raise ValueError, IndexError or struct.error where the message is not long enough.
    """

    def __init__(self, data: bytes | memoryview, cdr: bool):
        if cdr and bytes(data[:2]) not in (b"\0\0", b"\0\1"):
            raise ValueError("not in CDR")
        self.order = "<" if not cdr or data[1] else ">"  # of bytes, as numpy and struct write it
        self.data = memoryview(data)[4 if cdr else 0 :]
        self.at = 0  # where to read on
        self.frame = ""  # of the header
        self._cdr = cdr
        self._unpack = _WORD[self.order]

    def align(self, size: int) -> None:
        if self._cdr:
            self.at = -(-self.at // size) * size

    def uint32(self) -> int:
        self.align(4)
        (number,) = self._unpack(self.data, self.at)
        self.at += 4
        return int(number)

    def uint8(self) -> int:
        number = self.data[self.at]
        self.at += 1
        return number

    def block(self, size: int) -> memoryview:
        begin, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise ValueError(f"{size} bytes are declared, there are {len(self.data) - begin}")
        return self.data[begin : self.at]

    def text(self) -> str:
        """Read a text; in ROS 2 it ends with a zero."""
        return bytes(self.block(self.uint32())).rstrip(b"\0").decode()

    def header(self) -> int:
        """Read a std_msgs/Header, and give its stamp in nanoseconds."""
        if not self._cdr:
            self.uint32()  # its sequence number
        stamp = self.uint32() * 10**9 + self.uint32()
        self.frame = self.text().lstrip("/")  # ROS 1 may write it with a slash
        return stamp

    def end(self) -> None:
        left = len(self.data) - self.at
        if left > (3 if self._cdr else 0):
            raise ValueError(f"{left} bytes are left over")


def header_of(data: bytes | memoryview, cdr: bool) -> tuple[int | None, str]:
    """Stamp and frame of a message that begins with a header; no stamp if it is damaged there."""
    try:
        message = _Serialized(data, cdr)
        return message.header(), message.frame
    except (ValueError, IndexError, struct.error):
        return None, ""


# The numbers of sensor_msgs/PointField's datatypes.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LARGEST_POINT = 1 << 20
RING_FIELDS = ("ring", "line", "channel", "laser_id")
# CloudCompare puts a prefix before the names of what it stores in a PLY file.
INTENSITY_FIELDS = ("intensity", "reflectivity", "scalar_intensity", "scalar_Intensity")
FARTHEST = 1000.0  # metres beyond which a point is doubted
_OUT_OF_SIGHT = 1e4  # metres beyond which no LiDAR sees


Field = tuple[str, int, int, int]
"""Name, offset, datatype and count, in the order of sensor_msgs/PointField."""


class PointCloudError(AdaptuneError):
    """A message that does not describe a point cloud."""


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
    """Read a message without a copy of its points; a PointCloudError if it is not a whole one."""
    try:
        body = _Serialized(data, cdr)
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
        if datatype not in _DATATYPES:
            raise PointCloudError(f"field {name!r} has unknown datatype {datatype}")
        if name in names:
            raise PointCloudError(f"field {name!r} appears twice")
        single = np.dtype((">" if is_bigendian else "<") + _DATATYPES[datatype])
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
    """All points of a message as a structured array of shape (height * width,), without a copy."""
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


def decode_cloud(data: bytes | memoryview, cdr: bool, timing: Timing = AUTO) -> Scan:
    """Decode a serialised sensor_msgs/PointCloud2.

    Points that are not finite are dropped, and so are those at the very origin and farther than any
    LiDAR sees, by which drivers mark rays that did not come back. See `parse` and `from_fields`.
    """
    cloud = parse(data, cdr)
    return from_fields(read_points(cloud), cloud.stamp, timing)


def from_fields(raw: NDArray[Any] | Mapping[str, NDArray[Any]], stamp: int, timing: Timing) -> Scan:
    """Make a scan of points given field by field, and the header's stamp in nanoseconds.

    `raw` is a structured array of shape (n,), or arrays of shape (n,) by name, with x, y and z.
    There is a PointCloudError if these are not single numbers, or if they or the times cannot be.
    """
    names = raw.dtype.names or () if isinstance(raw, np.ndarray) else tuple(raw)
    time, unread = next((name for name in TIME_FIELDS if name in names), None), ""
    if time is None and (likely := [name for name in names if _TIMELIKE.search(name.lower())]):
        sure = [name for name in likely if _is_time(raw[name], name, stamp, timing)]
        time, unread = (sure[0], "") if sure else (None, likely[0])
        timing = replace(timing, unit=timing.unit or _unit_in(sure[0])) if sure else timing
    ring = next((name for name in RING_FIELDS if name in names), None)
    # An odd intensity field is ignored: nothing needs it.
    numbers = (n for n in INTENSITY_FIELDS if n in names and raw[n].ndim == 1)
    intensity = next((name for name in numbers if raw[name].dtype.kind in "iuf"), None)
    columns = {name: raw[name] for name in (*"xyz", time, ring, intensity) if name}
    for name, column in columns.items():
        if column.ndim != 1 or column.dtype.kind not in "iuf":
            raise PointCloudError(f"field {name!r} is not one number for each point")
    native = None if time is None else columns[time].dtype.newbyteorder("=")
    with np.errstate(over="ignore", invalid="ignore"):
        x, y, z = (np.asarray(columns[axis], np.float32) for axis in "xyz")
        given = (
            _NO_TIMES if time is None else columns[time].astype(native, copy=False),
            _NO_RINGS if ring is None else np.asarray(columns[ring], np.uint16),
            _NO_INTENSITIES if intensity is None else np.asarray(columns[intensity], np.float32),
        )
    n = len(x)
    made = (np.empty((n, 3), np.float32), *(np.empty(len(v), v.dtype) for v in given))
    gather = _kernel(given[0].dtype.str)
    valid, far, low, high = gather(x, y, z, given, made)
    marks = 0.0
    if far or not valid:
        marked = _marks([columns[axis] for axis in "xyz"])
        x = np.where(marked, np.float32(np.nan), x)
        valid, _, low, high = gather(x, y, z, given, made)
        marks = np.count_nonzero(marked) / max(n, 1)
    if valid < n:
        # A copy, so that the other points are not kept in memory with them.
        made = tuple(values[:valid].copy() for values in made)
    points, times, rings, lights = made
    try:
        timed = None if time is None else times
        start, seconds, reading = timing.resolve(stamp, timed, (low, high))
    except TimingError as error:
        raise PointCloudError(str(error)) from error
    given_rings, given_lights = rings if ring else None, lights if intensity else None
    reading = reading._replace(marks=marks, unread=unread)
    return Scan(start, points, seconds, given_rings, None, given_lights, reading)


# Names of fields that may hold times, besides those that are known, and the units in them.
_TIMELIKE = re.compile(r"time|stamp|offset|(^|_)(ts|dt|t)($|_)")


def _unit_in(name: str) -> Unit | None:
    units: dict[str, Unit] = {"ns": "ns", "nsec": "ns", "us": "us", "usec": "us", "ms": "ms"}
    return units.get(name.lower().rpartition("_")[2])


def _is_time(column: NDArray[Any], name: str, stamp: int, timing: Timing) -> bool:
    """Whether a field holds the times of the points: by its unit, they span about a scan."""
    if column.ndim != 1 or column.dtype.kind not in "iuf" or column.dtype.itemsize < 4:
        return False
    values = column[np.isfinite(column)]
    if timing.unit is not None or not len(values):
        return len(values) > 0
    try:
        timing = replace(timing, unit=_unit_in(name))
        extent = values.min().item(), values.max().item()
        reading = timing.resolve(stamp, values, extent)[2]
    except TimingError:
        return False
    return 0.01 < reading.last - reading.first < 1.1


@np.errstate(over="ignore", invalid="ignore")
def _marks(columns: Sequence[NDArray[Any]]) -> NDArray[np.bool_]:
    """Which points are marks of lost rays; a PointCloudError if the coordinates are misread."""
    x, y, z = (np.asarray(column, np.float64) for column in columns)
    away = np.hypot(np.hypot(x, y), z)
    seen = np.isfinite(away) & (away > 0)
    # Marks are all at one distance. Nothing that is measured is.
    far = seen & (away > FARTHEST)
    same = far & (np.abs(away / np.median(away[far]) - 1.0) < 1e-6) if far.any() else far
    marks = (far & (away > _OUT_OF_SIGHT)) | (same & (np.count_nonzero(same) > 2))
    rest = seen & ~same
    middle = np.median(away[rest]) if rest.any() else 0.0
    if middle <= FARTHEST and np.count_nonzero(marks & rest) <= 0.1 * np.count_nonzero(rest):
        return marks
    share = np.mean(far[seen])
    raise PointCloudError(
        f"{share:.0%} of the points are farther than {FARTHEST:g} m: they are in millimetres, on a "
        f"map, of the other byte order, or at other offsets than the fields say; correct the bag"
    )


_NO_TIMES, _NO_RINGS = np.empty(0, np.float32), np.empty(0, np.uint16)
_NO_INTENSITIES = np.empty(0, np.float32)
# Single precision keeps the loop fast.
_ZERO, _INFINITE = np.float32(0.0), np.float32(np.inf)
_DOUBTED = np.float32(FARTHEST**2)


def _gather(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    z: NDArray[np.float32],
    given: tuple[NDArray[Any], NDArray[np.uint16], NDArray[np.float32]],
    made: tuple[NDArray[np.float32], NDArray[Any], NDArray[np.uint16], NDArray[np.float32]],
) -> tuple[int, int, Any, Any]:
    """Put the valid points side by side; count them and far ones, and find their times' extent."""
    given_times, given_rings, given_intensities = given
    points, times, rings, intensities = made
    timed, ringed, lit = len(given_times) > 0, len(given_rings) > 0, len(given_intensities) > 0
    low = high = times.dtype.type(0)
    valid = far = 0
    for i in range(len(x)):
        a, b, c = x[i], y[i], z[i]
        # Not a number or infinite if any coordinate is, zero if all of them are.
        square = a * a + b * b + c * c
        good = (square > _ZERO) & (square < _INFINITE)
        far += good & (square > _DOUBTED)
        # What is not valid is overwritten by the next point.
        points[valid, 0] = a
        points[valid, 1] = b
        points[valid, 2] = c
        if timed:
            t = given_times[i]
            good &= t - t == 0
            times[valid] = t
            if good:
                low, high = (min(low, t), max(high, t)) if valid else (t, t)
        if ringed:
            rings[valid] = given_rings[i]
        if lit:
            light = given_intensities[i]
            intensities[valid] = light if light - light == _ZERO else _ZERO
        valid += good
    return valid, far, low, high


@cache
def _kernel(kind: str) -> Callable[..., Any]:
    """Gather clouds whose times are of this type."""
    # Importing numba takes time, and a bag may never be read.
    import numba

    # Fields lie at any offset. Unaligned types accept aligned arrays, too.
    def column(scalar: Any) -> Any:
        return types.Array(scalar, 1, "A", readonly=True, aligned=False)

    types: Any = numba.types
    real, whole, time = numba.float32, numba.uint16, numba.from_dtype(np.dtype(kind))
    kinds = ((real, 2), (time, 1), (whole, 1), (real, 1))
    scan = types.Tuple([types.Array(scalar, axes, "C") for scalar, axes in kinds])
    given = types.Tuple((column(time), column(whole), column(real)))
    signature = types.Tuple((numba.int64, numba.int64, time, time))(
        *3 * (column(real),), given, scan
    )
    return compiled(_gather, signature)


LIVOX_TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")

_POINT = """uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z
uint8 reflectivity\nuint8 tag\nuint8 line\n"""
_LIVOX_POINT = (
    ("offset_time", "u4"),
    *((axis, "f4") for axis in "xyz"),
    *((name, "u1") for name in ("reflectivity", "tag", "line")),
)
_LIVOX_SIZE = 19  # bytes, without padding
_MESSAGE = """std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id
uint8[3] rsvd\nCustomPoint[] points\n"""
# For ROS 2 bags without definitions; all others bring their own.
DEFINITIONS = {
    f"{package}/msg/{name}": text
    for package in ("livox_ros_driver", "livox_ros_driver2")
    for name, text in (("CustomPoint", _POINT), ("CustomMsg", _MESSAGE))
}


def decode_livox(data: bytes | memoryview, cdr: bool, timing: Timing = AUTO) -> Scan:
    """Decode a serialised CustomMsg; a PointCloudError reports a message that is cut short.

    The points' offsets count from the time base. The stamp marks the same moment, unless `timing`
    sets it to mark the scan's end, or takes the time base in its place.
    """
    try:
        body = _Serialized(data, cdr)
        stamp = body.header()
        body.align(8)
        base = int(np.frombuffer(body.block(8), body.order + "u8")[0])
        body.block(4 + 1 + 3)  # what else comes before the points
        count = body.uint32()
        dtype = np.dtype([(name, body.order + kind) for name, kind in _LIVOX_POINT], align=cdr)
        # Behind the last point there is no padding.
        size = max(count - 1, 0) * dtype.itemsize + _LIVOX_SIZE
        points = body.block(size if count else 0)
        raw = np.zeros(count, dtype)
        raw.view(np.uint8)[: len(points)] = np.frombuffer(points, np.uint8)
    except (struct.error, ValueError, IndexError) as error:
        raise PointCloudError(f"not a whole Livox message ({error})") from error
    if timing.stamp == "sensor_clock":
        stamp, timing = base, replace(timing, stamp="start")
    scan = from_fields(raw, stamp, timing)
    return replace(scan, reading=scan.reading._replace(clock=base))


CLOUDS: dict[str, Callable[[bytes | memoryview, bool, Timing], Scan]] = {
    "sensor_msgs/msg/PointCloud2": decode_cloud,
    **dict.fromkeys(LIVOX_TYPES, decode_livox),
}
"""What decodes a serialised message of point clouds, by its type. Where nobody publishes a topic
yet, it is taken to be of the first."""


def livox_points(scan: Scan) -> bytes:
    """The points of a scan as a Livox driver for ROS 2 serialises them, their number first."""
    raw = np.zeros(len(scan), np.dtype(list(_LIVOX_POINT), align=True))
    for axis, values in zip("xyz", scan.points.T, strict=True):
        raw[axis] = values
    raw["tag"] = 0x10  # a good return
    for name, given, factor in (
        ("offset_time", scan.times, 1e9),
        ("reflectivity", scan.intensities, 1.0),
        ("line", scan.rings, 1),
    ):
        if given is not None:
            most = np.iinfo(raw.dtype[name]).max
            raw[name] = (np.asarray(given, np.float64) * factor).clip(0, most).round()
    behind = raw.dtype.itemsize - _LIVOX_SIZE
    return struct.pack("<I", len(scan)) + raw.tobytes()[: -behind if len(scan) else None]
