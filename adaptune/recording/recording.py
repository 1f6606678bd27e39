"""Recordings: what every format offers, and the part of one that a study uses."""

import logging
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache as once
from functools import cached_property
from itertools import chain, islice, product
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.geometry import to_pose
from adaptune.recording import cache, compensation
from adaptune.recording.config import ESTIMATED, NO_REFERENCE, SequenceConfig, files_of
from adaptune.recording.content import Content, of_looks
from adaptune.recording.poses import in_angles, sound
from adaptune.recording.scan import BACKWARD, Frame, Imu, Recording, Scan, SequenceError, in_order
from adaptune.recording.timing import FIRST_SCANS, SOONEST, Timing, doubts
from adaptune.trajectory import Trajectory, TrajectoryError, is_kitti, read_kitti, read_trajectory

if TYPE_CHECKING:
    from adaptune.recording.bag import BagSource
    from adaptune.recording.folder import FileSource

    Source = BagSource | FileSource

_log = logging.getLogger(__name__)


def open_sequence(config: SequenceConfig, with_imu: bool = False) -> Recording:
    """Open what a study describes; scans are not read before they are asked for.

    A SequenceError says why it cannot be opened as described.
    """
    return RecordedSequence(config, with_imu)


def wants_estimate(config: SequenceConfig) -> bool:
    """Whether the reference of a sequence is to be estimated; a SequenceError if it cannot tell."""
    if config.reference is not None or config.bag is not None:
        return config.reference in (None, ESTIMATED)
    return not _source(config)[0].pose_files


class SequenceFiles(NamedTuple):
    """The files that a sequence is read from."""

    recording: Sequence[Path]
    reference: Sequence[Path]  # those of the poses, where they are not in the recording


def sequence_files(config: SequenceConfig) -> SequenceFiles:
    """The files that a sequence is read from; a SequenceError if it cannot be opened."""
    poses = None if config.poses_file is None else [config.poses_file]
    if config.reference in (ESTIMATED, NO_REFERENCE):
        poses = []
    if config.bag is not None:
        return SequenceFiles(files_of(config.bags()), poses or ())
    source, _ = _source(config)
    return SequenceFiles(source.files, source.pose_files if poses is None else poses)


_LOOK, _NEVER = 10**9, 1 << 62
"""Nanoseconds of a recording that are searched for a scan of another one; later than all stamps."""
_NOTES = (".txt", ".yaml")  # files beside scans: two recordings may have the same


def _alike(one: Scan, other: Scan) -> bool:
    """Whether two scans have half of their points in common, to the millimetre."""
    mine, others = (
        np.round(scan.points * 1e3).astype(np.int64) @ (1, 1 << 20, 1 << 40)
        for scan in (one, other)
    )
    fewest = min(len(mine), len(others))
    return fewest > 0 and bool(np.isin(mine, others).sum() >= 0.5 * fewest)


def _source(config: SequenceConfig) -> "tuple[Source, str | None]":
    """What reads the recording, and under which key its decoded scans are kept."""
    # Formats import this module, and rosbags takes long to import.
    from adaptune.recording.bag import BagSource
    from adaptune.recording.folder import kitti, scan_folder

    timing = Timing(config.stamp, config.time_unit, config.period)
    if config.kitti is not None:
        return kitti(Path(config.kitti), config.elevation), None
    if config.folder is not None:
        return scan_folder(Path(config.folder), timing), None
    paths = config.bags()
    within = (config.start, math.inf if config.stop is None else config.stop)
    key, entry, keep = None, None, config.cache and cache.cap() > 0
    try:
        part = (config.start, config.stop, config.stride, config.part)
        read = (config.points, config.frame, timing, *part, config.compensate)
        if keep:
            entry = cache.find(key := cache.key(files_of(paths), read))
    except OSError as error:
        raise SequenceError(f"{paths[0]}: cannot be read ({error})") from error
    about = None if entry is None else entry.about
    return BagSource(paths, config.points, timing, config.frame, about, within, keep), key


def _check_topics(source: "Source", config: SequenceConfig) -> None:
    from adaptune.recording.bag import IMU_TYPES, BagSource
    from adaptune.recording.pose_messages import POSES

    topic = None if config.imu is None else config.imu.topic
    if isinstance(source, BagSource):
        if config.poses_topic is not None:
            source.topic(config.poses_topic, POSES, "poses")
        if config.imu is not None:
            source.topic(topic, IMU_TYPES, "an IMU's measurements")
    elif config.poses_topic or config.child_frame or topic:
        raise SequenceError(
            f"{source.name}: has no topics; leave `child_frame` and `imu.topic` out, and let "
            f"`reference` be a file of poses, or leave it out"
        )


