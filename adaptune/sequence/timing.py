"""When a scan began, and when each of its points was measured."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError

TIME_FIELDS = ("time", "t", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset")
"""Names under which drivers write the time of a point."""

Unit = Literal["s", "ms", "us", "ns"]
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

# A turn of a spinning LiDAR takes 0.05 to 0.2 s, a frame of the slowest accumulating ones 1 s.
_LONGEST = 10.0
# A header and its points are on the same clock if they are no further apart than this.
_SAME_CLOCK = 10.0


class TimingError(AdaptuneError):
    """Times of points that are not plausible."""


@dataclass(frozen=True)
class Timing:
    """Meaning of the time stamps of a recording."""

    # Moment of the scan that the header's stamp marks. `auto` follows the points: they come before
    # the stamp or after it. Scans whose points have no time are stamped at their start.
    stamp: Literal["auto", "start", "end"] = "auto"
    # Unit of the points' times. If left out, floating-point numbers are seconds and whole ones
    # nanoseconds; the size of absolute times reveals their unit.
    unit: Unit | None = None
    # Seconds a scan takes; only for scans stamped at their end whose points have no time.
    period: float = 0.1

    def resolve(
        self, stamp: int, values: NDArray[Any] | None, extent: tuple[float, float]
    ) -> tuple[int, NDArray[np.float32] | None]:
        """Find the start of a scan, and the time of each point since then.

        Parameters
        ----------
        stamp
            The header's, in nanoseconds.
        values
            Times of the valid points as the driver wrote them, of shape (n,): relative to the
            stamp, or absolute. All finite.
        extent
            The least and the greatest of them.

        Returns
        -------
        start : int
            Nanoseconds.
        times : ndarray of shape (n,)
            float32 seconds since `start`, none below zero.
        """
        if values is None or not len(values):
            start = stamp - round(self.period * 1e9) if self.stamp == "end" else stamp
            return start, None if values is None else np.empty(0, np.float32)
        low, high = extent
        scale, absolute = self._scale(values.dtype, high)
        span = (high - low) * scale
        what = ""
        if not span <= _LONGEST:
            what = f"span {span:g} s"
        elif not absolute and max(abs(low), abs(high)) * scale > _LONGEST:
            what = f"reach {high * scale:g} s from the scan's stamp"
        if what:
            help_ = "if they are in another unit, name it with `time_unit: s|ms|us|ns`"
            raise TimingError(f"the times of the points {what}; {help_}")
        zero, begin = self._start(stamp, extent, scale, absolute)
        if scale == 1.0 and zero == 0 and values.dtype == np.float32:
            times = np.ascontiguousarray(values)
        else:
            # The difference of small integers is not always one of them.
            small = values.dtype.kind in "iu" and values.dtype.itemsize < 8
            wide = values.astype(np.int64) if small else values
            times = ((wide - wide.dtype.type(zero)) * scale).astype(np.float32)
        return stamp + round(begin * 1e9), times

    def _start(
        self, stamp: int, extent: tuple[float, float], scale: float, absolute: bool
    ) -> tuple[float, float]:
        """The points' time at the scan's start, and seconds from the header's stamp to it."""
        low, high = extent
        span = (high - low) * scale
        if absolute:
            nanoseconds = low if scale == 1e-9 else low * scale * 1e9
            before = (int(nanoseconds) - stamp) * 1e-9
            same_clock = abs(before) <= _SAME_CLOCK
            known = {"start": 0.0, "end": -span}
            return low, known.get(self.stamp, before if same_clock else 0.0)
        if low < 0:
            known = {"start": 0.0, "end": (low - max(high, 0)) * scale}
            return low, known.get(self.stamp, low * scale)
        # Counted from the scan's start, which is before the first ray that came back.
        return 0, -high * scale if self.stamp == "end" else 0.0

    def _scale(self, dtype: np.dtype[Any], high: float) -> tuple[float, bool]:
        """Seconds per unit, and whether the times are absolute."""
        if self.unit is not None:
            scale = _SECONDS[self.unit]
            return scale, high * scale > 1e6 and dtype.itemsize == 8
        whole = dtype.kind in "iu"
        if dtype.itemsize < 8 or high < (1e12 if whole else 1e6):
            return (1e-9 if whole else 1.0), False
        # Seconds since 1970 are about 2e9: what is larger by 1e3 is in milliseconds, and so on.
        for scale, limit in ((1.0, 1e11), (1e-3, 1e14), (1e-6, 1e17)):
            if high < limit:
                return scale, True
        return 1e-9, True


AUTO = Timing()
"""Follow the points."""
