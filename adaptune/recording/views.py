"""Views of a sequence: parts, losses, speeds and disturbances, without a copy of its clouds.

A view changes a scan depending on the scan and the view's seed alone. The same scans are lost and
the same noise is added in every process, in either direction, whatever was cut before.
"""

from collections.abc import Callable, Iterable, Iterator
from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from functools import cache as once
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.recording.compensation import compensate_neighbours, compensate_rotation
from adaptune.recording.config import DropConfig, NoiseConfig, SpeedConfig
from adaptune.recording.scan import Imu, Recording, Scan, SequenceError
from adaptune.trajectory import Trajectory

# Nanoseconds after the first scan at which an IMU that is on the same clock has begun.
_LATE = 10 * 10**9

Part = tuple[float, float | None]
"""Seconds since the first scan: [start, stop), to the end where stop is None."""


class Reversible(Recording, Protocol):
    """A sequence that can be read from its end."""

    def backward(self) -> Iterator[Scan]:
        """Read the scans, the last one first."""


@dataclass(frozen=True, eq=False)
class View:
    """A sequence of which every scan is changed or left out by itself."""

    inner: Reversible  # what it is a view of
    # Gives the scan as seen, or None to leave it out.
    change: Callable[[Scan], Scan | None] = lambda scan: scan
    # What the view does to poses, to measurements and to the time of arrival.
    of_reference: Callable[[Trajectory], Trajectory] = lambda trajectory: trajectory
    of_imu: Callable[[Imu], Imu] = lambda imu: imu
    of_clock: Callable[[NDArray[np.int64]], NDArray[np.int64]] = lambda stamps: stamps

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
        return self._changed(self.inner)

    def backward(self) -> Iterator[Scan]:
        """Read the scans, the last one first."""
        return self._changed(self.inner.backward())

    def _changed(self, scans: Iterable[Scan]) -> Iterator[Scan]:
        seen = None
        for scan in scans:
            if (changed := self.change(scan)) is not None:
                seen = changed
                yield seen
        if seen is None:
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
        return self.of_clock(self.inner.played_at(stamps))


@dataclass(frozen=True, eq=False)
class WithoutMotion(View):
    """Points as if the sensor had stood still since the scan's start, its velocity being constant.

    The velocity is that since the scan read before, which is registered for it.
    """

    def _changed(self, scans: Iterable[Scan]) -> Iterator[Scan]:
        return compensate_neighbours(_timed(self.name, scan) for scan in scans)


def without_rotation(sequence: Reversible) -> View:
    """Points as if the sensor had not turned since the scan's start, by its gyroscope."""
    imu = once(sequence.imu)

    def change(scan: Scan) -> Scan:
        if (measured := imu()) is None:
            return scan
        return compensate_rotation(_timed(sequence.name, scan), measured)

    return View(sequence, change)


def _timed(name: str, scan: Scan) -> Scan:
    if scan.times is None and len(scan):
        raise SequenceError(f"{name}: its points have no times; leave `compensate` out")
    return scan


@dataclass(frozen=True, eq=False)
class _First:
    """Stamp of the first scan, read when it is wanted."""

    sequence: Recording

    @cached_property
    def stamp(self) -> int:
        return next(iter(self.sequence)).stamp

    def within(self, stamp: int, part: Part) -> bool:
        seconds = (stamp - self.stamp) * 1e-9
        start, stop = part
        return seconds >= start and (stop is None or seconds < stop)


def _cut(sequence: Reversible, parts: Items[Part]) -> View:
    """Only these parts of it; stamps stay as they are."""
    first = _First(sequence)
    return View(
        sequence,
        lambda scan: scan if any(first.within(scan.stamp, part) for part in parts) else None,
    )


def _drop(sequence: Reversible, given: DropConfig) -> View:
    """Lose a share of the scans of a part, each at random by itself."""
    first, part = _First(sequence), (given.start, given.stop)

    def lose(scan: Scan) -> Scan | None:
        lost = first.within(scan.stamp, part) and _rng(given.seed, scan).random() < given.share
        return None if lost else scan

    return View(sequence, lose)


