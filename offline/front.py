"""What CPU time buys: the front of error over cost, and what it costs on the machine at hand."""

import json
from collections.abc import Collection, Sequence
from contextlib import closing
from itertools import islice
from typing import Any

import numpy as np

from adaptune._system.progress import Progress, unseen
from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from adaptune.model.registry import ADAPTIVE
from adaptune.recording.scan import Recording
from adaptune.runs.loop import replay
from adaptune.runs.record import Run
from adaptune.space import ODOMETRY, in_words
from adaptune.study.driven import ANY, BELOW, COST, EQUAL, ERROR, FILES, OWN, WITHIN
from offline.choice import (
    LEAST_COST,
    MOST_OF_PERIOD,
    Elsewhere,
    allowed_cost,
    bounds,
    choose,
    elsewhere,
    mean_and_error,
    why_not,
)
from offline.config import OfflineStudy
from offline.labelled import LabelledData


def front_rows(data: LabelledData, model: ErrorModel, left_out: str = "") -> list[dict[str, Any]]:
    """Error over cost: the baseline, the best sets within rising budgets, and the bank.

    Errors are those of drives of whole recordings in training. Ratios to the baseline's are those
    to expect on another drive, with intervals of 95 %. The sentence on what was `left_out` stands
    in the row of what is recommended.
    """
    blocks, front = data.driven_blocks(), data.front()
    means, _ = mean_and_error(blocks.errors, blocks.sequence)
    of_bounds = dict(zip(blocks.trials, bounds(blocks).tolist(), strict=True))
    costs = data.beside or data.costs
    roles: dict[int, list[str]] = {}
    for what, trial in zip((OWN, WITHIN, EQUAL, ANY, BELOW), front, strict=True):
        if what != BELOW or trial not in roles:
            roles.setdefault(trial, []).append(what)
    rows = []
    for trial, names in roles.items():
        error, ratio = means[list(blocks.trials).index(trial)], elsewhere(blocks, trial)
        row = _row(names, error, costs.alone(trial), ratio) | {
            "recommended": trial == model.fixed and model.recommended != ADAPTIVE,
            "parameters": in_words(data.sets[trial]),
            "odometry": data.sets[trial].get(ODOMETRY, ""),
        }
        rows.append(row | {"trial": trial, "_bound": of_bounds[trial]})
    members = [trial for trial in model.bank if trial not in model.reserve]
    if (of_bank := model.expected) and len(members) > 1:
        by = of_bank["geometric"]
        error = by * means[list(blocks.trials).index(model.fixed)]
        ratio = elsewhere(blocks, model.fixed, (by, of_bank.get("error", np.inf)))
        row = _row([ADAPTIVE], error, costs.adaptive(members), ratio)
        row |= {"recommended": model.recommended == ADAPTIVE}
        row |= {"parameters": f"trials {', '.join(map(str, members))}", "odometry": ""}
        rows.append(row | {"trial": None, "_bound": None})
    rows = [row | {"left out": left_out if row["recommended"] else ""} for row in rows]
    order = list(FILES)
    return sorted(rows, key=lambda row: min(map(order.index, row["what"].split(", "))))


def in_short(data: LabelledData) -> str:
    """What trials that are done would recommend."""
    blocks = data.blocks()
    if (trial := choose(blocks, data.budget)) in blocks.defaults:
        return "so far, none is safely better than the odometry's own parameters"
    ratio, costs = elsewhere(blocks, trial).ratio, data.costs
    own = costs.alone(blocks.trials[blocks.baseline])
    return (
        f"so far, trial {trial} is the best ({in_words(data.sets[trial])}), with {ratio:.2f} times "
        f"the error of the odometry's own parameters, for {costs.alone(trial):.1f} instead of "
        f"{own:.1f} ms a scan"
    )


def _row(roles: Sequence[str], error: float, cost: float, ratio: Elsewhere) -> dict[str, Any]:
    row = {"what": ", ".join(roles), ERROR: float(error), COST: cost}
    row |= {"another drive": ratio.ratio, "low": ratio.low, "high": ratio.high}
    return row | {"file": next(filter(None, map(FILES.get, roles)), "")}


AS_GOOD, CHEAPER = 1.01, 0.9
"""Times the error and the cost of what is recommended up to which a set is no worse, and times
their product below which it is better."""


