"""One parameter set on one sequence, or several at once on one pass over it."""

import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count, islice
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from adaptune import recording
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
from adaptune.recording.scan import Scan, SequenceError
from adaptune.space import ParameterSet
from adaptune.study.study import StudySequences
from adaptune.trajectory import Trajectory
from offline.config import OfflineStudyConfig
from offline.objective import trajectory_metrics


@dataclass
class _Kept:
    """What a sequence was prepared to in one way."""

    first: OdometryInstance  # prepares for all with the same preparation
    scans: dict[int, Any] = field(default_factory=dict)  # by number
    nbytes: int = 0
    seconds: float = 0.0  # of CPU time for `n_prepared` scans
    n_prepared: int = 0


SharedScan = Callable[[OdometryInstance], Any]
"""Gives a scan as an instance takes it."""


class SharedScans:
    """The scans of a sequence, each prepared once for all instances with the same preparation.

    Iterating yields a `SharedScan` for every scan, and does not end. Prepared scans that exceed
    `memory` bytes are read and prepared again on every pass. Of several preparations, those that a
    pass does not use make room.
    """

    def __init__(self, scans: Iterable[Scan], memory: float):
        self._scans, self._memory = scans, memory
        self._kept: dict[Hashable, _Kept] = {}
        self._used: set[Hashable] = set()  # in the present pass

    @property
    def nbytes(self) -> int:
        """Bytes that the prepared scans take."""
        return sum(kept.nbytes for kept in self._kept.values())

    def __iter__(self) -> Iterator[SharedScan]:
        self._used = set()
        numbered = enumerate(self._scans)
        last: tuple[int, Any] = -1, None

        def read(i: int) -> Any:  # only what is asked for, in order
            nonlocal last
            while last[0] < i:
                last = next(numbered)
            return last[1]

        for i in count():
            yield partial(self.prepared, i, partial(read, i))

    def prepared(self, i: int, read: Callable[[], Scan], instance: OdometryInstance) -> Any:
        """Scan `i`, which `read` returns, as an instance takes it."""
        key = instance.preparation
        self._used.add(key)
        kept = self._kept.setdefault(key, _Kept(instance))
        if i in kept.scans:
            return kept.scans[i]
        # Also those that a pass makes while it runs: a worker once grew to five times its share.
        with apart():
            try:
                scan = read()
            except OSError as error:
                what = f"{getattr(self._scans, 'name', 'the recording')}: cannot be read ({error})"
                raise SequenceError(f"{what}; run the same command again") from error
            begin = time.process_time()
            prepared = kept.first.prepare(scan)
            kept.seconds += time.process_time() - begin
        kept.n_prepared += 1
        if self._has_room(size := prepared_bytes(prepared), i):
            kept.scans[i] = prepared
            kept.nbytes += size
        return prepared

    def n_kept(self, instance: OdometryInstance) -> int:
        """How many scans are kept as such an instance takes them."""
        kept = self._kept.get(instance.preparation)
        return 0 if kept is None else len(kept.scans)

    def milliseconds(self, instance: OdometryInstance) -> float:
        """Mean CPU time that it took to prepare a scan for such an instance."""
        kept = self._kept.get(instance.preparation)
        return 1e3 * kept.seconds / kept.n_prepared if kept and kept.n_prepared else 0.0

    def _has_room(self, size: int, i: int) -> bool:
        """Whether so many bytes more are allowed at scan `i`; where they are not, make room."""
        # Which preparations a pass uses is known after its first scan.
        for key in [key for key in self._kept if i and key not in self._used]:
            if self.nbytes + size <= self._memory:
                break
            self._kept[key].scans.clear()
            self._kept[key].nbytes = 0
        return self.nbytes + size <= self._memory


