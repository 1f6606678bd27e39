"""The offline stage: run trials batch by batch, then fit the error model."""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from adaptune import report, yaml
from adaptune.archive import Archive
from adaptune.cores import available
from adaptune.descriptor import averaged
from adaptune.files import write_text
from adaptune.model import ErrorModel
from adaptune.space import ParameterSet
from adaptune.study import TIMED, OfflineConfig, Study
from offline.budget import BUDGETS, Clock
from offline.cluster import Cluster
from offline.objective import Verdict, choose_fixed, judge, label, pareto_front
from offline.pruning import rungs
from offline.search import Finished, Search, Stage, assess, best_of_each, make_stages
from offline.storage import Told, open_mirror
from offline.validation import choose_bank, labelled_sequences, tune, tune_bank
from offline.workers import Pool, Task, Workers, run

Progress = Callable[[str, int, int, str], None]
"""Called with what is being done, how much of it is done, how much there is, and a remark."""

_log = logging.getLogger(__name__)


class Training(NamedTuple):
    """What the offline stage found.

    Attributes
    ----------
    model : ErrorModel
    means : dict
        For every training sequence the mean capped error in percent of each trial, by rising
        number, of shape (n_trials,); NaN where it was not run.
    fixed : int
        Number of the trial of the fixed set.
    rows : list of dict
        For every training sequence what the baseline, the fixed set and its own best set do there.
    """

    model: ErrorModel
    means: dict[str, list[float]]
    fixed: int
    rows: list[dict[str, Any]]


def train(
    study: Study, progress: Progress = lambda *_: None, cluster: str | None = None
) -> Training:
    """Run all trials that are not in the archive yet, and fit the model.

    Parameters
    ----------
    study
        The study; its folder holds the archive and receives the error model (``model.npz``), the
        fixed set (``fixed.yaml``), a table of all trials (``trials.csv``, ``trials.json``), one of
        the training sequences (``training.csv``, ``training.json``), and where there are several
        objectives their Pareto front (``pareto.csv``, ``pareto.json``, ``pareto.png``).
    progress
        Told about every finished trial.
    cluster
        Address of a Dask scheduler, whose workers run the trials; processes of this machine when
        left out.

    Raises
    ------
    AdaptuneError
        If a sequence cannot be used, or no set keeps the limits.
    """
    study.open()
    config = study.config.offline
    if timed := sorted(config.metrics & set(TIMED)):
        _log.warning(
            "%s differ from run to run: the same study run again will not find the same sets",
            " and ".join(timed),
        )
    archive = Archive(study.folder / "trials")
    archive.tidy()
    n_workers = config.workers or available()
    where = cluster or f"{n_workers} worker{'s' if n_workers > 1 else ''}"
    _log.info("trials run on %s; each sequence is prepared before its first one", where)
    with Cluster(study, cluster) if cluster else Workers(study, n_workers) as workers:
        verdicts = run_batches(study, archive, workers, progress)
        fixed = choose_fixed(config, verdicts)
        whole = _run_whole(study, archive, workers, verdicts, fixed, progress)
    model = fit(study, archive, verdicts, fixed)
    model = _tuned(study, model)
    model = model.thinned(config.max_frames)
    model.save(study.folder / "model.npz")
    finished = {
        name: {n: archive.finished(name)[n] for n, v in verdicts.items() if name in v.sequences}
        for name in study.training
    }
    means = {
        name: [trials[n].mean_error if n in trials else np.nan for n in verdicts]
        for name, trials in finished.items()
    }
    write_text(study.folder / "fixed.yaml", yaml.dump(verdicts[fixed].parameters))
    table = _trial_rows(config, verdicts, finished)
    report.write_rows(study.folder, "trials", list(table.values()))
    if len(config.objective) > 1:
        _write_pareto(study, verdicts, table)
    rows = _training_rows(config, verdicts, finished, fixed, whole)
    report.write_rows(study.folder, "training", rows)
    return Training(model, means, fixed, rows)


def _trial_rows(
    config: OfflineConfig, verdicts: Mapping[int, Verdict], finished: Finished
) -> dict[int, dict[str, Any]]:
    """A row for every trial: its parameters, how it was judged, its mean errors in percent."""
    rows: dict[int, dict[str, Any]] = {}
    for n, verdict in verdicts.items():
        runs = [finished[name][n] for name in verdict.sequences]
        row = rows[n] = {"trial": n, **verdict.parameters}
        if config.metrics != {"rte"}:
            judged = zip(config.objective, verdict.values, strict=True)
            row |= {label(weights): value for weights, value in judged}
            for metric in sorted(config.metrics):
                row[metric] = float(np.mean([run.metrics[metric] for run in runs]))
        if config.limits:
            row["excess"] = verdict.excess
        if config.repeats > 1:
            row["margin"] = verdict.margin
        mean = float(np.mean([run.mean_error for run in runs])) if verdict.complete else None
        row["mean"] = mean
        for name, trials in finished.items():
            row[name] = trials[n].mean_error if n in trials else None
    return rows


