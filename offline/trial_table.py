"""Finished trials as a table: its rows, its columns, and which parameters matter."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError, nearest
from adaptune.runs.archive import FIRST_POSE, PREPARE_MS, REGISTER_MS, Archive, TrialSummary
from adaptune.space import ODOMETRY, ParameterSet, ParameterSpace, in_words
from offline.config import OfflineConfig, OfflineStudy, distribution
from offline.objective import JudgedSet, judge, label

Row = dict[str, Any]

_COLUMN = {"rte": "mean"}
"""Columns that have another name in a study's objectives."""
_HEADINGS = {
    "mean": "mean RTE [%]",
    "rpe": "RPE [m]",
    "ape": "APE [m]",
    "kitti": "KITTI [%]",
    "ms_per_scan": "odometry [ms]",
    "cpu": "cpu [%]",
    "memory": "memory [MB]",
    "cost": "cost [ms]",
    FIRST_POSE: "first pose after [s]",
}
"""Columns as a table for reading names them."""


def rows(archive: Archive, names: Sequence[str]) -> list[Row]:
    """A row for every trial that is finished on at least one of the sequences.

    Errors are means in percent; that over all sequences is None before the trial is finished on all
    of them. A metric is None if a sequence is too short for it, the cost, in milliseconds of CPU
    time a scan, if it was not measured.
    """
    finished = {name: archive.finished(name) for name in names}
    every = [trial for trials in finished.values() for trial in trials.values()]
    # Dictionaries keep the order of metrics, and of parameters: several odometries have others.
    metrics = dict.fromkeys(metric for trial in every for metric in trial.metrics)
    parameters = dict.fromkeys(name for trial in every for name in trial.parameters)
    found = []
    for number in sorted(set().union(*finished.values())):
        trials = {name: finished[name].get(number) for name in names}
        there = [trial for trial in trials.values() if trial is not None]
        row: Row = {"trial": number} | {name: there[0].parameters.get(name) for name in parameters}
        errors = {name: t.mean_error if t else None for name, t in trials.items()}
        row |= {"mean": _mean(list(errors.values()))} | errors
        row |= {
            "proposed by": there[0].source,
            "restarts": round(sum(t.restarts for t in there)),
            "faults": sum(t.faults for t in there),
        }
        for metric in metrics:
            if metric not in ("rte", REGISTER_MS, PREPARE_MS):
                without = 0.0 if metric == FIRST_POSE else None
                row[metric] = _mean([t.metrics.get(metric, without) for t in there])
        cost = float(np.mean([t.cost for t in there]))
        found.append(row | {"cost": None if np.isnan(cost) else cost})
    return found


def _mean(values: Sequence[float | None]) -> float | None:
    """Mean of values; None if one is unknown."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) else None


def select(
    table: Sequence[Row],
    sort: str | None = None,
    top: int | None = None,
    shown: Mapping[str, str] | None = None,
) -> list[Row]:
    """The first `top` rows in the order of a column, by default of the mean; else all rows.

    With ``-`` before the column, the largest value comes first; unknown values come last. `shown`
    has by column the heading under which it is printed, which names it, too.
    """
    if sort is None and top is None:
        return list(table)
    sort = sort or "mean"
    name = sort.removeprefix("-")
    column = (_COLUMN | {heading: key for key, heading in (shown or {}).items()}).get(name, name)
    if table and column not in table[0]:
        known = nearest(column, table[0])
        raise AdaptuneError(f"--sort {sort}: there is no column {column!r}: {known}")
    chosen = [row for row in table if row[column] is not None]
    chosen.sort(key=lambda row: row[column], reverse=sort.startswith("-"))
    return [*chosen, *(row for row in table if row[column] is None)][:top]


def headings(names: Sequence[str], labels: Mapping[str, str]) -> dict[str, str]:
    """By column, its heading in a table for reading.

    `labels` are those of the parameters, see `ParameterSpace.labels`.
    """
    return {**labels, **_HEADINGS} | {name: f"RTE [%] {name}" for name in names}


def with_units(table: Sequence[Row], names: Sequence[str], labels: Mapping[str, str]) -> list[Row]:
    """Rows for reading: see `headings`."""
    shown = headings(names, labels)
    if table and ODOMETRY in table[0]:
        table = [_short(row) for row in table]
    return [{shown.get(key, key): value for key, value in row.items()} for row in table]


def _short(row: Row) -> Row:
    """The row with all parameters in a single column: those of several odometries are many."""
    keys = list(row)
    last = keys.index("mean")
    parameters = {key: row[key] for key in keys[1:last] if row[key] is not None}
    short = {"trial": row["trial"], ODOMETRY: parameters.pop(ODOMETRY)}
    short["parameters"] = in_words(parameters)
    return short | {key: row[key] for key in keys[last:]}


def of_each(table: Sequence[Row]) -> dict[str, tuple[Row, Row]]:
    """Of several odometries, the rows of each one's own parameters and of its best set, or none."""
    found: dict[str, tuple[Row, Row]] = {}
    for row in table:
        # The first trial of each has its own parameters.
        own, best = found.get(label := row.get(ODOMETRY, ""), (row, row))
        found[label] = own, min(best, row, key=_rank)
    return found if len(found) > 1 else {}


