"""One parameter set on one sequence, or several at once on one pass over it."""

import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Frames, Trial
from adaptune.descriptor import Describer, DescriptorError, lowest_elevation
from adaptune.descriptor.motion import fill_in, speed_and_turn_rate
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses, invert, steps
from adaptune.metrics import KITTI_LENGTHS, cap, sub_trajectory_rte, travelled, window_ends
from adaptune.odometry.base import OdometryInstance, prepared_bytes
from adaptune.odometry.health import unhealthy
from adaptune.sequence import Scan
from adaptune.space import ParameterSet
from adaptune.study import Study
from offline.objective import trajectory_metrics

MIN_POINTS = 20
"""No odometry makes anything of a scan with fewer."""
EPISODE = 4.0
"""Sub-trajectories from the beginning of an episode to that of the next."""


class PreparedSequence:
    """A sequence read, prepared and described once, for all trials of a worker.

    Parameters
    ----------
    study
        The study.
    name
        The sequence.
    memory
        Bytes that prepared scans may take. What does not fit is read again on every pass.

    Attributes
    ----------
    name : str
    frames : Frames
    nbytes : int
        What the prepared scans take.

    Raises
    ------
    AdaptuneError
        If the sequence cannot be read, or holds nothing to learn from.
    """

    def __init__(self, study: Study, name: str, memory: float):
        self.name = name
        self._sequence = study.sequence(name)
        self._box = _odometry(study)
        self._kept: list[Any] = []
        self.nbytes = 0
        describe = Describer(study.config.descriptor.names)
        stamps, descriptors, elevations, full, enough = [], [], [], False, False
        for scan in self._sequence:
            enough = enough or len(scan) >= MIN_POINTS
            stamps.append(scan.stamp)
            descriptors.append(_described(describe, scan, name))
            elevations.append(lowest_elevation(scan))
            if full:
                continue
            prepared = self._box.prepare(scan)
            full = self.nbytes + prepared_bytes(prepared) > memory
            if not full:
                self._kept.append(prepared)
                self.nbytes += prepared_bytes(prepared)
        if not enough:
            raise AdaptuneError(
                f"sequences.{name}: none of its {len(stamps)} scans has {MIN_POINTS} points"
            )
        reference = self._sequence.reference()
        if reference is None:
            raise AdaptuneError(
                f"sequences.{name}: training needs a reference trajectory; name its topic or file "
                f"(reference: ...)"
            )
        at = np.array(stamps, np.int64)
        T_ref_sensor = reference.at(at)
        check_reference(study, name, T_ref_sensor)
        described = np.array(descriptors)
        # When a scan is to be described online, the pose of the one before is known.
        motion = speed_and_turn_rate(at, T_ref_sensor)
        fill_in(described[1:], describe.blocks, motion[:-1])
        self.frames = Frames(
            at,
            T_ref_sensor,
            described,
            describe.blocks,
            np.array(elevations, np.float32),
        )

    def __iter__(self) -> Iterator[Any]:
        yield from self._kept
        if len(self._kept) < len(self.frames.stamps):
            for i, scan in enumerate(self._sequence):
                if i >= len(self._kept):
                    yield self._box.prepare(scan)


def _described(describe: Describer, scan: Scan, name: str) -> NDArray[np.float32]:
    try:
        return describe(scan)
    except DescriptorError as error:
        raise AdaptuneError(f"sequences.{name}: {error}") from error


def check_reference(study: Study, name: str, T_ref_sensor: Poses) -> None:
    """Refuse a sequence in which no sub-trajectory can be measured.

    Parameters
    ----------
    study
        The study.
    name
        The sequence.
    T_ref_sensor
        Reference poses at the scans' stamps, NaN where there is none.

    Raises
    ------
    AdaptuneError
    """
    if np.isnan(T_ref_sensor).all():
        raise AdaptuneError(
            f"sequences.{name}: the reference does not overlap the scans in time; check that both "
            f"are of the same recording and clock"
        )
    if not (window_ends(T_ref_sensor, study.config.sub_trajectory) >= 0).any():
        known = T_ref_sensor[~np.isnan(T_ref_sensor[:, 0, 0])]
        path = np.linalg.norm(np.diff(known[:, :3, 3], axis=0), axis=1).sum()
        raise AdaptuneError(
            f"sequences.{name}: its path of {path:.1f} m holds no sub-trajectory of "
            f"{study.config.sub_trajectory:g} m; make sub_trajectory shorter or the sequence longer"
        )
    shortest = min(KITTI_LENGTHS)
    judged = "kitti" in study.config.offline.metrics
    if judged and not (window_ends(T_ref_sensor, shortest) >= 0).any():
        raise AdaptuneError(
            f"sequences.{name}: its path holds no sub-trajectory of {shortest:g} m, the least of "
            f"KITTI's error; judge by another metric (offline.objective, offline.limits)"
        )


def _odometry(
    study: Study, parameters: ParameterSet | None = None, sequence: str | None = None
) -> OdometryInstance:
    """An odometry, in a process of its own where its memory is to be told apart."""
    if "memory" in study.config.offline.metrics:
        return study.odometry(parameters, sequence, isolated=True)
    return study.odometry(parameters, sequence)