def _training_rows(
    config: OfflineConfig,
    verdicts: Mapping[int, Verdict],
    finished: Finished,
    fixed: int,
    whole: Mapping[str, tuple[float, float]],
) -> list[dict[str, Any]]:
    """A row for every training sequence; its own best set is found as the fixed one is."""
    rows = []
    for name, runs in finished.items():
        best = choose_fixed(config, {n: judge(config, [run]) for n, run in runs.items()})
        rows.append(
            {
                "sequence": name,
                "baseline": runs[0].mean_error,
                "fixed": runs[fixed].mean_error,
                "own best": runs[best].mean_error,
                "lost, baseline": runs[0].lost,
                "lost, fixed": runs[fixed].lost,
                "baseline, whole run": whole[name][0],
                "fixed, whole run": whole[name][1],
                "_own best trial": best,
            }
            | {f"_own best {key}": value for key, value in verdicts[best].parameters.items()}
        )
    return rows


def _write_pareto(
    study: Study, verdicts: Mapping[int, Verdict], trials: Mapping[int, Mapping[str, Any]]
) -> None:
    """The sets that none that keeps the limits is better than in every objective."""
    feasible = [n for n, verdict in verdicts.items() if verdict.feasible and verdict.complete]
    values = np.array([verdicts[n].values for n in feasible])
    front = [feasible[i] for i in pareto_front(values)]
    report.write_rows(study.folder, "pareto", [trials[n] for n in front])
    names = [label(weights) for weights in study.config.offline.objective]
    report.draw_front(
        study.folder / "pareto.png", names, values, np.array([verdicts[n].values for n in front])
    )


def run_batches(
    study: Study, archive: Archive, workers: Pool[Any], progress: Progress = lambda *_: None
) -> dict[int, Verdict]:
    """Run all trials that are not in the archive yet, and tell how each did.

    Parameters
    ----------
    study
        The study, whose folder is there.
    archive
        Its trials.
    workers
        Who runs them.
    progress
        Told about every finished trial.

    Returns
    -------
    dict
        Verdicts by the trials' numbers, which rise.
    """
    return _Campaign(study, archive, workers, progress).run()


class _Campaign:
    """Searches on their way."""

    def __init__(self, study: Study, archive: Archive, workers: Pool[Any], progress: Progress):
        self._study, self._archive, self._workers = study, archive, workers
        self._progress = progress
        self._config, self._names = study.config.offline, study.training
        self._finished = {name: archive.finished(name) for name in self._names}
        of_sequences = self._finished.values()
        known = {n: trial.parameters for trials in of_sequences for n, trial in trials.items()}
        self._mirror = open_mirror(study, known)
        described = study.config.descriptor.names
        self._unframed = [name for name in self._names if not archive.has_frames(name, described)]
        self._stages = make_stages(study, self._finished)
        self._tally = _Tally(progress, self._finished, self._stages)
        # By the trials' numbers, the sequences that they are of.
        self._counted: dict[int, Sequence[str]] = {}

    def run(self) -> dict[int, Verdict]:
        hours = 0.0
        best: dict[int, Verdict] = {}
        for stage in self._stages:
            hours += self._run_stage(stage, hours)
            best |= best_of_each(self._config, stage) if stage.alone else {}
        self._tell()
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
                        self._tally.watch(_run(self._archive, self._workers, tasks))
                for search in at_work:
                    search.prune(m)
            numbers = sorted({n for search in at_work for n in search.numbers})
            for search in at_work:
                self._counted |= dict.fromkeys(search.numbers, search.sequences)
                search.close()
            self._counted[0] = self._names
            self._tally.best = _best(self._config, stage)
            if begun:
                self._tell()
                self._tally.catch_up()
                _log.info("trials %d to %d done; %s", numbers[0], numbers[-1], self._tally.best)
            batch += 1
        for search in stage.searches:
            where = f" on {search.sequences[0]}" if stage.alone else ""
            _log.info("the search%s ends: %s", where, search.end)
        return clock.hours(batch)

    def _run_everywhere(self, best: Mapping[int, Verdict]) -> None:
        """Run the best set of each sequence on the others, to choose the fixed one among them."""
        missing = {name: [n for n in best if n not in self._finished[name]] for name in self._names}
        tasks = self._tasks([Missing(missing, lambda n: best[n].parameters)])
        for done, _ in enumerate(_run(self._archive, self._workers, tasks), start=1):
            self._progress("best sets of each on the others", done, len(tasks), "")
        self._counted |= dict.fromkeys(best, self._names)

    def _tasks(self, missing: Sequence["Missing"]) -> list[Task]:
        unframed, self._unframed = self._unframed, []
        return _tasks(missing, unframed, len(self._workers.workers()))

    def _verdict(self, n: int) -> Verdict:
        return assess(n, self._counted[n], self._config, self._names, self._finished)

    def _tell(self) -> None:
        self._mirror.tell(
            self._counted, lambda n: _told(self._config, self._verdict(n), self._finished, n)
        )


