"""The campaign: run the trials of the search, batch by batch."""

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from adaptune.archive import REGISTER_MS, Archive, ArchiveError, Summary, Trial, summarise
from adaptune.errors import AdaptuneError
from adaptune.progress import Progress, unseen
from adaptune.space import ParameterSet, PooledSpace
from adaptune.study.references import contradictions_of
from offline.config import OfflineStudy
from offline.objective import Verdict, label
from offline.search import Clock, Search, rungs
from offline.trial import SLOW
from offline.workers import Pool, Task, TaskResult, run

_log = logging.getLogger(__name__)


class Campaign:
    """Runs the search of a study."""

    def __init__(
        self,
        study: OfflineStudy,
        archive: Archive,
        workers: Pool[Any],
        progress: Progress = unseen,
    ):
        self._study, self._archive, self._workers = study, archive, workers
        self._progress = progress
        self._config, self._names = study.config.offline, study.training
        self._finished = {name: archive.finished(name) for name in self._names}
        space, known = study.odometry.space, archive.sets()
        self._search = Search(self._config, space, self._names, self._finished, known)
        baselines = range(len(space.baselines))
        self._most_ms = {
            name: SLOW * max(drive.others.get(REGISTER_MS, np.inf) for drive in drives.values())
            for name, drives in read_whole_drives(archive, self._names, baselines).items()
            if drives
        }
        described = study.config.descriptor
        self._without_frames = [
            name for name in self._names if not archive.has_frames(name, described)
        ]

    def run(self) -> dict[int, Verdict]:
        """Run all trials that are not in the archive yet, and judge all of them by number."""
        clock = Clock(self._study.folder / "elapsed.json")
        batch, search = 0, self._search
        while search.begin(clock.hours(batch)):
            for m in rungs(self._config.pruning == "wilcoxon", batch, len(self._names)):
                if tasks := self._tasks(search.missing(m)):
                    with clock.running(batch):
                        self._run_tasks(tasks)
                search.prune(m)
            search.close()
            self._show(self._n_done())
            batch += 1
        _log.info("the search ends: %s", search.end)
        self._show(self._n_done())
        return dict(sorted(search.done.items()))

    def _run_tasks(self, tasks: list[Task]) -> None:
        before = self._n_done()

        def show(what: str, done: float, of: int, remark: str = "", /) -> None:
            if what == "runs":
                self._show(before + done)
            else:
                self._progress(what, done, of, remark)

        for task, result in run(self._workers, tasks, "runs", show):
            _store(self._archive, task, result)

    def _n_done(self) -> int:
        """Runs that are done, with those that will not be run."""
        search, finished = self._search, self._finished.values()
        closed = len(search.done) * len(self._names)
        return closed + sum(number in of for of in finished for number in search.numbers)

    def _show(self, done: float) -> None:
        search, remark = self._search, ""
        if verdict := search.done.get(search.best):
            what = f"best {label(self._config.objective)} {verdict.value:.3f}"
            remark = f"{what} (trial {search.best})"
        self._progress("runs", done, search.total(), remark)

    def _tasks(self, missing: Sequence[tuple[str, Mapping[int, ParameterSet]]]) -> list[Task]:
        without_frames, self._without_frames = self._without_frames, []
        n_workers = len(self._workers.workers())
        tasks = trial_tasks(missing, without_frames, n_workers, self._study.odometry.one_by_one)
        return [task._replace(most_ms=self._most_ms.get(task.sequence, np.inf)) for task in tasks]


def trial_tasks(
    missing: Sequence[tuple[str, Mapping[int, ParameterSet]]],
    without_frames: Sequence[str],
    n_workers: int,
    one_by_one: bool = False,
) -> list[Task]:
    """Split the trials that are missing on sequences, sets by number, between the workers.

    Those of the last sequence are split into ever smaller pieces, so that all workers end together.
    A sequence whose frames are missing, but no trial, is a task of its own. If trials run
    `one_by_one`, so is every trial.
    """
    lacking = [(name, list(sets.items())) for name, sets in missing if sets]
    to_read = [name for name in without_frames if name not in dict(lacking)]
    tasks = [Task(name, (), (), frames=True) for name in to_read]
    n_workers = max(1, n_workers)  # those of a cluster may all be on their way back
    for last, (name, sets_of) in enumerate(lacking, 1 - len(lacking)):
        left = sets_of
        # The first task of a sequence returns what all trials on it share.
        first = left[0] if name in without_frames else None
        while left:
            size = 1 if one_by_one else math.ceil(len(left) / n_workers / (1 if last else 2))
            for share in range(n_workers):
                if some := left[share * size : (share + 1) * size]:
                    numbers, sets = zip(*some, strict=True)
                    tasks.append(Task(name, numbers, sets, frames=some[0] is first))
            left = left[n_workers * size :]
    return tasks


