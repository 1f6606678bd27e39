"""The offline stage: run trials batch by batch, then fit the error model."""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from adaptune import report, yaml
from adaptune.archive import Archive, Summary
from adaptune.cores import available
from adaptune.descriptor import averaged
from adaptune.files import write_text
from adaptune.model import ErrorModel, thin
from adaptune.odometry import versions
from adaptune.space import ParameterSet
from adaptune.study import TIMED, OfflineConfig, Study
from offline.budget import BUDGETS, Clock, max_trials, spent
from offline.cluster import Cluster
from offline.objective import (
    Verdict,
    choose_fixed,
    judge,
    label,
    pareto_front,
    told,
    weighted,
)
from offline.pruning import estimate, rungs, survivors
from offline.samplers import make_sampler
from offline.storage import Told, open_mirror
from offline.validation import labelled_sequences, tune
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
        For every training sequence the mean capped error of each trial in percent, of shape
        (n_trials,).
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
    with Cluster(study, cluster) if cluster else Workers(study, n_workers) as workers:
        verdicts = run_batches(study, archive, workers, progress)
        fixed = choose_fixed(config, verdicts)
        whole = _run_whole(study, archive, workers, verdicts, fixed, progress)
    model = fit(study, archive, verdicts, fixed)
    model = replace(model, paired=tune(*labelled_sequences(study, model)))
    model.save(study.folder / "model.npz")
    finished = {
        name: [archive.finished(name).get(n) for n in range(len(verdicts))]
        for name in study.training
    }
    means = {
        name: [trial.mean_error if trial else np.nan for trial in trials]
        for name, trials in finished.items()
    }
    write_text(study.folder / "fixed.yaml", yaml.dump(verdicts[fixed].parameters))
    table = _trial_rows(config, verdicts, finished)
    report.write_rows(study.folder, "trials", table)
    if len(config.objective) > 1:
        _write_pareto(study, verdicts, table)
    rows = _training_rows(config, verdicts, finished, fixed, whole)
    report.write_rows(study.folder, "training", rows)
    return Training(model, means, fixed, rows)


def _trial_rows(
    config: OfflineConfig,
    verdicts: Sequence[Verdict],
    finished: Mapping[str, Sequence[Summary | None]],
) -> list[dict[str, Any]]:
    """A row for every trial: its parameters, how it was judged, its mean errors in percent."""
    rows: list[dict[str, Any]] = []
    for n, verdict in enumerate(verdicts):
        runs = [run for trials in finished.values() if (run := trials[n])]
        rows.append({"trial": n, **verdict.parameters})
        if config.metrics != {"rte"}:
            judged = zip(config.objective, verdict.values, strict=True)
            rows[-1] |= {label(weights): value for weights, value in judged}
            for metric in sorted(config.metrics):
                rows[-1][metric] = float(np.mean([run.metrics[metric] for run in runs]))
        if config.limits:
            rows[-1]["excess"] = verdict.excess
        if config.repeats > 1:
            rows[-1]["margin"] = verdict.margin
        mean = float(np.mean([run.mean_error for run in runs])) if verdict.complete else None
        rows[-1]["mean"] = mean
        for name, trials in finished.items():
            rows[-1][name] = run.mean_error if (run := trials[n]) else None
    return rows


def _training_rows(
    config: OfflineConfig,
    verdicts: Sequence[Verdict],
    finished: Mapping[str, Sequence[Summary | None]],
    fixed: int,
    whole: Mapping[str, tuple[float, float]],
) -> list[dict[str, Any]]:
    """A row for every training sequence; its own best set is found as the fixed one is."""
    rows = []
    for name, trials in finished.items():
        runs = {n: run for n, run in enumerate(trials) if run}
        alone = {n: judge(config, [run]) for n, run in runs.items()}
        best = list(runs)[choose_fixed(config, list(alone.values()))]
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
    study: Study, verdicts: Sequence[Verdict], trials: Sequence[Mapping[str, Any]]
) -> None:
    """The sets that none that keeps the limits is better than in every objective."""
    feasible = [n for n, verdict in enumerate(verdicts) if verdict.feasible]
    values = np.array([verdicts[n].values for n in feasible])
    front = [feasible[i] for i in pareto_front(values)]
    report.write_rows(study.folder, "pareto", [trials[n] for n in front])
    names = [label(weights) for weights in study.config.offline.objective]
    report.draw_front(
        study.folder / "pareto.png", names, values, np.array([verdicts[n].values for n in front])
    )


