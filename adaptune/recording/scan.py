"""What recordings consist of: scans, measurements of an IMU, and the formats that give them."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator

from adaptune.errors import AdaptuneError, Finding
from adaptune.geometry import Poses
from adaptune.trajectory import Trajectory

# Measurements of an IMU.


_MEASURED = ("stamps", "angular_velocity", "acceleration")


class ImuNoise(NamedTuple):
    """White noise and random walk of the biases of an IMU; by default those of a fair MEMS IMU."""

    gyroscope: float = 2e-4  # rad/s for a root hertz
    accelerometer: float = 2e-3  # m/s^2 for a root hertz
    gyroscope_walk: float = 2e-5  # rad/s^2 for a root hertz
    accelerometer_walk: float = 2e-4  # m/s^3 for a root hertz


USUAL = ImuNoise()


@dataclass(frozen=True, eq=False)
class Imu:
    """What an IMU measured, in its own frame.

    Attributes
    ----------
    stamps : ndarray of shape (n,)
        Strictly increasing integer nanoseconds.
    angular_velocity : ndarray of shape (n, 3)
        Radians per second.
    acceleration : ndarray of shape (n, 3)
        Metres per second squared, gravity included.
    T_sensor_imu : ndarray of shape (4, 4)
        The IMU's pose in the LiDAR's frame.
    noise : ImuNoise
    """

    stamps: NDArray[np.int64]
    angular_velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    T_sensor_imu: Poses = field(default_factory=lambda: np.eye(4))
    noise: ImuNoise = USUAL

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def nbytes(self) -> int:
        """Memory that the measurements take, in bytes."""
        return self.stamps.nbytes + self.angular_velocity.nbytes + self.acceleration.nbytes

    def part(self, first: int, last: int) -> "Imu":
        """Measurements from number `first` to before number `last`."""
        return replace(self, **{name: getattr(self, name)[first:last] for name in _MEASURED})


def joined(parts: Sequence[Imu]) -> Imu:
    """Measurements of one IMU, one part after the other."""
    whole: dict[str, Any]
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _MEASURED}
    return replace(parts[0], **whole)


class Reading(NamedTuple):
    """How a scan was read from its message; times in seconds since its stamp, NaN without times."""

    stamp: int = 0  # of the scan
    first: float = np.nan
    last: float = np.nan
    unit: float = 0.0  # seconds per unit of the points' times
    clock: int | None = None  # nanoseconds of the first point, if the sensor gives its own clock
    unread: str = ""  # a field whose name says that it holds times, and whose values do not
    marks: float = 0.0  # share of the points that mark rays that did not come back, far away


UNREAD = Reading()


@dataclass(frozen=True, eq=False)
class Scan:
    """A point cloud in the sensor's frame; its arrays cannot be written to.

    Attributes
    ----------
    stamp : int
        Nanoseconds, at the scan's start.
    points : ndarray of shape (n, 3)
        float32 metres, finite. There may be none.
    times : ndarray of shape (n,), optional
        float32 seconds since `stamp` at which each point was measured.
    rings : ndarray of shape (n,), optional
        uint16 number of the laser that measured each point.
    imu : Imu, optional
        What the IMU measured since the scan before, to the first measurement at the scan's end or
        after it.
    intensities : ndarray of shape (n,), optional
        float32 share of the light that came back from each point, on the sensor's own scale;
        finite.
    reading : Reading
        Of a scan as it was read, neither changed nor from the cache.
    """

    stamp: int
    points: NDArray[np.float32]
    times: NDArray[np.float32] | None = None
    rings: NDArray[np.uint16] | None = None
    imu: Imu | None = None
    intensities: NDArray[np.float32] | None = None
    reading: Reading = UNREAD

    def __post_init__(self) -> None:
        # Decoded scans may be shared by all who use them, as those from the cache are.
        for array in (self.points, self.times, self.rings, self.intensities):
            if array is not None:
                array.flags.writeable = False

    def __len__(self) -> int:
        return len(self.points)

    def select(self, which: NDArray[Any]) -> "Scan":
        """The scan with some of its points, by a mask of shape (n,) or indices of shape (m,)."""
        index = np.flatnonzero(which) if which.dtype == np.bool_ else which
        return Scan(
            self.stamp,
            self.points.take(index, axis=0),
            None if self.times is None else self.times.take(index),
            None if self.rings is None else self.rings.take(index),
            self.imu,
            None if self.intensities is None else self.intensities.take(index),
        )

    @property
    def span(self) -> int:
        """Nanoseconds from the stamp to the last point; 0 where points have no times."""
        return round(float(self.times.max()) * 1e9) if self.times is not None and len(self) else 0


# What every sequence offers.


class SequenceError(AdaptuneError):
    """A recording that cannot be read as described."""


class Recording(Protocol):
    """Scans of a LiDAR in the order of their stamps, with its reference and its IMU."""

    @property
    def name(self) -> str:
        """Its file, for messages."""

    @property
    def n_messages(self) -> int:
        """About how many scans there are."""

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans; their stamps strictly increase."""

    def since(self, stamp: int) -> Iterator[Scan]:
        """Read the scans from `stamp` on, or from some before: views need those, too."""

    def backward(self) -> Iterator[Scan]:
        """Read the scans, the last one first."""

    def reference(self) -> Trajectory | None:
        """Poses of the LiDAR, if they are known."""

    def imu(self) -> Imu | None:
        """Measurements of the IMU, if there is one."""

    def played_at(self, stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        """Nanoseconds at which measurements of `stamps` arrive when played in real time."""


# When a scan began, and when each of its points was measured.


TIME_FIELDS = ("time", "t", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")
"""Names under which drivers write the time of a point."""

Mark = Literal["auto", "start", "end", "first_point", "sensor_clock"]
Unit = Literal["s", "ms", "us", "ns", "turn", "none"]
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LEAVE_OUT = "no `time_unit` mends them: write `time_unit: none` to leave the times out"

# A turn of a spinning LiDAR takes 0.05 to 0.2 s, a frame of the slowest accumulating ones 1 s.
_LONGEST = 10.0
# A header and its points are on the same clock if they are no further apart than this.
_SAME_CLOCK = 10.0
# Times below a day or so are absolute, too, if they agree with the header to this.
_AGREE = 0.1


class TimingError(AdaptuneError):
    """Times of points that are not plausible."""


def unit_of(span: float, least: float, most: float) -> str | None:
    """Unit in which a span as the driver wrote it takes from `least` to `most` seconds, if any."""
    return next((u for u, scale in _SECONDS.items() if least < span * scale < most), None)


@dataclass(frozen=True)
class Timing:
    """Meaning of the time stamps of a recording."""

    # Moment of the scan that the header's stamp marks. `auto` follows the points: they come before
    # the stamp or after it. Scans whose points have no time are stamped at their start. The stamp
    # of `first_point` is that point's, on whatever clock the points are; `sensor_clock` takes the
    # points' absolute times in place of the header's.
    stamp: Mark = "auto"
    # Unit of the points' times. If left out, floating-point numbers are seconds and whole ones
    # nanoseconds; the size of absolute times reveals their unit. A `turn` takes `period` seconds.
    unit: Unit | None = None
    # Seconds a scan takes; for `turn`, and scans stamped at their end whose points have no time.
    period: float = 0.1

    def resolve(
        self, stamp: int, values: NDArray[Any] | None, extent: tuple[float, float]
    ) -> tuple[int, NDArray[np.float32] | None, Reading]:
        """Find the start of a scan, and the time of each point since then.

        The header's stamp is nanoseconds. `values` are the times of the valid points as the driver
        wrote them, of shape (n,): relative to the stamp, or absolute, all finite; `extent` is the
        least and the greatest of them.

        Returns the start in nanoseconds, and the float32 seconds of the points since then, of
        shape (n,), none below zero.
        """
        if values is None or not len(values) or self.unit == "none":
            start = stamp - round(self.period * 1e9) if self.stamp == "end" else stamp
            none = values is None or self.unit == "none"
            return start, None if none else np.empty(0, np.float32), UNREAD
        values, extent = _unwrapped(values, extent)
        scale, absolute = self._scale(stamp, values.dtype, extent)
        self._check(values.dtype, extent, scale, absolute)
        zero, begin = self._start(stamp, extent, scale, absolute)
        if scale == 1.0 and zero == 0 and values.dtype == np.float32:
            times = np.ascontiguousarray(values)
        else:
            # The difference of small integers is not always one of them.
            small = values.dtype.kind in "iu" and values.dtype.itemsize < 8
            wide = values.astype(np.int64) if small else values
            times = ((wide - wide.dtype.type(zero)) * scale).astype(np.float32)
        start, clock = stamp + round(begin * 1e9), _nanoseconds(extent[0], scale)
        first, last = ((end - zero) * scale for end in extent)
        return start, times, Reading(start, first, last, scale, clock if absolute else None)

    def _check(
        self, dtype: np.dtype[Any], extent: tuple[float, float], scale: float, absolute: bool
    ) -> None:
        """Refuse times that no scan has."""
        low, high = extent
        span = (high - low) * scale
        # Seconds from the stamp to the first point, or from the last one to the stamp.
        away = max(low, -high, 0) * scale
        reach = max(abs(low), abs(high)) * scale
        if not span <= _LONGEST:
            what, unit = f"span {span:g} s", unit_of(high - low, 2e-3, 2.0)
            help_ = LEAVE_OUT if absolute or unit is None else f"write `time_unit: {unit}`"
        elif absolute or self.stamp == "first_point":
            return
        elif self.stamp == "sensor_clock":
            what, help_ = "are not absolute", "leave `stamp: sensor_clock` out"
        elif reach > _LONGEST or away > max(1.0, 2.0 * span):
            what = f"begin {low * scale:g} s after their scan's stamp: they are on another clock"
            help_ = "write `stamp: first_point` to count them from the first point of each scan"
        else:
            return
        if dtype == np.float32 and low > high - low and np.spacing(np.float32(high)) * scale > 1e-3:
            what, help_ = f"reach {reach:g} s, too much for float32", LEAVE_OUT
        raise TimingError(f"the times of the points {what}; {help_}")

    def _start(
        self, stamp: int, extent: tuple[float, float], scale: float, absolute: bool
    ) -> tuple[float, float]:
        """The points' time at the scan's start, and seconds from the header's stamp to it."""
        low, high = extent
        span = (high - low) * scale
        if self.stamp == "first_point":
            return low, 0.0
        if absolute:
            before = (_nanoseconds(low, scale) - stamp) * 1e-9
            same_clock = abs(before) <= _SAME_CLOCK or self.stamp == "sensor_clock"
            known = {"start": 0.0, "end": -span}
            return low, known.get(self.stamp, before if same_clock else 0.0)
        if low < 0:
            known = {"start": 0.0, "end": (low - max(high, 0)) * scale}
            return low, known.get(self.stamp, low * scale)
        # Counted from the scan's start, which is before the first ray that came back.
        return 0, -high * scale if self.stamp == "end" else 0.0

    def _scale(
        self, stamp: int, dtype: np.dtype[Any], extent: tuple[float, float]
    ) -> tuple[float, bool]:
        """Seconds per unit, and whether the times are absolute."""
        high = extent[1]
        if self.unit == "turn":
            return self.period, False
        given = None if self.unit is None else _SECONDS[self.unit]
        for scale in _SECONDS.values() if given is None else (given,):
            if _agree(stamp * 1e-9, extent, scale):
                return scale, True
        if given is not None:
            return given, high * given > 1e6 and dtype.itemsize == 8
        whole = dtype.kind in "iu"
        if dtype.itemsize < 8 or high < (1e12 if whole else 1e6):
            return (1e-9 if whole else 1.0), False
        # Seconds since 1970 are about 2e9: what is larger by 1e3 is in milliseconds, and so on.
        for scale, limit in ((1.0, 1e11), (1e-3, 1e14), (1e-6, 1e17)):
            if high < limit:
                return scale, True
        return 1e-9, True


def _nanoseconds(value: float, scale: float) -> int:
    return int(value if scale == 1e-9 else value * scale * 1e9)


def _agree(stamp: float, extent: tuple[float, float], scale: float) -> bool:
    """Whether the first or the last time is the stamp, in seconds, and not a short one."""
    low, high = (end * scale for end in extent)
    if 2.0 * low <= high - low or low < 0.5 * stamp or high - low > _LONGEST:
        return False
    return min(abs(low - stamp), abs(high - stamp)) <= _AGREE


def _unwrapped(
    values: NDArray[Any], extent: tuple[float, float]
) -> tuple[NDArray[Any], tuple[float, float]]:
    """The times and their extent; those below zero, which unsigned numbers wrap, as such."""
    size, spread = values.dtype.itemsize, extent[1] - extent[0]
    if values.dtype.kind == "u" and size >= 4 and spread > 2 ** (8 * size - 1):
        signed = values.view(f"i{size}")
        low, high = int(signed.min()), int(signed.max())
        if high - low < spread // 2:
            return signed, (low, high)
    return values, extent


AUTO = Timing()
"""Follow the points."""


# What some scans of a recording show about its times: whether they can be.


FIRST_SCANS = 10
"""Scans at the beginning of a recording that show how it is timed."""
SOONEST = 1_000_000
"""Nanoseconds from one scan to the next one; no LiDAR is faster."""
_POSSIBLE = "possible times of the points"


def doubts(readings: Sequence[Reading], period: float, timing: Timing = AUTO) -> Iterator[Finding]:
    """What is odd about scans that come every `period` seconds, and were read with `timing`."""
    if unread := next((reading.unread for reading in readings if reading.unread), ""):
        mend = "name their unit if it holds those of the points (`time_unit`), or write `none`"
        yield Finding((), f"the field {unread!r} looks like times and is not read", mend, of="imu")
    timed = [reading for reading in readings if reading.last == reading.last]
    if len(timed) >= 5 and period * 1e9 >= SOONEST:
        first, last = np.array([reading[1:3] for reading in timed]).T
        late, span = float(np.median(first)), float(np.median(last - first))
        if not (last > first).any():
            help_ = "no motion compensation is possible; `time_unit: none` leaves the times out"
            what = "all points of a scan have the same time"
            yield Finding((), what, help_, of="imu", lacks="a time for each point")
        elif span > 1.5 * period or span < min(0.05 * period, 0.002):
            what = f"the times of the points span {span:.3g} s, scans come every {period:.3g} s"
            help_, known = _mended(span, float(last.max()), timed[0].unit, period)
            sure = timing.unit is None and (known or span > 5.0 * period)
            help_ = f"{help_}, or name their unit if they are right"
            yield Finding((), what, help_, of="points", lacks=_POSSIBLE if sure else "")
        if late > 1.5 * period:
            what = f"the times of the points begin {late:.3g} s after their scan's stamp"
            help_ = "write `stamp: first_point` to count them from the first point of each scan"
            lacks = _POSSIBLE if timing.stamp == "auto" else ""
            yield Finding((), what, help_, of="points", lacks=lacks)
    both = [(reading.stamp, reading.stamp - reading.clock) for reading in timed if reading.clock]
    if len(both) >= 5:
        stamps, late_by = np.array(both).T
        # One clock may go faster than the other.
        drift = (late_by[-1] - late_by[0]) / max(stamps[-1] - stamps[0], 1)
        steps = np.diff(late_by) - drift * np.diff(stamps)
        if (shake := float(np.quantile(np.abs(steps), 0.8)) * 1e-6) > 5.0:
            what = f"the stamps shake by {shake:.0f} ms against the sensor's clock"
            help_ = "write `stamp: sensor_clock`, and `clock_offset` if needed"
            yield Finding((), what, help_, of="points")


def _mended(span: float, last: float, unit: float, period: float) -> tuple[str, bool]:
    """What to write so that points span a scan, and whether anything helps."""
    if unit == 1.0 and span > 0.9 and last < 1.001:
        help_ = f"write `time_unit: turn` and `period: {period:.3g}`"
        return f"they look like shares of a turn: {help_}", True
    right = unit_of(span / unit, 0.2 * period, 1.5 * period) if unit else None
    return LEAVE_OUT if right is None else f"write `time_unit: {right}`", right is not None


# Stretches of several recordings.


def stretch_numbers(place: NDArray[np.intp], stretch: NDArray[np.intp]) -> NDArray[np.intp]:
    """Number stretches of all recordings from 0 on.

    All of shape (n_frames,): each frame's number, that of its place, and of its stretch there.
    """
    _, number = np.unique(np.stack([place, stretch], axis=1), axis=0, return_inverse=True)
    return np.asarray(number.ravel())


# Parts of a sequence, in percent of its duration.


Fractions = tuple[float, float]
"""Where a part begins and ends, as fractions of the duration."""

_PERCENT = re.compile(r"\s*(\d+(?:\.\d+)?)\s*-\s*(\d+(?:\.\d+)?)\s*%\s*")


def read_part(given: Any) -> Fractions:
    """Read ``0-60%``, or two fractions; a ValueError says what is wrong."""
    begin, end = 1.0, 0.0
    if isinstance(given, str) and (match := _PERCENT.fullmatch(given)):
        begin, end = (float(percent) / 100.0 for percent in match.groups())
    elif isinstance(given, list | tuple) and [type(f) for f in given] in ([float] * 2, [int] * 2):
        begin, end = map(float, given)
    if not 0.0 <= begin < end <= 1.0:
        raise ValueError("give a part in percent of the duration, from 0 to 100, as in 0-60%")
    return begin, end


def part_name(name: str, part: Fractions) -> str:
    """Name of a part of a sequence, which may be the name of a file."""
    begin, end = (f"{100.0 * fraction:.10g}" for fraction in part)
    return f"{name}_{begin}-{end}"


Part = Annotated[Fractions, BeforeValidator(read_part)]


class Frame(NamedTuple):
    """A scan before it is decoded."""

    stamp: int  # nanoseconds, as recorded
    recorded: int  # nanoseconds on the clock of the recorder; the stamp where there is none
    load: Callable[[], Scan]  # decodes the scan


BACKWARD = "scans whose stamps do not come after the one before"
LEAP = "scans whose stamps leap ahead of the recording"


def in_order(frames: Iterable[Frame], left_out: Counter[str]) -> Iterator[Frame]:
    """Leave out the fewest frames so that stamps strictly increase.

    If a stamp does not come after the one before it, one of the two is wrong. The one that
    disagrees more with the recorder's clock is left out. A single stamp in the future thus costs
    one scan, not all that follow.
    """
    last: Frame | None = None
    doubtful: Frame | None = None
    for frame in frames:
        if doubtful is not None:
            if frame.stamp > doubtful.stamp:
                yield doubtful
                last = doubtful
            elif _leap(last, doubtful) > _leap(last, frame):
                left_out[LEAP] += 1
            else:
                left_out[BACKWARD] += 1
                continue
            doubtful = None
        if last is not None and frame.stamp <= last.stamp:
            left_out[BACKWARD] += 1
        elif last is None or _leap(last, frame) > _DOUBT:
            # The next frame decides. Other frames pass at once: they are decoded while their bytes
            # are still in the processor's cache.
            doubtful = frame
        else:
            yield frame
            last = frame
    if doubtful is not None:
        yield doubtful


# Nanoseconds; a recorder is seldom later than this.
_DOUBT = 50_000_000


def _leap(last: Frame | None, frame: Frame) -> int:
    """By how much a stamp has moved against the recorder's clock."""
    usual = 0 if last is None else last.stamp - last.recorded
    return abs(frame.stamp - frame.recorded - usual)
