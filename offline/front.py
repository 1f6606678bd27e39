"""What CPU time buys: the front of error over cost, and what it costs on the machine at hand."""

import json
import time
from collections.abc import Sequence
from itertools import islice
from typing import Any

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.machine import resident_megabytes
from adaptune.model import ErrorModel
from adaptune.model.rules import BASELINE
from adaptune.odometry.tracker import Tracker
from adaptune.progress import Progress, unseen
from adaptune.recording.scan import Recording
from adaptune.space import in_words
from offline.choice import (
    MOST_OF_PERIOD,
    choose,
    front,
    left_out_ratio,
    mean_and_error,
    ratio_to_baseline,
)
from offline.config import OfflineStudy
from offline.labelled import LabelledData

COST = "cost [ms]"
"""Column of CPU time a scan, preparation included."""
MOST_ROWS = 5
"""Rows of the front, the baseline's included."""


def front_rows(data: LabelledData, model: ErrorModel) -> list[dict[str, Any]]:
    """Error over cost: the fixed set, the baseline, what costs more and errs less, and the bank.

    Errors are those of drives of whole recordings in training, with intervals of 95 % of their
    ratio to the baseline's.
    """
    blocks = data.whole_blocks(data.finalists())
    base = float(mean_and_error(blocks.errors, blocks.sequence)[0][blocks.baseline])

    def row(
        what: str, ratio: Sequence[float], cost: float, parameters: str, trial: int | None
    ) -> dict[str, Any]:
        value, low, high = ratio
        found = {"what": what, "error [%]": base * value, COST: cost, "vs baseline": value}
        found |= {"low": low, "high": high, "recommended": trial == model.fixed}
        return found | {"parameters": parameters, "trial": trial}

    rows = []
    others = [trial for trial in front(blocks) if trial not in (model.fixed, BASELINE)]
    for trial in list(dict.fromkeys([model.fixed, BASELINE, *others]))[: MOST_ROWS - 1]:
        what = "baseline" if trial == BASELINE else f"trial {trial}"
        ratio, cost = ratio_to_baseline(blocks, trial), (data.beside or data.costs).alone(trial)
        rows.append(row(what, ratio, cost, in_words(data.sets[trial]), trial))
    members = [trial for trial in model.bank if trial not in model.reserve]
    if (of_bank := model.expected) and len(members) > 1:
        by = (of_bank["geometric"], of_bank["low"], of_bank["high"])
        ratio = np.multiply(ratio_to_baseline(blocks, model.fixed), by).tolist()
        trials = f"trials {', '.join(map(str, members))}"
        rows.append(
            row(f"bank of {len(members)}", ratio, data.costs.adaptive(members), trials, None)
        )
    return [rows[0], *sorted(rows[1:], key=lambda row: row[COST])]


def left_out_in_words(data: LabelledData) -> str:
    """What to expect elsewhere of a set that is chosen as the fixed one is."""
    left_out = left_out_ratio(data.blocks(), lambda blocks: choose(blocks, data.budget))
    if left_out is None:
        return "To tell how a chosen set does on other drives, train on longer recordings, or more."
    ratio, low, high = left_out
    return (
        f"Sets chosen in the same way, without the part that they are tested on, have {ratio:.2f} "
        f"times the baseline's error there (95 % interval {low:.2f}-{high:.2f})."
    )


SECONDS = 60.0
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
    n = max(2, min(round(1e3 * SECONDS / period), scans.n_messages))
    for i, row in enumerate(rows):
        odometry = study.odometry(sets[row["trial"]], scans.name)
        tracker, took, prepared = Tracker(odometry, study.config.health), [], 0.0
        try:
            for j, scan in enumerate(islice(scans, n)):
                begin, cpu = time.perf_counter(), time.process_time()
                ready = odometry.prepare(scan)
                prepared += time.process_time() - cpu
                tracker.register_prepared(scan.stamp, ready, scan=scan)
                took.append(time.perf_counter() - begin)
                progress("driving the front", i * n + j + 1, n * len(rows))
            used = odometry.usage
        finally:
            odometry.close()
        row[COST] = 1e3 * (prepared + used.cpu) / len(took)
        row["99 % [ms]"] = 1e3 * float(np.percentile(took, 99.0))
        row["memory [MB]"] = used.memory or resident_megabytes()
    best = recommended(rows, study.config.online.budget, period)
    return [row | {"recommended": row is best} for row in sorted(rows, key=lambda row: row[COST])]


def recommended(
    rows: Sequence[dict[str, Any]], budget: float | None, period: float
) -> dict[str, Any]:
    """The row with the least error within a budget, or what the baseline costs, that is in time.

    Budget and the time from scan to scan are in milliseconds. Where there is none, the cheapest.
    """
    base = next(row[COST] for row in rows if row["trial"] == BASELINE)
    most = base if budget is None else budget
    few = [r for r in rows if r[COST] <= most and r["99 % [ms]"] <= MOST_OF_PERIOD * period]
    return min(few or rows, key=lambda row: row["error [%]"] if few else row[COST])
