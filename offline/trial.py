"""One parameter set on one sequence, or several at once on one pass over it."""

import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count, islice
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from adaptune import recording
from adaptune.archive import (
    FIRST_POSE,
    MAX_SHARE_WITHOUT_POSE,
    PREPARE_MS,
    REGISTER_MS,
    Frames,
    Trial,
)
from adaptune.errors import AdaptuneError, UnavailableError, in_a_line
from adaptune.geometry import Poses, invert, steps
from adaptune.live.evidence import hops_along
from adaptune.metrics import KITTI_LENGTHS, cap, sub_trajectory_rte, travelled, window_ends
from adaptune.model.descriptor import (
    Describer,
    DescriptorError,
    fill_in,
    lowest_elevation,
    speed_and_turn_rate,
)
from adaptune.odometry.base import MIN_POINTS, OdometryInstance, Usage, prepared_bytes
from adaptune.odometry.registry import Factory
from adaptune.odometry.tracker import HealthCheck, Tracker, unhealthy
from adaptune.processes import apart
from adaptune.progress import Progress, unseen
from adaptune.recording.scan import Scan
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
            scan, begin = read(), time.process_time()
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


class TrialRun:
    """A run of an odometry on a sequence, restarted at the reference where it loses track.

    An exception of the odometry is a fault, after which there is no pose.
    """

    def __init__(
        self,
        make: Callable[[], OdometryInstance],
        frames: Frames,
        lost_track: float | None,
    ):
        n = len(frames.stamps)
        self.T_odom_sensor = np.empty((n, 4, 4))
        self.restarted = np.zeros(n, bool)
        self.registered = np.ones(n, bool)
        self.seconds = np.zeros(n)
        self.lost_steps: dict[int, Poses] = {}
        self.unhealthy = Counter[str]()  # scans without a pose
        self._make = make
        self._odometry: OdometryInstance | None = None
        self._failure: tuple[str, ...] = ()
        self._T_ref_sensor = frames.T_ref_sensor
        self._T_ref_steps = steps(frames.T_ref_sensor)
        self._bounds = np.diff(frames.stamps) * 1e-9 * (lost_track or np.inf)

    @property
    def faults(self) -> tuple[str, ...]:
        """See `Trial`."""
        return (*(() if self._odometry is None else self._odometry.faults), *self._failure)

    def usage(self, scans: SharedScans) -> tuple[Usage, float]:
        """What the odometry used, and the mean CPU time in ms that it took to prepare a scan."""
        of = self._odometry
        return (Usage(0.0, None), 0.0) if of is None else (of.usage, scans.milliseconds(of))

    def step(self, i: int, scan: SharedScan) -> None:
        """Register the scan of frame `i`."""
        if not self._failure:
            try:
                self._step(i, scan)
            except UnavailableError:
                raise
            except Exception as error:
                self._failure = (in_a_line(error),)
        if self._failure:
            self._step_without_pose(i)

    def close(self) -> None:
        """End the odometry's processes; what they used stays known."""
        if self._odometry is not None:
            self._odometry.close()

    def _step(self, i: int, scan: SharedScan) -> None:
        if i == 0:
            T = self._T_ref_sensor[i]
            T = np.eye(4) if np.isnan(T[0, 0]) else T
            self._odometry = self._make()
            self._odometry.start(scan(self._odometry), T)
            self.T_odom_sensor[i], self.registered[i] = T, self._odometry.begun
            return
        assert self._odometry is not None
        odometry = self._odometry
        prepared, waiting = scan(odometry), not odometry.begun
        begin = time.perf_counter()
        T, self.registered[i] = odometry.register(prepared)
        self.seconds[i] = time.perf_counter() - begin
        finite = np.isfinite(T).all()
        if waiting and not odometry.faults:
            # Nobody knows how it moved until its first pose.
            self.registered[i] &= odometry.begun and finite
            self.T_odom_sensor[i] = T if self.registered[i] else self.T_odom_sensor[i - 1]
            return
        self.unhealthy.update([] if finite else ["no_pose"])
        # An odometry without a pose counts as not moved.
        T_step = invert(self.T_odom_sensor[i - 1]) @ T if finite else np.eye(4)
        if self._lost(i, T_step if finite else None):
            self.lost_steps[i] = T_step
            T = self._T_ref_sensor[i]
            odometry.start(prepared, T, self._T_ref_steps[i - 1])
            self.restarted[i] = True
        elif not finite:
            # There is no reference at which to restart.
            T = self.T_odom_sensor[i - 1]
            odometry.start(prepared, T)
        self.T_odom_sensor[i] = T

    def _step_without_pose(self, i: int) -> None:
        self.unhealthy["no_pose"] += 1
        self.registered[i] = False
        if self._lost(i, None):
            self.T_odom_sensor[i], self.restarted[i] = self._T_ref_sensor[i], True
            self.lost_steps[i] = np.eye(4)
        else:
            self.T_odom_sensor[i] = np.eye(4) if i == 0 else self.T_odom_sensor[i - 1]

    def _lost(self, i: int, T_step: Poses | None) -> bool:
        if i == 0 or np.isnan(self._T_ref_steps[i - 1, 0, 0]) or np.isinf(self._bounds[i - 1]):
            return False
        if T_step is None:
            return True
        departure = T_step[:3, 3] - self._T_ref_steps[i - 1, :3, 3]
        return bool(np.linalg.norm(departure) > self._bounds[i - 1])


