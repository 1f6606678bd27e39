"""The gate: a comparison whose modes are a new and an old side of the same recordings."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple
from xml.etree import ElementTree as Xml

import numpy as np
from numpy.typing import NDArray

from adaptune._system import manifest
from adaptune._system.files import write_text
from adaptune.errors import AdaptuneError
from adaptune.odometry.faults import MAX_SHARE_WITHOUT_POSE
from adaptune.paired import Pair, Ratio, in_cell, ratio
from adaptune.report.tables import Listing, markdown
from adaptune.runs.files import read_run, read_summary
from adaptune.space import load_space
from adaptune.study.driven import PER_SEGMENT
from adaptune.study.study import Study, is_written_to
from online.modes import BASELINE, FIXED
from online.reference import read_reference
from online.statistics import ALL
from online.turns import COST, P99, Costs, StoredReplay, cost_ratios

Verdict = Literal["better", "worse", "equal", "unclear"]
"""`equal` is surely within the bound, `unclear` too little to tell."""
ERROR, RESTARTS, LACKING = "error", "restarts", "scans without a pose"
_UNITS = {ERROR: "RTE [%]", COST: "cost [ms]", P99: f"{P99} [ms]"}
"""Quantities as tables name them."""
_SHARE = 0.05
"""Of the comparisons of equal sides, so many may find one worse."""
_NO_COST = 0.5
"""Milliseconds a scan by which the same code differs, where other work shares the caches."""


def stored_replays(study: Study, mode: str) -> dict[str, StoredReplay]:
    """What was replayed with the set of a mode, by content and part of the recording."""

    def is_of_mode(inputs: manifest.Inputs) -> bool:
        space = load_space(inputs["odometry"]["parameters"])
        wanted = study.fixed if mode == FIXED else space.baseline
        return wanted is not None and inputs["parameters"] == wanted

    # Earlier ones may be of recordings that the study does not name any more.
    found = [
        StoredReplay(study, name, path.parent, read_summary(path.parent))
        for name in sorted([*study.config.sequences, *study.config.courses])
        for path in (study.folder / "replays" / name).glob("*/replay.json")
    ]
    found = [one for one in found if is_of_mode(one.summary.inputs)]
    # Of several, that which would be made now, or the last one.
    found.sort(key=lambda one: (not one.obstacle, one.made))
    return {_key(one): one for one in found}


class PairedReplays(NamedTuple):
    """Both sides on a recording, new first."""

    both: tuple[StoredReplay, StoredReplay]
    pair: Pair  # the errors, at the scans where both are known
    seconds: NDArray[np.float64]  # (n,): of these, from the first scan
    restarts: tuple[int, int]
    lost: tuple[int, int]  # places where only one was restarted

    @property
    def name(self) -> str:
        """The new side's."""
        return self.both[0].name


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
    # Of errors: by segment, seconds from the first scan and the ratio there.
    segments: tuple[tuple[float, float], ...] = ()

    def columns(self) -> dict[str, Any]:
        """The row of a table."""
        ends = None if self.low is None or self.high is None else (self.low, self.high)
        worst = max(self.segments, key=lambda segment: segment[1], default=None)
        return {
            "recording": self.recording,
            "of": _UNITS.get(self.quantity, self.quantity),
            "new": self.new,
            "old": self.old,
            "ratio": self.ratio,
            "interval": ends and in_cell(ends, 3),
            "verdict": self.verdict + (f": {self.why}" if self.why else ""),
            "worst segment": worst and f"{worst[1]:.2f} at {worst[0]:.0f} s",
        }


class Gate(NamedTuple):
    """The result."""

    verdict: Verdict
    rows: list[GateRow]
    words: str  # in one line
    odometry: str = ""  # the new side's
    mode: str = ""  # in which both were driven
    length: float = np.nan  # metres over which errors are measured


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


class SharedReplays(NamedTuple):
    """What both sides have replayed."""

    new: Study
    old: Study
    mode: str
    pairs: list[PairedReplays]
    alone: str  # in words, the recordings of one side only


