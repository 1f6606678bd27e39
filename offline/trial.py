"""Drives of parameter sets along the stretches of a recording, and the trials that they make."""

import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import FIRST_POSE, PREPARE_MS, REGISTER_MS, Frames, Trial
from adaptune.errors import AdaptuneError, MachineError, UnavailableError, in_a_line
from adaptune.geometry import Poses, invert, scale
from adaptune.live.evidence import hops_along
from adaptune.machine import apart
from adaptune.metrics import KITTI_LENGTHS, cap, sub_trajectory_rte, travelled, window_ends
from adaptune.model.descriptor import (
    Describer,
    DescriptorError,
    fill_in,
    lowest_elevation,
    speed_and_turn_rate,
)
from adaptune.odometry.base import MIN_POINTS, OdometryInstance, Usage
from adaptune.odometry.faults import MAX_SHARE_WITHOUT_POSE, MOST_FAULTS
from adaptune.odometry.prepared import prepared_bytes
from adaptune.odometry.registry import Factory
from adaptune.odometry.tracker import HealthCheck, Tracker
from adaptune.progress import Progress, unseen
from adaptune.recording.scan import Recording, Scan, SequenceError
from adaptune.space import ParameterSet
from adaptune.study.study import StudySequences
from adaptune.trajectory import Trajectory
from offline.config import OfflineStudyConfig
from offline.objective import trajectory_metrics


class Stretch(NamedTuple):
    """A stretch of a recording, as it is driven."""

    sequence: str
    first: int  # number of its first scan
    stamps: NDArray[np.int64]  # (n,): nanoseconds of its scans
    T_odom_start: Poses  # (4, 4): where a drive begins
    # (4, 4): the motion that leads there. A robot drives already where a recording is entered, and
    # is started at its begin.
    T_before_start: Poses | None

    @property
    def key(self) -> tuple[str, int, int]:
        """Identifies it among all of a study."""
        return self.sequence, self.first, len(self.stamps)


RECENT = 0.5
"""Seconds of the reference whose mean motion leads to the begin of a stretch: one step is noisy."""


def stretches_along(name: str, frames: Frames) -> list[Stretch]:
    """The stretches of a sequence that are driven."""
    T_ref_sensor, stamps = frames.T_ref_sensor, frames.stamps
    found = []
    for first, _, end in frames.stretches.tolist():
        before = int(np.searchsorted(stamps, stamps[first] - round(RECENT * 1e9)))
        known = not np.isnan(T_ref_sensor[first, 0, 0])
        T_odom_start = T_ref_sensor[first] if first and known else np.eye(4)
        T_before_start = None
        if before < first and known and np.isfinite(T_ref_sensor[before]).all():
            moved = invert(T_ref_sensor[before]) @ T_ref_sensor[first]
            share = (stamps[first] - stamps[first - 1]) / (stamps[first] - stamps[before])
            T_before_start = scale(moved, float(share))
        found.append(Stretch(name, first, stamps[first:end], T_odom_start, T_before_start))
    return found


@dataclass
class _Kept:
    """What a stretch was prepared to in one way."""

    scans: dict[int, Any] = field(default_factory=dict)  # by number
    nbytes: int = 0
    seconds: float = 0.0  # of CPU time for `n_prepared` scans
    n_prepared: int = 0
    used: int = 0  # number of the pass


SharedScan = Callable[[OdometryInstance], Any]
"""Gives a scan as an instance takes it."""
STALE = 64
"""Passes after which prepared scans that are not used make room for others."""


