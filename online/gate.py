"""The gate: whether one side of the same recordings is worse than another."""

import json
from collections.abc import Iterable, Sequence
from functools import reduce
from pathlib import Path
from typing import Any, Literal, NamedTuple
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from adaptune import manifest
from adaptune.errors import AdaptuneError
from adaptune.files import write_text
from adaptune.metrics import MIN_BLOCKS, RESAMPLES
from adaptune.odometry.faults import MAX_SHARE_WITHOUT_POSE
from adaptune.report.tables import Listing, markdown
from adaptune.study.driven import MIN_RECORDINGS, PER_STRETCH
from adaptune.study.study import Study, is_written_to
from online.compare import SEED, allowed, pooled_logs, resampled_logs
from online.modes import BASELINE, FIXED
from online.record import StoredReplay
from online.reference import Reference
from online.statistics import ALL

Verdict = Literal["better", "worse", "equal", "unclear"]
"""`equal` is surely within the bound, `unclear` too little to tell."""
ERROR, COST, P99 = "error", "cost", "cost, 99th percentile"
RESTARTS, LACKING = "restarts", "scans without a pose"
_UNITS = {ERROR: "RTE [%]", COST: "cost [ms]", P99: "cost, 99th percentile [ms]"}
"""Quantities as tables name them."""
_WARM_UP, _COSTS = 10, 5
"""Scans whose costs do not count, because caches fill, and scans whose costs are drawn together."""
_SHARE = 0.05
"""Of the intervals of all recordings together, so many may miss the truth."""


class Side(NamedTuple):
    """Replays of one side."""

    name: str
    study: Study

    def replays(self) -> dict[str, StoredReplay]:
        """The replay of each sequence, by its name: of the fixed set, or of the baseline.

        An AdaptuneError says that there is none, or that they are still being made.
        """
        if is_written_to(self.study.folder):
            raise AdaptuneError(
                f"{self.study.folder}: another adaptune writes to it; run this again when that is "
                f"done"
            )
        for mode in (FIXED, BASELINE):
            made = sorted((self.study.folder / "replays").glob(f"*/{mode}/replay.json"))
            found = {path.parents[1].name: path.parent for path in made}
            # Earlier ones may be of recordings that the study does not name any more.
            named = {*self.study.config.sequences, *self.study.config.courses}
            if there := {n: StoredReplay.read(at) for n, at in found.items() if n in named}:
                return there
        raise AdaptuneError(
            f"{self.study.folder}: holds no replays; run `adaptune online` with this study first"
        )


class GateRow(NamedTuple):
    """One quantity on a recording, or over all of them."""

    recording: str
    quantity: str
    new: float | None = None
    old: float | None = None
    verdict: Verdict = "unclear"
    ratio: float | None = None
    low: float | None = None  # ends of the ratio's interval
    high: float | None = None
    why: str = ""
    # Of errors: by stretch, seconds from the first scan and the ratio there.
    stretches: tuple[tuple[float, float], ...] = ()

    def columns(self) -> dict[str, Any]:
        """The row of a table."""
        ends = None if self.low is None else f"{self.low:.3f}-{self.high:.3f}"
        worst = max(self.stretches, key=lambda stretch: stretch[1], default=None)
        return {
            "recording": self.recording,
            "of": _UNITS.get(self.quantity, self.quantity),
            "new": self.new,
            "old": self.old,
            "ratio": self.ratio,
            "interval": ends,
            "verdict": self.verdict + (f": {self.why}" if self.why else ""),
            "worst stretch": worst and f"{worst[1]:.2f} at {worst[0]:.0f} s",
        }


class Gate(NamedTuple):
    """The result."""

    verdict: Verdict
    rows: list[GateRow]
    words: str  # in one line


class _Pair(NamedTuple):
    """Both sides on a recording, new first, at the same scans."""

    name: str
    errors: NDArray[np.float64]  # (2, n): percent, where both are known
    costs: NDArray[np.float64]  # (2, n_costs): milliseconds
    block: int  # scans whose errors are drawn together
    seconds: NDArray[np.float64]  # (n,): from the first scan, of the errors
    counts: dict[str, tuple[int, int, int]]  # of both sides, and how much may be chance
    obstacle: str  # why costs say nothing
    reference_error: float | None