def shared_replays(new: Study, old: Study) -> SharedReplays:
    """Pair the replays of two sides by recording, in the mode that both have: fixed, or baseline.

    Raises
    ------
    AdaptuneError
        If they have no recording in common, what they share differs, or a side is being driven.
    """
    for side in (new, old):
        if is_written_to(side.folder):
            raise AdaptuneError(
                f"{side.folder}: another adaptune writes to it; run this again when that is done"
            )
    if new.config.sub_trajectory != old.config.sub_trajectory:
        lengths = [f"{side.config.sub_trajectory:g} m ({side.name})" for side in (new, old)]
        raise AdaptuneError(
            f"sub_trajectory: errors over {' and '.join(lengths)} do not compare; give both the "
            f"same with --sub-trajectory"
        )
    found = {m: (stored_replays(new, m), stored_replays(old, m)) for m in (FIXED, BASELINE)}
    for i, side in enumerate((new, old)):
        if not any(both[i] for both in found.values()):
            raise AdaptuneError(
                f"{side.folder}: holds no replays; run `adaptune online` with this study first"
            )
    if not any(mine and others for mine, others in found.values()):
        first, second = (next(m for m, both in found.items() if both[i]) for i in (0, 1))
        raise AdaptuneError(
            f"{new.name} was replayed as `{first}` only, and {old.name} as `{second}`; run "
            f"`adaptune online` with both"
        )
    common = {m: [key for key in mine if key in others] for m, (mine, others) in found.items()}
    mode = max(common, key=lambda mode: len(common[mode]))
    alone = "; ".join(
        f"{', '.join(one.name for key, one in own.items() if key not in common[mode])} "
        f"(only in {side.name})"
        for side, own in zip((new, old), found[mode], strict=True)
        if len(own) > len(common[mode])
    )
    if not common[mode]:
        raise AdaptuneError(f"no recording is in both, by content and part: {alone}")
    mine, others = found[mode]
    pairs = [_paired((mine[key], others[key])) for key in common[mode]]
    return SharedReplays(new, old, mode, pairs, alone)


def _key(one: StoredReplay) -> str:
    """A recording by its content, and which part of it was driven."""
    inputs = one.summary.inputs
    part = [_settings(one).get(key) for key in ("part", "start", "stop")]
    return manifest.digest([inputs["recording"][one.name], part])


def _settings(one: StoredReplay) -> dict[str, Any]:
    inputs = one.summary.inputs
    return dict(inputs["sequences" if "sequences" in inputs else "courses"][one.name])


def _check_same(both: Sequence[StoredReplay]) -> None:
    """Refuse another pace, another reading of the same recording, and another reference."""
    words = f"{both[0].name}: {' and '.join(one.study.name for one in both)}"
    inputs = [one.summary.inputs for one in both]
    paces = [of["real_time"] for of in inputs]
    if paces[0] != paces[1]:
        given = " and ".join(map(json.dumps, paces))
        raise AdaptuneError(
            f"{words} were replayed with other values of online.real_time: {given}; replay both "
            f"alike"
        )
    new, old = (
        {"reader": of["reader"], "settings": _settings(one)}
        for of, one in zip(inputs, both, strict=True)
    )
    if said := manifest.changes(old, new):
        raise AdaptuneError(f"{words} read it differently: {'; '.join(said)}; replay both alike")
    # Without the names of the sequence.
    references = (one.study.sequences.reference(one.name) for one in both)
    mine, other = ([list(about.values()) for about in of.values()] for of in references)
    if mine != other:
        raise AdaptuneError(f"{words} are judged by different references; name the same in both")