class DrivenRun(TrialRun):
    """A run from end to end as a replay drives it: with the health check, without reference."""

    def __init__(self, make: Callable[[], OdometryInstance], frames: Frames, health: HealthCheck):
        super().__init__(make, frames, None)
        self._stamps, self._health = frames.stamps.tolist(), health

    def _step(self, i: int, scan: SharedScan) -> None:
        if i == 0:
            self._odometry = self._make()
            self._tracker = Tracker(self._odometry, self._health)
        prepared = scan(self._tracker.odometry)
        found = self._tracker.register_prepared(self._stamps[i], prepared)
        self.T_odom_sensor[i], self.registered[i] = found.T_odom_sensor, found.registered
        self.seconds[i] = found.register_seconds if i else 0.0
        self.unhealthy.update([found.unhealthy] if found.unhealthy else [])


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
    lost_track: float = 3.0
    health: HealthCheck = field(default_factory=HealthCheck)
    descriptors: tuple[str, ...] = ("ndt",)
    runs: Literal["restart", "whole"] = "restart"
    repeats: int = 1
    baseline_runs: int | None = None  # as many as `repeats`, if not given
    metrics: frozenset[str] = frozenset({"rte"})

    @classmethod
    def of(cls, config: OfflineStudyConfig) -> Self:
        """The settings of a study."""
        shared = (config.sub_trajectory, config.lost_track, config.health, config.descriptor)
        offline = config.offline
        own = (config.runs, offline.repeats, offline.baseline_runs, frozenset(offline.objective))
        return cls(*shared, *own)


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
        self.frames = Frames(at, T_ref_sensor, described, describe.blocks, elevation)

    def __iter__(self) -> Iterator[SharedScan]:
        yield from islice(self.shared, len(self.frames.stamps))

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
    """Everything that a process needs to run trials."""

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
        progress: Progress = unseen,
    ) -> list[Trial]:
        """Run the odometry with several parameter sets on one pass over a sequence.

        With ``runs: restart``, an odometry that loses track restarts at the reference with that
        scan. The sub-trajectories across that frame count as failures; later ones are judged on
        their own. `OfflineConfig` describes other kinds. With `whole`, it is driven from end to end
        as a replay drives it: without reference, and restarted by the health check.
        """
        runs = [self._begin(scans, parameters, whole) for parameters in sets]
        each = [run for of_set in runs for run in of_set]
        n_frames = len(scans.frames.stamps)
        with ExitStack() as ended:
            for run in each:
                ended.callback(run.close)
            for i, scan in enumerate(_watched(scans, n_frames, "running", progress)):
                for run in each:
                    run.step(i, scan)
        return [
            _mean(s, [_trial(self.settings, s, scans, run) for run in of_set])
            for s, of_set in zip(sets, runs, strict=True)
        ]

    def _begin(
        self, scans: PreparedSequence, parameters: ParameterSet, whole: bool
    ) -> list[TrialRun]:
        """The runs of a parameter set."""
        settings, odometry = self.settings, self.odometry
        make = partial(odometry, parameters, scans.name)
        n = settings.repeats
        if settings.baseline_runs is not None and parameters in odometry.space.baselines:
            n = max(n, settings.baseline_runs)
        if whole:
            return [DrivenRun(make, scans.frames, settings.health) for _ in range(n)]
        lost_track = settings.lost_track if settings.runs == "restart" else None
        return [TrialRun(make, scans.frames, lost_track) for _ in range(n)]