def judged(ratio: float, ends: tuple[float, float], bound: float) -> Verdict:
    """What a ratio of new to old says, with its interval.

    It is worse beyond the bound, where the interval shows a loss; equal, or better, only where the
    interval ends below the bound.
    """
    low, high = ends
    if low > 1.0 and ratio > 1.0 + bound:
        return "worse"
    if high < 1.0:
        return "better"
    return "equal" if high <= 1.0 + bound else "unclear"


def compare_sides(new: Side, old: Side, error: float = 0.05, cost: float = 0.1) -> Gate:
    """Pair the replays of two sides by recording, and judge error, cost and restarts.

    The new side's error and cost may be larger by these shares.

    Raises
    ------
    AdaptuneError
        If they have no recording in common, or what they share differs.
    """
    if new.study.config.sub_trajectory != old.study.config.sub_trajectory:
        lengths = [f"{side.study.config.sub_trajectory:g} m ({side.name})" for side in (new, old)]
        raise AdaptuneError(f"sub_trajectory: errors over {' and '.join(lengths)} do not compare")
    # A program that runs whole recordings has no cost of each scan.
    whole = any(side.study.odometry.description.whole for side in (new, old))
    pairs, left_out = _pairs(new, old, whole)
    rows = _rows(ERROR, pairs, error)
    for quantity in (COST,) if whole else (COST, P99):
        rows += _rows(quantity, pairs, cost)
    for quantity in (RESTARTS, LACKING):
        counts = [(pair.name, *pair.counts[quantity]) for pair in pairs]
        if len(pairs) > 1:
            counts.append((ALL, *np.sum([count[1:] for count in counts], axis=0).tolist()))
        for name, mine, others, chance in counts:
            apart = mine - others if abs(mine - others) > chance else 0
            said: Verdict = "worse" if apart > 0 else "better" if apart else "equal"
            if quantity == RESTARTS or any(count[1] or count[2] for count in counts):
                rows.append(GateRow(name, quantity, mine, others, said))
    verdict = _overall(rows)
    words = _in_words(new, old, verdict, rows)
    return Gate(verdict, rows, words + (f" Not compared: {left_out}." if left_out else ""))


def _pairs(new: Side, old: Side, whole: bool) -> tuple[list[_Pair], str]:
    """The recordings of both sides, and in words those of one side only."""
    sides = new.replays(), old.replays()
    named = [{_key(n, replay.summary.inputs): n for n, replay in side.items()} for side in sides]
    common = [key for key in named[0] if key in named[1]]
    alone = "; ".join(
        f"{', '.join(names[key] for key in names if key not in common)} (only in {side.name})"
        for side, names in zip((new, old), named, strict=True)
        if len(names) > len(common)
    )
    if not common:
        raise AdaptuneError(f"no recording is in both, by content and part: {alone}")
    pairs = []
    for name, other in ((named[0][key], named[1][key]) for key in common):
        replays = sides[0][name], sides[1][other]
        lacking, n = replays[1].summary.unhealthy.get("no_pose", 0), replays[1].summary.scans
        if lacking >= MAX_SHARE_WITHOUT_POSE * n:
            raise AdaptuneError(
                f"{other}: {old.name} gives no pose for {lacking} of {n} scans, so nothing "
                f"compares with it; mend it, or leave the recording out"
            )
        _check_same((name, other), (new, old), [replay.summary.inputs for replay in replays])
        pairs.append(_pair(name, replays, Reference.read(new.study, name), whole))
    return pairs, alone


def _settings(name: str, inputs: manifest.Inputs) -> dict[str, Any]:
    return dict(inputs["sequences" if "sequences" in inputs else "courses"][name])


def _key(name: str, inputs: manifest.Inputs) -> str:
    """A recording by its content, and which part of it was driven."""
    part = [_settings(name, inputs).get(key) for key in ("part", "start", "stop")]
    return manifest.digest([inputs["recording"][name], part])