_SECONDS_BEFORE = 3.0
"""Seconds by which reading from a stamp on begins earlier: that of a message may mark the end of a
scan, and what is seen of a scan may depend on those before."""
_MOST_SCANS = 600  # at most so many scans are registered to find a clock offset


class RecordedSequence:
    """The scans of a recording in [start, stop) seconds since the first one, every stride-th.

    They carry the measurements of the IMU if `with_imu`. Methods raise a SequenceError where the
    recording cannot be read as described.
    """

    def __init__(self, config: SequenceConfig, with_imu: bool = False):
        if (file := config.poses_file) is not None and not file.is_file():
            raise SequenceError(f"{file}: there is no such file")
        self.source, self.key = _source(config)
        self.start, self.stop = max(config.start, self.source.skipped), config.stop
        self.stride, self._config, self._with_imu = config.stride, config, with_imu
        _check_topics(self.source, config)
        if config.part is not None and self._seconds:
            begin, end = config.part
            whole = self._until - self.start
            self.stop = self.stop if end == 1.0 else self.start + end * whole
            self.start += begin * whole

    @property
    def name(self) -> str:
        """The recording's file."""
        return self.source.name

    @cached_property
    def _seconds(self) -> float:
        """About when the recording ends, or the part of it that is used."""
        begin, end = self.source.span() or (0, 0)
        return self.source.skipped + (end - begin) * 1e-9

    @property
    def _until(self) -> float:
        return self._seconds if self.stop is None else min(self.stop, self._seconds)

    @property
    def n_messages(self) -> int:
        """About how many scans of the recording it uses."""
        whole = self._seconds - self.source.skipped
        share = max(self._until - self.start, 0.0) / whole if whole > 0.0 else 1.0
        return -(-round(self.source.n_messages * share) // self.stride)

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans one after the other.

        Scans whose stamps do not come after the one before, or that repeat it, are left out. That,
        and what else is odd, is logged. Times that cannot be are a SequenceError.
        """
        return self._carrying(self._scans())

    def since(self, stamp: int) -> Iterator[Scan]:
        """Read the scans from a little before `stamp` on, without a word about what is odd."""
        return self._carrying(self._scans_since(stamp - round(_SECONDS_BEFORE * 1e9)))

    def _carrying(self, scans: Iterator[Scan]) -> Iterator[Scan]:
        yield from carry_imu(scans, self._measured, self.name) if self._with_imu else scans

    def _scans_since(self, begin: int) -> Iterator[Scan]:
        kept = None if self.key is None else cache.find(self.key)
        if kept is not None:
            yield from kept.since(begin)
        else:
            yield from self._compensated(self._decode(Counter(), Content(), begin))

    def _scans(self) -> Iterator[Scan]:
        for finding in self.source.findings:
            _warn(self.name, str(finding))
        left_out: Counter[str] = Counter()
        odd: list[str] = []
        kept = None if self.key is None else cache.find(self.key)
        if kept is not None:
            yield from kept
            left_out.update(kept.about["left_out"])
            odd = kept.about["odd"]
        else:
            about = self.source.about() | {"left_out": left_out, "odd": odd}
            decoded = self._compensated(self._checked(left_out, odd))
            yield from decoded if self.key is None else cache.tee(decoded, self.key, about)
        if left_out:
            what = ", ".join(f"{n} {reason}" for reason, n in left_out.items())
            _log.warning("%s: left out %s", self.name, what)
        for text in odd:
            _warn(self.name, text)

    def _compensated(self, scans: Iterator[Scan]) -> Iterator[Scan]:
        """Points as if the sensor had kept its place since the scan's start, if that is set."""
        if self._config.compensate is None:
            return scans

        def timed() -> Iterator[Scan]:
            for scan in scans:
                if scan.times is None and len(scan):
                    raise SequenceError(
                        f"{self.name}: its points have no times; leave `compensate` out"
                    )
                yield scan

        return compensation.compensate_neighbours(timed())

    def _checked(self, left_out: Counter[str], odd: list[str]) -> Iterator[Scan]:
        """The scans, unless the first ones have times that cannot be; what is odd about them."""
        content = Content()
        scans = self._decode(left_out, content)
        first = list(islice(scans, FIRST_SCANS))
        steps = np.diff([scan.stamp for scan in first]) * 1e-9 / self.stride
        period = float(np.median(steps)) if len(steps) else 0.0
        timing = Timing(self._config.stamp, self._config.time_unit)
        for doubt in doubts([scan.reading for scan in first], period, timing):
            if doubt.of == "points" and doubt.lacks:
                raise SequenceError(f"{self.name}: {doubt}")
            odd.append(str(doubt))
            _warn(self.name, odd[-1])
        yield from chain(first, scans)
        odd += map(str, of_looks(content.looks, start=self.start))

    def _decode(
        self, left_out: Counter[str], content: Content, begin: float = -math.inf
    ) -> Iterator[Scan]:
        last: Scan | None = None
        for frame in self._frames(left_out):
            if frame.stamp < begin:
                continue
            scan = frame.load()
            if last is not None and scan.stamp <= last.stamp:
                left_out[BACKWARD] += 1
                continue
            look = content.see(scan)
            if not look.repeats and not look.soon:
                last = scan
                yield scan
        if last is None:
            stop = "the end" if self.stop is None else f"{self.stop:g} s"
            raise SequenceError(
                f"{self.name}: no scan between start = {self.start:g} s and stop = {stop}; change "
                f"start, stop or stride"
            )

    def _frames(self, left_out: Counter[str]) -> Iterator[Frame]:
        """The frames of the part that is used; their stamps strictly increase."""
        first, number = None, 0
        for frame in in_order(self.source.frames(), left_out):
            first = frame.stamp if first is None else first
            seconds = self.source.skipped + (frame.stamp - first) * 1e-9
            if self.stop is not None and seconds >= self.stop:
                return
            if seconds >= self.start:
                if number % self.stride == 0:
                    yield frame
                number += 1

    def holds(self, stamps: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which scans of the recording are in the part that is used, by their stamps: (n,)."""
        # Stamps of scans may be those of their messages, or not.
        first = next(in_order(self.source.frames(), Counter())).load().stamp
        seconds = self.source.skipped + (stamps - first) * 1e-9
        stop = math.inf if self.stop is None else self.stop
        return np.asarray((seconds >= self.start) & (seconds < stop))

    def shares_scans(self, other: "RecordedSequence") -> bool:
        """Whether both use the same scans, of one file or written again.

        Scans of one stamp tell, those in the middle of the common time first.
        """
        begin, end, files = 0, _NEVER, list[set[Path]]()
        for one in (self, other):
            first, last = one.source.span() or (0, _NEVER)
            first -= round(1e9 * one.source.skipped)
            begin = max(begin, first + round(1e9 * one.start))
            end = min(end, last + 1 if one.stop is None else first + round(1e9 * one.stop))
            files.append({f.resolve() for f in one.source.files if f.suffix not in _NOTES})
        if begin >= end or files[0] & files[1]:
            return begin < end
        for at in ((begin + end) // 2, begin, max(begin, end - _LOOK)):
            mine, others = (one.source.between(at, min(at + _LOOK, end)) for one in (self, other))
            near = [p for p in product(mine, others) if abs(p[0].stamp - p[1].stamp) < SOONEST]
            for a, b in near:
                if len(scan := a.load()):
                    return _alike(scan, b.load())
            if mine and others and not near:
                return False
        return False

    @cached_property
    def _measured(self) -> Imu | None:
        return self.imu()

    def imu(self) -> Imu | None:
        """Measurements of the IMU in SI units, if one is set."""
        settings = self._config.imu
        imu = None if settings is None else self.source.imu(settings.topic)
        return imu if settings is None or imu is None else settings.in_si(imu)

    def reference(self) -> Trajectory | None:
        """Poses of the LiDAR, if they are known."""
        config = self._config
        if config.reference in (ESTIMATED, NO_REFERENCE):
            return None
        if config.poses_file is not None:
            trajectory: Trajectory | None = self.from_file(config.poses_file)
        else:
            trajectory = self.source.poses(config.poses_topic, config.child_frame)
        if trajectory is None:
            return None
        T = trajectory.T_world_sensor
        if config.extrinsic is not None:
            T = T @ to_pose(config.extrinsic)
        stamps = trajectory.stamps + round(config.clock_offset * 1e9)
        return self._checked_poses(Trajectory(stamps, T, config.max_gap))

    def check(self) -> None:
        """Refuse a section after the end and a reference of another time, without reading scans.

        Of poses on a topic, only the first one is checked.
        """
        span = self.source.span()
        if span is None:
            return
        if self.start > self._seconds:
            what = f"start = {self.start:g} s is beyond its end, it lasts {self._seconds:.1f} s"
            raise SequenceError(f"{self.name}: {what}")
        topic, file = self._config.poses_topic, self._config.poses_file
        if topic is not None:
            first = self.source.begins.get(topic)
            offset = round(self._config.clock_offset * 1e9)
            if first is None or abs(first + offset - span[0]) <= span[1] - span[0]:
                return
        if file is not None and is_kitti(file):
            self._check_count(file, len(read_kitti(file)))
        else:
            self.reference()

    def _check_count(self, path: Path, n_poses: int) -> None:
        if n_poses != self.source.n_messages:
            raise SequenceError(
                f"{path}: {n_poses} poses without stamps do not go with {self.source.n_messages} "
                f"scans of {self.name}; give a file with stamps (TUM)"
            )

    def from_file(self, path: Path) -> Trajectory:
        """The poses of a file; those without stamps are one for each scan."""
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

    def _checked_poses(self, trajectory: Trajectory) -> Trajectory:
        """The poses that a robot can have had; a SequenceError if they are of another time."""
        if len(trajectory) > 1 and (angles := in_angles(trajectory)) is not None:
            raise SequenceError(f"{self.name}: {angles}")
        self.check_time(trajectory, self._config.clock_offset)
        if (span := self.source.span()) is None:
            return trajectory
        # A gap shorter than the time between two scans would not be noticed.
        period = self._seconds / max(self.source.n_messages, 1)
        trajectory, found = sound(trajectory, span[0], 1.5 * period)
        for finding in found:
            _warn(self.name, str(finding))
        return trajectory

    def check_time(
        self,
        trajectory: Trajectory,
        offset: float,
        what: str = "the reference",
        key: str = "clock_offset",
    ) -> None:
        """Refuse poses of another time than the scans, by a SequenceError that says by how much.

        Their stamps already include the `offset`, seconds, which is set by a `key` or an option.
        """
        span, (begin, end) = self.source.span(), trajectory.stamps[[0, -1]].tolist()
        if span is None or (begin <= span[1] and end >= span[0]):
            return
        times = [f"{stamp * 1e-9:.3f} s" for stamp in (begin, end, *span)]
        raise SequenceError(
            f"{self.name}: {what} covers {times[0]} to {times[1]}, the scans cover "
            f"{times[2]} to {times[3]}: set `{key}` to the seconds to add to its stamps"
            f"{self._proposal(trajectory, offset, key)}"
        )

    def _proposal(self, trajectory: Trajectory, offset: float, key: str) -> str:
        _log.info("%s: comparing how its scans turn with the reference", self.name)
        try:
            turns = compensation.turning_of(islice(self._decode(Counter(), Content()), _MOST_SCANS))
        except AdaptuneError:
            return ""
        if (more := compensation.clock_offset(trajectory, *turns)) is None:
            return ""
        return f" (the scans show the same motion with {key}: {offset + more:.3f})"


@once
def _warn(name: str, text: str) -> None:
    _log.warning("%s: %s", name, text)


_LATE = 10 * 10**9
"""Nanoseconds after the first scan at which an IMU that is on the same clock has begun."""


def carry_imu(scans: Iterable[Scan], imu: Imu | None, name: str) -> Iterator[Scan]:
    """Scans with the measurements of the IMU; a SequenceError if these are of another time."""
    if imu is None or not len(imu):
        what = "holds no measurements of an IMU; name their topic"
        raise SequenceError(f"{name}: {what}")
    first: int | None = None
    for scan in scans:
        if first is None:
            begin, end = imu.stamps[0], imu.stamps[-1]
            if not begin - _LATE < scan.stamp < end:
                first_scan, *covered = (f"{t * 1e-9:.3f} s" for t in (scan.stamp, begin, end))
                raise SequenceError(
                    f"{name}: the IMU covers {' to '.join(covered)}, the first scan is "
                    f"of {first_scan}: record both on the same clock, or leave `imu` out"
                )
            # Those during the first scan, and the one before.
            first = max(int(imu.stamps.searchsorted(scan.stamp, "right")) - 1, 0)
        last = max(int(imu.stamps.searchsorted(scan.stamp + scan.span)) + 1, first)
        yield replace(scan, imu=imu.part(first, last))
        first = last