class Missing(NamedTuple):
    """What is still to be run.

    Attributes
    ----------
    numbers : dict
        On every sequence, of the trials.
    parameters : callable
        Tells a trial's set.
    """

    numbers: Mapping[str, Sequence[int]]
    parameters: Callable[[int], ParameterSet]


def _tasks(missing: Sequence[Missing], unframed: Sequence[str], n_workers: int) -> list[Task]:
    """Share every sequence's trials between the workers; reading it again is a task of its own.

    Those of the last one are shared in ever smaller pieces, so that all workers end together.
    """
    lacking = [
        (name, numbers, some.parameters)
        for some in missing
        for name, numbers in some.numbers.items()
        if numbers
    ]
    to_read = [name for name in unframed if name not in {n for n, *_ in lacking}]
    tasks = [Task(name, (), (), frames=True) for name in to_read]
    for last, (name, numbers, parameters) in enumerate(lacking, 1 - len(lacking)):
        # What all trials on a sequence share is told by the first of its tasks.
        tells = numbers[0] if name in unframed else None
        left = numbers
        while left:
            size = math.ceil(len(left) / n_workers / (1 if last else 2))
            tasks += [
                Task(name, tuple(n), tuple(map(parameters, n)), frames=n[0] == tells)
                for share in range(n_workers)
                if (n := left[share * size : (share + 1) * size])
            ]
            left = left[n_workers * size :]
    return tasks


def _told(config: OfflineConfig, verdict: Verdict, finished: Finished, n: int) -> Told:
    """What the mirror is told of a trial."""
    trials = {name: finished[name][n] for name in verdict.sequences}
    attributes = {name: trial.mean_error for name, trial in trials.items()}
    attributes["lost"] = sum(trial.lost for trial in trials.values())
    attributes["ms"] = float(np.mean([trial.ms for trial in trials.values()]))
    constraints = {
        f"{name} <= {limit.max:g}": by
        for (name, limit), by in zip(config.limits.items(), verdict.constraints, strict=True)
    }
    return Told(verdict.parameters, verdict.values, attributes, constraints)


class _Tally:
    """What the progress tells of trials."""

    def __init__(self, progress: Progress, finished: Finished, stages: Sequence[Stage]):
        self.best = ""
        self._progress, self._finished = progress, finished
        self._searches = [search for stage in stages for search in stage.searches]
        self._done = self._failed = 0

    def begin(self, at_work: Iterable[Search]) -> None:
        """Begin a batch, some of whose trials may be finished."""
        for search in at_work:
            for name in search.sequences:
                self._add(name, [n for n in search.numbers if n in self._finished[name]])
        self._show()

    def watch(self, tasks: Iterable[tuple[Task, int]]) -> None:
        """Count trials as they are finished."""
        for task, running in tasks:
            self._add(task.sequence, task.numbers)
            self._show(running)

    def catch_up(self) -> None:
        """Count as done what will not be run, too."""
        self._done = sum(len(s.verdicts) * len(s.sequences) for s in self._searches)
        self._show()

    def _add(self, name: str, numbers: Iterable[int]) -> None:
        runs = [self._finished[name][n] for n in numbers]
        self._done += len(runs)
        self._failed += sum(run.lost > 0 or run.faults > 0 for run in runs)

    def _show(self, running: int = 0) -> None:
        remarks = [f"{running} running"] if running else []
        remarks += [self.best] if self.best else []
        remarks += [f"{self._failed} lost track or failed"] if self._failed else []
        total = sum(search.total() for search in self._searches)
        self._progress("runs", self._done, total, ", ".join(remarks))


