"""Run the baselines before anything else: a setup in which one fails is stopped at once."""

import logging
from collections.abc import Mapping
from typing import Any

from adaptune.archive import Archive, Trial
from adaptune.errors import AdaptuneError
from adaptune.odometry.frame_check import contradiction
from adaptune.odometry.isolation import MOST_FAULTS
from adaptune.pooled_space import PooledSpace
from adaptune.space import ParameterSet, ParameterSpace
from offline.campaign import Progress, watched
from offline.offline_study import OfflineStudy
from offline.whole_runs import whole_run
from offline.workers import Pool, Task

MOST_WITHOUT_POSE = 0.1
"""Share of the scans from which an odometry that gives no pose for them has failed."""

_log = logging.getLogger(__name__)


class BaselineError(AdaptuneError):
    """An odometry that fails with its own parameters."""


def run_baseline(
    study: OfflineStudy, archive: Archive, workers: Pool[Any], progress: Progress
) -> None:
    """Run the baseline from end to end on every training sequence, unless that was done before.

    Of several odometries, the baseline of each. Nothing is stored before all have done well on all
    sequences. Where the reference contradicts the motion of the first, a warning says what the
    reference looks like.

    Raises
    ------
    BaselineError
        If one fails on one of them.
    """
    baselines = _by_label(study.odometry.name, study.odometry.space)
    labels = list(baselines)
    done = []
    for task, result in watched(workers, _tasks(study, archive, baselines), "baseline", progress):
        check_baseline(labels[task.numbers[0]], task.sequence, result.trials[0])
        done.append((task, result))
    for task, result in done:
        if result.frames is not None:
            archive.write_frames(task.sequence, result.frames)
    for task, result in done:
        (number,), (run,) = task.numbers, result.trials
        archive.write(task.sequence, number, run, whole=True)
        T_ref_sensor = archive.read_frames(task.sequence).T_ref_sensor
        if number == 0 and (what := contradiction(run.T_odom_sensor, T_ref_sensor)):
            _log.warning(
                "sequences.%s: the reference contradicts the odometry's motion nearly everywhere: "
                "%s; check the file or topic (reference), the LiDAR's pose in its frame "
                "(extrinsic) and its clock (clock_offset)",
                task.sequence,
                what,
            )


def _by_label(name: str, space: ParameterSpace) -> dict[str, ParameterSet]:
    """The baselines by what the study calls their odometries, in the order of their trials."""
    if isinstance(space, PooledSpace):
        return dict(zip(space.spaces, space.baselines, strict=True))
    return {name: space.baseline}


def _tasks(
    study: OfflineStudy, archive: Archive, baselines: Mapping[str, ParameterSet]
) -> list[Task]:
    """The whole runs that are lacking; the first of a sequence returns its frames, if they are."""
    tasks: list[Task] = []
    for name in study.training:
        frames = not archive.has_frames(name, study.config.descriptor.names)
        for number, parameters in enumerate(baselines.values()):
            if whole_run(archive, name, number, study.config.health) is None:
                tasks.append(Task(name, (number,), (parameters,), True, frames))
                frames = False
    return tasks


def check_baseline(odometry: str, sequence: str, run: Trial) -> None:
    """Refuse a whole run of the baseline that failed; a fault now and then is only told.

    Raises
    ------
    BaselineError
    """
    n, missing = len(run.errors), run.unhealthy.get("no_pose", 0)
    if not run.faults and missing < MOST_WITHOUT_POSE * n:
        return
    failed = missing >= MOST_WITHOUT_POSE * n
    gave_up = len(run.faults) >= MOST_FAULTS * max(1, len(run.repeats))
    last = run.faults[-1] if run.faults else "it gave no pose, and no reason"
    if failed or gave_up:
        raise BaselineError(
            f"sequences.{sequence}: {odometry} fails with its own parameters, the baseline: no "
            f"pose for {missing} of {n} scans; {last}; nothing of it is stored: mend the odometry "
            f"(odometry in the study), or leave the sequence out, and run the same command again"
        )
    _log.warning(
        "sequences.%s: %s with its own parameters, the baseline: %d fault%s, the last: %s",
        sequence,
        odometry,
        len(run.faults),
        "s" if len(run.faults) > 1 else "",
        last,
    )