class Drives:
    """The drives of one parameter set along the stretches of a sequence.

    Each is as a robot drives: from the reference's pose at its begin, with the health check, and
    without the reference from then on. An exception of the odometry is a fault, after which the
    drive has no pose. A set that takes more than `most` seconds of CPU time is stopped.
    """

    def __init__(
        self,
        make: Callable[[], OdometryInstance],
        frames: Frames,
        health: HealthCheck,
        most: float = np.inf,
    ):
        n = len(frames.stamps)
        self.T_odom_sensor = np.full((n, 4, 4), np.nan)
        self.restarted = np.zeros(n, bool)
        self.registered = np.zeros(n, bool)
        self.tried = np.zeros(n, bool)  # scans that the odometry was given
        self.without_pose = np.zeros(n, bool)
        self.seconds = np.full(n, np.nan)
        self.unhealthy = Counter[str]()
        self.too_slow = False
        self._make, self._frames, self._health, self._most = make, frames, health, most
        self._stamps = frames.stamps.tolist()
        self._begins = set(frames.stretches[:, 0].tolist())
        self._odometry: OdometryInstance | None = None
        self._exceptions: dict[str, None] = {}
        self._failed = False

    @property
    def faults(self) -> tuple[str, ...]:
        """See `Trial`."""
        return (*(() if self._odometry is None else self._odometry.faults), *self._exceptions)

    def usage(self, scans: SharedScans) -> tuple[Usage, float]:
        """What the odometry used, and the mean CPU time in ms that it took to prepare a scan."""
        odometry = self._odometry
        if odometry is None:
            return Usage(0.0, None), 0.0
        return odometry.usage, scans.milliseconds(odometry)

    def step(self, i: int, scan: SharedScan) -> None:
        """Register scan `i`, which is one of a stretch."""
        self._failed &= i not in self._begins
        try:
            if not self._failed and not self.too_slow:
                self._step(i, scan)
        except (UnavailableError, SequenceError, MachineError, MemoryError):
            raise  # of the machine or the recording, whatever the parameters
        except Exception as error:
            self._exceptions[in_a_line(error)] = None
            self._failed = True
        if np.isfinite(self.T_odom_sensor[i, 0, 0]):
            return
        self.without_pose[i] = True
        self.T_odom_sensor[i] = (
            self._start(i)[0] if i in self._begins else self.T_odom_sensor[i - 1]
        )

    def close(self) -> None:
        """End the odometry's processes; what they used stays known."""
        if self._odometry is not None:
            self._odometry.close()

    def _step(self, i: int, scan: SharedScan) -> None:
        if self._odometry is None:
            self._odometry = self._make()
        prepared = scan(self._odometry)
        if i in self._begins:
            T_odom_start, T_before_start = self._start(i)
            self._tracker = Tracker(
                self._odometry,
                self._health,
                T_odom_start=T_odom_start,
                T_before_start=T_before_start,
            )
        found = self._tracker.register_prepared(self._stamps[i], prepared)
        self.T_odom_sensor[i], self.tried[i] = found.T_odom_sensor, True
        self.without_pose[i] = found.unhealthy == "no_pose"
        self.registered[i] = found.registered and not self.without_pose[i]
        self.restarted[i] = found.unhealthy is not None
        if found.unhealthy not in (None, "no_pose"):
            self.unhealthy[found.unhealthy] += 1
        if i not in self._begins:
            self.seconds[i] = found.register_seconds
        self.too_slow = self._odometry.usage.cpu > self._most

    def _start(self, i: int) -> tuple[Poses, Poses | None]:
        """Where a drive begins, and the motion that leads there.

        A robot drives already where a recording is entered, and is started at its begin.
        """
        T_ref_sensor, stamps = self._frames.T_ref_sensor, self._frames.stamps
        before = int(np.searchsorted(stamps, stamps[i] - round(RECENT * 1e9)))
        if not i or before == i or not np.isfinite(T_ref_sensor[[before, i]]).all():
            return np.eye(4) if not i or np.isnan(T_ref_sensor[i, 0, 0]) else T_ref_sensor[i], None
        moved = invert(T_ref_sensor[before]) @ T_ref_sensor[i]
        share = (stamps[i] - stamps[i - 1]) / (stamps[i] - stamps[before])
        return T_ref_sensor[i], scale(moved, float(share))