def _paired(both: tuple[StoredReplay, StoredReplay]) -> PairedReplays:
    _check_same(both)
    new, old = both[0], both[1].summary
    if (lacking := old.unhealthy.get("no_pose", 0)) >= MAX_SHARE_WITHOUT_POSE * old.scans:
        raise AdaptuneError(
            f"{both[1].name}: {both[1].study.name} gives no pose for {lacking} of {old.scans} "
            f"scans, so nothing compares with it; mend it, or leave the recording out"
        )
    mine, other = (read_run(one.folder) for one in both)
    stamps = np.intersect1d(mine.trajectory.stamps, other.trajectory.stamps)
    reference = read_reference(new.study, new.name)
    kept = [(replay, np.isin(replay.trajectory.stamps, stamps)) for replay in (mine, other)]
    errors = np.array([reference.errors(replay.trajectory)[at] for replay, at in kept])
    restarted = np.array([replay.restarted[at] for replay, at in kept])
    known = np.isfinite(errors).all(axis=0)
    recording = manifest.digest(new.summary.inputs["recording"][new.name])
    pair = Pair(errors[:, known], reference.block, recording, reference.error)
    restarts = new.summary.restarts, old.restarts
    seconds = (stamps[known] - stamps[0]) * 1e-9
    return PairedReplays(both, pair, seconds, restarts, _places(restarted, reference.block))


def _places(restarted: NDArray[np.bool_], block: int) -> tuple[int, int]:
    """Places where only the new side was restarted, and only the old one.

    A place is one sub-trajectory, or several that follow each other.
    """
    starts = np.arange(0, restarted.shape[1], block)
    in_place = np.logical_or.reduceat(restarted, starts, axis=1)
    only = np.pad(in_place & ~in_place[::-1], ((0, 0), (1, 0)))
    first, second = (only[:, 1:] & ~only[:, :-1]).sum(axis=1).tolist()
    return first, second


def compare_sides(
    shared: SharedReplays, costs: Mapping[str, Costs | str] | None, error: float, cost: float
) -> Gate:
    """Judge error, cost and restarts; the new side's may be larger by the shares `error`, `cost`.

    `costs` are by recording, or why they are not known; None where they are no matter. Of equal
    sides, one in twenty may be found worse, whatever the number of quantities and recordings.
    """
    pairs, given, rows = shared.pairs, costs or {}, list[GateRow]()
    known = {name: of for name, of in given.items() if not isinstance(of, str)}
    quantities = list(dict.fromkeys(key for of in known.values() for key in of))
    quantities = quantities or [COST] * bool(given)
    share = _SHARE / (2 + len(quantities))
    # Of both ends of an interval, one finds a side worse.
    each = 2.0 * share / (len(pairs) + (len(pairs) > 1))
    judges = {pair.name: pair.pair for pair in pairs if pair.pair.errors.size}
    groups = [*([one] for one in judges.values()), [*judges.values()]]
    ratios = [ratio(group, each) for group in groups if group]
    means = {name: one.errors.mean(axis=1) for name, one in judges.items()}
    segments = {pair.name: _segments(pair) for pair in pairs if pair.name in judges}
    for row in _rows(ERROR, pairs, means, ratios, error, {}):
        rows.append(row._replace(segments=segments.get(row.recording, ())))
    for quantity in quantities:
        of = {pair.name: known[pair.name][quantity] for pair in pairs if pair.name in known}
        means = {name: one.mean(axis=(1, 2)) for name, one in of.items()}
        names = [pair.pair.recording for pair in pairs if pair.name in of]
        ratios = cost_ratios(list(of.values()), names, each) if of else []
        rows += _rows(quantity, pairs, means, ratios, cost, given, _NO_COST)
    rows += [_restarts(pairs, share), *_lacking(pairs)]
    verdict = _overall(rows)
    left_out = f" Not compared: {shared.alone}." if shared.alone else ""
    words, study = _in_words(shared, verdict, rows) + left_out, shared.new
    length = study.config.sub_trajectory
    return Gate(verdict, rows, words, study.odometry.name, shared.mode, length)


