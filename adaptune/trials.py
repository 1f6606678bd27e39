"""The table of the trials in a study's archive: sort, filter and export it."""

import operator
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from adaptune import yaml
from adaptune.archive import PREPARE_MS, REGISTER_MS, Archive, Summary
from adaptune.errors import AdaptuneError
from adaptune.parameter_sets import in_words
from adaptune.pooled_space import ODOMETRY
from adaptune.space import nearest
from adaptune.trajectory import Trajectory, write_tum

Row = dict[str, Any]

_OPERATORS: dict[str, Callable[[Any, Any], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}
_COLUMN = {"rte": "mean"}
"""Columns that have another name in a study's objectives."""
_HEADINGS = {
    "mean": "mean RTE [%]",
    "rpe": "RPE [m]",
    "ape": "APE [m]",
    "kitti": "KITTI [%]",
    "ms_per_scan": "ms a scan",
    "cpu": "cpu [%]",
    "memory": "memory [MB]",
    "cost": "cost [ms]",
}
"""Columns as a table for reading names them."""
_CONDITION = re.compile(r"\s*([\w.-]+)\s*(<=|>=|==|!=|<|>)\s*(.*?)\s*")


class TrialsError(AdaptuneError):
    """A condition or a column that is not valid."""


def rows(archive: Archive, names: Sequence[str]) -> list[Row]:
    """A row for every trial that is finished on at least one of the sequences.

    It has number, parameters, mean error in percent (None before the trial is finished on all
    sequences), mean error on each sequence, then over all sequences how often it lost track, how
    often its process ended and how often the health check would have found a fault, its other
    metrics (None if a sequence is too short for one), and its cost in milliseconds of CPU time a
    scan (None if it was not measured; without the column if none was).
    """
    finished = {name: archive.finished(name) for name in names}
    # A dictionary keeps their order.
    known = {m: None for of in finished.values() for trial in of.values() for m in trial.metrics}
    metrics = [metric for metric in known if metric not in ("rte", REGISTER_MS, PREPARE_MS)]
    sets = (trial.parameters for of in finished.values() for trial in of.values())
    # Sets of several odometries have other parameters.
    names_of_parameters = list(dict.fromkeys(name for parameters in sets for name in parameters))
    found = [
        _row(number, {n: finished[n].get(number) for n in names}, names_of_parameters, metrics)
        for number in sorted(set().union(*finished.values()))
    ]
    if all(row["cost"] is None for row in found):
        for row in found:
            del row["cost"]
    return found


def _row(
    number: int,
    trials: Mapping[str, Summary | None],
    parameters: Sequence[str],
    metrics: Sequence[str],
) -> Row:
    there = [trial for trial in trials.values() if trial is not None]
    whole = len(there) == len(trials)
    row: Row = {"trial": number} | {name: there[0].parameters.get(name) for name in parameters}
    row["mean"] = float(np.mean([trial.mean_error for trial in there])) if whole else None
    row |= {name: trial and trial.mean_error for name, trial in trials.items()}
    row |= {"lost": sum(t.lost for t in there), "faults": sum(t.faults for t in there)}
    row["unhealthy"] = sum(sum(t.unhealthy.values()) for t in there)
    for metric in metrics:
        values = [t.metrics[metric] for t in there if metric in t.metrics]
        row[metric] = float(np.mean(values)) if len(values) == len(there) else None
    cost = float(np.mean([t.cost for t in there]))
    row["cost"] = None if np.isnan(cost) else cost
    return row


def select(
    table: Sequence[Row],
    where: Sequence[str] = (),
    sort: str | None = None,
    top: int | None = None,
) -> list[Row]:
    """The first `top` rows that meet all conditions, in order.

    A condition, as ``mean < 1``, is a column, one of ``< <= > >= == !=``, and a value in YAML. With
    ``-`` before the column to sort by, the largest value comes first; unknown values come last.
    """
    chosen = list(table)
    for condition in where:
        option = f"--where {condition!r}"
        match = _CONDITION.fullmatch(condition)
        if match is None:
            help_ = "give a column, one of < <= > >= == !=, and a value, as in 'mean < 1'"
            raise TrialsError(f"{option}: {help_}")
        name, sign, text = match.groups()
        try:
            value = yaml.scalar(text)
        except yaml.YamlError as error:
            raise TrialsError(f"{option}: {error}") from error
        column = _column(chosen, name, option)
        chosen = [row for row in chosen if _meets(row[column], sign, value, option)]
    if sort is not None:
        column = _column(chosen, sort.removeprefix("-"), f"--sort {sort}")
        known = [row for row in chosen if row[column] is not None]
        unknown = [row for row in chosen if row[column] is None]
        known.sort(key=lambda row: row[column], reverse=sort.startswith("-"))
        chosen = known + unknown
    return chosen[:top]


def with_units(table: Sequence[Row], names: Sequence[str], labels: Mapping[str, str]) -> list[Row]:
    """Rows for reading: headings say what is measured on the sequences, and units.

    `labels` are those of the parameters, see `ParameterSpace.labels`.
    """
    headings = {**labels, **_HEADINGS} | {name: f"RTE [%] {name}" for name in names}
    if table and ODOMETRY in table[0]:
        table = [_short(row) for row in table]
    return [{headings.get(key, key): value for key, value in row.items()} for row in table]


def _short(row: Row) -> Row:
    """The row with all parameters in a single column: those of several odometries are many."""
    keys = list(row)
    last = keys.index("mean")
    parameters = {key: row[key] for key in keys[1:last] if row[key] is not None}
    short = {"trial": row["trial"], ODOMETRY: parameters.pop(ODOMETRY)}
    short["parameters"] = in_words(parameters)
    return short | {key: row[key] for key in keys[last:]}


def _column(table: Sequence[Row], name: str, option: str) -> str:
    column = _COLUMN.get(name, name)
    if table and column not in table[0]:
        raise TrialsError(f"{option}: there is no column {column!r}: {nearest(column, table[0])}")
    return column


def _meets(given: Any, sign: str, value: Any, option: str) -> bool:
    try:
        return given is not None and _OPERATORS[sign](given, value)
    except TypeError as error:
        raise TrialsError(f"{option}: {given!r} and {value!r} cannot be compared") from error


def export(archive: Archive, names: Sequence[str], numbers: Sequence[int], folder: Path) -> int:
    """Write trajectories as TUM: ``<sequence>/<number>.tum``, and ``<sequence>/reference.tum``.

    Unfinished trials are left out. Returns the number of trials' trajectories.
    """
    written = 0
    for name in names:
        present = [n for n in numbers if n in archive.finished(name)]
        if not present:
            continue
        frames = archive.read_frames(name)
        known = ~np.isnan(frames.T_ref_sensor[:, 0, 0])
        reference = Trajectory(frames.stamps[known], frames.T_ref_sensor[known])
        write_tum(folder / name / "reference.tum", reference)
        for number in present:
            T_odom_sensor = archive.read(name, number).T_odom_sensor
            path = folder / name / f"{number:05d}.tum"
            write_tum(path, Trajectory(frames.stamps, T_odom_sensor))
        written += len(present)
    return written