def _check_same(
    names: Sequence[str], sides: Sequence[Side], inputs: Sequence[manifest.Inputs]
) -> None:
    """Refuse another reading of the same recording, and another reference."""
    both = f"{names[0]}: {sides[0].name} and {sides[1].name}"
    new, old = (
        {"reader": made_from["reader"], "settings": _settings(name, made_from)}
        for name, made_from in zip(names, inputs, strict=True)
    )
    if said := manifest.changes(old, new):
        raise AdaptuneError(f"{both} read it differently: {'; '.join(said)}; replay both alike")
    paths = (
        side.study.folder / "replays" / name / f"reference.{manifest.FILE}"
        for side, name in zip(sides, names, strict=True)
    )
    # Without the names of the sequence.
    mine, other = (
        [list(v.values()) for v in (manifest.recorded(path) or {}).values() if isinstance(v, dict)]
        for path in paths
    )
    if mine != other:
        raise AdaptuneError(f"{both} are judged by different references; name the same in both")


def _pair(name: str, replays: Sequence[StoredReplay], reference: Reference, whole: bool) -> _Pair:
    common = reduce(np.intersect1d, (replay.trajectory.stamps for replay in replays))
    errors, costs = [], []
    new, old = (replay.summary for replay in replays)
    few = new.scans // 100  # of which one side may lack the poses by chance
    for replay in replays:
        kept = np.isin(replay.trajectory.stamps, common)
        errors.append(reference.errors(replay.trajectory)[kept])
        costs.append((replay.frames["prepare_ms"] + replay.frames["register_ms"])[kept])
    known = np.isfinite(errors).all(axis=0)
    cost = np.array(costs)[:, _WARM_UP:]
    if whole:
        cost = np.array([[replay.summary.cpu_ms or np.nan] for replay in replays])
    cost = cost[:, np.isfinite(cost).all(axis=0)]
    machines = {replay.summary.machine for replay in replays}
    why = "" if cost.shape[1] else "no times"
    if None in machines or len(machines) > 1:
        why = "driven on different machines"
    return _Pair(
        name,
        np.array(errors)[:, known],
        cost,
        reference.block,
        (common[known] - common[0]) * 1e-9,
        {RESTARTS: (new.restarts, old.restarts, 0), LACKING: (new.lacking, old.lacking, few)},
        why,
        reference.error,
    )


def _rows(quantity: str, pairs: Sequence[_Pair], bound: float) -> list[GateRow]:
    """A row for each recording, and if there are several, one for all."""
    rng, rows, pooled = np.random.default_rng(SEED), list[GateRow](), list[Any]()
    share = 100.0 * _SHARE / len(pairs)
    for pair in pairs:
        values, block, why = pair.costs, _COSTS, pair.obstacle
        if quantity == ERROR:
            values, block = pair.errors, pair.block
            why = "" if values.shape[1] else "no reference"
        if why:
            rows.append(GateRow(pair.name, quantity, why=why))
            continue
        both = np.percentile(values, 99, axis=1) if quantity == P99 else values.mean(axis=1)
        new, old = both.tolist()
        few = "one figure a run" if quantity == COST and values.shape[1] == 1 else "too short"
        row = GateRow(pair.name, quantity, new, old, ratio=new / max(old, 1e-12), why=few)
        same = bool((values[0] == values[1]).all())
        resampled = _resampled_p99 if quantity == P99 else resampled_logs
        logs = resampled(values, block, rng)
        if quantity == ERROR:
            row = row._replace(stretches=_stretches(pair))
            if not same:
                logs += np.where(logs < np.median(logs), *allowed(values, pair.reference_error))
        enough = same or values.shape[1] >= MIN_BLOCKS * block
        if enough:
            ends = np.percentile(logs, [share / 2, 100.0 - share / 2])
            row = _judged(row._replace(why=""), ends, bound)
        if enough or len(pairs) >= MIN_RECORDINGS:
            pooled.append((new, old, row.ratio, logs))
        rows.append(row)
    return [*rows, _over_all(quantity, pooled, len(pairs), bound)] if len(pairs) > 1 else rows


def _over_all(quantity: str, pooled: Sequence[Any], n: int, bound: float) -> GateRow:
    """The row of all recordings: geometric mean of the ratios, and its interval."""
    why = "" if len(pooled) == n else f"known on {len(pooled)} of {n} recordings"
    row = GateRow(ALL, quantity, why=why)
    if 2 * len(pooled) < n or not pooled:
        return row
    new, old, ratios, logs = map(np.array, zip(*pooled, strict=True))
    ends = pooled_logs(logs, np.arange(len(logs)), np.random.default_rng(SEED))
    ratio = float(np.exp(np.log(np.maximum(ratios, 1e-12)).mean()))
    row = row._replace(new=float(new.mean()), old=float(old.mean()), ratio=ratio)
    return _judged(row, ends, bound)


