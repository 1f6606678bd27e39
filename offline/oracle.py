"""Trials of a model's sets on the test sequences, to know the best choice in hindsight."""

import logging
from typing import Any

import numpy as np

from adaptune.archive import Archive
from adaptune.errors import AdaptuneError
from adaptune.metrics import cap
from adaptune.model import ErrorModel
from adaptune.model.rules import TrainingData, complementary, mean_errors
from adaptune.progress import Progress, unseen
from adaptune.recording.config import NO_REFERENCE
from adaptune.study.references import ensure_references
from adaptune.study.study import OracleErrors, oracle_errors
from offline.campaign import trial_tasks, watch_tasks
from offline.config import OfflineStudy
from offline.train import trial_workers

_log = logging.getLogger(__name__)


def run_oracle(
    study: OfflineStudy,
    n_sets: int = 16,
    progress: Progress = unseen,
    cluster: str | None = None,
) -> list[dict[str, Any]]:
    """Run some of the model's sets as trials on the test sequences, unless that was done before.

    What was run with another recording, odometry or set is run again.

    ``oracle`` in the study's folder receives the trials, which no model is fitted to.

    Returns
    -------
    list of dict
        For every test sequence the errors of the fixed set and of the best one, in percent.

    Raises
    ------
    AdaptuneError
        If there is no model, it was fitted to something else, or no test sequence has a reference.
    """
    model = study.model()
    study.open()
    names = _judged(study, progress)
    numbers = oracle_sets(model, n_sets)
    archive = study.archive("oracle")
    archive.renew(names)
    for name in names:
        _remove_other_sets(archive, name, model)
    archive.tidy()
    due = {name: [n for n in numbers if n not in archive.finished(name)] for name in names}
    described = study.config.descriptor
    without_frames = [name for name in names if not archive.has_frames(name, described)]
    if any(due.values()) or without_frames:
        missing = [(name, {n: model.sets[n] for n in trials}) for name, trials in due.items()]
        with trial_workers(study, list(due), cluster) as workers:
            at_once, one_by_one = len(workers.workers()), study.odometry.one_by_one
            tasks = trial_tasks(missing, without_frames, at_once, one_by_one)
            watch_tasks(archive, workers, tasks, "runs on test sequences", progress)
    found = {name: oracle_errors(archive, name, model) for name in names}
    return [_row(name, errors) for name, errors in found.items() if errors is not None]


def oracle_sets(model: ErrorModel, n: int) -> list[int]:
    """Trial numbers of some of a model's complete sets.

    The fixed set, the members of the bank, sets that complement each other (see `complementary`),
    and, where these are too few, those with the least training error.
    """
    data = TrainingData(
        np.empty((len(model.sequence), 0)),
        model.stretches(),
        model.errors,
        model.sets,
        model.fixed,
        allowed=model.allowed(),
    )
    means = np.where(data.allows(), mean_errors(data.errors, data.sequence), np.inf)
    best = [model.sets.trials[c] for c in np.argsort(means, kind="stable") if means[c] < np.inf]
    chosen = dict.fromkeys([model.fixed, *model.bank, *complementary(data, n), *best])
    return list(chosen)[:n]


def _judged(study: OfflineStudy, progress: Progress) -> list[str]:
    """The test sequences that have a reference, or get an estimated one."""
    refused = ensure_references(study, study.config.test, progress, required=False)
    for name, said in refused.items():
        _log.warning("%s; so %s is left out", said, name)
    recordings = study.sequences.recordings
    names = [
        name
        for name in study.config.test
        if name not in refused
        and (name not in recordings or recordings[name].reference != NO_REFERENCE)
    ]
    if not names:
        raise AdaptuneError(
            "test: name at least one sequence with a reference; without one, nobody knows which "
            "set was best"
        )
    return names


def _remove_other_sets(archive: Archive, name: str, model: ErrorModel) -> None:
    """Remove trials whose numbers are those of other sets in the model."""
    for number, summary in archive.finished(name).items():
        if number in model.sets and summary.parameters != model.sets[number]:
            _log.info("%s: trial %d is run again: it is another set now", name, number)
            archive.trial_path(name, number).unlink()


def _row(name: str, found: OracleErrors) -> dict[str, Any]:
    means = np.nanmean(cap(found.errors), axis=0)
    best = int(means.argmin())
    return {
        "sequence": name,
        "fixed": float(means[0]),
        "best": float(means[best]),
        "best / fixed": float(means[best] / means[0]),
        "trial": found.trials[best],
        "sets": len(found.trials),
    }