RECENT = 0.5
"""Seconds of the reference whose mean motion leads to the begin of a stretch: one step is noisy."""
SLOW, LEAST_SECONDS = 10.0, 20.0
"""A set is stopped that takes so many times the CPU time of the baseline, and so many seconds."""


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


class PreparedSequence:
    """A sequence that is read, prepared and described once, for all trials of a worker.

    Attributes
    ----------
    name : str
    scans : Recording
    frames : Frames
    shared : SharedScans
        The prepared scans, which take `memory` bytes at most.

    Raises
    ------
    AdaptuneError
        If the sequence cannot be read, or no error can be measured on it.
    """

    def __init__(self, setup: "TrialSetup", name: str, memory: float, progress: Progress):
        settings, key = setup.settings, setup.sequences.key(name)
        self.name, self._setup = name, setup
        self.scans = scans = setup.sequences.open(name)
        self.shared = SharedScans(scans, memory)
        self._odometry: OdometryInstance | None = None
        reference = scans.reference()
        if reference is None:
            raise AdaptuneError(f"{key}: training needs a reference trajectory")
        stamps, descriptors, elevations, full, enough = [], [], [], False, False
        try:
            describe = Describer(settings.descriptors)
            for scan in _watched(scans, scans.n_messages, "reading", progress):
                enough = enough or len(scan) >= MIN_POINTS
                stamps.append(scan.stamp)
                descriptors.append(describe(scan))
                elevations.append(lowest_elevation(scan))
                full = full or self._prepare(len(stamps) - 1, scan)
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
        self.frames = Frames(
            at, T_ref_sensor, described, describe.blocks, elevation, stretches=stretches
        )

    def _prepare(self, i: int, scan: recording.Scan) -> bool:
        """Prepare a scan for the baseline; whether there is no room for another."""
        try:
            if self._odometry is None:
                self._odometry = self._setup.odometry()
            self.shared.prepared(i, lambda: scan, self._odometry)
        except Exception as error:
            raise AdaptuneError(
                f"sequences.{self.name}: the odometry fails with its own parameters, the baseline, "
                f"when it is to prepare a scan: {in_a_line(error)}; mend the odometry "
                f"(odometry in the study), and run the same command again"
            ) from error
        return self.shared.n_kept(self._odometry) <= i


def _watched(scans: Iterable[Any], n: int, what: str, progress: Progress) -> Iterator[Any]:
    done = 0
    for done, scan in enumerate(scans, start=1):
        yield scan
        progress(what, min(done, n), n)
    progress(what, done, done)


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
    """Everything that a process needs to drive trials."""

    settings: TrialSettings
    odometry: Factory
    sequences: StudySequences

    def prepare(self, name: str, memory: float, progress: Progress = unseen) -> PreparedSequence:
        """Read and prepare a sequence, see `PreparedSequence`."""
        return PreparedSequence(self, name, memory, progress)

    def run(
        self,
        scans: PreparedSequence,
        sets: Sequence[ParameterSet],
        whole: bool = False,
        most_ms: float = np.inf,
        progress: Progress = unseen,
    ) -> list[Trial]:
        """Drive with several parameter sets on one pass over a sequence, see `Drives`.

        The stretches of the sequence are driven, or with `whole` all of it. Sets that take more
        than `most_ms` milliseconds of CPU time a scan, see `SLOW`, are stopped.
        """
        frames = scans.frames.uncut if whole else scans.frames
        most = max(1e-3 * most_ms * frames.n_driven, LEAST_SECONDS)
        drives = [self._begin(scans, frames, parameters, most) for parameters in sets]
        each = [one for of_set in drives for one in of_set]
        with ExitStack() as ended:
            for one in each:
                ended.callback(one.close)
            driven = _driven(scans.shared, frames)
            for i, scan in _watched(driven, frames.n_driven, "running", progress):
                for one in each:
                    one.step(i, scan)
        return [
            _mean(s, [_trial(self.settings, s, frames, scans.shared, one) for one in of_set])
            for s, of_set in zip(sets, drives, strict=True)
        ]

    def _begin(
        self, scans: PreparedSequence, frames: Frames, parameters: ParameterSet, most: float
    ) -> list[Drives]:
        """The drives of a parameter set, once for each repeat."""
        settings, odometry = self.settings, self.odometry
        make = partial(odometry, parameters, scans.name)
        n = settings.repeats
        if settings.baseline_runs is not None and parameters in odometry.space.baselines:
            n = max(n, settings.baseline_runs)
        return [Drives(make, frames, settings.health, most) for _ in range(n)]


