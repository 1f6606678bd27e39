"""Runs of parameter sets along the segments of a recording, and the trials that they make."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import NamedTuple

import numpy as np

from adaptune._system.progress import Progress, unseen, watched
from adaptune.errors import MachineError, UnavailableError, in_a_line
from adaptune.geometry import Poses
from adaptune.metrics import cap, sub_trajectory_rte
from adaptune.odometry.factory import Factory
from adaptune.odometry.faults import MAX_SHARE_WITHOUT_POSE, MOST_FAULTS
from adaptune.odometry.tracker import Tracker
from adaptune.recording.scan import Recording, SequenceError
from adaptune.runs.archive import FIRST_POSE, PREPARE_MS, REGISTER_MS, Frames, Trial
from adaptune.runs.record import Run
from adaptune.space import ParameterSet
from adaptune.study.sequences import StudySequences
from offline.config import OfflineStudyConfig
from offline.frames import Segment, segments_along
from offline.objective import trajectory_metrics
from offline.shared_scans import SharedScan, SharedScans


class _SegmentDrive:
    """Drives one parameter set along one segment.

    It begins at the reference's pose, as a robot does, with the health check, and without the
    reference from then on; it never falls back, as `adaptune.runs.loop.Driver` does. An exception
    of the odometry is a fault, after which the run has no pose. A set that takes more than `most`
    seconds of CPU time is stopped.
    """

    def __init__(self, begin: Callable[[], Tracker], segment: Segment, most: float):
        self.run = Run()
        self._begin, self._segment, self._most = begin, segment, most
        self._tracker: Tracker | None = None

    def step(self, stamp: int, scan: SharedScan) -> None:
        """Register the next scan."""
        run = self.run
        if run.exception or run.too_slow:
            return
        try:
            self._tracker = self._tracker or self._begin()
            odometry = self._tracker.odometry
            run.steps.append(self._tracker.register_prepared(stamp, scan(odometry)))
            run.too_slow = odometry.usage.cpu > self._most
        except (UnavailableError, SequenceError, MachineError, MemoryError):
            raise  # of the machine or the recording, whatever the parameters
        except Exception as error:
            run.exception = in_a_line(error)

    def close(self, scans: SharedScans) -> None:
        """End the odometry's processes, and note what they used."""
        if self._tracker is None:
            return
        run, odometry = self.run, self._tracker.odometry
        odometry.close()
        run.faults, run.usage = tuple(odometry.faults), odometry.usage
        run.prepare_ms = scans.milliseconds(self._segment, odometry)


class TrialSetup(NamedTuple):
    """What a process needs to describe recordings, and to drive along them."""

    config: OfflineStudyConfig
    odometry: Factory
    sequences: StudySequences


def drive_sets(
    setup: TrialSetup,
    shared: SharedScans,
    scans: Recording,
    segment: Segment,
    sets: Iterable[ParameterSet],
    most: float = np.inf,
    bare: bool = False,
    progress: Progress = unseen,
) -> list[list[Run]]:
    """Drive with several parameter sets on one pass along a segment; each for every repeat.

    Sets that take more than `most` seconds of CPU time are stopped. What is driven `bare`, once and
    without the health check, shows how a set does elsewhere.
    """
    config, odometry, _ = setup

    def begin(parameters: ParameterSet) -> Tracker:
        return Tracker(
            odometry(parameters, segment.sequence),
            config.health,
            T_odom_start=segment.T_odom_start,
            T_before_start=segment.T_before_start,
            bare=bare,
        )

    def n_repeats(parameters: ParameterSet) -> int:
        of_baseline, repeats = config.offline.baseline_runs, config.offline.repeats
        if bare:
            return 1
        if of_baseline is None or parameters not in odometry.space.baselines:
            return repeats
        return max(repeats, of_baseline)

    drivers = [
        [_SegmentDrive(partial(begin, one), segment, most) for _ in range(n_repeats(one))]
        for one in sets
    ]
    stamps = segment.stamps.tolist()
    with ExitStack() as ended:
        each = [driver for of_set in drivers for driver in of_set]
        for driver in each:
            ended.callback(driver.close, shared)
        along = watched(shared.along(segment, scans), len(stamps), "running", progress)
        for stamp, scan in zip(stamps, along, strict=True):
            for driver in each:
                driver.step(stamp, scan)
    return [[driver.run for driver in of_set] for of_set in drivers]


def trial_of(
    config: OfflineStudyConfig,
    parameters: ParameterSet,
    frames: Frames,
    runs: Mapping[int, Sequence[Run]],
) -> Trial:
    """Make a trial of the runs along all segments of a sequence, by the first scan of each.

    There is one for every repeat. Segments along which a set was not driven count as lost.
    """
    firsts = frames.segments[:, 0].tolist()
    repeats = [
        [runs[first][i] if first in runs else Run() for first in firsts]
        for i in range(min(map(len, runs.values())))
    ]
    return _mean([_trial(config, parameters, frames, of_repeat) for of_repeat in repeats])


