"""One parameter set on one sequence, or several at once on one pass over it."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from adaptune import sequence
from adaptune.archive import PREPARE_MS, REGISTER_MS, Frames, Trial
from adaptune.descriptor import Describer, DescriptorError, lowest_elevation
from adaptune.descriptor.motion import fill_in, speed_and_turn_rate
from adaptune.errors import AdaptuneError, in_a_line
from adaptune.geometry import Poses, invert, steps
from adaptune.metrics import KITTI_LENGTHS, cap, sub_trajectory_rte, travelled, window_ends
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.health import HealthCheck, unhealthy
from adaptune.odometry.pool import Factory
from adaptune.sequence.recorded import RecordedSequence
from adaptune.space import ParameterSet
from adaptune.study.sequences import StudySequences
from adaptune.trajectory import Trajectory
from offline.config import OfflineStudyConfig
from offline.hops import with_measured_hops
from offline.objective import trajectory_metrics
from offline.prepared import SharedScan, SharedScans
from offline.trial_run import DrivenRun, TrialRun

Advance = Callable[[int, int], None]
"""Called with how many scans of a sequence are done, and how many there are."""

MIN_POINTS = 20
"""No odometry can use a scan with fewer points."""
_AROUND = 1.0
"""Seconds by which a reference's clock may differ from the scans' while its length is looked at."""
EPISODE = 4.0
"""Sub-trajectories from the beginning of an episode to the beginning of the next."""


@dataclass(frozen=True)
class TrialSettings:
    """What a trial depends on besides odometry, sequence and parameter set."""

    sub_trajectory: float = 25.0
    lost_track: float = 3.0
    health: HealthCheck = field(default_factory=HealthCheck)
    descriptors: tuple[str, ...] = ("ndt",)
    runs: Literal["restart", "whole", "episodes"] = "restart"
    repeats: int = 1
    baseline_runs: int | None = None  # as many as `repeats`, if not given
    metrics: frozenset[str] = frozenset({"rte"})

    @classmethod
    def of(cls, config: OfflineStudyConfig) -> Self:
        """The settings of a study."""
        shared = (config.sub_trajectory, config.lost_track, config.health, config.descriptor.names)
        offline = config.offline
        own = (offline.runs, offline.repeats, offline.baseline_runs, frozenset(offline.metrics))
        return cls(*shared, *own)

    @property
    def isolated(self) -> bool:
        """Whether every odometry needs a process of its own, to measure its memory."""
        return "memory" in self.metrics


class PreparedSequence:
    """A sequence that is read, prepared and described once, for all trials of a worker.

    Attributes
    ----------
    name : str
    frames : Frames
    shared : SharedScans
        The prepared scans, which take `memory` bytes at most.

    Errors of its reference name it by `key`.

    Raises
    ------
    AdaptuneError
        If the sequence cannot be read, or no error can be measured on it.
    """

    def __init__(
        self,
        name: str,
        scans: sequence.Sequence,
        odometry: Factory,
        settings: TrialSettings,
        memory: float,
        advance: Advance = lambda *_: None,
        key: str | None = None,
    ):
        key = key or f"sequences.{name}"
        self.name = name
        self._scans = scans
        self.shared = SharedScans(scans, memory)
        self._baseline = partial(odometry, isolated=settings.isolated)
        self._odometry: OdometryInstance | None = None
        reference = _reference(key, scans, settings)
        with _of_sequence(name):
            describe = Describer(settings.descriptors)
        stamps, descriptors, elevations, full, enough = [], [], [], False, False
        for scan in _watched(scans, scans.n_messages, advance):
            enough = enough or len(scan) >= MIN_POINTS
            stamps.append(scan.stamp)
            with _of_sequence(name):
                descriptors.append(describe(scan))
            elevations.append(lowest_elevation(scan))
            if not full:
                full = self._prepare(len(stamps) - 1, scan)
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

    def measured_frames(self, advance: Advance = lambda *_: None) -> Frames:
        """The frames with the hops between them, for which the scans are read again."""
        return with_measured_hops(self._scans, self.frames, advance)

    @property
    def nbytes(self) -> int:
        """Bytes that the prepared scans take."""
        return self.shared.nbytes

    def __iter__(self) -> Iterator[SharedScan]:
        yield from islice(self.shared, len(self.frames.stamps))

    def _prepare(self, i: int, scan: sequence.Scan) -> bool:
        """Prepare a scan for the baseline; whether there is no room for another."""
        try:
            if self._odometry is None:
                self._odometry = self._baseline()
            self.shared.prepared(i, lambda: scan, self._odometry)
        except Exception as error:
            raise AdaptuneError(
                f"sequences.{self.name}: the odometry fails with its own parameters, the baseline, "
                f"when it is to prepare a scan: {in_a_line(error)}; mend the odometry "
                f"(odometry in the study), and run the same command again"
            ) from error
        return self.shared.n_kept(self._odometry) <= i


def _watched(scans: Iterable[Any], n: int, advance: Advance) -> Iterator[Any]:
    done = 0
    for done, scan in enumerate(scans, start=1):
        yield scan
        advance(min(done, n), n)
    advance(done, done)


@contextmanager
def _of_sequence(name: str) -> Iterator[None]:
    """Name the sequence in errors of descriptors."""
    try:
        yield
    except DescriptorError as error:
        raise AdaptuneError(f"sequences.{name}: {error}") from error


def _reference(key: str, scans: sequence.Sequence, settings: TrialSettings) -> Trajectory:
    """The reference; an AdaptuneError if it alone shows that no error can be measured."""
    reference = scans.reference()
    if reference is None:
        raise AdaptuneError(
            f"{key}: training needs a reference trajectory; name its topic or file (reference: "
            f"...), or let adaptune estimate one (reference: estimated)"
        )
    T = reference.T_world_sensor[_during(scans, reference)]
    if len(T) and travelled(T)[-1] < settings.sub_trajectory:
        raise _too_short(key, T, settings)
    return reference


def _during(scans: sequence.Sequence, reference: Trajectory) -> NDArray[np.bool_]:
    """Which poses of a reference may be of the scans' time, of shape (n,)."""
    span = scans.source.span() if isinstance(scans, RecordedSequence) else None
    if span is None or not isinstance(scans, RecordedSequence):
        return np.ones(len(reference.stamps), bool)
    seconds, section = (reference.stamps - span[0]) * 1e-9, scans.section
    stop = np.inf if section.stop is None else section.stop
    return np.asarray((seconds > section.start - _AROUND) & (seconds < stop + _AROUND))