def run_batches(
    study: Study, archive: Archive, workers: Pool[Any], progress: Progress = lambda *_: None
) -> list[Verdict]:
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
    """
    config = study.config.offline
    names, described = study.training, study.config.descriptor.names
    finished = {name: archive.finished(name) for name in names}
    mirror = open_mirror(study, {n: s.parameters for n, s in finished[names[0]].items()})
    verdicts: list[Verdict] = []

    sampler = make_sampler(study.space, config)
    clock = Clock(study.folder / "elapsed.json")
    limit = max_trials(config)
    tally = _Tally(progress, finished)
    batch = best = 0
    while (reason := spent(config, verdicts, best, clock.hours(batch))) is None:
        first = batch * config.batch
        numbers = range(first, min(first + config.batch, limit or first + config.batch))
        order = _hardest_first(config, finished) if batch else names
        sets: list[ParameterSet] = []
        if any(n not in finished[order[0]] for n in numbers):
            sets = sampler.propose(told(verdicts))
            numbers = numbers[: len(sets)]
        if not numbers:
            reason = "there is nothing else to try"
            break
        tally.begin((limit or numbers.stop) * len(names), numbers)
        alive = list(numbers)
        unframed = [name for name in names if not archive.has_frames(name, described)]
        begun = False
        for m in rungs(config.pruning, batch, len(names)):
            missing = {name: [n for n in alive if n not in finished[name]] for name in order[:m]}
            if any(missing.values()) or unframed:
                begun = True
                sets = sets or sampler.propose(told(verdicts))
                tasks = _tasks(missing, unframed, sets, first, len(workers.workers()))
                with clock.running(batch):
                    tally.watch(_run(archive, workers, tasks))
                unframed = []
            if m < len(names):
                alive = _survivors(config, order, finished, m, alive, first)
        verdicts.extend(_verdict(config, order, finished, n) for n in numbers)
        best = min((best, *numbers), key=lambda n: _rank(verdicts[n]))
        tally.best = _best(config, best, verdicts[best])
        if begun:
            mirror.tell(len(verdicts), lambda n: _told(config, verdicts[n], finished, n))
            tally.catch_up(len(verdicts) * len(names))
            _log.info("trials %d to %d done; %s", numbers[0], numbers[-1], tally.best)
        if len(numbers) < config.batch and limit != len(verdicts):
            reason = "there is nothing else to try"
            break
        batch += 1
    mirror.tell(len(verdicts), lambda n: _told(config, verdicts[n], finished, n))
    tally.catch_up(len(verdicts) * len(names), end=True)
    _log.info("the search ends: %s", reason)
    return verdicts


def _rank(verdict: Verdict) -> tuple[bool, float, float]:
    return not verdict.complete, verdict.excess, verdict.values[0]


Finished = Mapping[str, Mapping[int, Summary]]
"""The finished trials on every sequence, by number."""


def _told(config: OfflineConfig, verdict: Verdict, finished: Finished, n: int) -> Told:
    """What the mirror is told of a trial."""
    trials = {name: of[n] for name, of in finished.items() if n in of}
    attributes = {name: trial.mean_error for name, trial in trials.items()}
    attributes["lost"] = sum(trial.lost for trial in trials.values())
    attributes["ms"] = float(np.mean([trial.ms for trial in trials.values()]))
    if config.limits:
        attributes["excess"] = verdict.excess
    return Told(verdict.parameters, verdict.values, attributes)


def _values(config: OfflineConfig, order: Sequence[str], finished: Finished, n: int) -> list[float]:
    """A trial's first objective on the sequences that it was run on."""
    runs = [finished[name][n] for name in order if n in finished[name]]
    return [weighted(config.objective[0], run.metrics) for run in runs]


def _hardest_first(config: OfflineConfig, finished: Finished) -> list[str]:
    """The sequences by falling mean of the first objective over the first batch."""
    first = range(config.batch)
    means = {
        name: np.mean([weighted(config.objective[0], trials[n].metrics) for n in first])
        for name, trials in finished.items()
    }
    return sorted(means, key=lambda name: -means[name])


def _survivors(
    config: OfflineConfig,
    order: Sequence[str],
    finished: Finished,
    m: int,
    alive: Sequence[int],
    first: int,
) -> list[int]:
    """Those of a batch that begins with trial `first` that go on beyond `m` sequences."""

    def values(numbers: Iterable[int], seen: Sequence[str]) -> dict[int, list[float]]:
        return {
            n: _values(config, seen, finished, n)
            for n in numbers
            if _verdict(config, seen, finished, n).feasible
        }

    return survivors(config.pruning, m, values(alive, order[:m]), values(range(first), order))