def _rank(row: Row) -> tuple[bool, float]:
    return row.get("state", "complete") != "complete", row["mean"] or np.inf


@dataclass(frozen=True, eq=False)
class TrialTable:
    """Trials, in the order of their numbers."""

    space: ParameterSpace
    names: Sequence[str]  # of the training sequences
    trials: Mapping[int, JudgedSet]  # by number; the value is NaN if a set was not run on all
    objective: str = "RTE [%]"  # name of the objective, with its unit
    fixed: int | None = None  # trial number of the fixed set, once it is chosen

    def __len__(self) -> int:
        return len(self.trials)

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """Their numbers, of shape (n,)."""
        return np.array([*self.trials], int)

    @cached_property
    def values(self) -> NDArray[np.float64]:
        """The objective over all sequences, of shape (n,)."""
        return np.array([trial.value for trial in self.trials.values()])

    def on(self, name: str) -> NDArray[np.float64]:
        """The objective on a sequence, of shape (n,); NaN where a trial was not run."""
        return np.array([trial.by_sequence.get(name, np.nan) for trial in self.trials.values()])

    def column(self, name: str) -> list[Any]:
        """Values of one of `space.parameters`; None where a set has none."""
        return [self.space.flat(trial.parameters).get(name) for trial in self.trials.values()]

    def some(self, kept: Iterable[bool | np.bool_]) -> "TrialTable":
        """The same of some of the trials."""
        each = zip(self.trials.items(), kept, strict=True)
        return replace(self, trials=dict(trial for trial, its in each if its))

    def odometries(self) -> dict[str, "TrialTable"]:
        """By the name of an odometry its trials; of the only one by no name."""
        names = [str(trial.parameters.get(ODOMETRY, "")) for trial in self.trials.values()]
        return {name: self.some(own == name for own in names) for name in dict.fromkeys(names)}


def read_trials(study: OfflineStudy) -> TrialTable:
    """Read the finished trials of a study on its training sequences; there may be none."""
    archive = Archive(study.folder / "trials")
    finished = {name: archive.finished(name) for name in study.training}
    return trial_table(study.config.offline, study.odometry.space, finished, study.fixed)


def trial_table(
    config: OfflineConfig,
    space: ParameterSpace,
    finished: Mapping[str, Mapping[int, TrialSummary]],
    fixed: ParameterSet | None = None,
) -> TrialTable:
    """Finished trials as columns: by training sequence, `finished` has them by their numbers.

    Of `config`, the objective counts; `fixed` is the fixed set, once chosen.
    """
    objective, trials = config.objective, dict[int, JudgedSet]()
    for number in sorted({number for of_sequence in finished.values() for number in of_sequence}):
        of_set = {name: of[number] for name, of in finished.items() if number in of}
        judged = judge(config, of_set)
        everywhere = len(of_set) == len(finished)
        trials[number] = judged if everywhere else judged._replace(value=np.nan)
    named = "RTE [%]" if objective == {"rte": 1.0} else label(objective, units=True)
    chosen = next((n for n, trial in trials.items() if trial.parameters == fixed), None)
    return TrialTable(space, list(finished), trials, named, chosen)


FEW = 8
"""With fewer trials, importances mean nothing."""


def importances(table: TrialTable) -> dict[str, float]:
    """Share of each parameter in the variance of the error's logarithm, by falling share.

    It is functional ANOVA, Optuna's default, on a small forest: Optuna's own takes minutes for some
    thousand trials, and gives the same shares. The trials are of one odometry. There is none with
    fewer than `FEW` finished trials, one parameter, or equal errors.
    """
    known = table.some(np.isfinite(table.values) & (table.values > 0.0))
    columns = {name: known.column(name) for name in table.space.parameters}
    columns = {
        name: values
        for name, values in columns.items()
        if None not in values and len(set(map(repr, values))) > 1
    }
    logs = np.log(known.values)
    if len(known) < FEW or len(columns) < 2 or np.ptp(logs) < 1e-9:
        return {}
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    distributions = {name: distribution(table.space.parameters[name]) for name in columns}
    study = optuna.create_study()
    study.add_trials(
        optuna.trial.create_trial(
            params={name: column[i] for name, column in columns.items()},
            distributions=distributions,
            value=float(log),
        )
        for i, log in enumerate(logs)
    )
    # The size of the forest bounds the time that it takes.
    evaluator = optuna.importance.FanovaImportanceEvaluator(n_trees=16, max_depth=8, seed=0)
    shares = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {name: float(share) for name, share in shares.items()}
