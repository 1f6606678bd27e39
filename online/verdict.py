"""The verdict of a comparison: what to drive, what that gives and costs, and how sure it is."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from adaptune.metrics import LOST_ABOVE
from adaptune.model.registry import ADAPTIVE
from adaptune.paired import Ratio
from adaptune.study import driven as may
from adaptune.study.driven import COST, ERROR, FILES
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
    """What to drive: what training recommends, unless the baseline is surely better here.

    Or holds track where that does not. Without training, the untrained bank where it is surely
    better. The rows over all sequences come last. None if no test sequence has a reference.
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
    kept = (last[m] for m in (recommended, FIXED) if m in last and not _fails(rows, last[m]))
    one = next(kept, base)
    return base if _is_baseline(one) else one


def _fails(rows: Sequence[ComparisonRow], row: ComparisonRow) -> bool:
    """Whether a mode is surely worse than the baseline, or loses track where that does not."""
    low, high = _to_baseline(row).interval or (0.0, math.inf)
    return low > 1.0 or (high >= 1.0 and bool(_loses_track(rows, row.mode)))


def _loses_track(rows: Sequence[ComparisonRow], mode: str) -> list[ComparisonRow]:
    """Where a mode loses track, and the baseline, with less than half of its error, does not."""
    of_base = {r.sequence: r.rte for r in rows if r.mode == BASELINE and r.sequence != ALL}
    return [
        row
        for row in rows
        if row.mode == mode and row.sequence in of_base and row.rte and row.rte > LOST_ABOVE
        if (base := of_base[row.sequence]) and base < min(LOST_ABOVE, row.rte / 2.0)
    ]


def _to_baseline(row: ComparisonRow) -> Ratio:
    """Ratio of a mode's error to the baseline's."""
    return row.against.get(BASELINE, _ratio(row) if row.yardstick == BASELINE else Ratio(math.nan))


def _is_baseline(row: ComparisonRow) -> bool:
    """Whether a mode drove as the baseline did: with its set."""
    return row.mode == FIXED and abs(_to_baseline(row).value - 1.0) < ROUNDING


def adapts(mode: str) -> bool:
    """Whether a mode adapts, and is no control: ours, without a model, or a rule of the user's."""
    return mode in ("adaptive", "untrained") or mode not in (*MODES, ORACLE)


def _adapting(last: Mapping[str, ComparisonRow]) -> list[ComparisonRow]:
    """Those of `_judged` that adapt; rules of the user's come last."""
    found = [row for mode, row in last.items() if adapts(mode)]
    return sorted(found, key=lambda row: [*MODES, row.mode].index(row.mode))


def called(mode: str) -> str:
    """What a mode is called in a sentence."""
    return CALLED.get(mode, f"`{mode}`")


def own_parameters(odometries: Mapping[str, str]) -> str:
    """What the baseline is called; of several odometries, it names the one that a mode drives."""
    return (
        f"{odometries[BASELINE]}'s own parameters" if BASELINE in odometries else CALLED[BASELINE]
    )


def choices(
    rows: Sequence[ComparisonRow],
    front: Sequence[Mapping[str, Any]],
    best: str = "",
    obstacle: str = "",
) -> list[dict[str, Any]]:
    """What may be driven: the best within each budget, and the bank.

    Error and cost are those of the test, or of training where it was not driven on the test.
    `front` has the rows of training, see `offline.front.front_rows`; `best` is the mode to drive.
    """
    last, found, told = _judged(rows), list[dict[str, Any]](), set[str]()
    for row in front:
        if row["what"] == may.BELOW or (row["trial"] is None and obstacle):
            continue
        modes = [ADAPTIVE] * (row["trial"] is None) + [BASELINE] * (row["trial"] == 0)
        modes += [FIXED] * (may.WITHIN in row["what"])
        told |= {*modes}
        found.append(dict(row) | {"what": row["what"].split(", ")[0], "mode": "", _ON: "training"})
        found[-1] |= {"in training": (row[ERROR], row[COST])}
        found[-1] |= next((_driven(last[mode]) for mode in modes if mode in last), {})
        found[-1]["recommended"] = best in modes
    for mode, what in _ALONE.items():
        # Of several odometries, the first one's own parameters may be no row of the front.
        if mode in last and mode not in told and (mode in (best, ADAPTIVE) or not front):
            one = {
                "what": what,
                "file": FILES[what],
                "recommended": mode == best,
                **_driven(last[mode]),
            }
            one |= dict.fromkeys(("trial", "low", "high"))
            found.append(one | dict.fromkeys(("odometry", "parameters", "left out"), ""))
    return sorted(found, key=lambda row: list(FILES).index(row["what"]))


_ON = "driven on"
_ALONE = {BASELINE: may.OWN, FIXED: may.WITHIN, ADAPTIVE: ADAPTIVE, UNTRAINED: may.UNTRAINED}
"""What modes are that training does not know."""