def _speed(sequence: Reversible, given: SpeedConfig) -> View:
    """A part of it arrives `given.factor` times faster.

    Scans, stamps and poses stay the same. Only `played_at` changes, for odometries that run
    against the clock.
    """
    first = _First(sequence)

    def arrival(stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        start = first.stamp + round(given.start * 1e9)
        # Later than any stamp, and small enough to subtract from.
        stop = 2**62 if given.stop is None else first.stamp + round(given.stop * 1e9)
        inside = np.clip(stamps, start, stop) - start
        saved: NDArray[np.int64] = np.rint(inside * (1.0 - 1.0 / given.factor)).astype(np.int64)
        return stamps - saved

    return View(sequence, of_clock=arrival)


def _noise(sequence: Reversible, given: NoiseConfig) -> View:
    """Move every point along its ray by a normal error."""

    def disturb(scan: Scan) -> Scan:
        ranges = np.linalg.norm(scan.points, axis=1)
        error = _rng(given.seed, scan).normal(0.0, given.sigma, len(scan)).astype(np.float32)
        # A point does not come out behind the sensor.
        scale = np.maximum(1.0 + error / ranges, 1e-3)
        return replace(scan, points=scan.points * scale[:, None])

    return View(sequence, disturb)


def _transform(sequence: Reversible, given: Any) -> View:
    """See it from another frame, as if the LiDAR were mounted differently."""
    T_seen_sensor = geometry.to_pose(given)
    R = T_seen_sensor[:3, :3].astype(np.float32)
    t = T_seen_sensor[:3, 3].astype(np.float32)
    T_sensor_seen = geometry.invert(T_seen_sensor)
    return View(
        sequence,
        lambda scan: replace(scan, points=scan.points @ R.T + t),
        lambda poses: replace(poses, T_world_sensor=poses.T_world_sensor @ T_sensor_seen),
        lambda imu: replace(imu, T_sensor_imu=T_seen_sensor @ imu.T_sensor_imu),
    )


@dataclass(frozen=True, eq=False)
class Reversed(View):
    """A sequence played backwards: the last scan comes first, and time still goes forward."""

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans."""
        return map(self._mirror, self.inner.backward())

    def backward(self) -> Iterator[Scan]:
        """Read the scans, the last one first."""
        return map(self._mirror, self.inner)

    @cached_property
    def _sum(self) -> int:
        """Sum of a moment and its mirror image."""
        first, last = next(iter(self.inner)), next(self.inner.backward())
        return first.stamp + last.stamp + last.span

    def _mirror(self, scan: Scan) -> Scan:
        times, span = scan.times, scan.span
        if times is not None:
            times = np.maximum(np.float32(span * 1e-9) - times, np.float32(0.0))
        return replace(scan, stamp=self._sum - scan.stamp - span, times=times)

    def reference(self) -> Trajectory | None:
        """Poses of the LiDAR in mirrored time."""
        trajectory = self.inner.reference()
        if trajectory is None:
            return None
        stamps = (self._sum - trajectory.stamps)[::-1]
        return replace(trajectory, stamps=stamps, T_world_sensor=trajectory.T_world_sensor[::-1])

    def imu(self) -> Imu | None:
        """Measurements in mirrored time: it turns the other way, and accelerates the same."""
        imu = self.inner.imu()
        if imu is None:
            return None
        return replace(
            imu,
            stamps=(self._sum - imu.stamps)[::-1],
            angular_velocity=-imu.angular_velocity[::-1],
            acceleration=imu.acceleration[::-1],
        )

    def played_at(self, stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        """When measurements of `stamps` arrive."""
        mirrored: NDArray[np.int64] = self._sum - self.inner.played_at(self._sum - stamps)
        return mirrored


VIEWS: dict[str, Callable[[Reversible, Any], Reversible]] = {
    "cut": _cut,
    "drop": _drop,
    "speed": _speed,
    "reverse": lambda sequence, _: Reversed(sequence),
    "noise": _noise,
    "transform": _transform,
}
"""By the names of a study's views, each with its settings."""


class WithImu:
    """A sequence whose scans carry the IMU's measurements."""

    def __init__(self, inner: Recording):
        self.inner = inner
        self.name, self.n_messages = inner.name, inner.n_messages
        self.reference, self.played_at = inner.reference, inner.played_at
        self.imu = once(inner.imu)

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans; a SequenceError if there is no IMU, or it measured at another time."""
        imu = self.imu()
        if imu is None or not len(imu):
            raise SequenceError(f"{self.name}: holds no measurements of an IMU; name their topic")
        first: int | None = None
        for scan in self.inner:
            if first is None:
                begin, end = imu.stamps[0], imu.stamps[-1]
                if not begin - _LATE < scan.stamp < end:
                    first_scan, *covered = (f"{t * 1e-9:.3f} s" for t in (scan.stamp, begin, end))
                    raise SequenceError(
                        f"{self.name}: the IMU covers {' to '.join(covered)}, the first scan is of "
                        f"{first_scan}: record both on the same clock, or leave `imu` out"
                    )
                # Those during the first scan, and the one before.
                first = max(int(imu.stamps.searchsorted(scan.stamp, "right")) - 1, 0)
            last = max(int(imu.stamps.searchsorted(scan.stamp + scan.span)) + 1, first)
            yield replace(scan, imu=imu.part(first, last))
            first = last


def _rng(seed: int, scan: Scan) -> np.random.Generator:
    return np.random.default_rng([seed, scan.stamp % 2**64])