def watch_tasks(
    archive: Archive, workers: Pool[Any], tasks: list[Task], what: str, progress: Progress
) -> None:
    """Run tasks and store their results, see `offline.workers.run`."""
    for task, result in run(workers, tasks, what, progress):
        _store(archive, task, result)


def _store(archive: Archive, task: Task, result: TaskResult) -> None:
    if result.frames is not None:
        archive.write_frames(task.sequence, result.frames)
    for number, trial in zip(task.numbers, result.trials, strict=True):
        archive.write(task.sequence, number, trial, task.whole)


WholeDrives = Mapping[str, Mapping[int, Summary]]
"""By sequence, drives of whole recordings by trial number."""


def read_whole_drives(
    archive: Archive, names: Sequence[str], numbers: Iterable[int]
) -> dict[str, dict[int, Summary]]:
    """The drives of whole recordings that there are of some trials."""
    found: dict[str, dict[int, Summary]] = {name: {} for name in names}
    for name in names:
        for n in numbers:
            with suppress(ArchiveError):
                found[name][n] = summarise(archive.read(name, n, whole=True))
    return found


def drive_whole(
    names: Sequence[str],
    sets: Mapping[int, ParameterSet],
    archive: Archive,
    workers: Pool[Any],
    progress: Progress,
) -> dict[str, dict[int, Summary]]:
    """Drive sets along whole recordings, unless that was done before."""
    there = read_whole_drives(archive, names, sets)
    tasks = [
        Task(name, (n,), (parameters,), whole=True)
        for name in names
        for n, parameters in sets.items()
        if n not in there[name]
    ]
    watch_tasks(archive, workers, tasks, "whole drives", progress)
    return read_whole_drives(archive, names, sets) if tasks else there


class BaselineError(AdaptuneError):
    """An odometry that fails with its own parameters."""


def run_baseline(
    study: OfflineStudy, archive: Archive, workers: Pool[Any], progress: Progress
) -> None:
    """Drive the baseline along every training sequence, all of it, unless that was done before.

    Of several odometries, the baseline of each. Nothing is stored before all have done well on all
    sequences. Where the reference contradicts the motion of one, scans say which of them is wrong.

    Raises
    ------
    BaselineError
        If one fails on one of them.
    """
    space = study.odometry.space
    there = read_whole_drives(archive, study.training, range(len(space.baselines)))
    # What the study calls its odometries, in the order of their baselines' trials.
    labels = list(space.spaces) if isinstance(space, PooledSpace) else [study.odometry.name]
    tasks: list[Task] = []
    for name in study.training:
        # The first task of a sequence returns its frames, if they are lacking.
        frames = not archive.has_frames(name, study.config.descriptor)
        for number, parameters in enumerate(space.baselines):
            if number not in there[name]:
                tasks.append(Task(name, (number,), (parameters,), True, frames))
                frames = False
    done = []
    for task, result in run(workers, tasks, "baseline", progress):
        check_baseline(labels[task.numbers[0]], task.sequence, result.trials[0])
        done.append((task, result))
    # What all trials share comes first: it says which scans are driven.
    for task, result in sorted(done, key=lambda pair: pair[1].frames is None):
        _store(archive, task, result)
        name, whole = task.sequence, result.trials[0]
        told = contradictions_of(study.sequences, name, whole.T_odom_sensor, whole.mean_error)
        for what in told:
            _log.warning("sequences.%s, %s: %s", name, labels[task.numbers[0]], what)


def check_baseline(odometry: str, sequence: str, run: Trial) -> None:
    """Refuse a baseline that failed; a fault now and then does no harm.

    Raises
    ------
    BaselineError
    """
    if not run.failure:
        return
    last = run.faults[-1] if run.faults else "it gave no pose, and no reason"
    raise BaselineError(
        f"sequences.{sequence}: {odometry} fails with its own parameters, the baseline: "
        f"{run.failure}; {last}; nothing of it is stored: mend the odometry (odometry "
        f"in the study), or leave the sequence out, and run the same command again"
    )