def _trial(
    settings: TrialSettings, parameters: ParameterSet, scans: PreparedSequence, run: TrialRun
) -> Trial:
    """Make a trial of a run."""
    frames, T_odom_sensor = scans.frames, run.T_odom_sensor
    T_steps = steps(T_odom_sensor)
    for i, T_step in run.lost_steps.items():
        T_steps[i - 1] = T_step
    n, first = len(frames.stamps), int(np.argmax([*run.registered, True]))
    # Scans before the first pose are unknown, unless they are so many that the run has failed.
    begin = 0
    if (missing := first + run.unhealthy["no_pose"]) >= MAX_SHARE_WITHOUT_POSE * n:
        run.unhealthy["no_pose"] = min(missing, n)
    elif begin := first:
        T_ref_sensor = frames.T_ref_sensor.copy()
        T_ref_sensor[:first] = np.nan
        frames = replace(frames, T_ref_sensor=T_ref_sensor)
    usage, prepare_ms = run.usage(scans.shared)
    if usage.seconds is not None:
        run.seconds[:] = usage.seconds
    used = {
        "cpu": 100.0 * usage.cpu / ((frames.stamps[-1] - frames.stamps[0]) * 1e-9),
        REGISTER_MS: 1e3 * usage.cpu / len(frames.stamps),
        PREPARE_MS: prepare_ms,
    } | ({} if usage.memory is None else {"memory": usage.memory})
    if 0 < first < n:
        used[FIRST_POSE] = (frames.stamps[first] - frames.stamps[0]) * 1e-9
    driven = run if isinstance(run, DrivenRun) else None
    return Trial(
        parameters,
        T_odom_sensor,
        sub_trajectory_rte(
            frames.T_ref_sensor, T_odom_sensor, settings.sub_trajectory, run.restarted
        ),
        run.restarted,
        run.registered,
        run.seconds,
        run.faults,
        trajectory_metrics(frames, T_odom_sensor, run.lost_steps),
        used,
        unhealthy=dict(run.unhealthy)
        if driven
        else unhealthy(
            settings.health, T_steps[begin:], frames.stamps[begin:], run.registered[begin:]
        )
        | dict(run.unhealthy),
        health=settings.health.model_dump() if driven else {},
    )


def _mean(parameters: ParameterSet, repeats: Sequence[Trial]) -> Trial:
    """One trial of several runs with the same parameters."""
    if len(repeats) == 1:
        return repeats[0]
    return Trial(
        parameters,
        repeats[0].T_odom_sensor,
        np.mean([cap(trial.errors) for trial in repeats], axis=0),
        np.any([trial.restarted for trial in repeats], axis=0),
        np.all([trial.registered for trial in repeats], axis=0),
        np.mean([trial.seconds for trial in repeats], axis=0),
        tuple(fault for trial in repeats for fault in trial.faults),
        {m: float(np.mean([t.metrics[m] for t in repeats])) for m in repeats[0].metrics},
        {
            m: float(np.mean([t.usage.get(m, 0.0) for t in repeats]))
            for m in {m: None for t in repeats for m in t.usage}
        },
        tuple({"rte": trial.mean_error} | trial.metrics for trial in repeats),
        max(repeats, key=lambda trial: trial.unhealthy.get("no_pose", 0)).unhealthy,
        repeats[0].health,
    )
