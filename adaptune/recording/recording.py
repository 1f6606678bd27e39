"""A part of a recording, with its reference and its IMU."""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.recording import cache
from adaptune.recording.cache import alongside
from adaptune.recording.scan import (
    USUAL,
    Fractions,
    Imu,
    ImuNoise,
    Scan,
    SequenceError,
    clock_offset,
)
from adaptune.trajectory import Trajectory, TrajectoryError, is_kitti, read_kitti, read_trajectory

# What every format of recordings offers, and which of its scans are used.


class Frame(NamedTuple):
    """A scan before it is decoded."""

    stamp: int  # nanoseconds, as recorded
    recorded: int  # nanoseconds on the clock of the recorder; the stamp where there is none
    load: Callable[[], Scan]  # decodes the scan


class Source(Protocol):
    """One format of recordings.

    Attributes
    ----------
    random_access : bool
        Whether frames hold nothing in memory before they are loaded.
    """

    random_access: ClassVar[bool]

    @property
    def name(self) -> str:
        """Its file, for messages."""

    @property
    def n_messages(self) -> int:
        """At least as many as there are scans."""

    @property
    def files(self) -> Sequence[Path]:
        """All files that its scans and its IMU are read from."""

    @property
    def pose_files(self) -> Sequence[Path]:
        """All other files that its own poses are read from."""

    def frames(self) -> Iterator[Frame]:
        """All scans in the order of their recording."""

    def about(self) -> dict[str, Any]:
        """Plain data to store with its decoded scans."""

    def span(self) -> tuple[int, int] | None:
        """First stamp, and about the last one; none where there is no scan."""

    def poses(self, name: str | None, child_frame: str | None) -> Trajectory | None:
        """Reference poses of the recording itself, or those of one topic."""

    def first_pose(self, name: str) -> int | None:
        """Stamp of the first pose on a topic."""

    def imu(self, name: str | None) -> Imu | None:
        """Measurements of its IMU, in the IMU's own units."""


@dataclass
class Repairs:
    """Counts of what was left out of a recording, by reason."""

    counts: dict[str, int] = field(default_factory=dict)

    def add(self, reason: str, n: int = 1) -> None:
        """Count what was left out."""
        if n:
            self.counts[reason] = self.counts.get(reason, 0) + n

    def report(self, name: str) -> None:
        """Log the counts, if there are any."""
        if self.counts:
            what = ", ".join(f"{n} {reason}" for reason, n in self.counts.items())
            _log.warning("%s: left out %s", name, what)


BACKWARD = "scans whose stamps do not come after the one before"
LEAP = "scans whose stamps leap ahead of the recording"


def in_order(frames: Iterable[Frame], repairs: Repairs) -> Iterator[Frame]:
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
                repairs.add(LEAP)
            else:
                repairs.add(BACKWARD)
                continue
            doubtful = None
        if last is not None and frame.stamp <= last.stamp:
            repairs.add(BACKWARD)
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


