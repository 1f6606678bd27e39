"""Views of a sequence: parts, losses, speeds and disturbances, without a copy of its clouds.

A view changes a scan depending on the scan alone. The same scans are lost and the same noise is
added in every process, in either direction, whatever was cut before.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache as once
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.recording.compensation import compensate_neighbours
from adaptune.recording.scan import Imu, Recording, Scan, SequenceError
from adaptune.trajectory import Trajectory

# Nanoseconds after the first scan at which an IMU that is on the same clock has begun.
_LATE = 10 * 10**9


@dataclass(frozen=True, eq=False)
class View:
    """A sequence whose scans are changed or left out, and read from its end if `reverse`."""

    inner: Recording
    # What it does to the scans, to poses, to measurements and to the time of arrival.
    of_scans: Callable[[Iterator[Scan]], Iterable[Scan]] = lambda scans: scans
    of_reference: Callable[[Trajectory], Trajectory] = lambda trajectory: trajectory
    of_imu: Callable[[Imu], Imu] = lambda imu: imu
    clock: Callable[[NDArray[np.int64]], NDArray[np.int64]] | None = None  # None: as before
    reverse: bool = False

    @property
    def name(self) -> str:
        """The recording's file."""
        return self.inner.name

    @property
    def n_messages(self) -> int:
        """At least as many as there are scans."""
        return self.inner.n_messages

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans; a SequenceError if the view leaves none."""
        return self._seen(self.inner.backward() if self.reverse else iter(self.inner))

    def since(self, stamp: int) -> Iterator[Scan]:
        """Read the scans from about `stamp` on; played backwards, all of them."""
        return iter(self) if self.reverse else self._seen(self.inner.since(stamp))

    def backward(self) -> Iterator[Scan]:
        """Read the scans, the last one first."""
        return self._seen(iter(self.inner) if self.reverse else self.inner.backward())

    def _seen(self, scans: Iterator[Scan]) -> Iterator[Scan]:
        scan = None
        for scan in self.of_scans(scans):
            yield scan
        if scan is None:
            raise SequenceError(f"{self.name}: its views leave no scan; cut or drop less")

    def reference(self) -> Trajectory | None:
        """Poses of the LiDAR as seen."""
        trajectory = self.inner.reference()
        return None if trajectory is None else self.of_reference(trajectory)

    def imu(self) -> Imu | None:
        """Measurements of the IMU as seen."""
        imu = self.inner.imu()
        return None if imu is None else self.of_imu(imu)

    def played_at(self, stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        """When measurements of `stamps` arrive."""
        return (self.clock or self.inner.played_at)(stamps)


def without_motion(sequence: Recording) -> View:
    """Points as if the sensor had kept its place since the scan's start, at constant velocity.

    The velocity is that since the scan read before, which is registered for it.
    """
    return View(sequence, lambda scans: compensate_neighbours(_timed(sequence, scans)))


def _timed(sequence: Recording, scans: Iterator[Scan]) -> Iterator[Scan]:
    for scan in scans:
        if scan.times is None and len(scan):
            raise SequenceError(
                f"{sequence.name}: its points have no times; leave `compensate` out"
            )
        yield scan


def with_imu(sequence: Recording) -> View:
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

    return View(sequence, carrying)


def _cut(sequence: Recording, parts: Sequence[tuple[float, float]]) -> View:
    """Only these parts of it; stamps stay as they are."""
    first = once(lambda: next(iter(sequence)).stamp)

    def kept(scan: Scan) -> bool:
        seconds = (scan.stamp - first()) * 1e-9
        return any(start <= seconds < stop for start, stop in parts)

    return View(sequence, partial(filter, kept))


def _drop(sequence: Recording, share: float) -> View:
    """Lose a share of the scans, each at random by itself."""
    return View(sequence, partial(filter, lambda scan: _rng(scan).random() >= share))


def _speed(sequence: Recording, factor: float) -> View:
    """Arrive so many times faster.

    Scans, stamps and poses stay the same. Only `played_at` changes, for odometries that run
    against the clock.
    """
    first = once(lambda: next(iter(sequence)).stamp)

    def arrival(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        since = sequence.played_at(stamps) - first()
        return np.asarray(first() + np.rint(since / factor).astype(np.int64))

    return View(sequence, clock=arrival)


def _noise(sequence: Recording, sigma: float) -> View:
    """Move every point along its ray by a normal error."""

    def disturb(scan: Scan) -> Scan:
        ranges = np.linalg.norm(scan.points, axis=1)
        error = _rng(scan).normal(0.0, sigma, len(scan)).astype(np.float32)
        # A point does not come out behind the sensor.
        scale = np.maximum(1.0 + error / ranges, 1e-3)
        return replace(scan, points=scan.points * scale[:, None])

    return View(sequence, partial(map, disturb))


def _transform(sequence: Recording, given: Any) -> View:
    """See it from another frame, as if the LiDAR were mounted differently."""
    T_seen_sensor = geometry.to_pose(given)
    R = T_seen_sensor[:3, :3].astype(np.float32)
    t = T_seen_sensor[:3, 3].astype(np.float32)
    T_sensor_seen = geometry.invert(T_seen_sensor)
    return View(
        sequence,
        lambda scans: (replace(scan, points=scan.points @ R.T + t) for scan in scans),
        lambda poses: replace(poses, T_world_sensor=poses.T_world_sensor @ T_sensor_seen),
        lambda imu: replace(imu, T_sensor_imu=T_seen_sensor @ imu.T_sensor_imu),
    )


def _reverse(sequence: Recording, _: Any) -> View:
    """Played backwards: the last scan comes first, and time still goes forward."""

    @once
    def total() -> int:
        """Sum of a moment and its mirror image."""
        first, last = next(iter(sequence)), next(sequence.backward())
        return first.stamp + last.stamp + last.span

    def mirror(scan: Scan) -> Scan:
        times, span = scan.times, scan.span
        if times is not None:
            times = np.maximum(np.float32(span * 1e-9) - times, np.float32(0.0))
        return replace(scan, stamp=total() - scan.stamp - span, times=times)

    def poses(given: Trajectory) -> Trajectory:
        stamps = (total() - given.stamps)[::-1]
        return replace(given, stamps=stamps, T_world_sensor=given.T_world_sensor[::-1])

    def measured(imu: Imu) -> Imu:
        """It turns the other way, and accelerates the same."""
        stamps, turning = (total() - imu.stamps)[::-1], -imu.angular_velocity[::-1]
        return replace(
            imu, stamps=stamps, angular_velocity=turning, acceleration=imu.acceleration[::-1]
        )

    def clock(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        return total() - sequence.played_at(total() - stamps)

    return View(sequence, partial(map, mirror), poses, measured, clock, reverse=True)


VIEWS: dict[str, Callable[[Recording, Any], View]] = {
    "cut": _cut,
    "drop": _drop,
    "speed": _speed,
    "reverse": _reverse,
    "noise": _noise,
    "transform": _transform,
}
"""By the names of a study's views, each with its settings."""


def _rng(scan: Scan) -> np.random.Generator:
    return np.random.default_rng([0, scan.stamp % 2**64])