def _trial(
    config: OfflineStudyConfig, parameters: ParameterSet, frames: Frames, runs: Sequence[Run]
) -> Trial:
    segments, n = segments_along("", frames), len(frames.stamps)
    T_odom_sensor, took = np.full((n, 4, 4), np.nan), list[float]()
    tried, restarted, lost, waiting = np.zeros((4, n), bool)
    for run, segment in zip(runs, segments, strict=True):
        whole = slice(segment.first, segment.first + len(segment.stamps))
        driven, own = slice(segment.first, segment.first + len(run.steps)), run.usage.seconds
        T_odom_sensor[whole] = _poses(run, segment)
        tried[driven], lost[whole] = True, True
        lost[driven], restarted[driven] = run.lost, run.restarted
        # Without the first one, where it begins.
        took += [step.register_seconds if own is None else own for step in run.steps[1:]]
        # Scans before a first pose that comes are unknown.
        sound = ~run.lost & run.registered
        waiting[driven] = np.arange(len(sound)) < sound.argmax() if sound.any() else False
    T_ref_sensor, failure = frames.counted, ""
    missing = int((waiting | lost).sum())
    if missing >= MAX_SHARE_WITHOUT_POSE * frames.n_driven:
        failure = f"no pose for {missing} of {frames.n_driven} scans"
    else:
        T_ref_sensor[waiting & ~lost] = np.nan
    faults = [fault for run in runs for fault in run.faults]
    faults += dict.fromkeys(run.exception for run in runs if run.exception)
    if len(faults) >= MOST_FAULTS:
        failure = f"{len(faults)} faults"
    used = _used(runs, segments)
    if slow := any(run.too_slow for run in runs):
        failure = f"too slow: {used[REGISTER_MS]:.0f} ms a scan"
    # What goes on without poses may seem to do well; where a slow set is stopped is chance.
    unseen = ~tried | slow | ((lost | waiting) & bool(failure))
    errors = sub_trajectory_rte(T_ref_sensor, T_odom_sensor, config.sub_trajectory, unseen)
    if np.isnan(errors).all():
        failure = failure or "no sub-trajectory has poses"
    stamps = segments[0].stamps
    if late := int(waiting[segments[0].first :][: len(stamps)].sum()):
        used[FIRST_POSE] = float(stamps[late] - stamps[0]) * 1e-9
    return Trial.of(
        parameters,
        *(T_odom_sensor, errors, restarted, 1e3 * float(np.mean(took or [0.0])), faults),
        others=trajectory_metrics(T_ref_sensor, T_odom_sensor) | used,
        failure=failure,
    )


def _poses(run: Run, segment: Segment) -> Poses:
    """Poses along a segment, of shape (n, 4, 4): where there is none, the last one stays."""
    last, found = segment.T_odom_start, []
    for step in run.steps:
        last = step.T_odom_sensor if np.isfinite(step.T_odom_sensor[0, 0]) else last
        found.append(last)
    return np.array([*found, *[last] * (len(segment.stamps) - len(found))])


def _used(runs: Sequence[Run], segments: Sequence[Segment]) -> dict[str, float]:
    """CPU time and memory of runs, see `TrialSummary.others`."""
    seconds = sum(float(one.stamps[-1] - one.stamps[0]) * 1e-9 for one in segments)
    cpu, n = sum(run.usage.cpu for run in runs), max(sum(len(run.steps) for run in runs), 1)
    prepare_ms = sum(run.prepare_ms * len(run.steps) for run in runs)
    used = {"cpu": 100.0 * cpu / seconds, REGISTER_MS: 1e3 * cpu / n, PREPARE_MS: prepare_ms / n}
    memory = [run.usage.memory for run in runs if run.usage.memory is not None]
    return used | ({"memory": max(memory)} if memory else {})


def _mean(repeats: Sequence[Trial]) -> Trial:
    """One trial of several with the same parameters."""
    if len(repeats) == 1:
        return repeats[0]
    names = dict.fromkeys(name for trial in repeats for name in trial.others)
    known = [
        name
        for name in names
        if name == FIRST_POSE or all(name in trial.others for trial in repeats)
    ]
    first = repeats[0]
    return Trial.of(
        first.parameters,
        first.T_odom_sensor,
        np.mean([cap(trial.errors) for trial in repeats], axis=0),
        np.mean([trial.restarted for trial in repeats], axis=0),
        float(np.mean([trial.ms for trial in repeats])),
        [reason for trial in repeats for reason in trial.reasons],
        others={m: float(np.mean([t.others.get(m, 0.0) for t in repeats])) for m in known},
        repeats=[trial.metrics for trial in repeats],
        failure=next((trial.failure for trial in repeats if trial.failure), ""),
    )