class SharedScans:
    """The scans of stretches, each prepared once for all instances with the same preparation.

    Prepared scans that exceed `memory` bytes are read and prepared again on every pass, once for
    all that share it.
    """

    def __init__(self, memory: float):
        self.nbytes = 0  # that the prepared scans take
        self._memory = memory
        self._kept: dict[tuple[Hashable, ...], _Kept] = {}
        self._n_passes = 0

    def along(self, stretch: Stretch, scans: Recording) -> Iterator[SharedScan]:
        """Pass along a stretch of a recording; scans are read where they are asked for."""
        self._n_passes += 1
        numbered = enumerate(_scans_of(stretch, scans))
        last: tuple[int, Any] = -1, None

        def read(i: int) -> Any:
            nonlocal last
            while last[0] < i:
                last = next(numbered)
            return last[1]

        for i in range(len(stretch.stamps)):
            yield partial(self._prepared, stretch.key, i, partial(read, i), {})

    def _prepared(
        self,
        key: tuple[Hashable, ...],
        i: int,
        read: Callable[[], Scan],
        fresh: dict[Hashable, Any],
        instance: OdometryInstance,
    ) -> Any:
        """Scan `i` as an instance takes it; `fresh` has what there is no room for."""
        preparation = instance.preparation
        kept = self._kept.setdefault((*key, preparation), _Kept())
        kept.used = self._n_passes
        if i in kept.scans:
            return kept.scans[i]
        if preparation in fresh:
            return fresh[preparation]
        # Also those that a pass makes while it runs: a worker once grew to five times its share.
        with apart():
            scan = read()
            begin = time.process_time()
            prepared = instance.prepare(scan)
            kept.seconds += time.process_time() - begin
        kept.n_prepared += 1
        if self._has_room(size := prepared_bytes(prepared)):
            kept.scans[i] = prepared
            kept.nbytes += size
            self.nbytes += size
        else:
            fresh[preparation] = prepared
        return prepared

    def milliseconds(self, stretch: Stretch, instance: OdometryInstance) -> float:
        """Mean CPU time that it took to prepare a scan of a stretch for such an instance."""
        kept = self._kept.get((*stretch.key, instance.preparation))
        return 1e3 * kept.seconds / kept.n_prepared if kept and kept.n_prepared else 0.0

    def _has_room(self, size: int) -> bool:
        """Whether so many bytes more are allowed; where they are not, make room."""
        for kept in self._kept.values():
            if self.nbytes + size <= self._memory:
                break
            if self._n_passes - kept.used > STALE:
                self.nbytes -= kept.nbytes
                kept.scans, kept.nbytes = {}, 0
        return self.nbytes + size <= self._memory


def _scans_of(stretch: Stretch, scans: Recording) -> Iterator[Scan]:
    """Read the scans of a stretch.

    Raises
    ------
    SequenceError
        If they cannot be read, or are others than before.
    """
    again = "run the same command again"
    try:
        read = scans.since(int(stretch.stamps[0]))
        for stamp in stretch.stamps.tolist():
            scan = next((one for one in read if one.stamp >= stamp), None)
            if scan is None or scan.stamp != stamp:
                raise SequenceError(f"{scans.name}: has other scans than before; {again}")
            yield scan
    except OSError as error:
        raise SequenceError(f"{scans.name}: cannot be read ({error}); {again}") from error


_UNUSED = Usage(0.0, None)


@dataclass(eq=False)
class Drive:
    """What one parameter set did along one stretch; it is lost where it was not driven.

    It begins at the reference's pose, as a robot does, with the health check, and without the
    reference from then on.
    """

    T_odom_sensor: Poses  # (n, 4, 4)
    restarted: NDArray[np.bool_]  # (n,): by the health check
    registered: NDArray[np.bool_]  # (n,)
    tried: NDArray[np.bool_]  # (n,): scans that the odometry was given
    without_pose: NDArray[np.bool_]  # (n,)
    seconds: NDArray[np.float64]  # (n,): NaN where it begins
    unhealthy: Counter[str] = field(default_factory=Counter)
    faults: tuple[str, ...] = ()  # of the odometry
    exception: str = ""  # after which the drive has no pose
    usage: Usage = _UNUSED
    prepare_ms: float = 0.0  # mean CPU time that it took to prepare a scan
    too_slow: bool = False

    @classmethod
    def lost(cls, stretch: Stretch) -> Self:
        """A drive before it begins."""
        n = len(stretch.stamps)
        T_odom_sensor = np.tile(stretch.T_odom_start, (n, 1, 1))
        restarted, registered, tried = np.zeros((3, n), bool)
        return cls(
            T_odom_sensor, restarted, registered, tried, np.ones(n, bool), np.full(n, np.nan)
        )