def _driven(shared: SharedScans, frames: Frames) -> Iterator[tuple[int, SharedScan]]:
    """The scans of all stretches, with their numbers."""
    stop, wanted = int(frames.stretches[:, 2].max()), np.zeros(len(frames.stamps), bool)
    for first, _, end in frames.stretches:
        wanted[first:end] = True
    yield from ((i, scan) for i, scan in enumerate(islice(shared, stop)) if wanted[i])


def _trial(
    settings: TrialSettings,
    parameters: ParameterSet,
    frames: Frames,
    shared: SharedScans,
    drives: Drives,
) -> Trial:
    """Make a trial of the drives along all stretches."""
    T_odom_sensor, T_ref_sensor = drives.T_odom_sensor, frames.counted
    n, waiting = frames.n_driven, np.zeros(len(frames.stamps), bool)
    for first, _, end in frames.stretches:
        without = int(np.argmax([*drives.registered[first:end], True]))
        # Scans before a first pose that comes are unknown.
        waiting[first : first + without] = first + without < end
    missing = int((waiting | drives.without_pose).sum())
    failure, lost = "", int(drives.without_pose.sum())
    if missing >= MAX_SHARE_WITHOUT_POSE * n:
        failure, lost = f"no pose for {missing} of {n} scans", missing
    else:
        T_ref_sensor[waiting & ~drives.without_pose] = np.nan
    unhealthy = dict(drives.unhealthy) | ({"no_pose": lost} if lost else {})
    if len(drives.faults) >= MOST_FAULTS:
        failure = f"{len(drives.faults)} faults"
    usage, prepare_ms = drives.usage(shared)
    tried = max(int(drives.tried.sum()), 1)
    if drives.too_slow:
        failure = f"too slow: {1e3 * usage.cpu / tried:.0f} ms a scan"
    if usage.seconds is not None:
        drives.seconds[~np.isnan(drives.seconds)] = usage.seconds
    # What goes on without poses may seem to do well.
    unseen = ~drives.tried | ((drives.without_pose | waiting) & bool(failure))
    errors = sub_trajectory_rte(T_ref_sensor, T_odom_sensor, settings.sub_trajectory, unseen)
    if np.isnan(errors).all():
        failure = failure or "no sub-trajectory has poses"
    seconds = sum(
        (frames.stamps[end - 1] - frames.stamps[first]) * 1e-9 for first, _, end in frames.stretches
    )
    used = {
        "cpu": 100.0 * usage.cpu / seconds,
        REGISTER_MS: 1e3 * usage.cpu / tried,
        PREPARE_MS: prepare_ms,
    } | ({} if usage.memory is None else {"memory": usage.memory})
    first, _, end = frames.stretches[0]
    if 0 < (late := int(np.argmax([*drives.registered[first:end], True]))) < end - first:
        used[FIRST_POSE] = (frames.stamps[first + late] - frames.stamps[first]) * 1e-9
    return Trial(
        parameters,
        T_odom_sensor,
        errors,
        drives.restarted,
        drives.registered,
        drives.seconds,
        drives.faults,
        trajectory_metrics(T_ref_sensor, T_odom_sensor),
        used,
        unhealthy=unhealthy,
        failure=failure,
    )


def _mean(parameters: ParameterSet, repeats: Sequence[Trial]) -> Trial:
    """One trial of several with the same parameters."""
    if len(repeats) == 1:
        return repeats[0]
    metrics = set.intersection(*(set(trial.metrics) for trial in repeats))
    return Trial(
        parameters,
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