def _verdict(config: OfflineConfig, order: Sequence[str], finished: Finished, n: int) -> Verdict:
    """What a trial came to, or would have if it had not been given up."""
    verdict = judge(config, [finished[name][n] for name in order if n in finished[name]])
    if all(n in finished[name] for name in order):
        return verdict
    value = estimate(_values(config, order, finished, n), _values(config, order, finished, 0))
    return verdict._replace(values=(value,), complete=False)


class _Tally:
    """What the progress tells of trials."""

    def __init__(self, progress: Progress, finished: Finished):
        self.best = ""
        self._progress, self._finished = progress, finished
        self._done = self._failed = self._total = 0

    def begin(self, total: int, numbers: Iterable[int]) -> None:
        """Begin a batch, some of whose trials may be finished."""
        self._total = total
        numbers = list(numbers)
        for name, finished in self._finished.items():
            self._add(name, [n for n in numbers if n in finished])
        self._show()

    def watch(self, tasks: Iterable[tuple[Task, int]]) -> None:
        """Count trials as they are finished."""
        for task, running in tasks:
            self._add(task.sequence, task.numbers)
            self._show(running)

    def catch_up(self, done: int, end: bool = False) -> None:
        """Count as done what will not be run, too."""
        self._done = done
        self._total = done if end else self._total
        self._show()

    def _add(self, name: str, numbers: Iterable[int]) -> None:
        runs = [self._finished[name][n] for n in numbers]
        self._done += len(runs)
        self._failed += sum(run.lost > 0 or run.faults > 0 for run in runs)

    def _show(self, running: int = 0) -> None:
        remarks = [f"{running} running"] if running else []
        remarks += [self.best] if self.best else []
        remarks += [f"{self._failed} lost track or failed"] if self._failed else []
        self._progress("trials", self._done, self._total, ", ".join(remarks))


def _best(config: OfflineConfig, number: int, verdict: Verdict) -> str:
    what = f"{label(config.objective[0])} {verdict.values[0]:.3f}"
    return f"best {what} (trial {number})" + (
        "" if verdict.feasible else ", which does not keep the limits"
    )


def _tasks(
    missing: dict[str, list[int]],
    unframed: list[str],
    sets: list[ParameterSet],
    first: int,
    n_workers: int,
) -> list[Task]:
    """Share every sequence's trials between the workers; reading it again is a task of its own.

    Those of the last one are shared in ever smaller pieces, so that all workers end together.
    """
    tasks = [Task(name, (), (), frames=True) for name in unframed if not missing.get(name)]
    for last, (name, numbers) in enumerate(missing.items(), 1 - len(missing)):
        left = numbers
        while left:
            size = math.ceil(len(left) / n_workers / (1 if last else 2))
            tasks += [
                Task(name, tuple(n), tuple(sets[i - first] for i in n), frames=name in unframed)
                for share in range(n_workers)
                if (n := left[share * size : (share + 1) * size])
            ]
            left = left[n_workers * size :]
    return tasks


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
    verdicts: Sequence[Verdict],
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


def fit(study: Study, archive: Archive, verdicts: Sequence[Verdict], fixed: int) -> ErrorModel:
    """Make the error model of all trials that keep the limits.

    Sets that were given up have no errors (NaN) on the sequences that they were not run on.

    Parameters
    ----------
    study
        The study.
    archive
        Its trials.
    verdicts
        How they did, in their order.
    fixed
        Number of the fixed set's.
    """
    numbers = [n for n, verdict in enumerate(verdicts) if verdict.feasible]
    descriptors, sequence, errors, elevations = [], [], [], []
    window = study.window
    for s, name in enumerate(study.training):
        of_sequence = archive.read_errors(name, numbers)
        # Whether there is a sub-trajectory depends on the reference alone.
        labelled = ~np.isnan(of_sequence).all(axis=1)
        frames = archive.read_frames(name)
        period = study.config.online.period
        described = averaged(frames.descriptors, frames.stamps, window, period)
        descriptors.append(described[labelled])
        elevations.append(float(np.nanmedian(frames.elevations)))
        sequence.append(np.full(labelled.sum(), s))
        errors.append(of_sequence[labelled])
    model = ErrorModel(
        odometry={
            "name": study.config.odometry.name,
            "settings": study.settings.model_dump(mode="json"),
        },
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
        provenance={"versions": versions(study.box), "trials": numbers}
        | study.config.offline.model_dump(
            mode="json", exclude={*BUDGETS, "workers", "memory", "storage"}
        ),
    )
    max_frames = study.config.offline.max_frames
    return model if max_frames is None else thin(model, max_frames)