class _Driver:
    """Drives one parameter set along one stretch.

    An exception of the odometry is a fault, after which the drive has no pose. A set that takes
    more than `most` seconds of CPU time is stopped.
    """

    def __init__(
        self,
        make: Callable[[], OdometryInstance],
        stretch: Stretch,
        health: HealthCheck,
        most: float,
        bare: bool,
    ):
        self.drive = Drive.lost(stretch)
        self._make, self._stretch, self._health, self._most = make, stretch, health, most
        self._bare = bare
        self._stamps = stretch.stamps.tolist()
        self._odometry: OdometryInstance | None = None

    def step(self, i: int, scan: SharedScan) -> None:
        """Register scan `i`."""
        drive = self.drive
        try:
            if not drive.exception and not drive.too_slow:
                self._step(drive, i, scan)
        except (UnavailableError, SequenceError, MachineError, MemoryError):
            raise  # of the machine or the recording, whatever the parameters
        except Exception as error:
            drive.exception = in_a_line(error)
        if not (drive.tried[i] and np.isfinite(drive.T_odom_sensor[i, 0, 0])):
            drive.without_pose[i] = True
            drive.T_odom_sensor[i] = drive.T_odom_sensor[i - 1] if i else self._stretch.T_odom_start

    def close(self, scans: SharedScans) -> None:
        """End the odometry's processes, and note what they used."""
        if self._odometry is None:
            return
        self._odometry.close()
        drive, usage = self.drive, self._odometry.usage
        drive.faults, drive.usage = tuple(self._odometry.faults), usage
        drive.prepare_ms = scans.milliseconds(self._stretch, self._odometry)
        if usage.seconds is not None:
            drive.seconds[~np.isnan(drive.seconds)] = usage.seconds

    def _step(self, drive: Drive, i: int, scan: SharedScan) -> None:
        if self._odometry is None:
            self._odometry = self._make()
        prepared = scan(self._odometry)
        if not i:
            self._tracker = Tracker(
                self._odometry,
                self._health,
                T_odom_start=self._stretch.T_odom_start,
                T_before_start=self._stretch.T_before_start,
                bare=self._bare,
            )
        found = self._tracker.register_prepared(self._stamps[i], prepared)
        drive.T_odom_sensor[i], drive.tried[i] = found.T_odom_sensor, True
        lost = not np.isfinite(found.T_odom_sensor).all()
        drive.without_pose[i] = lost or found.unhealthy == "no_pose"
        drive.registered[i] = found.registered and not drive.without_pose[i]
        drive.restarted[i] = found.unhealthy is not None
        if found.unhealthy not in (None, "no_pose"):
            drive.unhealthy[found.unhealthy] += 1
        if i:
            drive.seconds[i] = found.register_seconds
        drive.too_slow = self._odometry.usage.cpu > self._most


# Which stretches of a recording are driven.


STRETCH, OVERHANG = 2.0, 1.0
"""Sub-trajectories that begin along a stretch, and that it is longer than that."""
WARM_UP = 10.0, 3.0
"""Metres and seconds that do not count at the begin of a stretch: an odometry has no map yet."""
MOST_DRIVEN = 0.7
"""Share of a recording above which all of it is driven."""
STANDING = 0.5
"""Metres a second below which a robot stands: where a recording begins so, no warm-up is needed."""


def stretches_of(
    T_ref_sensor: Poses, stamps: NDArray[np.int64], length: float, n: int | None
) -> NDArray[np.intp]:
    """Choose `n` stretches, evenly spaced along the reference's path; None for all of it.

    Returns shape (k, 3), see `Frames.stretches`.
    """
    metres, seconds = travelled(T_ref_sensor), (stamps - stamps[0]) * 1e-9
    whole = np.array([[0, _settled(metres, seconds), len(stamps)]], np.intp)
    size = (STRETCH + OVERHANG) * length
    if n is None or n * size > metres[-1]:
        return whole

    def last(of: NDArray[np.float64], until: NDArray[np.float64]) -> NDArray[np.intp]:
        return np.maximum(np.searchsorted(of, until, side="right") - 1, 0)

    # Where the robot stands, the last scan before it moves.
    begins = last(metres, np.linspace(metres[whole[0, 1]], metres[-1] - 1.01 * size, n))
    ends = last(metres, metres[begins] + size) + 2
    warm = np.minimum(
        last(metres, np.maximum(metres[begins] - WARM_UP[0], 0.0)),
        last(seconds, seconds[begins] - WARM_UP[1]),
    )
    firsts = np.maximum(warm, last(metres, np.maximum(metres[begins] - size / 3.0, 0.0)))
    found = np.stack([firsts, begins, np.minimum(ends, len(stamps))], axis=1)
    if (firsts[1:] < ends[:-1]).any() or (ends - firsts).sum() > MOST_DRIVEN * len(stamps):
        return whole
    known = window_ends(T_ref_sensor, length) >= 0
    return found[[bool(known[begin:end].any()) for _, begin, end in found]]


