"""The offline stage: run trials batch by batch, then fit the error model."""

import logging
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune import __version__, report, yaml
from adaptune.archive import Archive
from adaptune.cores import available
from adaptune.descriptor import averaged
from adaptune.files import write_text
from adaptune.metrics import cap
from adaptune.model import ErrorModel
from adaptune.model.base import mean_errors
from adaptune.space import ParameterSet
from adaptune.study import Study
from offline.samplers import propose
from offline.storage import Told, open_mirror
from offline.workers import Task, Workers, run

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""

_log = logging.getLogger(__name__)


class Training(NamedTuple):
    """What the offline stage found.

    Attributes
    ----------
    model : ErrorModel
    means : dict
        For every training sequence the mean capped error of each set in percent, of shape
        (n_sets,).
    whole : dict
        For every training sequence the mean RTE in percent of the whole run, without new starts at
        the reference, of the baseline and of the fixed set.
    lost : dict
        For every training sequence how often the baseline and the fixed set lost track.
    """

    model: ErrorModel
    means: dict[str, list[float]]
    whole: dict[str, tuple[float, float]]
    lost: dict[str, tuple[int, int]]


def train(study: Study, progress: Progress = lambda *_: None) -> Training:
    """Run all trials that are not in the archive yet, and fit the model.

    Parameters
    ----------
    study
        The study; its folder holds the archive and receives the error model (``model.npz``), the
        fixed set (``fixed.yaml``) and a table of all trials (``trials.csv``, ``trials.json``).
    progress
        Told about every finished trial.

    Raises
    ------
    AdaptuneError
        If a sequence cannot be used.
    """
    study.open()
    archive = Archive(study.folder / "trials")
    archive.tidy()
    n_workers = study.config.offline.workers or available()
    with Workers(study, n_workers) as workers:
        sets = _run_batches(study, archive, workers, progress)
        model = fit(study, archive, sets)
        whole = _run_whole(archive, workers, model, progress)
    model.save(study.folder / "model.npz")
    means = {
        name: cap(model.errors[model.sequence == s]).mean(axis=0)
        for s, name in enumerate(model.sequences)
    }
    write_text(study.folder / "fixed.yaml", yaml.dump(model.sets[model.fixed]))
    report.write_rows(study.folder, "trials", _rows(model, means))
    lost = {
        name: (finished[0].lost, finished[model.fixed].lost)
        for name in model.sequences
        if (finished := archive.finished(name))
    }
    return Training(model, {name: m.tolist() for name, m in means.items()}, whole, lost)


def _rows(model: ErrorModel, means: dict[str, NDArray[np.float64]]) -> list[dict[str, Any]]:
    """A row for every trial: its number, its parameters, and its mean errors in percent."""
    all_means = np.mean(list(means.values()), axis=0)
    return [
        {"trial": n, **parameters, "mean": float(all_means[n])}
        | {name: float(of_sequence[n]) for name, of_sequence in means.items()}
        for n, parameters in enumerate(model.sets)
    ]


