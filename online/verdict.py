"""The verdict of a comparison: what to drive, what that gives and costs, and how sure it is."""

import math
from collections.abc import Mapping, Sequence

from adaptune.paired import Ratio
from adaptune.study.config import WORTH
from adaptune.study.driven import EQUAL_COST, RIVAL_WORDS, RIVALS, is_worth
from online.modes import EVEN, MODES
from online.statistics import ALL, ORACLE, ComparisonRow
from online.tables import YARDSTICKS, last_rows

ROUNDING = 1e-6
"""A ratio that differs less from 1 is 1."""
CLEARLY = 0.8
"""Ratio to the error of what training chose, below which another set does better on a test that is
too short for an interval."""
CALLED = {
    "baseline": "the odometry's own parameters",
    "fixed": "the fixed set",
    "adaptive": "adaptive",
    "untrained": "the untrained bank",
    **RIVAL_WORDS,
}
_ONE_SET = ("baseline", "fixed", "best_default")
"""Modes that drive one set; those that cost less first."""


def _judged(rows: Sequence[ComparisonRow]) -> dict[str, ComparisonRow]:
    """Those of `last_rows` by mode that have an error."""
    return {row.mode: row for row in last_rows(rows) if row.ratio is not None}


def decided(rows: Sequence[ComparisonRow], worth: float = WORTH) -> ComparisonRow | None:
    """What to drive: the fixed set, unless another one is surely better, or what is worth its cost.

    Adapting has to spare the share `worth` of the error, and to beat the best set that costs as
    much. The rows over all sequences come last. None if no test sequence has a reference.
    """
    last = _judged(rows)
    if not last:
        return None
    one = next(last[mode] for mode in _ONE_SET if mode in last)
    if "fixed" in last:
        same = "baseline" in last and abs(_ratio(last["baseline"]).value - 1.0) < ROUNDING
        one = last["baseline" if same else "fixed"]
    for mode in _ONE_SET:
        if mode in last and _surely_better(last[mode], one):
            one = last[mode]
    candidates = [one]
    for row in _adapting(last):
        ratio, rival = _to(row, one), last.get(EQUAL_COST)
        beats = rival is None or _surely_better(row, rival)
        spares = ratio.interval is not None and is_worth(ratio.value, ratio.interval[1], worth)
        candidates += [row] if spares and beats else []
    return min(candidates, key=lambda row: _ratio(row).value)


def _surely_better(row: ComparisonRow, other: ComparisonRow) -> bool:
    ratio = _to(row, other)
    return ratio.value < CLEARLY if ratio.interval is None else ratio.interval[1] < 1.0


def _to(row: ComparisonRow, one: ComparisonRow) -> Ratio:
    """Ratio of two modes' errors, with its interval where that is known."""
    if one.mode == row.yardstick:
        return _ratio(row)
    return row.against.get(one.mode, Ratio(_ratio(row).value / max(_ratio(one).value, 1e-12)))


def adapts(mode: str) -> bool:
    """Whether a mode adapts, and is no control: ours, without a model, or a rule of the user's."""
    return mode in ("adaptive", "untrained") or mode not in (*MODES, ORACLE)


def _adapting(last: Mapping[str, ComparisonRow]) -> list[ComparisonRow]:
    """Those of `_judged` that adapt; rules of the user's come last."""
    found = [row for mode, row in last.items() if adapts(mode)]
    return sorted(found, key=lambda row: [*MODES, row.mode].index(row.mode))


def adapting(rows: Sequence[ComparisonRow]) -> ComparisonRow | None:
    """The mode that adapts: `adaptive` if it was driven; None if none was."""
    return next(iter(_adapting(_judged(rows))), None)


def called(mode: str) -> str:
    """What a mode is called in a sentence."""
    return CALLED.get(mode, f"`{mode}`")


