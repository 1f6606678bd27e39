"""The verdict of a comparison: what to drive, what that gives and costs, and how sure it is."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from adaptune.paired import Ratio
from online.modes import BASELINE, EVEN, FIXED, MODES, UNTRAINED
from online.statistics import ALL, ORACLE, ComparisonRow
from online.tables import YARDSTICKS, last_rows

CALLED = {
    "baseline": "the odometry's own parameters",
    "fixed": "the fixed set",
    "adaptive": "adaptive",
    "untrained": "the untrained bank",
}


def _judged(rows: Sequence[ComparisonRow]) -> dict[str, ComparisonRow]:
    """Those of `last_rows` by mode that have an error."""
    return {row.mode: row for row in last_rows(rows) if row.ratio is not None}


def decided(rows: Sequence[ComparisonRow], recommended: str = FIXED) -> ComparisonRow | None:
    """What to drive: what training recommends, unless it is surely worse than the baseline here.

    Without training, the untrained bank where it is surely better. The rows over all sequences come
    last. None if no test sequence has a reference.
    """
    last = _judged(rows)
    if not last:
        return None
    base = last.get(BASELINE)
    one = next((last[mode] for mode in (recommended, FIXED) if mode in last), base)
    if one is None or base is None or one is base:
        bank = last.get(UNTRAINED)
        better = bank is not None and FIXED not in last and _to_baseline(bank).interval
        return bank if better and better[1] < 1.0 else one or base
    ends = _to_baseline(one).interval
    return base if ends is not None and ends[0] > 1.0 else one


def _to_baseline(row: ComparisonRow) -> Ratio:
    """Ratio of a mode's error to the baseline's."""
    return row.against.get(BASELINE, _ratio(row) if row.yardstick == BASELINE else Ratio(math.nan))


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
    rows: Sequence[ComparisonRow],
    length: float,
    recommended: str = FIXED,
    front: Sequence[Mapping[str, Any]] = (),
    obstacle: str = "",
) -> list[str]:
    """What to do, and why, in at most five sentences.

    Of the `rows`, those over all sequences come last. `length` is a sub-trajectory's, in metres.
    Training recommends a mode, and knows the `front`, see `offline.front.front_rows`; `obstacle`
    says why nothing adapts.
    """
    last = _judged(rows)
    if (best := decided(rows, recommended)) is None:
        nobody = "No test sequence has a reference"
        known = [row for row in rows if row.reference != "none" and row.sequence != ALL]
        if judged := dict.fromkeys(row.sequence for row in known):
            nobody = (
                f"No sub-trajectory of {length:g} m fits into what is known of "
                f"{' and '.join(judged)} (test a longer part, or lower sub_trajectory)"
            )
        return [f"{nobody}: nobody can say what was gained.", *_estimates(rows)[:2]]
    judge = " by an estimated reference" * any(row.reference == "estimated" for row in rows)
    where = f"RTE over {length:g} m, {_where(rows)}{judge}"
    own = next((row for row in front if row["trial"] is not None and row["recommended"]), None)
    base = last.get(BASELINE)
    if best is base or (best.mode == FIXED and own is not None and own["trial"] == 0):
        said = [f"Keep {CALLED[BASELINE]}: {error_and_cost(best)}, {where}."]
        said += _why_kept(best, last, recommended)
    else:
        trial = f" (trial {own['trial']})" if best.mode == FIXED and own is not None else ""
        what = f"Drive {called(best.mode)}{trial}: {error_and_cost(best)}"
        if base is not None:
            what += f" instead of {error_and_cost(base)} with {CALLED[BASELINE]}"
        said = [f"{what}, {where}{_sure(best, base, front)}."]
    said += _bought(best, front)
    main = last.get("adaptive")
    if main is not None and main is not best:
        against = f": {_ratio(main).value:.2f} times the {YARDSTICKS[main.yardstick]}'s error"
        interval = f" ({_interval(_ratio(main))})"
        said.append(f"With cores to spare: adaptive, {error_and_cost(main)}{against}{interval}.")
    elif main is None and obstacle:
        said.append(f"Nothing adapts: {obstacle}.")
    return [*said, *_other_rules(best, last)]


def _sure(
    best: ComparisonRow, base: ComparisonRow | None, front: Sequence[Mapping[str, Any]]
) -> str:
    """How sure the ratio to the baseline is, and what to expect on another drive."""
    ratio = _to_baseline(best)
    if base is None or abs(ratio.value - 1.0) < ROUNDING:
        return ""
    said = f": {ratio.value:.2f} times its error ({_interval(ratio)})"
    for row in front:
        if row["recommended"]:
            said += f"; on another drive, {_end(row['low'])} to {_end(row['high'])} times"
    return said


def _why_kept(
    best: ComparisonRow, last: Mapping[str, ComparisonRow], recommended: str
) -> list[str]:
    """Why the odometry's own parameters are kept."""
    other = last.get(recommended)
    if other is None or other is best or abs(_to_baseline(other).value - 1.0) < ROUNDING:
        return ["In training, no set within the budget was safely better."] * (FIXED in last)
    ratio = _to_baseline(other)
    return [
        f"{called(recommended).capitalize()}, which training recommends, is surely worse here: "
        f"{ratio.value:.2f} times its error ({_interval(ratio)})."
    ]