def _too_short(key: str, T: Poses, settings: TrialSettings) -> AdaptuneError:
    return AdaptuneError(
        f"{key}: its path of {travelled(T)[-1]:.1f} m holds no sub-trajectory of "
        f"{settings.sub_trajectory:g} m; make sub_trajectory shorter or the sequence longer"
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
    if np.isnan(T_ref_sensor).all():
        raise AdaptuneError(
            f"{key}: the reference does not overlap the scans in time; check that both "
            f"are of the same recording and clock"
        )
    if not (window_ends(T_ref_sensor, settings.sub_trajectory) >= 0).any():
        raise _too_short(key, T_ref_sensor[~np.isnan(T_ref_sensor[:, 0, 0])], settings)
    shortest = min(KITTI_LENGTHS)
    if "kitti" in settings.metrics and not (window_ends(T_ref_sensor, shortest) >= 0).any():
        raise AdaptuneError(
            f"{key}: its path holds no sub-trajectory of {shortest:g} m, the shortest "
            f"of KITTI's error; judge by another metric (offline.objective, offline.limits)"
        )
    return T_ref_sensor


def episodes(T_ref_sensor: Poses, length: float) -> list[tuple[int, int]]:
    """Overlapping pieces of a sequence: every sub-trajectory lies within one of them.

    Parameters
    ----------
    T_ref_sensor
        Reference poses of shape (n, 4, 4).
    length
        Metres of a sub-trajectory. Pieces begin `EPISODE` times that apart.

    Returns
    -------
    list of (begin, end)
        Frames from `begin` to before `end`.
    """
    distance = travelled(T_ref_sensor)
    n = len(distance)
    starts = np.arange(0.0, max(distance[-1], 1e-9), EPISODE * length)
    begins = np.unique(np.searchsorted(distance, starts)).tolist()
    ends = [
        min(n, int(np.searchsorted(distance, distance[last - 1] + length, side="right")) + 1)
        for last in [*begins[1:], n]
    ]
    return list(zip(begins, ends, strict=True))


def run_trials(
    settings: TrialSettings,
    odometry: Factory,
    scans: PreparedSequence,
    sets: Sequence[ParameterSet],
    whole: bool = False,
    advance: Advance = lambda *_: None,
) -> list[Trial]:
    """Run an odometry with several parameter sets on one pass over a sequence.

    With ``runs: restart``, an odometry that loses track restarts at the reference with that scan.
    The sub-trajectories across that frame count as failures; later ones are judged on their own.
    `OfflineConfig` describes other kinds. With `whole`, it is driven from end to end as a replay
    drives it: without reference, and restarted by the health check.
    """
    frames = scans.frames
    pieces = [(0, len(frames.stamps))]
    if settings.runs == "episodes":
        pieces = episodes(frames.T_ref_sensor, settings.sub_trajectory)
    lost_track = settings.lost_track if settings.runs == "restart" else None

    def repeat(parameters: ParameterSet) -> list[TrialRun]:
        make = partial(odometry, parameters, scans.name, isolated=settings.isolated)
        if whole:
            return [DrivenRun(make, frames, settings.health)]
        return [TrialRun(make, frames, lost_track, *piece) for piece in pieces]

    # For every set every repeat, and for every repeat every piece.
    runs = [[repeat(s) for _ in range(_n_runs(settings, odometry, s))] for s in sets]
    each = [run for of_set in runs for of_repeat in of_set for run in of_repeat]
    with ExitStack() as ended:
        for run in each:
            ended.callback(run.close)
        for i, scan in enumerate(_watched(scans, len(frames.stamps), advance)):
            for run in each:
                if run.begin <= i < run.end:
                    run.step(i, scan)
    return [
        _mean(s, [_trial(settings, s, scans, pieces) for pieces in of_set])
        for s, of_set in zip(sets, runs, strict=True)
    ]


def _n_runs(settings: TrialSettings, odometry: Factory, parameters: ParameterSet) -> int:
    if settings.baseline_runs is None or parameters not in odometry.space.baselines:
        return settings.repeats
    return settings.baseline_runs


def _trial(
    settings: TrialSettings,
    parameters: ParameterSet,
    scans: PreparedSequence,
    pieces: Sequence[TrialRun],
) -> Trial:
    """Make one trial of pieces: each frame belongs to the last piece that begins before it."""
    frames = scans.frames
    n = len(frames.stamps)
    T_odom_sensor = np.empty((n, 4, 4))
    errors, seconds = np.empty(n), np.empty(n)
    restarted, registered = np.zeros(n, bool), np.ones(n, bool)
    lost_steps: dict[int, Poses] = {}
    cpu = 0.0
    for run, after in zip(pieces, [*pieces[1:], None], strict=True):
        own = slice(run.begin, n if after is None else after.begin)
        T_odom_sensor[own] = run.T_odom_sensor[own]
        piece = slice(run.begin, run.end)
        errors[own] = sub_trajectory_rte(
            frames.T_ref_sensor[piece],
            run.T_odom_sensor[piece],
            settings.sub_trajectory,
            run.restarted[piece],
        )[: own.stop - own.start]
        restarted[own], registered[own] = run.restarted[own], run.registered[own]
        apart = run.usage.seconds
        seconds[own] = run.seconds[own] if apart is None else apart
        lost_steps |= run.lost_steps
        cpu += run.usage.cpu * (own.stop - own.start) / (run.end - run.begin)
        if after is not None:
            T = run.T_odom_sensor
            lost_steps[after.begin] = invert(T[after.begin - 1]) @ T[after.begin]
    T_steps = steps(T_odom_sensor)
    for i, T_step in lost_steps.items():
        T_steps[i - 1] = T_step
    driven = pieces[0] if isinstance(pieces[0], DrivenRun) else None
    return Trial(
        parameters,
        T_odom_sensor,
        errors,
        restarted,
        registered,
        seconds,
        tuple(fault for run in pieces for fault in run.faults),
        trajectory_metrics(frames, T_odom_sensor, lost_steps),
        _usage(cpu, scans, pieces),
        unhealthy=dict(driven.unhealthy)
        if driven
        else unhealthy(settings.health, T_steps, frames.stamps, registered),
        health=settings.health.model_dump() if driven else {},
    )


def _usage(cpu: float, scans: PreparedSequence, pieces: Sequence[TrialRun]) -> dict[str, float]:
    """What a trial used, see `Trial`."""
    stamps = scans.frames.stamps
    usage = {
        "cpu": 100.0 * cpu / ((stamps[-1] - stamps[0]) * 1e-9),
        REGISTER_MS: 1e3 * cpu / len(stamps),
        PREPARE_MS: pieces[0].prepare_ms(scans.shared),
    }
    memory = [run.usage.memory for run in pieces]
    if known := [megabytes for megabytes in memory if megabytes is not None]:
        usage["memory"] = max(known)
    return usage


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
        {m: float(np.mean([t.usage[m] for t in repeats])) for m in repeats[0].usage},
        tuple({"rte": trial.mean_error} | trial.metrics for trial in repeats),
        repeats[0].unhealthy,
        repeats[0].health,
    )


@dataclass(frozen=True)
class TrialSetup:
    """Everything that a process needs to run trials."""

    settings: TrialSettings
    odometry: Factory
    sequences: StudySequences

    def prepare(
        self, name: str, memory: float, advance: Advance = lambda *_: None
    ) -> PreparedSequence:
        """Read and prepare a sequence, see `PreparedSequence`."""
        scans = self.sequences.open(name)
        key = self.sequences.key(name)
        return PreparedSequence(name, scans, self.odometry, self.settings, memory, advance, key)

    def run(
        self,
        scans: PreparedSequence,
        sets: Sequence[ParameterSet],
        whole: bool = False,
        advance: Advance = lambda *_: None,
    ) -> list[Trial]:
        """Run trials, see `run_trials`."""
        return run_trials(self.settings, self.odometry, scans, sets, whole, advance)