def verdict(
    rows: Sequence[ComparisonRow], length: float, obstacle: str = "", worth: float = WORTH
) -> list[str]:
    """What to do, and why, in at most three sentences.

    Of the `rows`, those over all sequences come last. `length` is a sub-trajectory's, in metres;
    `obstacle` says why nothing adapts, or was compared with the fixed set in training; for `worth`
    see `decided`.
    """
    last = {row.mode: row for row in last_rows(rows)}
    if (best := decided(rows, worth)) is None:
        nobody = "No test sequence has a reference"
        known = [row for row in rows if row.reference != "none" and row.sequence != ALL]
        if judged := dict.fromkeys(row.sequence for row in known):
            nobody = (
                f"No sub-trajectory of {length:g} m fits into what is known of "
                f"{' and '.join(judged)} (test a longer part, or lower sub_trajectory)"
            )
        return [f"{nobody}: nobody can say what was gained.", *_estimates(rows)[:2]]
    main = adapting(rows)
    others = [m for m in ("fixed", "baseline") if m in last and m != best.mode]
    instead = " and ".join(
        f"{error_and_cost(last[m])} with {called(m)}" for m in others if last[m].rte
    )
    judge = " by an estimated reference" * any(row.reference == "estimated" for row in rows)
    where = f"RTE over {length:g} m, {_where(rows)}{judge}"
    said = "Keep " if best.mode == "baseline" else "Drive "
    said += f"{called(best.mode)}: {error_and_cost(best)}"
    if best.mode == "baseline" and "fixed" in last and _is_yardstick(best):
        said += f", {where}. No set that was tried did surely better in training"
    else:
        said += f"{f' instead of {instead}' * bool(instead)}, {where}"
    if best.mode not in _ONE_SET:
        has = f"It has {best.ratio:.2f} times the {YARDSTICKS[best.yardstick]}'s error"
        cost = _for_cost(best, last[best.yardstick])
        has = f"{has} ({_interval(_ratio(best))}){cost}{_beside(best, last)}."
        return [f"{said}.", has, *_other_rules(best, main, last)]
    said = f"{said}{_doubt(best, last)}."
    why = _other_set(best, last, worth) + _why_not(main, best, rows, obstacle, worth)
    return [said, *why, *_other_rules(best, main, last)]


def late(rows: Sequence[ComparisonRow], mode: str, periods: Mapping[str, float]) -> list[str]:
    """Where a mode takes longer than the milliseconds from scan to scan, in a sentence."""
    for row in rows:
        period = periods.get(row.sequence, math.inf)
        if row.mode == mode and row.cpu_ms is not None and row.cpu_ms > period:
            every = f"On {row.sequence}, scans come every {period:.0f} ms"
            return [f"{every}: {row.cpu_ms:.0f} ms of CPU time a scan take several cores."]
    return []


def error_and_cost(row: ComparisonRow) -> str:
    """The error of a mode, and what it costs."""
    return f"{row.rte:.3f} %" + (f" at {row.cpu_ms:.1f} ms a scan" if row.cpu_ms else "")


def _beside(best: ComparisonRow, last: Mapping[str, ComparisonRow]) -> str:
    """How what adapts compares with the best single set that costs no more."""
    rival = last.get(EQUAL_COST)
    if rival is None or rival.ratio is None or rival.cpu_ms is None:
        return ""
    ratio, ms = _to(best, rival).value, rival.cpu_ms
    return f", and {ratio:.2f} times that of the best single set that costs no more ({ms:.1f} ms)"


def _other_set(best: ComparisonRow, last: Mapping[str, ComparisonRow], worth: float) -> list[str]:
    """That another single set does better here: surely, where it costs more."""
    row = last.get(EQUAL_COST)
    if row is None or row.ratio is None or not row.cpu_ms or not best.cpu_ms:
        return []
    ratio, costs = _to(row, best), row.cpu_ms
    sure = "" if ratio.interval is None else f" ({_interval(ratio)})"
    has = f"{ratio.value:.2f} times its error{sure}{_for_cost(row, best)}"
    if costs > best.cpu_ms and ratio.interval and _surely_better(row, best):
        budget = f"`online.budget: {math.ceil(costs)}`"
        return [f"A single set that costs more has {has}: {budget} allows it."]
    if costs <= best.cpu_ms and ratio.value <= 1.0 - worth:
        sure = "that was not surely better in training " * (best.mode == "baseline")
        more = "drive both on another recording, to know"
        return [f"A set {sure}(`{EQUAL_COST}.yaml`) has {has}: {more}."]
    return []


def _other_rules(
    best: ComparisonRow, main: ComparisonRow | None, last: Mapping[str, ComparisonRow]
) -> list[str]:
    """How those rules did of which nothing else is said, as the user's."""
    return [
        f"`{row.mode}` had {_ratio(row).value:.2f} times the "
        f"{YARDSTICKS[row.yardstick]}'s error ({_interval(_ratio(row))})"
        f"{_for_cost(row, last[row.yardstick])}."
        for row in _adapting(last)
        if row is not best and (row is not main or best.mode not in _ONE_SET) and row.ratio
    ]


