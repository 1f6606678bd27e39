"""The campaign: run the trials of all searches, batch by batch."""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from adaptune.archive import Archive
from adaptune.space import ParameterSet
from offline.budget import Clock
from offline.config import OfflineConfig
from offline.objective import Verdict, label
from offline.offline_study import OfflineStudy
from offline.pruning import rungs
from offline.search import Finished, Search, Stage, assess, best_of_each, make_stages
from offline.storage import MirrorRow, open_mirror
from offline.workers import Pool, Task, TaskProgress, TaskResult, run

Progress = Callable[[str, float, int, str], None]
"""Called with what is being done, how much of it is done, how much there is, and a remark."""

_log = logging.getLogger(__name__)


def run_batches(
    study: OfflineStudy, archive: Archive, workers: Pool[Any], progress: Progress = lambda *_: None
) -> dict[int, Verdict]:
    """Run all trials that are not in the archive yet, and judge all of them by trial number.

    Parameters
    ----------
    study
        The study; its folder exists.
    archive
        Its trials.
    workers
        They run the trials.
    progress
        Called about every finished trial.
    """
    return _Campaign(study, archive, workers, progress).run()


class _Campaign:
    """Runs the searches of a study, one stage after the other."""

    def __init__(
        self, study: OfflineStudy, archive: Archive, workers: Pool[Any], progress: Progress
    ):
        self._study, self._archive, self._workers = study, archive, workers
        self._progress = progress
        self._config, self._names = study.config.offline, study.training
        self._finished = {name: archive.finished(name) for name in self._names}
        self._stages = make_stages(study.config, study.odometry.space, self._names, archive)
        known = archive.sets()
        self._mirror = open_mirror(study.folder, self._config, study.odometry.space, known)
        described = study.config.descriptor.names
        self._without_frames = [
            name for name in self._names if not archive.has_frames(name, described)
        ]
        self._tally = _Tally(progress, self._finished, self._stages)
        # For each trial number, the sequences that count.
        self._counted: dict[int, Sequence[str]] = {}

    def run(self) -> dict[int, Verdict]:
        hours = 0.0
        best: dict[int, Verdict] = {}
        for stage in self._stages:
            hours += self._run_stage(stage, hours)
            best |= best_of_each(self._config, stage) if stage.alone else {}
        self._mirror_trials()
        self._tally.catch_up()
        self._run_everywhere(best)
        return {n: self._verdict(n) for n in sorted(self._counted)}

    def _run_stage(self, stage: Stage, hours: float) -> float:
        clock = Clock(self._study.folder / ("elapsed-own.json" if stage.alone else "elapsed.json"))
        batch = 0
        while at_work := [s for s in stage.searches if s.begin(hours + clock.hours(batch))]:
            self._tally.begin(at_work)
            begun = False
            for m in rungs(self._config.pruning, batch, len(at_work[0].sequences)):
                missing = [Missing(search.missing(m), search.parameters) for search in at_work]
                if tasks := self._tasks(missing):
                    begun = True
                    with clock.running(batch):
                        self._tally.watch(self._archive, self._workers, tasks)
                for search in at_work:
                    search.prune(m)
            numbers = sorted({n for search in at_work for n in search.numbers})
            for search in at_work:
                self._counted |= dict.fromkeys(search.numbers, search.sequences)
                search.close()
            self._counted[0] = self._names
            self._tally.best = _best(self._config, stage)
            if begun:
                self._mirror_trials()
                self._tally.catch_up()
                _log.debug("trials %d to %d done; %s", numbers[0], numbers[-1], self._tally.best)
            batch += 1
        for search in stage.searches:
            where = f" on {search.sequences[0]}" if stage.alone else ""
            _log.info("the search%s ends: %s", where, search.end)
        return clock.hours(batch)

    def _run_everywhere(self, best: Mapping[int, Verdict]) -> None:
        """Run the best set of each sequence on the others, to choose the fixed one among them."""
        missing = {name: [n for n in best if n not in self._finished[name]] for name in self._names}
        tasks = self._tasks([Missing(missing, lambda n: best[n].parameters)])
        what = "best sets of each on the others"
        watch_tasks(self._archive, self._workers, tasks, what, self._progress)
        self._counted |= dict.fromkeys(best, self._names)

    def _tasks(self, missing: Sequence["Missing"]) -> list[Task]:
        without_frames, self._without_frames = self._without_frames, []
        n_workers = len(self._workers.workers())
        return trial_tasks(missing, without_frames, n_workers, self._study.odometry.one_by_one)

    def _verdict(self, n: int) -> Verdict:
        return assess(n, self._counted[n], self._config, self._names, self._finished)

    def _mirror_trials(self) -> None:
        self._mirror.report(
            self._counted, lambda n: _mirrored(self._config, self._verdict(n), self._finished, n)
        )


