"""The verdict of a study: the table of what may be driven, and a file for programs."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from adaptune._system.files import write_text
from adaptune._system.manifest import plain
from adaptune.model.registry import ADAPTIVE
from adaptune.report.tables import Listing
from adaptune.study.driven import COST, ERROR, OWN
from offline.choice import USUAL_BUDGET
from offline.config import OfflineStudy
from online.compare import Comparison
from online.modes import BASELINE

VERDICT = "verdict.json"


def front_table(
    study: OfflineStudy, rows: Sequence[Mapping[str, Any]], title: str = "What each choice gives"
) -> Listing:
    """What may be driven, in training or on the test, and how: rows of a front, or `choices`."""
    cells, metres = [], f"{study.config.sub_trajectory:g} m"
    for row in rows:
        what, *_ = row["what"].split(", ")
        trial, of = row["trial"], f" ({row['odometry']})" if row["odometry"] else ""
        name = "-> " * row["recommended"] + what + (f": trial {trial}" if trial else "") + of
        low, high, file = row["low"], row["high"], row["file"]
        use = f"{'load' if file.endswith('.yaml') else 'run'} {file}" if file else None
        cell = {"choice": name + "*" * (row.get("driven on") == "training")}
        cell |= {"RTE [%]": row[ERROR]}
        cell["another drive"] = low and ("1" if low == high else f"{low:.2f}-{high:.2f}")
        cell |= {key: row[key] for key in (COST, "99 % [ms]", "memory [MB]") if key in row}
        cell["to drive it"] = "change nothing" if what == OWN else use
        cells.append(cell | {"parameters": row["parameters"]})
    said = [
        "Another drive: the error there, in times that of the odometry's own parameters, 95 %.",
        _of_training(rows) if any("*" in cell["choice"] for cell in cells) else "",
        f"RTE: mean error of the parts of the path that are {metres} long. Cost: CPU time a scan.",
        f"Files: {study.folder}.",
    ]
    own = None if study.fixed is None else study.own_file(study.fixed)
    if own is not None and own[0].exists():
        said.append(f"For the odometry's own tool: {own[0].name} ({own[1].use}).")
    if any(row["what"] == ADAPTIVE for row in rows):
        said.append(
            f"The bank, on a robot: `adaptune online {study.folder} --ros2 --mode adaptive`."
        )
    return Listing(f"{title} over {metres}", cells, " ".join(filter(None, said)))


def _of_training(rows: Sequence[Mapping[str, Any]]) -> str:
    """Which rows are of training, and what the odometry's own parameters have there."""
    known = (row["in training"] for row in rows if row["what"] == OWN and "in training" in row)
    there = (f", where own parameters have {error:.3g} % at {ms:.1f} ms" for error, ms in known)
    return f"* Error and cost are of training{next(there, '')}."


def write_verdict(study: OfflineStudy, found: Comparison) -> None:
    """Write ``verdict.json`` into the study's folder: what to do, what that gives, and why."""
    config, model = study.config, found.model
    row = next((row for row in found.front if row["recommended"]), dict[str, Any]())
    mode, trial = row.get("mode"), row.get("trial")
    last = next((one for one in found.rows[::-1] if one.mode == mode), None)
    ratio = None if last is None else last.against.get(BASELINE)
    action = "keep" if row.get("what") == OWN else "drive" if row else found.advised or "unknown"
    data = {
        "action": action,
        "odometry": row.get("odometry") or next(iter(config.odometries)),
        "mode": mode,
        "set": trial,
        "parameters": None if model is None or trial is None else model.sets[trial],
        "file": row.get("file") or None,
        "error_percent": row.get(ERROR),
        "cost_ms": row.get(COST),
        "ratio": ratio and ratio.value,
        "interval": ratio and ratio.interval,
        "on_another_drive": [row["low"], row["high"]] if row else None,
        "budget": config.online.budget or f"{USUAL_BUDGET:g}x",
        "why": found.verdict,
        "front": found.front,
    }
    write_text(study.folder / VERDICT, json.dumps(plain(data), indent=1) + "\n")