def _driven(row: ComparisonRow) -> dict[str, Any]:
    return {"mode": row.mode, _ON: "test", ERROR: row.rte, COST: row.run.cpu_ms}


def verdict(
    rows: Sequence[ComparisonRow],
    length: float,
    recommended: str = FIXED,
    front: Sequence[Mapping[str, Any]] = (),
    obstacle: str = "",
    tried: int = 0,
    odometries: Mapping[str, str] = MappingProxyType({}),
) -> list[str]:
    """What to do, and why, in at most five sentences.

    Of the `rows`, those over all sequences come last. `length` is a sub-trajectory's, in metres.
    Training `tried` so many sets, and recommends a mode; the `front` is that of `choices`;
    `obstacle` says why nothing adapts; of several `odometries`, it says which a mode drives.
    """
    last, whose = _judged(rows), own_parameters(odometries)
    if (best := decided(rows, recommended)) is None:
        nobody = "No test sequence has a reference"
        known = [row for row in rows if row.reference != "none" and row.sequence != ALL]
        if judged := dict.fromkeys(row.sequence for row in known):
            nobody = (
                f"No sub-trajectory of {length:g} m fits into what is known of "
                f"{' and '.join(judged)} (test a longer part, or lower sub_trajectory)"
            )
        return [f"{nobody}: nobody can say what was gained.", *_estimates(rows)[:2]]
    own = next((row for row in front if row["recommended"]), None)
    trial, base = None if own is None else own["trial"], last.get(BASELINE)
    judge = " by an estimated reference" * any(row.reference == "estimated" for row in rows)
    where = f"RTE over {length:g} m, {_where(rows)}{judge}"
    if best is base:
        said = [f"Keep {whose}: {_error_and_cost(best)} ({where})."]
        said += _why_kept(rows, best, last, recommended, tried)
    else:
        named = [odometries[best.mode]] if best.mode in odometries else []
        named += [f"trial {trial}"] if best.mode == FIXED and trial else []
        what = called(best.mode) + (f" ({', '.join(named)})" if named else "")
        gained = [f"{_error_and_cost(best)} ({where})."]
        gained = gained if base is None else _gained(best, base, where, own, whose)
        said = [f"Drive {what}: {gained[0]}", *gained[1:]]
    if bank := last.get(ADAPTIVE):
        gains = bank is not best and _ratio(bank).value < 1.0
        first = "With cores to spare: adaptive, " if gains else "Adapting: "
        said.append(f"{first}{_to_yardstick(bank, last)}.")
    elif obstacle:
        said.append(f"Nothing adapts: {obstacle}.")
    said += [own["left out"]] if own and own["left out"] else []
    rules = (row for row in _adapting(last) if row not in (best, bank))
    return said + [f"`{row.mode}` had {_to_yardstick(row, last)}." for row in rules]


def _error_and_cost(row: ComparisonRow) -> str:
    return f"{row.rte:.3f} %" + (f" at {row.run.cpu_ms:.1f} ms a scan" if row.run.cpu_ms else "")


def _gained(
    best: ComparisonRow,
    base: ComparisonRow,
    where: str,
    own: Mapping[str, Any] | None,
    whose: str,
) -> list[str]:
    """What is advised gives instead of the baseline, here and on another drive."""
    said = f"{best.rte:.3f} % instead of {base.rte:.3f} % with {whose}"
    if best.run.cpu_ms and base.run.cpu_ms:
        said += f", for {best.run.cpu_ms:.1f} instead of {base.run.cpu_ms:.1f} ms a scan"
    ratio = _to_baseline(best)
    sure = f"That is {ratio.value:.2f} times the error ({_interval(ratio)}; {where})"
    if own is not None and own["low"] is not None:
        worse = ", so perhaps more" * (own["low"] < 1.0 < own["high"])
        ends = f"{_end(own['low'])} to {_end(own['high'])}"
        expected = f"on another drive, expect {ends} times{worse}"
        if not round(own["low"], 2) <= round(ratio.value, 2) <= round(own["high"], 2):
            expected = f"training expected {ends} times"
        sure += f"; {expected}"
    return [f"{said}.", f"{sure}."]


def _why_kept(
    rows: Sequence[ComparisonRow],
    best: ComparisonRow,
    last: Mapping[str, ComparisonRow],
    recommended: str,
    tried: int,
) -> list[str]:
    """Why the odometry's own parameters are kept."""
    other = last.get(recommended, last.get(FIXED))
    if other is None or other is best or _is_baseline(other):
        if tried < 2:
            return ["No other set was tried: allow more trials, or more time."] * (FIXED in last)
        was = f"none of {tried - 1} other sets was" if tried > 2 else "the other set was not"
        return [f"In training, {was} safely better within the budget."] * (FIXED in last)
    ratio, what = _to_baseline(other), "is surely worse here"
    if lost := _loses_track(rows, other.mode):
        what = "loses track on " + ", ".join(f"{row.sequence} ({row.rte:.1f} %)" for row in lost)
    which = ", which training recommends," * (other.mode == recommended)
    return [
        f"{called(other.mode).capitalize()}{which} {what}: {ratio.value:.2f} times its error "
        f"({_interval(ratio)})."
    ]


