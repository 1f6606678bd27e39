"""The gate: whether one side of the same recordings is worse than another."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from adaptune import manifest
from adaptune.errors import AdaptuneError
from adaptune.files import write_text
from adaptune.metrics import MIN_BLOCKS, RESAMPLES, resampled_means
from adaptune.report.tables import Listing, markdown
from adaptune.study.study import PER_STRETCH, Study, is_written_to
from online.compare import SEED, allowed, pooled_logs
from online.modes import BASELINE, FIXED
from online.record import StoredReplay
from online.statistics import ALL, Reference

Verdict = Literal["better", "worse", "equal", "unclear"]
"""`equal` is surely within the bound, `unclear` too little to tell."""
ERROR, COST, P99, LOST = "error", "cost", "cost, 99th percentile", "lost tracks"
_WARM_UP = 10
"""Scans whose costs do not count: caches fill."""
_SHARE = 0.05
"""Of the intervals of all recordings together, so many may miss the truth."""


class Bounds(NamedTuple):
    """By which share the new side may be worse."""

    error: float = 0.05
    cost: float = 0.10


class Side(NamedTuple):
    """Replays of one side."""

    name: str
    study: Study

    def replays(self) -> dict[str, Path]:
        """The folder of the replay of each sequence, by its name: of the fixed set, or baseline.

        An AdaptuneError says that there is none, or that they are still being made.
        """
        if is_written_to(self.study.folder):
            raise AdaptuneError(
                f"{self.study.folder}: another adaptune writes to it; run this again when that is "
                f"done"
            )
        for mode in (FIXED, BASELINE):
            made = sorted((self.study.folder / "replays").glob(f"*/{mode}/replay.json"))
            if made:
                return {path.parents[1].name: path.parent for path in made}
        raise AdaptuneError(
            f"{self.study.folder}: holds no replays; run `adaptune online` with this study first"
        )


@dataclass(frozen=True)
class GateRow:
    """One quantity on a recording, or over all of them."""

    recording: str
    quantity: str
    new: float | None
    old: float | None
    verdict: Verdict
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
            "of": self.quantity,
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
    """Both sides on a recording, at the same scans; new first."""

    name: str
    errors: NDArray[np.float64]  # (2, n): percent, where both are known
    seconds: NDArray[np.float64]  # (n,): of these scans
    costs: NDArray[np.float64]  # (2, m): milliseconds a scan
    block: int  # frames of a sub-trajectory
    lost: tuple[int, int]
    machines: tuple[str | None, str | None]
    reference: Reference


def judged(ratio: float, ends: tuple[float, float] | None, bound: float) -> Verdict:
    """What a ratio of new to old says, with its interval.

    It is worse beyond the bound, where the interval shows a loss; equal, or better, only where the
    interval ends below the bound.
    """
    if ends is None:
        return "unclear"
    low, high = ends
    if low > 1.0 and ratio > 1.0 + bound:
        return "worse"
    if high < 1.0:
        return "better"
    return "equal" if high <= 1.0 + bound else "unclear"


def compare_sides(new: Side, old: Side, bounds: Bounds) -> Gate:
    """Pair the replays of two sides by recording, and judge error, cost and lost tracks.

    Raises
    ------
    AdaptuneError
        If they have no recording in common, or what they share differs.
    """
    if new.study.config.sub_trajectory != old.study.config.sub_trajectory:
        lengths = [f"{side.study.config.sub_trajectory:g} m ({side.name})" for side in (new, old)]
        raise AdaptuneError(f"sub_trajectory: errors over {' and '.join(lengths)} do not compare")
    pairs, left_out = _pairs(new, old)
    rows: list[GateRow] = []
    for quantity, bound in ((ERROR, bounds.error), (COST, bounds.cost), (P99, bounds.cost)):
        rows += _rows(quantity, pairs, bound)
    lost = [(pair.name, *pair.lost) for pair in pairs]
    if len(pairs) > 1:
        lost.append((ALL, *np.sum([pair.lost for pair in pairs], axis=0).tolist()))
    for name, mine, others in lost:
        said: Verdict = "equal" if mine == others else "worse" if mine > others else "better"
        rows.append(GateRow(name, LOST, mine, others, said))
    verdict = _overall(rows)
    words = _in_words(new, old, verdict, rows)
    return Gate(verdict, rows, f"{words} Not compared: {left_out}." if left_out else words)


def _pairs(new: Side, old: Side) -> tuple[list[_Pair], str]:
    """The recordings of both sides, and in words those of one side only."""
    folders = [side.replays() for side in (new, old)]
    sides = [{name: StoredReplay.read(folder) for name, folder in of.items()} for of in folders]
    keys = [
        {_key(name, replay.summary.inputs): name for name, replay in of.items()} for of in sides
    ]
    if not (common := [key for key in keys[0] if key in keys[1]]):
        listed = "; ".join(
            f"{side.name} has {', '.join(of)}" for side, of in zip((new, old), sides, strict=True)
        )
        raise AdaptuneError(f"no recording is in both, by content and part: {listed}")
    pairs = []
    for key in common:
        name, other = (of[key] for of in keys)
        replays = sides[0][name], sides[1][other]
        _check_same(name, other, new, old, [replay.summary.inputs for replay in replays])
        pairs.append(_pair(name, replays, Reference.read(new.study, name)))
    alone = [
        f"{', '.join(of[key] for key in of if key not in common)} (only in {side.name})"
        for side, of in zip((new, old), keys, strict=True)
        if len(of) > len(common)
    ]
    return pairs, "; ".join(alone)


def _key(name: str, inputs: manifest.Inputs) -> str:
    """A recording by its content, and which part of it was driven."""
    settings = next(inputs[kind][name] for kind in ("sequences", "courses") if kind in inputs)
    part = [settings.get(key) for key in ("part", "start", "stop")]
    return manifest.digest([inputs["recording"][name], part])


def _check_same(
    name: str, other: str, new: Side, old: Side, inputs: Sequence[manifest.Inputs]
) -> None:
    """Refuse another reading of the same recording, and another reference."""
    scans = [
        {"reader": of["reader"], "settings": of.get("sequences", of.get("courses"))[own]}
        for own, of in zip((name, other), inputs, strict=True)
    ]
    if said := manifest.changes(scans[1], scans[0]):
        raise AdaptuneError(
            f"{name}: {new.name} and {old.name} read it differently: {'; '.join(said)}; replay "
            f"both alike"
        )
    found = [
        manifest.recorded(side.study.folder / "replays" / own / f"reference.{manifest.FILE}") or {}
        for side, own in ((new, name), (old, other))
    ]
    # Without the names of the sequence.
    references = [[list(v.values()) for v in of.values() if isinstance(v, dict)] for of in found]
    if references[0] != references[1]:
        raise AdaptuneError(
            f"{name}: {new.name} and {old.name} are judged by different references; name the same "
            f"in both"
        )


def _pair(name: str, replays: Sequence[StoredReplay], reference: Reference) -> _Pair:
    stamps = [replay.trajectory.stamps for replay in replays]
    common = np.intersect1d(*stamps)
    at = [np.isin(of, common) for of in stamps]
    errors = np.stack(
        [reference.errors(r.trajectory)[own] for r, own in zip(replays, at, strict=True)]
    )
    costs = np.stack(
        [
            (r.frames["prepare_ms"] + r.frames["register_ms"])[own]
            for r, own in zip(replays, at, strict=True)
        ]
    )[:, _WARM_UP:]
    known = np.isfinite(errors).all(axis=0)
    lost, machines = zip(*((r.summary.restarts, r.summary.machine) for r in replays), strict=True)
    return _Pair(
        name,
        errors[:, known],
        (common[known] - common[0]) * 1e-9,
        costs[:, np.isfinite(costs).all(axis=0)],
        reference.block,
        lost,
        machines,
        reference,
    )


def _rows(quantity: str, pairs: Sequence[_Pair], bound: float) -> list[GateRow]:
    """A row for each recording, and if there are several, one for all."""
    rng, rows, resampled = np.random.default_rng(SEED), list[GateRow](), []
    share = 100.0 * _SHARE / len(pairs)
    for pair in pairs:
        values = pair.errors if quantity == ERROR else pair.costs
        if why := _lacking(quantity, pair, values):
            rows.append(GateRow(pair.name, quantity, *_both(quantity, values), "unclear", why=why))
            continue
        new, old = _both(quantity, values)
        ratio = max(new, 1e-12) / max(old, 1e-12)
        logs = _resampled(quantity, values, _block(quantity, pair), rng)
        wider = allowed(values, pair.reference.error) if quantity == ERROR else (0.0, 0.0)
        same = bool((values[0] == values[1]).all())
        resampled.append(logs + (0.0 if same else np.where(logs < np.median(logs), *wider)))
        low, high = np.exp(np.percentile(resampled[-1], [share / 2, 100.0 - share / 2])).tolist()
        said = judged(ratio, (low, high), bound)
        stretches = _stretches(pair) if quantity == ERROR else ()
        row = GateRow(pair.name, quantity, new, old, said, ratio, low, high, "", stretches)
        rows.append(row)
    if len(pairs) < 2:
        return rows
    known = [row for row in rows if row.ratio is not None]
    if 2 * len(known) < len(rows) or not known:
        why = f"known on {len(known)} of {len(rows)} recordings"
        return [*rows, GateRow(ALL, quantity, None, None, "unclear", why=why)]
    new, old = (float(np.mean([getattr(row, of) for row in known])) for of in ("new", "old"))
    low, high = np.exp(pooled_logs(np.array(resampled), np.arange(len(known)), rng)).tolist()
    ratio = float(np.exp(np.mean(np.log([row.ratio for row in known]))))
    said = judged(ratio, (low, high), bound)
    why = "" if len(known) == len(rows) else f"known on {len(known)} of {len(rows)} recordings"
    return [*rows, GateRow(ALL, quantity, new, old, said, ratio, low, high, why)]


def _lacking(quantity: str, pair: _Pair, values: NDArray[np.float64]) -> str:
    """Why nothing can be said of a quantity; empty if it can."""
    if not values.shape[1]:
        return "no reference" if quantity == ERROR else "no times"
    if quantity != ERROR and (None in pair.machines or len({*pair.machines}) > 1):
        return "driven on different machines"
    same = (values[0] == values[1]).all()
    if not same and values.shape[1] < MIN_BLOCKS * _block(quantity, pair):
        return f"shorter than {MIN_BLOCKS} sub-trajectories"
    return ""


def _block(quantity: str, pair: _Pair) -> int:
    """Scans that are drawn together: errors share sub-trajectories, costs the scene."""
    return pair.block if quantity == ERROR else min(pair.block, _WARM_UP)


def _both(quantity: str, values: NDArray[np.float64]) -> list[Any]:
    """The quantity on both sides."""
    if not values.shape[1]:
        return [None, None]
    found = np.percentile(values, 99, axis=1) if quantity == P99 else values.mean(axis=1)
    return [float(value) for value in found]


def _resampled(
    quantity: str, values: NDArray[np.float64], block: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Logarithms of the ratio in resamples of blocks, the same on both sides, (RESAMPLES,)."""
    n = values.shape[1]
    block = min(block, n)
    if quantity != P99:
        means = np.maximum(resampled_means(values, block, rng), 1e-12)
        return np.asarray(np.log(means[0] / means[1]))
    starts = rng.integers(0, n - block + 1, (RESAMPLES, -(-n // block)))
    inside = np.arange(block)
    ends = [np.percentile(values[:, (s[:, None] + inside).ravel()], 99, axis=1) for s in starts]
    high = np.maximum(ends, 1e-12)
    return np.asarray(np.log(high[:, 0] / high[:, 1]))


def _stretches(pair: _Pair) -> tuple[tuple[float, float], ...]:
    """By stretch of `PER_STRETCH` sub-trajectories its first second, and the ratio there."""
    n = max(1, len(pair.seconds) // (PER_STRETCH * pair.block))
    parts = zip(
        np.array_split(pair.seconds, n), np.array_split(pair.errors, n, axis=1), strict=True
    )
    return tuple(
        (round(float(seconds[0]), 1), float(of[0].mean() / max(of[1].mean(), 1e-12)))
        for seconds, of in parts
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


_CALLED: Mapping[Verdict, str] = {
    "better": "Better",
    "worse": "WORSE",
    "equal": "Not worse",
    "unclear": "TOO LITTLE TO TELL",
}


def _in_words(new: Side, old: Side, verdict: Verdict, rows: Sequence[GateRow]) -> str:
    """The result in one line."""
    names = list(dict.fromkeys(row.recording for row in rows if row.recording != ALL))
    over_all = [row for row in rows if row.recording == ALL] or rows
    parts = []
    for row in over_all:
        if row.quantity == LOST:
            parts.append(f"{row.new} lost tracks instead of {row.old}")
        elif row.ratio is None:
            parts.append(f"{row.quantity} unclear ({row.why})")
        else:
            ends = f"{row.low:.2f}-{row.high:.2f}"
            parts.append(f"{row.quantity} x{row.ratio:.3f} ({ends}), {row.verdict}")
    wrong = [f"{r.recording} ({r.quantity})" for r in rows if r.verdict == "worse"]
    where = f" Worse: {', '.join(wrong)}." if wrong else ""
    n = f"{len(names)} recording{'s' * (len(names) > 1)}"
    return f"{_CALLED[verdict]}: {new.name} against {old.name}, {n}: {'; '.join(parts)}.{where}"


def write_gate(folder: Path, gate: Gate) -> None:
    """Write ``gate.json``, ``junit.xml`` and ``summary.md``, for a CI service."""
    data = {"verdict": gate.verdict, "words": gate.words, "rows": [asdict(r) for r in gate.rows]}
    write_text(folder / "gate.json", json.dumps(data, indent=1) + "\n")
    counts = {kind: str(sum(r.verdict == kind for r in gate.rows)) for kind in ("worse", "unclear")}
    about = {
        "tests": str(len(gate.rows)),
        "failures": counts["worse"],
        "skipped": counts["unclear"],
    }
    suite = Xml.Element("testsuite", name="adaptune compare", **about)
    for row in gate.rows:
        case = Xml.SubElement(suite, "testcase", classname=row.recording, name=row.quantity)
        shown = ", ".join(f"{k}: {v}" for k, v in row.columns().items() if v is not None)
        if row.verdict in ("worse", "unclear"):
            kind = "failure" if row.verdict == "worse" else "skipped"
            Xml.SubElement(case, kind, message=shown)
    write_text(folder / "junit.xml", Xml.tostring(suite, "unicode", xml_declaration=True) + "\n")
    listing = Listing(gate.words, [row.columns() for row in gate.rows])
    write_text(folder / "summary.md", markdown(listing))