@dataclass(frozen=True)
class Section:
    """A part of a sequence."""

    # Seconds since the first scan; those in [start, stop) belong to it.
    start: float = 0.0
    stop: float | None = None
    stride: int = 1  # use every stride-th scan

    def of(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames in it; their stamps strictly increase."""
        first, number = None, 0
        for frame in frames:
            first = frame.stamp if first is None else first
            seconds = (frame.stamp - first) * 1e-9
            if self.stop is not None and seconds >= self.stop:
                return
            if seconds >= self.start:
                if number % self.stride == 0:
                    yield frame
                number += 1

    def part(self, part: Fractions, seconds: float) -> "Section":
        """A part of it in a recording of so many seconds; the last part has the last scan."""
        begin, end = part
        whole = (seconds if self.stop is None else min(self.stop, seconds)) - self.start
        stop = self.stop if end == 1.0 else self.start + end * whole
        return replace(self, start=self.start + begin * whole, stop=stop)

    def count(self, n: int, seconds: float) -> int:
        """About how many of `n` scans are in it, in a recording of so many seconds."""
        stop = seconds if self.stop is None else min(self.stop, seconds)
        share = max(stop - self.start, 0.0) / seconds if seconds > 0.0 else 1.0
        return -(-round(n * share) // self.stride)

    def __str__(self) -> str:
        stop = "the end" if self.stop is None else f"{self.stop:g} s"
        return f"between start = {self.start:g} s and stop = {stop}"


# Motion compensation: all points of a scan as seen from the sensor's pose at its start.


# Rotation changes slowly: between these many moments of a scan it is taken as constant.
_MOMENTS = 64
# Metres: cells and search radius for the registration of a scan with its neighbour.
_CELL, _REACH = 0.5, 2.0
# small_gicp crashes on an empty target.
_FEWEST = 20
# Seconds; the mean velocity between scans further apart is not that of either.
_FAR = 1.0


def compensate(scan: Scan, T_start_end: Poses, duration: float) -> Scan:
    """Undo a motion of constant velocity: the points as seen from the sensor at the scan's stamp.

    `T_start_end` is the sensor's pose `duration` seconds after the stamp, seen from where it was at
    the stamp. Afterwards all points have the time 0. A scan whose points have no times is returned
    as it is.
    """
    if scan.times is None or not len(scan):
        return scan
    from scipy.spatial.transform import Rotation

    twist = Rotation.from_matrix(T_start_end[:3, :3]).as_rotvec() / duration
    velocity = T_start_end[:3, 3] / duration
    moments = np.linspace(0.0, max(float(scan.times.max()), 1e-9), _MOMENTS)
    points = _rotate(scan, moments, Rotation.from_rotvec(moments[:, None] * twist))
    points += scan.times[:, None] * velocity.astype(np.float32)
    return replace(scan, points=points, times=np.zeros_like(scan.times))


def neighbour_motions(scans: Iterable[Scan]) -> Iterator[tuple[Scan, Poses | None, float]]:
    """Register each scan with the one read before it (GICP).

    Both were measured in the same motion, so that its distortion hardly matters.

    Yields
    ------
    scan : Scan
    T_before_scan : ndarray of shape (4, 4), or None where it is not known
    seconds : float
        Between their stamps; negative where scans are read backwards.
    """
    import small_gicp

    before: Any = None
    last, guess = 0, np.eye(4)
    for scan in scans:
        now = None
        if len(scan) >= _FEWEST:
            points = scan.points.astype(np.float64)
            now = small_gicp.preprocess_points(points, downsampling_resolution=_CELL, num_threads=1)
            now = now if now[0].size() >= _FEWEST else None
        seconds = (scan.stamp - last) * 1e-9
        T_before_scan = None
        if before is not None and now is not None and 0 < abs(seconds) <= _FAR:
            options = {"max_correspondence_distance": _REACH, "num_threads": 1}
            result = small_gicp.align(
                before[0], now[0], before[1], init_T_target_source=guess, **options
            )
            if result.converged and result.num_inliers > now[0].size() / 2:
                T_before_scan = geometry.rectify(result.T_target_source)
        yield scan, T_before_scan, seconds
        guess = np.eye(4) if T_before_scan is None else T_before_scan
        before, last = now, scan.stamp


def compensate_neighbours(scans: Iterable[Scan]) -> Iterator[Scan]:
    """Undo the motion within each scan, as fast as it was since the one read before.

    Where that is not known, the motion known last still holds for a second. Other scans, such as
    the first, pass as they are.
    """
    known: tuple[Poses, float, int] | None = None
    for scan, T_before_scan, seconds in neighbour_motions(scans):
        if T_before_scan is not None:
            known = T_before_scan, seconds, scan.stamp
        if known is None or abs(scan.stamp - known[2]) > _FAR * 1e9:
            yield scan
        elif known[1] > 0:
            yield compensate(scan, known[0], known[1])
        else:
            yield compensate(scan, geometry.invert(known[0]), -known[1])


def turning_of(scans: Iterable[Scan]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """How fast the sensor turned: stamps between scans and radians per second, of shape (n,)."""
    stamps, rates = [], []
    for scan, T_before_scan, seconds in neighbour_motions(scans):
        if T_before_scan is not None:
            stamps.append(scan.stamp - round(seconds * 0.5e9))
            rates.append(float(geometry.rotation_angle(T_before_scan)) / seconds)
    return np.array(stamps, np.int64), np.array(rates, np.float64)


def compensate_rotation(scan: Scan, imu: Imu) -> Scan:
    """Undo the rotation that a gyroscope measured during the scan.

    Translation stays. A scan without times, or without measurements around it, is returned as it
    is. Both are on the same clock.
    """
    if scan.times is None or not len(scan):
        return scan
    span = float(scan.times.max())
    first, last = np.searchsorted(imu.stamps, [scan.stamp, scan.stamp + round(span * 1e9)])
    # One measurement before the scan and one after it.
    if first == 0 or last >= len(imu):
        return scan
    part = slice(first - 1, last + 1)
    seconds = (imu.stamps[part] - scan.stamp) * 1e-9
    rates = imu.angular_velocity[part] @ imu.T_sensor_imu[:3, :3].T
    from scipy.spatial.transform import Rotation

    moments = np.linspace(0.0, max(span, 1e-9), _MOMENTS)
    at = np.stack([np.interp(moments, seconds, rates[:, i]) for i in range(3)], axis=1)
    steps = Rotation.from_rotvec((at[1:] + at[:-1]) * 0.5 * np.diff(moments)[:, None])
    rotations = [Rotation.identity()]
    for step in steps:
        rotations.append(rotations[-1] * step)
    return replace(scan, points=_rotate(scan, moments, Rotation.concatenate(rotations)))


def _rotate(scan: Scan, moments: NDArray[np.float64], rotations: Any) -> NDArray[np.float32]:
    """Rotate each point by the rotation at its time.

    The rotation of a point is looked up on a grid fine enough that the step between neighbours,
    a 64th of the scan's rotation, is met by interpolating the rotated points linearly.
    """
    assert scan.times is not None
    matrices = rotations.as_matrix().astype(np.float32)
    place = np.clip(scan.times / np.float32(moments[1]), 0, _MOMENTS - 1)
    low = np.minimum(place.astype(np.intp), _MOMENTS - 2)
    share = (place - low)[:, None]
    before = np.einsum("nij,nj->ni", matrices[low], scan.points)
    after = np.einsum("nij,nj->ni", matrices[low + 1], scan.points)
    return np.asarray(before + share * (after - before))


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