def _settled(metres: NDArray[np.float64], seconds: NDArray[np.float64]) -> int:
    """First scan that counts where a recording may begin in motion."""
    if metres[np.searchsorted(seconds, 1.0, side="right") - 1] < STANDING:
        return 0
    far = np.searchsorted(metres, min(WARM_UP[0], metres[-1] / 5.0))
    late = np.searchsorted(seconds, min(WARM_UP[1], seconds[-1] / 5.0))
    return int(min(far, late))


def with_measured_hops(
    scans: Iterable[Scan], frames: Frames, progress: Progress = unseen
) -> Frames:
    """The frames with the hops along them, see `hops_along`, and with the CPU time they took."""
    n, reading = len(frames.stamps), 0.0

    def read() -> Iterator[Scan]:
        nonlocal reading
        begin = time.process_time()
        for scan in scans:
            reading += time.process_time() - begin
            yield scan
            begin = time.process_time()

    begin = time.process_time()
    with_poses = zip(read(), frames.T_ref_sensor, strict=True)
    hops = hops_along(with_poses, lambda done: progress("registering hops of", done, n))
    seconds = time.process_time() - begin - reading
    return replace(frames, hops=hops, evidence_ms=1e3 * seconds / n)


@dataclass(frozen=True)
class TrialSettings:
    """What a trial depends on besides odometry, sequence and parameter set."""

    sub_trajectory: float = 25.0
    health: HealthCheck = field(default_factory=HealthCheck)
    descriptors: tuple[str, ...] = ("ndt",)
    stretches: int | None = None  # of each sequence; None for all of it
    repeats: int = 1
    baseline_runs: int | None = None  # as many as `repeats`, if not given
    metrics: frozenset[str] = frozenset({"rte"})

    @classmethod
    def of(cls, config: OfflineStudyConfig) -> Self:
        """The settings of a study."""
        offline = config.offline
        return cls(
            config.sub_trajectory,
            config.health,
            config.descriptor,
            config.stretches,
            offline.repeats,
            offline.baseline_runs,
            frozenset(offline.objective),
        )


def reference_poses(
    key: str, reference: Trajectory, stamps: NDArray[np.int64], settings: TrialSettings
) -> Poses:
    """Reference poses at the scans' stamps, of shape (n, 4, 4), NaN where they are not known.

    Raises
    ------
    AdaptuneError
        If no error can be measured on the sequence.
    """
    T_ref_sensor = reference.at(stamps)
    whole = (window_ends(T_ref_sensor, settings.sub_trajectory) >= 0).any()
    if not whole and reference.sparse:
        raise AdaptuneError(f"{key}: {reference.sparse}")
    if np.isnan(T_ref_sensor).all():
        raise AdaptuneError(
            f"{key}: the reference does not overlap the scans in time; check that both "
            f"are of the same recording and clock"
        )
    if not whole:
        metres = travelled(T_ref_sensor[~np.isnan(T_ref_sensor[:, 0, 0])])[-1]
        raise AdaptuneError(
            f"{key}: its path of {metres:.1f} m holds no sub-trajectory of "
            f"{settings.sub_trajectory:g} m; make sub_trajectory shorter or the sequence longer"
        )
    shortest = min(KITTI_LENGTHS)
    if "kitti" in settings.metrics and not (window_ends(T_ref_sensor, shortest) >= 0).any():
        raise AdaptuneError(
            f"{key}: its path holds no sub-trajectory of {shortest:g} m, the shortest "
            f"of KITTI's error; judge by another metric (offline.objective)"
        )
    return T_ref_sensor