def _doubt(best: ComparisonRow, last: Mapping[str, ComparisonRow]) -> str:
    """How sure it is that the fixed set and the baseline differ."""
    row = last.get("baseline")
    if best.mode == "best_default" or row is None or "fixed" not in last or _is_yardstick(row):
        return ""
    if (ends := row.ratio_interval) is None:
        return "; the test is too short to tell whether the two differ by chance"
    chance = "the two may differ by chance: " * (ends[0] <= 1.0 <= ends[1])
    ratio = f"{row.ratio:.2f} times the fixed set's error ({_interval(_ratio(row))})"
    return f"; {chance}{CALLED['baseline']} have {ratio}"


def _for_cost(main: ComparisonRow, one: ComparisonRow) -> str:
    if main.cpu_ms is None or not one.cpu_ms:
        return ""
    return f", for {main.cpu_ms / one.cpu_ms:.1f} times its CPU time ({main.cpu_ms:.1f} ms a scan)"


def _why_not(
    main: ComparisonRow | None,
    best: ComparisonRow,
    rows: Sequence[ComparisonRow],
    obstacle: str,
    worth: float,
) -> list[str]:
    if main is None:
        return [f"Adapting was not tried: {obstacle}."] if obstacle else []
    if _is_yardstick(main) and obstacle:
        return [f"`adaptive` drove the same set: {obstacle}."]
    if _is_yardstick(main):
        return ["Training showed no gain from adapting: `adaptive` drove the same set."]
    ratio = _to(main, best)
    sure = "" if ratio.interval is None else f" ({_interval(ratio)})"
    has = f"{ratio.value:.2f} times its error{sure}{_for_cost(main, best)}"
    if ratio.value <= 1.0 - worth:
        doubt, more = "that may be chance", ": drive more test recordings, or longer ones, to know"
        row = _judged(rows).get(EQUAL_COST)
        if row is not None and ratio.interval is not None and ratio.interval[1] < 1.0:
            rival = _to(main, row)
            doubt = (
                f"that is {rival.value:.2f} times the error of the best single set that costs no "
                f"more than adapting ({_interval(rival)})"
            )
            more *= rival.interval is None or rival.interval[0] < 1.0
        return [f"Adapting had {has}; {doubt}{more}."]
    if ratio.value <= 1.0:
        what = "is not worth its cost"
    else:
        surely = ratio.interval is not None and ratio.interval[0] > 1.0
        what = "did worse" if surely else "did no better"
    return [f"Adapting {what} {_where(rows)}: {has}."]


def _is_yardstick(row: ComparisonRow) -> bool:
    # A bank whose other members rest moves as the fixed set does, but for rounding.
    return row.ratio is not None and abs(row.ratio - 1.0) < ROUNDING and not row.switches


def _where(rows: Sequence[ComparisonRow]) -> str:
    names = {row.sequence for row in rows if row.rte is not None} - {ALL}
    return f"on {len(names)} test sequences" if len(names) > 1 else f"on {names.pop()}"


def _interval(ratio: Ratio) -> str:
    ends = ratio.interval
    if ends is None:
        return "the test is too short to tell how sure that is"
    return f"95 % interval {_end(ends[0])} to {_end(ends[1])}"


def _end(ratio: float) -> str:
    """An end of an interval; one that is near 1 has more digits, to show on which side it lies."""
    text = f"{ratio:.2f}"
    return f"{ratio:.3f}" if text == "1.00" and ratio != 1.0 else text


def _ratio(row: ComparisonRow) -> Ratio:
    assert row.ratio is not None
    return Ratio(row.ratio, row.ratio_interval)


def remarks(rows: Sequence[ComparisonRow]) -> list[str]:
    """How what adapts compares with rivals and controls, and what must be known to trust it."""
    of_drives = _kept_up(rows) + _late(rows) + _restarts(rows)
    return _rivals(rows) + _judges(rows) + _estimates(rows) + of_drives


def _rivals(rows: Sequence[ComparisonRow]) -> list[str]:
    """How what adapts compares on the same frames with what costs as much, or chooses nothing."""
    if (main := adapting(rows)) is None:
        return []
    costs, said = {row.mode: row.cpu_ms for row in last_rows(rows)}, []
    for mode in (mode for mode in main.against if mode in (*RIVALS, EVEN)):
        what, ratio = RIVAL_WORDS.get(mode, "the same bank with even weights"), main.against[mode]
        has = f"`{main.mode}` has {ratio.value:.2f} times the error of {what} ({_interval(ratio)})"
        if main.cpu_ms is not None and (cost := costs.get(mode)) is not None:
            has += f", at {main.cpu_ms:.1f} ms of CPU time a scan against {cost:.1f}"
        said.append(f"{has}.")
    return said


