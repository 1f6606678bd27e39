"""The table of the trials in a study's archive: sort it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from adaptune.archive import FIRST_POSE, PREPARE_MS, REGISTER_MS, Archive
from adaptune.errors import AdaptuneError, nearest
from adaptune.report.tables import Listing
from adaptune.space import ODOMETRY, in_words

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


def by_odometry(table: Sequence[Row]) -> Listing | None:
    """Of several odometries, what each has with its own parameters and tuned, the best first."""
    rows = [
        {"odometry": label, "its own parameters [%]": own["mean"], "tuned [%]": best["mean"]}
        | {key: best[column] for key, column in (("trial", "trial"), ("cost [ms]", "cost"))}
        for label, (own, best) in sorted(of_each(table).items(), key=lambda one: _rank(one[1][1]))
    ]
    title = "RTE of each odometry in training, over parts of the recordings"
    return Listing(title, rows) if rows else None
