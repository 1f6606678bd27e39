"""When a scan began, and when each of its points was measured."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError, Finding
from adaptune.recording.scan import UNREAD, Reading

TIME_FIELDS = ("time", "t", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")
"""Names under which drivers write the time of a point."""

Mark = Literal["auto", "start", "end", "first_point", "sensor_clock"]
Unit = Literal["s", "ms", "us", "ns", "turn", "none"]
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LEAVE_OUT = "no `time_unit` mends them: write `time_unit: none` to leave the times out"

# A turn of a spinning LiDAR takes 0.05 to 0.2 s, a frame of the slowest accumulating ones 1 s.
_LONGEST_SCAN = 10.0
# A header and its points are on the same clock if they are no further apart than this.
_SAME_CLOCK = 10.0
_SAME_SECONDS = (
    0.1  # times below a day or so are absolute, too, if they agree with the header to this
)


class TimingError(AdaptuneError):
    """Times of points that are not plausible."""


def unit_of(span: float, least: float, most: float) -> str | None:
    """Unit in which a span as the driver wrote it takes from `least` to `most` seconds, if any."""
    return next((u for u, scale in _UNITS.items() if least < span * scale < most), None)


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
        """Start of a scan in nanoseconds, float32 seconds of the points since then, and how read.

        `values` are the times of the valid points as the driver wrote them, of shape (n,): relative
        to the header's stamp, or absolute, all finite; `extent` is the least and the greatest of
        them. No point is before the start.
        """
        if values is None or not len(values) or self.unit == "none":
            start = stamp - round(self.period * 1e9) if self.stamp == "end" else stamp
            none = values is None or self.unit == "none"
            return start, None if none else np.empty(0, np.float32), UNREAD
        spread = extent[1] - extent[0]
        values, extent = _unwrapped(stamp, values, extent)
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
        start = stamp + round(begin * 1e9)
        clock = _nanoseconds(extent[0], scale) if absolute else None
        first, last = ((end - zero) * scale for end in extent)
        wrapped = spread * scale if extent[1] - extent[0] < spread else 0.0
        return start, times, Reading(start, first, last, scale, clock, wrapped=wrapped)

    def _check(
        self, dtype: np.dtype[Any], extent: tuple[float, float], scale: float, absolute: bool
    ) -> None:
        low, high = extent
        span = (high - low) * scale
        # Seconds from the stamp to the first point, or from the last one to the stamp.
        away = max(low, -high, 0) * scale
        reach = max(abs(low), abs(high)) * scale
        if not span <= _LONGEST_SCAN:
            what, unit = f"span {span:g} s", unit_of(high - low, 2e-3, 2.0)
            help_ = LEAVE_OUT if absolute or unit is None else f"write `time_unit: {unit}`"
        elif absolute or self.stamp == "first_point":
            return
        elif self.stamp == "sensor_clock":
            what, help_ = "are not absolute", "leave `stamp: sensor_clock` out"
        elif reach > _LONGEST_SCAN or away > max(1.0, 2.0 * span):
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
        given = None if self.unit is None else _UNITS[self.unit]
        for scale in _UNITS.values() if given is None else (given,):
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
    if 2.0 * low <= high - low or low < 0.5 * stamp or high - low > _LONGEST_SCAN:
        return False
    return min(abs(low - stamp), abs(high - stamp)) <= _SAME_SECONDS


def _unwrapped(
    stamp: int, values: NDArray[Any], extent: tuple[float, float]
) -> tuple[NDArray[Any], tuple[float, float]]:
    """The times and their extent; those below zero, which unsigned numbers wrap, as such.

    Also those that wrapped as nanoseconds of 32 bits before they became other numbers.
    """
    (low, high), size = extent, values.dtype.itemsize
    unsigned = values.dtype.kind == "u" and size >= 4
    turns = [2 ** (8 * size)] if unsigned else [2**32 * 1e-9 / s for s in _UNITS.values()]
    # All may be below zero; but a simulator's clock may be as small as four bytes.
    below = unsigned and size == 4 and low > 0.9 * 2**32 and stamp > 10**10
    for turn in (t for t in turns if below or 0.5 * t < high - low < 1.001 * t):
        late = values > low + turn / 2
        moved = values.view(f"i{size}") if unsigned else np.where(late, values - turn, values)
        first, last = moved.min().item(), moved.max().item()
        if last - first < 0.25 * turn:
            return moved, (first, last)
    return values, extent


AUTO = Timing()  # follow the points
FIRST_SCANS = 10  # scans at the beginning of a recording that show how it is timed
SOONEST = 1_000_000  # nanoseconds from one scan to the next one; no LiDAR is faster
_POSSIBLE = "possible times of the points"


def doubts(readings: Sequence[Reading], period: float, timing: Timing = AUTO) -> Iterator[Finding]:
    """What is odd about scans that come every `period` seconds, and were read with `timing`."""
    if unread := next((reading.unread for reading in readings if reading.unread), ""):
        mend = "name their unit if it holds those of the points (`time_unit`), or write `none`"
        yield Finding((), f"the field {unread!r} looks like times and is not read", mend, of="imu")
    timed = [reading for reading in readings if reading.last == reading.last]
    if wrapped := [reading.wrapped for reading in timed if reading.wrapped]:
        what = f"in {len(wrapped)} of {len(timed)} scans some points are {max(wrapped):.2f} s later"
        what += " than the others: times below zero were stored without a sign"
        yield Finding((), what, "adaptune takes them as below zero", of="points")
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