class Missing(NamedTuple):
    """What is still to be run."""

    numbers: Mapping[str, Sequence[int]]  # on every sequence, of the trials
    parameters: Callable[[int], ParameterSet]  # the set of a trial


def trial_tasks(
    missing: Sequence[Missing],
    without_frames: Sequence[str],
    n_workers: int,
    one_by_one: bool = False,
) -> list[Task]:
    """Split the trials of every sequence between the workers.

    Those of the last sequence are split into ever smaller pieces, so that all workers end together.
    A sequence whose frames are missing, but no trial, is a task of its own. If trials run
    `one_by_one`, so is every trial.
    """
    lacking = [
        (name, numbers, some.parameters)
        for some in missing
        for name, numbers in some.numbers.items()
        if numbers
    ]
    to_read = [name for name in without_frames if name not in {n for n, *_ in lacking}]
    tasks = [Task(name, (), (), frames=True) for name in to_read]
    n_workers = max(1, n_workers)  # those of a cluster may all be on their way back
    for last, (name, numbers, parameters) in enumerate(lacking, 1 - len(lacking)):
        # The first task of a sequence returns what all trials on it share.
        first = numbers[0] if name in without_frames else None
        left = numbers
        while left:
            size = 1 if one_by_one else math.ceil(len(left) / n_workers / (1 if last else 2))
            tasks += [
                Task(name, tuple(n), tuple(map(parameters, n)), frames=n[0] == first)
                for share in range(n_workers)
                if (n := left[share * size : (share + 1) * size])
            ]
            left = left[n_workers * size :]
    return tasks


def _mirrored(config: OfflineConfig, verdict: Verdict, finished: Finished, n: int) -> MirrorRow:
    """A trial as the mirror receives it."""
    trials = {name: finished[name][n] for name in verdict.sequences}
    attributes = {name: trial.mean_error for name, trial in trials.items()}
    attributes["lost"] = sum(trial.lost for trial in trials.values())
    attributes["ms"] = float(np.mean([trial.ms for trial in trials.values()]))
    constraints = {
        f"{name} <= {limit.max:g}": by
        for (name, limit), by in zip(config.limits.items(), verdict.constraints, strict=True)
    }
    return MirrorRow(verdict.parameters, verdict.values, attributes, constraints)


class _Tally:
    """The progress of trials."""

    def __init__(self, progress: Progress, finished: Finished, stages: Sequence[Stage]):
        self.best = ""
        self._progress, self._finished = progress, finished
        self._searches = [search for stage in stages for search in stage.searches]
        self._done = self._failed = self._running = 0
        self._under_way = _UnderWay(progress)

    def begin(self, at_work: Iterable[Search]) -> None:
        """Begin a batch; some of its trials may be finished already."""
        for search in at_work:
            for name in search.sequences:
                self._add(name, [n for n in search.numbers if n in self._finished[name]])
        self._show()

    def watch(self, archive: Archive, workers: Pool[Any], tasks: list[Task]) -> None:
        """Run tasks, and count trials scan by scan."""
        for task, running in run_tasks(archive, workers, tasks, self._report):
            self._under_way.end(task)
            self._add(task.sequence, task.numbers)
            self._running = running
            self._show()

    def _report(self, task: Task, progress: TaskProgress) -> None:
        self._under_way.report(task, progress)
        self._show()

    def catch_up(self) -> None:
        """Count trials that will not run as done, too."""
        self._done = sum(len(s.verdicts) * len(s.sequences) for s in self._searches)
        self._show()

    def _add(self, name: str, numbers: Iterable[int]) -> None:
        runs = [self._finished[name][n] for n in numbers]
        self._done += len(runs)
        self._failed += sum(run.lost > 0 or run.faults > 0 for run in runs)

    def _show(self) -> None:
        n = self._running
        remarks = [f"{n} worker{'s' if n > 1 else ''} at work"] if n else []
        remarks += [self.best] if self.best else []
        remarks += [f"{self._failed} lost track or failed"] if self._failed else []
        total = sum(search.total() for search in self._searches)
        done = self._done + self._under_way.runs
        self._progress("runs", done, total, ", ".join(remarks))


