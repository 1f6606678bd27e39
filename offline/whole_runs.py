"""Whole runs: the sets that may become the fixed one, driven as `adaptune online` drives them."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive, ArchiveError, Summary, Trial, summarise
from adaptune.odometry.health import HealthCheck
from adaptune.space import ParameterSet
from offline.campaign import Progress, watch_tasks
from offline.config import OfflineConfig
from offline.objective import judge, label, mean_value, weighted
from offline.workers import Pool, Task

WholeRuns = Mapping[str, Mapping[int, Summary]]
"""By sequence, whole runs by trial number."""


def whole_run(archive: Archive, name: str, number: int, health: HealthCheck) -> Trial | None:
    """The whole run of a trial; None if there is none with this health check."""
    try:
        trial = archive.read(name, number, whole=True)
    except ArchiveError:
        return None
    return trial if trial.health == health.model_dump() else None


def read_whole_runs(
    archive: Archive, names: Sequence[str], numbers: Sequence[int], health: HealthCheck
) -> dict[str, dict[int, Summary]]:
    """The whole runs of some trials that there are with this health check."""
    found = {name: {n: whole_run(archive, name, n, health) for n in numbers} for name in names}
    return {
        name: {n: summarise(trial) for n, trial in runs.items() if trial is not None}
        for name, runs in found.items()
    }


def run_whole(
    names: Sequence[str],
    sets: Mapping[int, ParameterSet],
    health: HealthCheck,
    archive: Archive,
    workers: Pool[Any],
    progress: Progress,
) -> dict[str, dict[int, Summary]]:
    """Run sets on the sequences from end to end, unless that was done before."""
    there = read_whole_runs(archive, names, list(sets), health)
    tasks = [
        Task(name, (n,), (parameters,), whole=True)
        for name in names
        for n, parameters in sets.items()
        if n not in there[name]
    ]
    watch_tasks(archive, workers, tasks, "whole runs", progress)
    return read_whole_runs(archive, names, list(sets), health) if tasks else there


def whole_values(config: OfflineConfig, runs: WholeRuns) -> dict[str, dict[int, float]]:
    """By sequence, the first objective in whole runs of every candidate for the fixed set.

    Candidates have whole runs on all sequences, and keep the limits there if one does.
    """
    numbers = set.intersection(*(set(of_sequence) for of_sequence in runs.values()))
    verdicts = {n: judge(config, [runs[name][n] for name in runs]) for n in sorted(numbers)}
    feasible = [n for n, verdict in verdicts.items() if verdict.feasible] or list(verdicts)
    return {
        name: {n: weighted(config.objective[0], of_sequence[n].metrics) for n in feasible}
        for name, of_sequence in runs.items()
    }


def whole_errors(
    archive: Archive, name: str, numbers: Iterable[int], frames: NDArray[np.intp]
) -> dict[int, NDArray[np.float64]]:
    """Errors in whole runs on some frames, by trial number, each of shape (n,)."""
    return {n: archive.read(name, n, whole=True).errors[frames] for n in numbers}


def mean_values(values: Sequence[Mapping[int, float]]) -> dict[int, float]:
    """Mean over the sequences of the values of those trials that have one on each."""
    numbers = set.intersection(*map(set, values)) if values else set()
    return {n: float(mean_value(np.array([of[n] for of in values]))) for n in sorted(numbers)}


def rivalry(config: OfflineConfig, whole: Mapping[int, float], best: int, fixed: int) -> str | None:
    """In words where the baseline is better than the trials suggested.

    Parameters
    ----------
    config
        It says what `whole` is.
    whole
        By trial number, the first objective in whole runs: its mean over the sequences.
    best, fixed
        Trial numbers of the set with the best trials, and of the fixed set.
    """
    if 0 not in whole or best == 0 or whole[0] >= whole.get(best, np.inf):
        return None
    what = label(config.objective[0])
    beaten = (
        f"In whole runs with the health check, the baseline is better than the trials suggested: "
        f"its {what} is {whole[0]:.3g}, that of trial {best}, the best by its trials, "
        f"{whole[best]:.3g}"
    )
    if fixed == 0:
        return f"{beaten}. So the fixed set is the baseline."
    return f"{beaten}. So the fixed set is trial {fixed}, with {whole[fixed]:.3g}."