def _judges(rows: Sequence[ComparisonRow]) -> list[str]:
    judged = {row.sequence: row for row in rows if row.sequence != ALL}
    said = []
    for name, row in judged.items():
        if row.reference != "estimated":
            continue
        if row.reference_error is None:
            own = "its own error is not known, and not in the intervals"
        elif row.rte_interval is None:
            own = f"its own error is about {row.reference_error:.2g} %"
        else:
            own = f"its own error, about {row.reference_error:.2g} %, is in the intervals"
        said.append(f"On {name} an estimated reference judged: {own}.")
    return said


def _estimates(rows: Sequence[ComparisonRow]) -> list[str]:
    """What is estimated where there is no reference, and where the reference contradicts it."""
    said = []
    contradicted: dict[str, list[str]] = {}
    for row in rows:
        if row.estimated is None or row.sequence == ALL:
            continue
        ends = row.estimated_interval
        interval = "" if ends is None else f"95 % interval {ends[0]:.3f}-{ends[1]:.3f} %"
        if row.rte is None:
            said.append(
                f"{row.sequence} has no reference. `{row.mode}` estimates its own mean RTE there: "
                f"{row.estimated:.3f} %{interval and f' ({interval})'}."
            )
        elif ends is not None and not ends[0] <= row.rte <= ends[1]:
            judge = "estimated reference" if row.reference == "estimated" else "reference"
            contradicted.setdefault(row.mode, []).append(
                f"{row.estimated:.3f} % ({interval}) on {row.sequence}, where by the {judge} it is "
                f"{row.rte:.3f} %"
            )
    for mode, those in contradicted.items():
        said.append(
            f"`{mode}` estimates its own mean RTE at {'; '.join(those)}. "
            f"Either the estimate or the reference is wrong there over this length."
        )
    return said


def _kept_up(rows: Sequence[ComparisonRow]) -> list[str]:
    """Of replays in real time, a sentence about each that did not get all scans or selections."""
    said, timed = [], [(row, row.real_time) for row in rows if row.real_time is not None]
    for row, kept in timed:
        found = [
            f"{kept[key]:.0f} {what}{'' if kept[key] == 1 else 's'}"
            for key, what in (("dropped_scans", "scan"), ("missed_selections", "selection"))
            if kept[key]
        ]
        if found:
            said.append(
                f"On {row.sequence} `{row.mode}` was too late for {' and '.join(found)}, at "
                f"{kept['rate']:g} times the recorded rate; 99 % of its poses came within "
                f"{kept['pose_ms_p99']:.0f} ms of the scans."
            )
    if timed and not said:
        rate = timed[0][1]["rate"]
        ms = max(kept["pose_ms_p99"] for _, kept in timed)
        within = f"99 % of the poses came within {ms:.0f} ms of their scans, in every mode"
        said.append(
            f"Replayed at {rate:g} times the recorded rate, nothing came too late: {within}."
        )
    return said


def _late(rows: Sequence[ComparisonRow]) -> list[str]:
    late: dict[str, list[float]] = {}
    for row in rows:
        if row.first_pose:
            late.setdefault(row.sequence, []).append(row.first_pose)
    return [
        f"On {name} the odometry gave its first pose after {max(seconds):.1f} s; errors count from "
        f"there."
        for name, seconds in late.items()
    ]


def _restarts(rows: Sequence[ComparisonRow]) -> list[str]:
    said = []
    for name in dict.fromkeys(row.sequence for row in rows if row.first_restart is not None):
        mine = [row for row in rows if row.sequence == name]
        modes: dict[str, list[str]] = {}
        for row in mine:
            if row.first_restart is not None:
                at = f"at {row.first_restart:.1f} s"
                when = at if row.restarts == 1 else f"{row.restarts} times, first {at}"
                modes.setdefault(f"{when} ({', '.join(row.unhealthy)})", []).append(row.mode)
        each = (
            f"{'all modes' if len(those) == len(mine) else ', '.join(those)} {what}"
            for what, those in modes.items()
        )
        said.append(f"On {name} the health check restarted {'; '.join(each)}.")
    return said