def _bought(best: ComparisonRow, front: Sequence[Mapping[str, Any]]) -> list[str]:
    """What less and more CPU time than that of what is advised buys, by training."""
    said = []
    for what, words in _BUDGETS.items():
        row = next((row for row in front if what in row["what"]), None)
        if row is None or row["trial"] is None or row["recommended"] or not row["trial"]:
            continue
        ends = f"{_end(row['low'])} to {_end(row['high'])}"
        said.append(
            f"{words}: trial {row['trial']}, {row['error [%]']:.3f} % at {row['cost [ms]']:.1f} ms "
            f"in training, on another drive {ends} times the error of {CALLED[BASELINE]}."
        )
    return said[: 2 if best.mode != "adaptive" else 1]


_BUDGETS = {
    "no more CPU time": "At no more CPU time",
    "within the budget": "Of single sets",
    "any CPU time": "At any CPU time",
}
"""What rows of the front are, and how a sentence on them begins."""
ROUNDING = 1e-6
"""A ratio that differs less from 1 is 1."""


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


def _other_rules(best: ComparisonRow, last: Mapping[str, ComparisonRow]) -> list[str]:
    """How rules of the user's did."""
    return [
        f"`{row.mode}` had {_ratio(row).value:.2f} times the "
        f"{YARDSTICKS[row.yardstick]}'s error ({_interval(_ratio(row))})"
        f"{_for_cost(row, last[row.yardstick])}."
        for row in _adapting(last)
        if row is not best and row.mode != "adaptive"
    ]


def _for_cost(main: ComparisonRow, one: ComparisonRow) -> str:
    if main.cpu_ms is None or not one.cpu_ms:
        return ""
    return f", for {main.cpu_ms / one.cpu_ms:.1f} times its CPU time ({main.cpu_ms:.1f} ms a scan)"


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
    """How what adapts compares with controls, and what must be known to trust it."""
    of_drives = _kept_up(rows) + _late(rows) + _restarts(rows)
    return _controls(rows) + _judges(rows) + _estimates(rows) + of_drives


def _controls(rows: Sequence[ComparisonRow]) -> list[str]:
    """How what adapts compares on the same frames with what chooses nothing."""
    main = adapting(rows)
    if main is None or EVEN not in main.against:
        return []
    ratio, cost = main.against[EVEN], {row.mode: row.cpu_ms for row in last_rows(rows)}[EVEN]
    has = f"`{main.mode}` has {ratio.value:.2f} times the error of the same bank with even weights"
    has += f" ({_interval(ratio)})"
    if main.cpu_ms is not None and cost is not None:
        has += f", at {main.cpu_ms:.1f} ms of CPU time a scan against {cost:.1f}"
    return [f"{has}."]


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
