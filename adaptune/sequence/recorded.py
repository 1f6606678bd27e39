"""A part of a recording, with its reference and its IMU."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.sequence import cache
from adaptune.sequence.compensation import turning_of
from adaptune.sequence.fingerprint import alongside
from adaptune.sequence.imu import USUAL, Imu, ImuNoise, clock_offset
from adaptune.sequence.scan import Scan
from adaptune.sequence.sequence import SequenceError
from adaptune.sequence.source import BACKWARD, Repairs, Section, Source, in_order
from adaptune.trajectory import Trajectory, TrajectoryError, is_kitti, read_kitti, read_trajectory

_log = logging.getLogger(__name__)

# At most so many scans are registered to find a clock offset.
_MOST_SCANS = 600

# Metres per second. No platform that carries a LiDAR is faster; only a jump of the reference is.
_FASTEST = 100.0


@dataclass(frozen=True, eq=False)
class ReferenceSettings:
    """Where reference poses come from and how they become those of the LiDAR."""

    source: str | Path | None = None  # a topic or a file; the recording's own poses if left out
    child_frame: str | None = None  # on a topic of transforms, the frame whose poses to take
    # The LiDAR's pose in the frame that the poses are of, of shape (4, 4).
    T_reference_sensor: Poses | None = None
    clock_offset: float = 0.0  # seconds to add to the poses' stamps
    max_gap: float = 1.0  # seconds. Between poses further apart the reference is unknown.
    given: bool = True  # whether there is one; if not, not even the recording's own poses count


@dataclass(frozen=True, eq=False)
class ImuSettings:
    """Which IMU, and how its measurements become SI units."""

    topic: str | None = None  # the only one when left out
    T_sensor_imu: Poses | None = None  # the IMU's pose in the LiDAR's frame, of shape (4, 4)
    scale: float = 1.0  # metres per second squared in a unit of its accelerometer
    noise: ImuNoise = USUAL


_WHOLE = Section()
_OWN = ReferenceSettings()


class RecordedSequence:
    """A part of a recording, with its reference.

    Its methods raise a SequenceError where the recording cannot be read as described.

    Parameters
    ----------
    source
        The recording.
    section
        The part to read.
    reference, imu
        Where its motion comes from; no IMU if left out.
    key
        Key of the decoded scans in the cache; not cached if left out.
    """

    def __init__(
        self,
        source: Source,
        section: Section = _WHOLE,
        reference: ReferenceSettings = _OWN,
        imu: ImuSettings | None = None,
        key: str | None = None,
    ):
        self.source, self.section, self.key = source, section, key
        self._reference, self._imu = reference, imu

    @property
    def name(self) -> str:
        """The recording's file."""
        return self.source.name

    @property
    def n_messages(self) -> int:
        """About how many scans of the recording it uses."""
        begin, end = self.source.span() or (0, 0)
        return self.section.count(self.source.n_messages, (end - begin) * 1e-9)

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans one after the other.

        Scans whose stamps do not come after the one before are left out, counted, and reported in
        the log.
        """
        repairs = Repairs()
        kept = None if self.key is None else cache.find(self.key)
        if kept is not None:
            yield from kept
            repairs.counts = kept.about["left_out"]
        else:
            about = self.source.about() | {"left_out": repairs.counts}
            decoded = self._decode(repairs)
            with alongside(self.source.files):
                yield from decoded if self.key is None else cache.tee(decoded, self.key, about)
        repairs.report(self.name)

    def _decode(self, repairs: Repairs) -> Iterator[Scan]:
        last = None
        for frame in self.section.of(in_order(self.source.frames(), repairs)):
            scan = frame.load()
            if last is not None and scan.stamp <= last:
                repairs.add(BACKWARD)
                continue
            last = scan.stamp
            yield scan
        if last is None:
            raise SequenceError(
                f"{self.name}: no scan {self.section}; change start, stop or stride"
            )

    def backward(self) -> Iterator[Scan]:
        """Read the scans, the last one first. A bag is decoded to the cache before."""
        if self.source.random_access:
            frames = list(self.section.of(in_order(self.source.frames(), Repairs())))
            yield from (frame.load() for frame in reversed(frames))
            return
        if self.key is not None and cache.find(self.key) is None:
            for _ in self:
                pass
        kept = None if self.key is None else cache.find(self.key)
        if kept is None:
            raise SequenceError(
                f"{self.name}: to be read backwards it must be kept decoded: leave `cache` on, and "
                f"let the cache grow (ADAPTUNE_CACHE_GB) where it is too small"
            )
        yield from (kept[i] for i in reversed(range(len(kept))))

    def played_at(self, stamps: NDArray[np.int64]) -> NDArray[np.int64]:
        """Recordings are played as they were recorded."""
        return stamps

    def imu(self) -> Imu | None:
        """Measurements of the IMU in SI units, if one is set."""
        settings = self._imu
        imu = None if settings is None else self.source.imu(settings.topic)
        if settings is None or imu is None:
            return None
        T = imu.T_sensor_imu if settings.T_sensor_imu is None else settings.T_sensor_imu
        acceleration = imu.acceleration * settings.scale
        return replace(imu, acceleration=acceleration, T_sensor_imu=T, noise=settings.noise)

    def reference(self) -> Trajectory | None:
        """Poses of the LiDAR, if they are known."""
        settings = self._reference
        if not settings.given:
            return None
        if isinstance(settings.source, Path):
            trajectory: Trajectory | None = self._from_file(settings.source)
        else:
            trajectory = self.source.poses(settings.source, settings.child_frame)
        if trajectory is None:
            return None
        T = trajectory.T_world_sensor
        if settings.T_reference_sensor is not None:
            T = T @ settings.T_reference_sensor
        stamps = trajectory.stamps + round(settings.clock_offset * 1e9)
        trajectory = Trajectory(stamps, T, settings.max_gap)
        self._check(trajectory)
        return trajectory

    def check(self) -> None:
        """Find early what would fail while reading the scans, without reading them.

        The section may begin after the end; the reference may be unreadable or of another time. Of
        poses on a topic, only the first one is checked.
        """
        span = self.source.span()
        if span is None:
            return
        seconds, start = (span[1] - span[0]) * 1e-9, self.section.start
        if start > seconds:
            what = f"start = {start:g} s is beyond its end, it lasts {seconds:.1f} s"
            raise SequenceError(f"{self.name}: {what}")
        settings = self._reference
        if isinstance(settings.source, str):
            first = self.source.first_pose(settings.source)
            offset = round(settings.clock_offset * 1e9)
            if first is None or abs(first + offset - span[0]) <= span[1] - span[0]:
                return
        if isinstance(settings.source, Path) and is_kitti(settings.source):
            self._check_count(settings.source, len(read_kitti(settings.source)))
        else:
            self.reference()

    def _check_count(self, path: Path, n_poses: int) -> None:
        if n_poses != self.source.n_messages:
            raise SequenceError(
                f"{path}: {n_poses} poses without stamps do not go with {self.source.n_messages} "
                f"scans of {self.name}; give a file with stamps (TUM)"
            )

    def _from_file(self, path: Path) -> Trajectory:
        try:
            if not is_kitti(path):
                return read_trajectory(path)
            poses = read_kitti(path)
        except TrajectoryError as error:
            raise SequenceError(str(error)) from error
        self._check_count(path, len(poses))
        stamps = np.array([frame.stamp for frame in self.source.frames()], np.int64)
        order = np.flatnonzero(np.diff(stamps, prepend=stamps[0] - 1) > 0)
        return Trajectory(stamps[order], poses[order])

    def _check(self, trajectory: Trajectory) -> None:
        span = self.source.span()
        if span is None:
            return
        begin, end = trajectory.stamps[0], trajectory.stamps[-1]
        if begin <= span[1] and end >= span[0]:
            _warn_of_jumps(self.name, trajectory)
            return
        times = [f"{stamp * 1e-9:.3f} s" for stamp in (begin, end, *span)]
        raise SequenceError(
            f"{self.name}: the reference covers {times[0]} to {times[1]}, the scans cover "
            f"{times[2]} to {times[3]}: set `clock_offset` to the seconds to add to the "
            f"reference's stamps{self._proposal(trajectory)}"
        )

    def _proposal(self, trajectory: Trajectory) -> str:
        """The offset found from the gyroscope, or from the scans if there is none."""
        try:
            imu = self.source.imu(None if self._imu is None else self._imu.topic)
        except AdaptuneError:
            imu = None
        if imu is not None:
            stamps, turning = imu.stamps, np.linalg.norm(imu.angular_velocity, axis=1)
            what = "gyroscope measured"
        else:
            _log.info("%s: comparing how its scans turn with the reference", self.name)
            try:
                stamps, turning = turning_of(islice(self._decode(Repairs()), _MOST_SCANS))
            except AdaptuneError:
                return ""
            what = "scans show"
        found = clock_offset(trajectory, stamps, turning)
        if found is None:
            return ""
        # The stamps already include the offset that is set.
        offset = self._reference.clock_offset + found
        return f" (the {what} the same motion with clock_offset: {offset:.3f})"


def _warn_of_jumps(name: str, trajectory: Trajectory) -> None:
    steps = geometry.steps(trajectory.T_world_sensor)[:, :3, 3]
    seconds = np.diff(trajectory.stamps) * 1e-9
    jumps = np.flatnonzero(np.linalg.norm(steps, axis=1) > _FASTEST * np.maximum(seconds, 1e-3))
    if len(jumps):
        first = trajectory.stamps[jumps[0] + 1] * 1e-9
        message = "%s: the reference jumps %d times, first at %.3f s, faster than %g m/s"
        _log.warning(message, name, len(jumps), first, _FASTEST)