@dataclass(frozen=True)
class TrialSetup:
    """Everything that a process needs to describe recordings, and to drive along them."""

    settings: TrialSettings
    odometry: Factory
    sequences: StudySequences

    def describe(self, name: str, progress: Progress = unseen) -> Frames:
        """Read a whole sequence, and describe its scans.

        Raises
        ------
        AdaptuneError
            If the sequence cannot be read, or no error can be measured on it.
        """
        settings, key = self.settings, self.sequences.key(name)
        scans = self.sequences.open(name)
        reference = scans.reference()
        if reference is None:
            raise AdaptuneError(f"{key}: training needs a reference trajectory")
        stamps, descriptors, elevations, enough = [], [], [], False
        try:
            describe = Describer(settings.descriptors)
            for scan in _watched(scans, scans.n_messages, "reading", progress):
                enough = enough or len(scan) >= MIN_POINTS
                stamps.append(scan.stamp)
                descriptors.append(describe(scan))
                elevations.append(lowest_elevation(scan))
        except DescriptorError as error:
            raise AdaptuneError(f"sequences.{name}: {error}") from error
        if not enough:
            raise AdaptuneError(
                f"sequences.{name}: none of its {len(stamps)} scans has {MIN_POINTS} points; check "
                f"`points` and what the sensor recorded"
            )
        at = np.array(stamps, np.int64)
        T_ref_sensor = reference_poses(key, reference, at, settings)
        described = np.array(descriptors)
        # When a scan is described online, the pose of the scan before is known.
        motion = speed_and_turn_rate(at, T_ref_sensor)
        fill_in(described[1:], describe.blocks, motion[:-1])
        elevation = np.array(elevations, np.float32)
        stretches = stretches_of(T_ref_sensor, at, settings.sub_trajectory, settings.stretches)
        return Frames(at, T_ref_sensor, described, describe.blocks, elevation, stretches=stretches)

    def drive(
        self,
        shared: SharedScans,
        scans: Recording,
        stretch: Stretch,
        sets: Iterable[ParameterSet],
        most: float = np.inf,
        bare: bool = False,
        progress: Progress = unseen,
    ) -> list[list[Drive]]:
        """Drive with several parameter sets on one pass along a stretch; each for every repeat.

        Sets that take more than `most` seconds of CPU time are stopped. What is driven `bare`, once
        and without the health check, shows how a set does elsewhere.
        """
        health, n = self.settings.health, len(stretch.stamps)
        drivers = [
            [
                _Driver(partial(self.odometry, one, stretch.sequence), stretch, health, most, bare)
                for _ in range(1 if bare else self._n_repeats(one))
            ]
            for one in sets
        ]
        with ExitStack() as ended:
            each = [driver for of_set in drivers for driver in of_set]
            for driver in each:
                ended.callback(driver.close, shared)
            along = _watched(shared.along(stretch, scans), n, "running", progress)
            for i, scan in enumerate(along):
                for driver in each:
                    driver.step(i, scan)
        return [[driver.drive for driver in of_set] for of_set in drivers]

    def _n_repeats(self, parameters: ParameterSet) -> int:
        settings = self.settings
        if settings.baseline_runs is None or parameters not in self.odometry.space.baselines:
            return settings.repeats
        return max(settings.repeats, settings.baseline_runs)


def _watched(scans: Iterable[Any], n: int, what: str, progress: Progress) -> Iterator[Any]:
    done = 0
    for done, scan in enumerate(scans, start=1):
        yield scan
        progress(what, min(done, n), n)
    progress(what, done, done)


# A trial of its drives.


def trial_of(
    settings: TrialSettings,
    parameters: ParameterSet,
    frames: Frames,
    drives: Mapping[int, Sequence[Drive]],
) -> Trial:
    """Make a trial of the drives along all stretches of a sequence, by the first scan of each.

    There is one for every repeat. Stretches along which a set was not driven count as lost.
    """
    lost = {stretch.first: Drive.lost(stretch) for stretch in stretches_along("", frames)}
    repeats = [
        [drives[first][i] if first in drives else none for first, none in lost.items()]
        for i in range(min(map(len, drives.values())))
    ]
    return _mean([_trial(settings, parameters, frames, of_repeat) for of_repeat in repeats])