def _run_batches(
    study: Study, archive: Archive, workers: Workers, progress: Progress
) -> list[ParameterSet]:
    config = study.config.offline
    names, described = study.config.training, study.config.descriptor.names
    finished = {name: archive.finished(name) for name in names}
    mirror = open_mirror(study, {n: s.parameters for n, s in finished[names[0]].items()})
    history: list[tuple[ParameterSet, float]] = []

    def told(number: int) -> Told:
        trials = {name: finished[name][number] for name in names}
        attributes = {name: trial.mean_error for name, trial in trials.items()}
        attributes["lost"] = sum(trial.lost for trial in trials.values())
        attributes["ms"] = float(np.mean([trial.ms for trial in trials.values()]))
        return Told(*history[number], attributes)

    total = config.trials * len(names)
    done = 0
    progress("trials", 0, total)
    for batch in range(-(-config.trials // config.batch)):
        first = batch * config.batch
        numbers = range(first, min(first + config.batch, config.trials))
        missing = {name: [n for n in numbers if n not in finished[name]] for name in names}
        n_missing = sum(map(len, missing.values()))
        done += len(numbers) * len(names) - n_missing
        progress("trials", done, total)
        unframed = [name for name in names if not archive.has_frames(name, described)]
        if n_missing or unframed:
            sets = propose(study.space, config, batch, history)
            tasks = _tasks(missing, unframed, sets, first, workers.n)
            for task in _run(archive, workers, tasks):
                done += len(task.numbers)
                progress("trials", done, total)
        for n in numbers:
            trials = [finished[name][n] for name in names]
            error = float(np.mean([trial.mean_error for trial in trials]))
            history.append((trials[0].parameters, error))
        mirror.tell(len(history), told)
        best = min(range(len(history)), key=lambda i: history[i][1])
        _log.info(
            "trials %d to %d done; best so far: trial %d with %.3f %%",
            numbers[0],
            numbers[-1],
            best,
            history[best][1],
        )
    return [parameters for parameters, _ in history]


def _tasks(
    missing: dict[str, list[int]],
    unframed: list[str],
    sets: list[ParameterSet],
    first: int,
    n_workers: int,
) -> list[Task]:
    """Share every sequence's trials between the workers; reading it again is a task of its own."""
    return [Task(name, (), (), frames=True) for name in unframed if not missing[name]] + [
        Task(name, tuple(some), tuple(sets[n - first] for n in some), frames=name in unframed)
        for name, numbers in missing.items()
        for share in range(n_workers)
        if (some := numbers[share::n_workers])
    ]


def _run(archive: Archive, workers: Workers, tasks: list[Task]) -> Iterator[Task]:
    """Run tasks, and yield each when its results are in the archive."""
    for task, result in run(workers, tasks):
        if result.frames is not None:
            archive.write_frames(task.sequence, result.frames)
        for number, trial in zip(task.numbers, result.trials, strict=True):
            archive.write(task.sequence, number, trial, task.whole)
        yield task


def _run_whole(
    archive: Archive, workers: Workers, model: ErrorModel, progress: Progress
) -> dict[str, tuple[float, float]]:
    """Mean RTE of baseline and fixed set on the training sequences, in one go from end to end."""
    numbers = (0, model.fixed)
    tasks = [
        Task(name, (n,), (model.sets[n],), whole=True)
        for name in model.sequences
        for n in sorted(set(numbers))
        if not archive.trial_path(name, n, whole=True).exists()
    ]
    for done, _ in enumerate(_run(archive, workers, tasks), start=1):
        progress("whole runs", done, len(tasks))
    means = {
        (name, n): float(np.nanmean(archive.read(name, n, whole=True).errors))
        for name in model.sequences
        for n in numbers
    }
    return {name: (means[name, 0], means[name, model.fixed]) for name in model.sequences}


def fit(study: Study, archive: Archive, sets: list[ParameterSet]) -> ErrorModel:
    """Make the error model of all trials.

    Parameters
    ----------
    study
        The study.
    archive
        Its trials, numbered as `sets`.
    sets
        The parameter sets.
    """
    descriptors, sequence, errors = [], [], []
    window = study.window
    for s, name in enumerate(study.config.training):
        of_sequence = archive.read_errors(name, range(len(sets)))
        # Whether there is a sub-trajectory depends on the reference alone.
        labelled = ~np.isnan(of_sequence).all(axis=1)
        frames = archive.read_frames(name)
        period = study.config.online.period
        described = averaged(frames.descriptors, frames.stamps, window, period)
        descriptors.append(described[labelled])
        sequence.append(np.full(labelled.sum(), s))
        errors.append(of_sequence[labelled])
    all_errors, all_sequences = np.concatenate(errors), np.concatenate(sequence)
    return ErrorModel(
        odometry={
            "name": study.config.odometry.name,
            "settings": study.settings.model_dump(mode="json"),
        },
        space=study.space,
        sets=sets,
        fixed=int(np.argmin(mean_errors(all_errors, all_sequences))),
        length=study.config.sub_trajectory,
        sequences=list(study.config.training),
        blocks=frames.blocks,
        window=window,
        descriptors=np.concatenate(descriptors),
        sequence=all_sequences,
        errors=all_errors,
        provenance={"adaptune": __version__}
        | study.config.offline.model_dump(mode="json", exclude={"workers", "memory", "storage"}),
    )