def left_out(
    every: LabelledData, data: LabelledData, model: ErrorModel, worse: Collection[int]
) -> str:
    """Why the best set that is better and cheaper than what is recommended is not, in a sentence.

    `every` has all sets, `data` those that may be chosen with their drives of whole recordings;
    those that are `worse` drive them badly without the health check.
    """
    costs, whole = data.beside or every.costs, data.driven_blocks()
    for tried in (whole, every.blocks()):
        if not len((blocks := tried.tracked()).errors):
            return ""
        means, _ = mean_and_error(blocks.errors, blocks.sequence)
        least, own = means[list(blocks.trials).index(model.fixed)], costs.alone(model.fixed)
        if model.recommended == ADAPTIVE:
            least *= model.expected["geometric"]
            own = costs.adaptive(t for t in model.bank if t not in model.reserve)
        errors, each = means / max(least, 1e-9), [costs.alone(t) for t in blocks.trials]
        ms = np.maximum(each, LEAST_COST) / max(own, LEAST_COST)
        dominates = (errors <= AS_GOOD) & (ms <= AS_GOOD) & (errors * ms < CHEAPER)
        if dominates.any():
            k = int(np.argmin(np.where(dominates, errors * ms, np.inf)))
            trial = blocks.trials[k]
            if trial in worse:
                why = "along whole recordings, without the health check, it is surely worse"
            elif tried is not whole and trial in whole.trials:
                why = "along whole recordings it is not better"
            else:
                why = why_not(blocks, trial, model.fixed)
            return (
                f"Trial {trial}, with {errors[k]:.2f} times the error for {ms[k]:.2f} times the "
                f"CPU time in training, is left out: {why}."
            )
    return ""


TIMED_SECONDS = 60.0
"""Of a recording, on which costs are measured."""


def measured_front(
    study: OfflineStudy, scans: Recording, progress: Progress = unseen
) -> list[dict[str, Any]]:
    """Drive the sets of a study's front along a recording, and rank them by what they cost here.

    Each drives alone, with the threads that the study gives it. Errors are those of training.

    Returns a row for each set: mean CPU time and the 99th percentile of the time a scan in
    milliseconds, memory in megabytes, and which one is recommended. There is an AdaptuneError if
    the study has no front yet, or the recording fewer than two scans.
    """
    path = study.folder / "front.json"
    if not path.exists():
        raise AdaptuneError(f"{path}: there is no such file; run `adaptune offline` before")
    if study.odometry.description.whole:
        raise AdaptuneError(f"{study.odometry.name}: runs whole recordings; time it by itself")
    sets = study.model().sets
    rows = [row for row in json.loads(path.read_text("utf-8")) if row["trial"] is not None]
    stamps = np.array([scan.stamp for scan in islice(scans, 2)])
    if len(stamps) < 2:
        raise AdaptuneError(f"{scans.name}: holds {len(stamps)} scans; two are the least")
    period = 1e-6 * float(np.diff(stamps)[0])
    n = max(2, min(round(1e3 * TIMED_SECONDS / period), scans.n_messages))
    for i, row in enumerate(rows):

        def watch(run: Run, before: int = i * n) -> None:
            progress("driving the front", before + run.done, n * len(rows))

        with closing(study.odometry(sets[row["trial"]], scans.name)) as odometry:
            run = replay(islice(scans, n), odometry, study.config.health, watch=watch)
            memory = odometry.usage.memory
        took = [step.prepare_seconds + step.register_seconds for step in run.steps]
        row[COST] = run.cpu_ms
        row["99 % [ms]"] = 1e3 * float(np.percentile(took, 99.0))
        row["memory [MB]"] = memory or run.memory
    best = recommended(rows, study.config.online.milliseconds(own_cost(rows)), period)
    return [row | {"recommended": row is best} for row in sorted(rows, key=lambda row: row[COST])]


def own_cost(rows: Sequence[dict[str, Any]]) -> float:
    """What the odometry's own parameters cost."""
    return float(next(row[COST] for row in rows if OWN in row["what"]))


def recommended(
    rows: Sequence[dict[str, Any]], budget: float | None, period: float
) -> dict[str, Any]:
    """The row with the least bound of its error within a budget that is in time.

    Budget and the time from scan to scan are in milliseconds. Where there is none, the cheapest.
    """
    most = allowed_cost(budget, own_cost(rows))
    few = [r for r in rows if r[COST] <= most and r["99 % [ms]"] <= MOST_OF_PERIOD * period]
    return min(few or rows, key=lambda row: row["bound"] if few else row[COST])