class _UnderWay:
    """The tasks under way: the scans that they read, and the runs that they have done."""

    def __init__(self, progress: Progress):
        self._progress = progress
        self._read: dict[str, int] = {}  # scans that were read, by what for
        self._runs: dict[tuple[str, tuple[int, ...]], float] = {}

    @property
    def runs(self) -> float:
        """Runs of tasks that are not finished."""
        return sum(self._runs.values())

    def report(self, task: Task, progress: TaskProgress) -> None:
        """Note how far a task is; several workers may read the same sequence."""
        name, (stage, done, total) = task.sequence, progress
        if stage != "running":
            what = f"{stage} {name}"
            self._read[what] = max(done, self._read.get(what, 0))
            self._progress(what, self._read[what], total, "")
        else:
            self._runs[task.key] = len(task.numbers) * done / max(total, 1)

    def end(self, task: Task) -> None:
        """Forget a task."""
        self._runs.pop(task.key, None)


def _best(config: OfflineConfig, stage: Stage) -> str:
    """The best value so far, or its mean where each search has a sequence of its own."""
    best = [search.verdicts[search.best] for search in stage.searches]
    value = float(np.mean([verdict.values[0] for verdict in best]))
    what = f"best {label(config.objective[0])} {value:.3f}"
    if stage.alone:
        return f"{what} in the mean of {len(best)} sequences"
    (search,) = stage.searches
    feasible = "" if best[0].feasible else ", which does not keep the limits"
    return f"{what} (trial {search.number(search.best)}){feasible}"


def watch_tasks(
    archive: Archive, workers: Pool[Any], tasks: list[Task], what: str, progress: Progress
) -> None:
    """Run tasks and store their results, see `watched`."""
    for task, result in watched(workers, tasks, what, progress):
        _store(archive, task, result)


def watched(
    workers: Pool[Any], tasks: list[Task], what: str, progress: Progress
) -> Iterator[tuple[Task, TaskResult]]:
    """Run tasks; `progress` is called with `what` and the number of runs that are done."""
    under_way, total = _UnderWay(progress), sum(len(task.numbers) for task in tasks)
    done = 0

    def report(task: Task, of_task: TaskProgress) -> None:
        under_way.report(task, of_task)
        progress(what, done + under_way.runs, total, "")

    for task, result, _ in run(workers, tasks, report):
        under_way.end(task)
        done += len(task.numbers)
        progress(what, done + under_way.runs, total, "")
        yield task, result


def run_tasks(
    archive: Archive,
    workers: Pool[Any],
    tasks: list[Task],
    report: Callable[[Task, TaskProgress], None] = lambda *_: None,
) -> Iterator[tuple[Task, int]]:
    """Run tasks; yield each one once it is in the archive, with the number of workers at work.

    `report` is called about tasks that go on.
    """
    for task, result, running in run(workers, tasks, report):
        _store(archive, task, result)
        yield task, running


def _store(archive: Archive, task: Task, result: TaskResult) -> None:
    if result.frames is not None:
        archive.write_frames(task.sequence, result.frames)
    for number, trial in zip(task.numbers, result.trials, strict=True):
        archive.write(task.sequence, number, trial, task.whole)