def _best(config: OfflineConfig, stage: Stage) -> str:
    """The best so far; the mean of them where each is of one sequence."""
    best = [search.verdicts[search.best] for search in stage.searches]
    value = float(np.mean([verdict.values[0] for verdict in best]))
    what = f"best {label(config.objective[0])} {value:.3f}"
    if stage.alone:
        return f"{what} in the mean of {len(best)} sequences"
    (search,) = stage.searches
    feasible = "" if best[0].feasible else ", which does not keep the limits"
    return f"{what} (trial {search.number(search.best)}){feasible}"


def _run(archive: Archive, workers: Pool[Any], tasks: list[Task]) -> Iterator[tuple[Task, int]]:
    """Run tasks; yield each when its results are in the archive, and how many trials run now."""
    for task, result, running in run(workers, tasks):
        if result.frames is not None:
            archive.write_frames(task.sequence, result.frames)
        for number, trial in zip(task.numbers, result.trials, strict=True):
            archive.write(task.sequence, number, trial, task.whole)
        yield task, running


def _run_whole(
    study: Study,
    archive: Archive,
    workers: Pool[Any],
    verdicts: Mapping[int, Verdict],
    fixed: int,
    progress: Progress,
) -> dict[str, tuple[float, float]]:
    """Mean RTE of baseline and fixed set on the training sequences, in one go from end to end."""
    names = study.training
    tasks = [
        Task(name, (n,), (verdicts[n].parameters,), whole=True)
        for name in names
        for n in sorted({0, fixed})
        if not archive.trial_path(name, n, whole=True).exists()
    ]
    for done, _ in enumerate(_run(archive, workers, tasks), start=1):
        progress("whole runs", done, len(tasks), "")
    means = {
        (name, n): float(np.nanmean(archive.read(name, n, whole=True).errors))
        for name in names
        for n in (0, fixed)
    }
    return {name: (means[name, 0], means[name, fixed]) for name in names}


def _tuned(study: Study, model: ErrorModel) -> ErrorModel:
    """Choose the bank, and the settings of the rule and of the bank's weights."""
    sequences, sets, everywhere = labelled_sequences(study, model)
    fixed = everywhere.index(model.fixed)
    switching = study.config.online.switching
    members = choose_bank(sequences, fixed, switching.size)
    named = [model.number(n) for n in switching.sets or ()]
    if named and set(named) <= set(everywhere) and len(set(named)) == len(named):
        members = [everywhere.index(n) for n in named if n is not None]
    elif named:
        _log.warning(
            "online.switching.sets: not all of them were run on every training sequence, or one is "
            "named twice; the bank is chosen without them (trials.csv tells which were)"
        )
    vectors = [s.vectors[:, members] for s in sequences if s.vectors is not None]
    return replace(
        model,
        paired=tune(sequences, sets),
        bank=[everywhere[i] for i in members],
        vectors=np.concatenate(vectors),
        fusion=tune_bank(sequences, sets, members, fixed),
    )


def fit(study: Study, archive: Archive, verdicts: Mapping[int, Verdict], fixed: int) -> ErrorModel:
    """Make the error model of all trials that keep the limits.

    Sets have no errors (NaN) on the sequences that they were not run on.

    Parameters
    ----------
    study
        The study.
    archive
        Its trials.
    verdicts
        How they did, by their numbers.
    fixed
        Number of the fixed set's.
    """
    numbers = [n for n, verdict in verdicts.items() if verdict.feasible]
    descriptors, sequence, errors, elevations = [], [], [], []
    window = study.window
    for s, name in enumerate(study.training):
        of_sequence = archive.read_errors(name, numbers)
        # What another budget has had run besides does not count.
        of_sequence[:, [name not in verdicts[n].sequences for n in numbers]] = np.nan
        # Whether there is a sub-trajectory depends on the reference alone.
        labelled = ~np.isnan(of_sequence).all(axis=1)
        frames = archive.read_frames(name)
        period = study.config.online.period
        described = averaged(frames.descriptors, frames.stamps, window, period)
        descriptors.append(described[labelled])
        elevations.append(float(np.nanmedian(frames.elevations)))
        sequence.append(np.full(labelled.sum(), s))
        errors.append(of_sequence[labelled])
    return ErrorModel(
        odometry=study.identity,
        space=study.space,
        sets=[verdicts[n].parameters for n in numbers],
        fixed=numbers.index(fixed),
        length=study.config.sub_trajectory,
        sequences=list(study.training),
        blocks=frames.blocks,
        window=window,
        descriptors=np.concatenate(descriptors),
        sequence=np.concatenate(sequence),
        errors=np.concatenate(errors),
        elevations=elevations,
        provenance={"versions": study.factory.versions, "trials": numbers}
        | study.config.offline.model_dump(
            mode="json", exclude={*BUDGETS, "workers", "memory", "storage"}
        ),
    )
