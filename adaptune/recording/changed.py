"""Recordings whose scans are changed while they are read: an IMU's measurements are added."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache as once

from adaptune.recording.scan import Imu, Recording, Scan, SequenceError
from adaptune.trajectory import Trajectory

_LATE = 10 * 10**9
"""Nanoseconds after the first scan at which an IMU that is on the same clock has begun."""


@dataclass(frozen=True, eq=False)
class ChangedRecording:
    """A recording whose scans pass through `change`."""

    inner: Recording
    change: Callable[[Iterator[Scan]], Iterable[Scan]]

    @property
    def name(self) -> str:
        """The recording's file."""
        return self.inner.name

    @property
    def n_messages(self) -> int:
        """About how many scans there are."""
        return self.inner.n_messages

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans."""
        yield from self.change(iter(self.inner))

    def since(self, stamp: int) -> Iterator[Scan]:
        """Read the scans from a little before `stamp` on."""
        yield from self.change(self.inner.since(stamp))

    def reference(self) -> Trajectory | None:
        """Poses of the LiDAR, if they are known."""
        return self.inner.reference()

    def imu(self) -> Imu | None:
        """Measurements of the IMU, if there is one."""
        return self.inner.imu()


def with_imu(sequence: Recording) -> Recording:
    """Scans carry the IMU's measurements.

    Reading raises a SequenceError if there is no IMU, or it measured at another time.
    """
    measurements = once(sequence.imu)

    def carrying(scans: Iterator[Scan]) -> Iterator[Scan]:
        imu = measurements()
        if imu is None or not len(imu):
            what = "holds no measurements of an IMU; name their topic"
            raise SequenceError(f"{sequence.name}: {what}")
        first: int | None = None
        for scan in scans:
            if first is None:
                begin, end = imu.stamps[0], imu.stamps[-1]
                if not begin - _LATE < scan.stamp < end:
                    first_scan, *covered = (f"{t * 1e-9:.3f} s" for t in (scan.stamp, begin, end))
                    raise SequenceError(
                        f"{sequence.name}: the IMU covers {' to '.join(covered)}, the first scan "
                        f"is of {first_scan}: record both on the same clock, or leave `imu` out"
                    )
                # Those during the first scan, and the one before.
                first = max(int(imu.stamps.searchsorted(scan.stamp, "right")) - 1, 0)
            last = max(int(imu.stamps.searchsorted(scan.stamp + scan.span)) + 1, first)
            yield replace(scan, imu=imu.part(first, last))
            first = last

    return ChangedRecording(sequence, carrying)