def _trial(
    settings: TrialSettings, parameters: ParameterSet, frames: Frames, drives: Sequence[Drive]
) -> Trial:
    at = np.concatenate([np.arange(first, end) for first, _, end in frames.stretches])
    late, seconds = [], 0.0
    for drive, (first, _, end) in zip(drives, frames.stretches, strict=True):
        late.append(int(np.argmax([*drive.registered, True])))
        seconds += (frames.stamps[end - 1] - frames.stamps[first]) * 1e-9

    def joined(parts: Iterable[NDArray[Any]], elsewhere: float) -> NDArray[Any]:
        driven = np.concatenate(list(parts))
        whole = np.full((len(frames.stamps), *driven.shape[1:]), elsewhere, driven.dtype)
        whole[at] = driven
        return whole

    T_odom_sensor = joined((drive.T_odom_sensor for drive in drives), np.nan)
    registered = joined((drive.registered for drive in drives), 0)
    tried = joined((drive.tried for drive in drives), 0)
    without_pose = joined((drive.without_pose for drive in drives), 0)
    # Scans before a first pose that comes are unknown.
    before = (np.arange(n := len(d.tried)) < k % n for d, k in zip(drives, late, strict=True))
    waiting = joined(before, 0)
    T_ref_sensor, failure, lost = frames.counted, "", int(without_pose.sum())
    missing = int((waiting | without_pose).sum())
    if missing >= MAX_SHARE_WITHOUT_POSE * frames.n_driven:
        failure, lost = f"no pose for {missing} of {frames.n_driven} scans", missing
    else:
        T_ref_sensor[waiting & ~without_pose] = np.nan
    unhealthy = dict(sum((drive.unhealthy for drive in drives), Counter[str]()))
    faults = [fault for drive in drives for fault in drive.faults]
    faults += dict.fromkeys(drive.exception for drive in drives if drive.exception)
    if len(faults) >= MOST_FAULTS:
        failure = f"{len(faults)} faults"
    used = _used(drives, seconds)
    if any(drive.too_slow for drive in drives):
        failure = f"too slow: {used[REGISTER_MS]:.0f} ms a scan"
    # What goes on without poses may seem to do well.
    unseen = ~tried | ((without_pose | waiting) & bool(failure))
    errors = sub_trajectory_rte(T_ref_sensor, T_odom_sensor, settings.sub_trajectory, unseen)
    if np.isnan(errors).all():
        failure = failure or "no sub-trajectory has poses"
    if 0 < late[0] < len(drives[0].tried):
        stamps = frames.stamps[frames.stretches[0, 0] :]
        used[FIRST_POSE] = float(stamps[late[0]] - stamps[0]) * 1e-9
    return Trial(
        parameters,
        T_odom_sensor,
        errors,
        joined((drive.restarted for drive in drives), 0),
        registered,
        joined((drive.seconds for drive in drives), np.nan),
        tuple(faults),
        trajectory_metrics(T_ref_sensor, T_odom_sensor),
        used,
        unhealthy=unhealthy | ({"no_pose": lost} if lost else {}),
        failure=failure,
    )


def _used(drives: Sequence[Drive], seconds: float) -> dict[str, float]:
    """CPU time and memory of drives along so many seconds, see `Trial.usage`."""
    cpu = sum(drive.usage.cpu for drive in drives)
    n_tried = [int(drive.tried.sum()) for drive in drives]
    prepare_ms = sum(drive.prepare_ms * n for drive, n in zip(drives, n_tried, strict=True))
    n = max(sum(n_tried), 1)
    used = {"cpu": 100.0 * cpu / seconds, REGISTER_MS: 1e3 * cpu / n, PREPARE_MS: prepare_ms / n}
    memory = [drive.usage.memory for drive in drives if drive.usage.memory is not None]
    return used | ({"memory": max(memory)} if memory else {})


def _mean(repeats: Sequence[Trial]) -> Trial:
    """One trial of several with the same parameters."""
    if len(repeats) == 1:
        return repeats[0]
    metrics = set.intersection(*(set(trial.metrics) for trial in repeats))
    return Trial(
        repeats[0].parameters,
        repeats[0].T_odom_sensor,
        np.mean([cap(trial.errors) for trial in repeats], axis=0),
        np.mean([trial.restarted for trial in repeats], axis=0),
        np.all([trial.registered for trial in repeats], axis=0),
        np.mean([trial.seconds for trial in repeats], axis=0),
        tuple(fault for trial in repeats for fault in trial.faults),
        {m: float(np.mean([t.metrics[m] for t in repeats])) for m in sorted(metrics)},
        {
            m: float(np.mean([t.usage.get(m, 0.0) for t in repeats]))
            for m in {m: None for t in repeats for m in t.usage}
        },
        tuple({"rte": trial.mean_error} | trial.metrics for trial in repeats),
        max(repeats, key=lambda trial: trial.unhealthy.get("no_pose", 0)).unhealthy,
        next((trial.failure for trial in repeats if trial.failure), ""),
    )