def _to_yardstick(row: ComparisonRow, last: Mapping[str, ComparisonRow]) -> str:
    """Error and CPU time of a mode, in times those of the fixed set, or the baseline."""
    same = FIXED in last and _is_baseline(last[FIXED])  # as the sentences before name them
    whose = "their" if same else f"the {YARDSTICKS[row.yardstick]}'s"
    ratio, other = _ratio(row), last[row.yardstick].run.cpu_ms
    said = f"{ratio.value:.2f} times {whose} error ({_interval(ratio)})"
    if ratio.interval and ratio.interval[1] - ratio.interval[0] < ROUNDING:
        said = f"exactly {whose} error, as it drove the same set"
    own = row.run.cpu_ms
    times = f", for {own / other:.1f} times the CPU time" if own and other else ""
    return said + times


ROUNDING = 1e-6
"""A ratio that differs less from 1 is 1."""


def late(rows: Sequence[ComparisonRow], mode: str, periods: Mapping[str, float]) -> list[str]:
    """Where a mode was too late, or takes longer than the milliseconds between scans."""
    of_mode = [row for row in rows if row.mode == mode]
    for row in of_mode:
        period = periods.get(row.sequence, math.inf)
        if row.run.cpu_ms is not None and row.run.cpu_ms > period:
            every = f"On {row.sequence}, scans come every {period:.0f} ms"
            return [f"{every}: {row.run.cpu_ms:.0f} ms of CPU time a scan take several cores."]
    return [told for row in of_mode if (told := _too_late(row))][:1]


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
    of_drives = _kept_up(rows) + _first_poses(rows) + _restarts(rows)
    return _controls(rows) + _judges(rows) + _estimates(rows) + of_drives


def _controls(rows: Sequence[ComparisonRow]) -> list[str]:
    """How what adapts compares on the same frames with what chooses nothing."""
    main = next(iter(_adapting(_judged(rows))), None)
    if main is None or EVEN not in main.against:
        return []
    ratio, cost = main.against[EVEN], {row.mode: row.run.cpu_ms for row in last_rows(rows)}[EVEN]
    has = f"`{main.mode}` has {ratio.value:.2f} times the error of the same bank with even weights"
    has += f" ({_interval(ratio)})"
    if main.run.cpu_ms is not None and cost is not None:
        has += f", at {main.run.cpu_ms:.1f} ms of CPU time a scan against {cost:.1f}"
    if ratio.interval is not None and ratio.interval[1] >= 1.0:
        has += ": what it gains is the mean of several sets; weighing them gains nothing sure"
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


def _too_late(row: ComparisonRow) -> str:
    """Of a replay in real time what came too late, in a sentence; empty if nothing did."""
    if (kept := row.run.real_time) is None:
        return ""
    found = [
        f"{kept[key]:.0f} {what}{'' if kept[key] == 1 else 's'}"
        for key, what in (("dropped_scans", "scan"), ("missed_selections", "selection"))
        if kept[key]
    ]
    if kept.get("removed_members"):
        found.append(f"{kept['removed_members']:.0f} of its members, which it went on without")
    if not found:
        return ""
    return (
        f"On {row.sequence} `{row.mode}` was too late for {' and '.join(found)}, at "
        f"{kept['rate']:g} times the recorded rate; 99 % of its poses came within "
        f"{kept['pose_ms_p99']:.0f} ms of the scans."
    )


def _kept_up(rows: Sequence[ComparisonRow]) -> list[str]:
    """Of replays in real time, what came too late."""
    said = [told for row in rows if (told := _too_late(row))]
    kept_up = [kept for row in rows if (kept := row.run.real_time) is not None]
    if kept_up and not said:
        rate = kept_up[0]["rate"]
        ms = max(kept["pose_ms_p99"] for kept in kept_up)
        within = f"99 % of the poses came within {ms:.0f} ms of their scans, in every mode"
        said.append(
            f"Replayed at {rate:g} times the recorded rate, nothing came too late: {within}."
        )
    return said


def _first_poses(rows: Sequence[ComparisonRow]) -> list[str]:
    late: dict[str, list[float]] = {}
    for row in rows:
        if row.run.first_pose:
            late.setdefault(row.sequence, []).append(row.run.first_pose)
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
                when = at if row.run.restarts == 1 else f"{row.run.restarts} times, first {at}"
                modes.setdefault(f"{when} ({', '.join(row.run.unhealthy)})", []).append(row.mode)
        each = (
            f"{'all modes' if len(those) == len(mine) else ', '.join(those)} {what}"
            for what, those in modes.items()
        )
        said.append(f"On {name} the health check restarted {'; '.join(each)}.")
    return said