class _Run:
    """An odometry on its way along a piece of a sequence, from frame `begin` to before `end`."""

    def __init__(
        self,
        odometry: OdometryInstance,
        frames: Frames,
        lost_track: float | None,
        begin: int,
        end: int,
    ):
        n = len(frames.stamps)
        self.odometry = odometry
        self.begin, self.end = begin, end
        self.T_odom_sensor = np.empty((n, 4, 4))
        self.restarted = np.zeros(n, bool)
        self.registered = np.ones(n, bool)
        self.seconds = np.zeros(n)
        self.lost_steps: dict[int, Poses] = {}
        self._T_ref_sensor = frames.T_ref_sensor
        self._T_ref_steps = steps(frames.T_ref_sensor)
        self._bounds = np.diff(frames.stamps) * 1e-9 * (lost_track or np.inf)

    def step(self, i: int, prepared: Any) -> None:
        if i == self.begin:
            T = self._T_ref_sensor[i]
            T = np.eye(4) if np.isnan(T[0, 0]) else T
            self.odometry.start(prepared, T)
            self.T_odom_sensor[i] = T
            return
        begin = time.perf_counter()
        T, self.registered[i] = self.odometry.register(prepared)
        self.seconds[i] = time.perf_counter() - begin
        finite = np.isfinite(T).all()
        # An odometry without a pose has, as far as one can tell, not moved.
        T_step = invert(self.T_odom_sensor[i - 1]) @ T if finite else np.eye(4)
        if self._lost(i, T_step if finite else None):
            self.lost_steps[i] = T_step
            T = self._T_ref_sensor[i]
            self.odometry.start(prepared, T, self._T_ref_steps[i - 1])
            self.restarted[i] = True
        elif not finite:
            # There is no reference to go on at.
            T = self.T_odom_sensor[i - 1]
            self.odometry.start(prepared, T)
        self.T_odom_sensor[i] = T

    def _lost(self, i: int, T_step: Poses | None) -> bool:
        T_ref_step = self._T_ref_steps[i - 1]
        if np.isnan(T_ref_step[0, 0]) or np.isinf(self._bounds[i - 1]):
            return False
        if T_step is None:
            return True
        departure = T_step[:3, 3] - T_ref_step[:3, 3]
        return bool(np.linalg.norm(departure) > self._bounds[i - 1])


def episodes(T_ref_sensor: Poses, length: float) -> list[tuple[int, int]]:
    """Pieces of a sequence that overlap, so that every sub-trajectory lies within one of them.

    Parameters
    ----------
    T_ref_sensor
        Reference poses of shape (n, 4, 4).
    length
        Metres of a sub-trajectory. A piece begins every `EPISODE` times that.

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
    study: Study, sequence: PreparedSequence, sets: Sequence[ParameterSet], whole: bool = False
) -> list[Trial]:
    """Run an odometry with several parameter sets on one pass over a sequence.

    With ``offline.runs: restart``, where the odometry loses track, it is started anew at the
    reference with that scan, and the sub-trajectories across that frame are labelled as failures:
    what comes after is judged for itself. See `OfflineConfig` for the other ways.

    Parameters
    ----------
    study
        The study.
    sequence
        The sequence.
    sets
        The parameter sets.
    whole
        From end to end, whatever the study says.
    """
    frames, config = sequence.frames, study.config
    kind, repeats = ("whole", 1) if whole else (config.offline.runs, config.offline.repeats)
    pieces = [(0, len(frames.stamps))]
    if kind == "episodes":
        pieces = episodes(frames.T_ref_sensor, config.sub_trajectory)
    lost_track = config.lost_track if kind == "restart" else None
    # Of every set every repeat, and of that every piece.
    runs = [
        [
            [
                _Run(_odometry(study, s, sequence.name), frames, lost_track, *piece)
                for piece in pieces
            ]
            for _ in range(repeats)
        ]
        for s in sets
    ]
    each = [run for of_set in runs for repeat in of_set for run in repeat]
    for i, prepared in enumerate(sequence):
        for run in each:
            if run.begin <= i < run.end:
                run.step(i, prepared)
    return [
        _mean(s, [_trial(study, s, frames, repeat) for repeat in of_set])
        for s, of_set in zip(sets, runs, strict=True)
    ]


def _trial(study: Study, parameters: ParameterSet, frames: Frames, pieces: Sequence[_Run]) -> Trial:
    """Make one trial of pieces: what is told of a frame is of the last that began before it."""
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
            study.config.sub_trajectory,
            run.restarted[piece],
        )[: own.stop - own.start]
        restarted[own], registered[own] = run.restarted[own], run.registered[own]
        seconds[own] = run.seconds[own]
        lost_steps |= run.lost_steps
        cpu += run.odometry.usage.cpu * (own.stop - own.start) / (run.end - run.begin)
        if after is not None:
            T = run.T_odom_sensor
            lost_steps[after.begin] = invert(T[after.begin - 1]) @ T[after.begin]
    T_steps = steps(T_odom_sensor)
    for i, T_step in lost_steps.items():
        T_steps[i - 1] = T_step
    duration = (frames.stamps[-1] - frames.stamps[0]) * 1e-9
    usage = {"cpu": 100.0 * cpu / duration}
    memory = [run.odometry.usage.memory for run in pieces]
    if known := [megabytes for megabytes in memory if megabytes is not None]:
        usage["memory"] = max(known)
    return Trial(
        parameters,
        T_odom_sensor,
        errors,
        restarted,
        registered,
        seconds,
        tuple(fault for run in pieces for fault in run.odometry.faults),
        trajectory_metrics(frames, T_odom_sensor, lost_steps),
        usage,
        unhealthy=unhealthy(study.config.health, T_steps, frames.stamps, registered),
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
        {m: float(np.mean([t.usage[m] for t in repeats])) for m in repeats[0].usage},
        tuple({"rte": trial.mean_error} | trial.metrics for trial in repeats),
        repeats[0].unhealthy,
    )