def _rows(
    quantity: str,
    pairs: Sequence[PairedReplays],
    means: Mapping[str, NDArray[np.float64]],
    ratios: Sequence[Ratio],
    bound: float,
    why: Mapping[str, Any],
    least: float = 0.0,
) -> list[GateRow]:
    """A row for each recording, and if there are several, one for all.

    `means` are those of both sides by recording, where they are known, `ratios` in the same order,
    the last one that of all; `why` says why they are not. The `bound` is `least` at least.
    """
    of, n, rows = dict(zip(means, ratios, strict=False)), len(pairs), list[GateRow]()

    def judge(row: GateRow, means: NDArray[np.float64], found: Ratio) -> GateRow:
        new, old = means.tolist()
        row = row._replace(new=new, old=old, ratio=found.value, why="too short")
        if found.interval is None:
            return row
        low, high = found.interval
        said = judged(found.value, found.interval, max(bound, least / max(old, 1e-12)))
        return row._replace(low=low, high=high, verdict=said, why="")

    for name in (pair.name for pair in pairs):
        row = GateRow(name, quantity, why=why.get(name, "no reference"))
        rows.append(judge(row, means[name], of[name]) if name in means else row)
    if n > 1:
        row = GateRow(ALL, quantity)
        if 0 < 2 * len(means) >= n:
            row = judge(row, np.mean(list(means.values()), axis=0), ratios[-1])
        said = f"known on {len(means)} of {n} recordings" * (len(means) < n)
        rows.append(row._replace(why=said or row.why))
    return rows


def _restarts(pairs: Sequence[PairedReplays], share: float) -> GateRow:
    """The row of the restarts over all recordings: where only one side has them, by a sign test."""
    from scipy.special import bdtr  # slow to import

    new, old = np.sum([pair.restarts for pair in pairs], axis=0).tolist()
    first, second = np.sum([pair.lost for pair in pairs], axis=0).tolist()
    worse, better = (float(bdtr(n, first + second, 0.5)) for n in (second, first))
    said: Verdict = "worse" if worse <= share else "better" if better <= share else "equal"
    if said == "equal" and worse <= _SHARE:
        said = "unclear"
    return GateRow(ALL if len(pairs) > 1 else pairs[0].name, RESTARTS, new, old, said)


def _lacking(pairs: Sequence[PairedReplays]) -> list[GateRow]:
    """The row of scans without a pose over all recordings, if there are any."""
    new, old = (sum(pair.both[i].summary.lacking for pair in pairs) for i in range(2))
    # One scan in a hundred may lack its pose on one side by chance.
    apart = abs(new - old) > sum(pair.both[0].summary.scans // 100 for pair in pairs)
    said: Verdict = "equal" if not apart else "worse" if new > old else "better"
    name = ALL if len(pairs) > 1 else pairs[0].name
    return [GateRow(name, LACKING, new, old, said)] if new or old else []


def _segments(pair: PairedReplays) -> tuple[tuple[float, float], ...]:
    """By segment of `PER_SEGMENT` sub-trajectories its first second, and the ratio there."""
    n = max(1, len(pair.seconds) // (PER_SEGMENT * pair.pair.block))
    parts = np.array_split(np.vstack([pair.seconds, pair.pair.errors]), n, axis=1)
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


def _in_words(shared: SharedReplays, verdict: Verdict, rows: Sequence[GateRow]) -> str:
    said = {"better": "Better", "worse": "WORSE", "equal": "Not worse"}
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
    n = len({pair.pair.recording for pair in shared.pairs})
    of = f"{n} recording{'s' * (n > 1)}"
    of += f" in {len(shared.pairs)} parts" * (len(shared.pairs) > n)
    first = said.get(verdict, "TOO LITTLE TO TELL")
    of += f" (`{shared.mode}`)" * (shared.mode != BASELINE)
    return f"{first}: {shared.new.name} against {shared.old.name}, {of}: {'; '.join(parts)}.{where}"


def write_gate(folder: Path, gate: Gate) -> None:
    """Write ``verdict.json``, ``junit.xml`` and ``summary.md``, for a CI service.

    A study has a ``verdict.json`` of its own, which says what to drive: `adaptune.tuning.verdict`.
    """
    # Of the error over all, which comes last.
    error = [row for row in gate.rows if row.quantity == ERROR][-1]
    data = {
        "action": gate.verdict if gate.verdict in ("worse", "unclear") else "pass",
        "verdict": gate.verdict,
        "odometry": gate.odometry,
        "mode": gate.mode,
        "ratio": error.ratio,
        "interval": [error.low, error.high],
        "why": [gate.words],
        "rows": [row._asdict() for row in gate.rows],
    }
    write_text(folder / "verdict.json", json.dumps(data, indent=1) + "\n")
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