def _judged(row: GateRow, ends: Iterable[float], bound: float) -> GateRow:
    low, high = (float(np.exp(end)) for end in ends)
    return row._replace(low=low, high=high, verdict=judged(row.ratio or 0.0, (low, high), bound))


def _resampled_p99(
    values: NDArray[np.float64], block: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """As `resampled_logs`, but of the ratio of 99th percentiles."""
    n = values.shape[1]
    block = min(block, n)
    starts = rng.integers(0, n - block + 1, (RESAMPLES, -(-n // block), 1))
    drawn = (starts + np.arange(block)).reshape(RESAMPLES, -1)
    values = np.maximum(values, 1e-12)
    new, old = np.array([np.percentile(values[:, frames], 99, axis=1) for frames in drawn]).T
    return np.asarray(np.log(new / old))


def _stretches(pair: _Pair) -> tuple[tuple[float, float], ...]:
    """By stretch of `PER_STRETCH` sub-trajectories its first second, and the ratio there."""
    n = max(1, len(pair.seconds) // (PER_STRETCH * pair.block))
    parts = np.array_split(np.vstack([pair.seconds, pair.errors]), n, axis=1)
    return tuple(
        (round(float(t[0]), 1), float(new.mean() / max(old.mean(), 1e-12))) for t, new, old in parts
    )


def _overall(rows: Sequence[GateRow]) -> Verdict:
    """Worse if anything is; better or equal only where each quantity over all tells."""
    verdicts = {row.verdict for row in rows}
    if "worse" in verdicts:
        return "worse"
    over_all = [row for row in rows if row.recording == ALL] or rows
    if any(row.verdict == "unclear" for row in over_all):
        return "unclear"
    return "better" if any(row.verdict == "better" for row in over_all) else "equal"


def _in_words(new: Side, old: Side, verdict: Verdict, rows: Sequence[GateRow]) -> str:
    said = {"better": "Better", "worse": "WORSE", "equal": "Not worse"}
    names = list(dict.fromkeys(row.recording for row in rows if row.recording != ALL))
    over_all = [row for row in rows if row.recording == ALL] or rows
    parts = []
    for row in over_all:
        if row.quantity in (RESTARTS, LACKING):
            by = " by the health check" * (row.quantity == RESTARTS)
            parts.append(f"{row.new} {row.quantity}{by} instead of {row.old}")
        elif row.low is None:
            parts.append(f"{row.quantity} unclear ({row.why})")
        else:
            ends = f"{row.low:.2f}-{row.high:.2f}"
            parts.append(f"{row.quantity} x{row.ratio:.3f} ({ends}), {row.verdict}")
    wrong = [f"{r.recording} ({r.quantity})" for r in rows if r.verdict == "worse"]
    where = f" Worse: {', '.join(wrong)}." if wrong else ""
    n = f"{len(names)} recording{'s' * (len(names) > 1)}"
    first = said.get(verdict, "TOO LITTLE TO TELL")
    return f"{first}: {new.name} against {old.name}, {n}: {'; '.join(parts)}.{where}"


def write_gate(folder: Path, gate: Gate) -> None:
    """Write ``gate.json``, ``junit.xml`` and ``summary.md``, for a CI service."""
    data = {"verdict": gate.verdict, "words": gate.words, "rows": [r._asdict() for r in gate.rows]}
    write_text(folder / "gate.json", json.dumps(data, indent=1) + "\n")
    suite = Xml.Element("testsuite", name="adaptune compare", tests=str(len(gate.rows)))
    for row in gate.rows:
        case = Xml.SubElement(suite, "testcase", classname=row.recording, name=row.quantity)
        if kind := {"worse": "failure", "unclear": "skipped"}.get(row.verdict):
            shown = ", ".join(f"{k}: {v}" for k, v in row.columns().items() if v is not None)
            Xml.SubElement(case, kind, message=shown)
    for counted, kind in (("failures", "failure"), ("skipped", "skipped")):
        suite.set(counted, str(len(suite.findall(f"testcase/{kind}"))))
    write_text(folder / "junit.xml", Xml.tostring(suite, "unicode", xml_declaration=True) + "\n")
    listing = Listing(gate.words, [row.columns() for row in gate.rows])
    write_text(folder / "summary.md", markdown(listing))
