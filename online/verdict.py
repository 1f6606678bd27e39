"""The first sentences of a comparison: what was gained, how surely, at what cost, what to do."""

from collections.abc import Mapping, Sequence

from adaptune.metrics import MIN_BLOCKS
from adaptune.study.driven import MIN_RECORDINGS, RIVAL_WORDS, RIVALS
from online.comparison_row import ALL, NO_DIFFERENCE, ORACLES, ComparisonRow, Ratio

NEARLY = 0.05
"""Where a whole interval lies within this share of 1, there is no difference."""
CONTROLS = {
    "random": "Switching at random among the members of the study's bank",
    "even": "The study's bank with even weights",
}
"""Modes that choose nothing, in words."""
ROUNDING = 1e-6
"""A ratio that differs less from 1 is 1."""
_SAME_COST = 0.2
"""Costs that differ by a smaller share are not worth a sentence."""
ENOUGH_STRETCHES = 20
"""Fewer stretches say little about the worst tenth of others."""
_UNSURE = "nothing can be said of how sure that is"
_YARDSTICKS = {"fixed": "fixed set", "baseline": "baseline"}
_NOT_ADAPTIVE = ("baseline", "fixed", *RIVALS, *ORACLES, *CONTROLS)


def verdict(rows: Sequence[ComparisonRow]) -> list[str]:
    """What the comparison says, in the order in which a user asks.

    Parameters
    ----------
    rows
        Of all sequences and modes, those over all sequences last.
    """
    last = {row.mode: row for row in rows if row.sequence == rows[-1].sequence}
    if all(row.ratio is None for row in last.values()):
        return ["No test sequence has a reference: nobody can say what was gained."]
    adaptive = [row for mode, row in last.items() if mode not in _NOT_ADAPTIVE]
    tuned = []
    if {"fixed", "baseline"} <= last.keys():
        tuned = [*_of_baseline(last["baseline"], rows), *_cost_of_tuning(last)]
    if not adaptive:
        return [*tuned, _advice(last)]
    # `paired` comes first; without a model there is the untrained bank.
    main = next((row for row in adaptive if row.mode == "paired"), adaptive[-1])
    if _is_yardstick(main):
        what = f"`{main.mode}` kept the {_YARDSTICKS[main.yardstick]} {_where(rows)}."
        said = [f"Nothing was adapted, nothing gained: {what}"]
    else:
        said = [_gain(main, rows), *_how_surely(main, rows), *_cost(main, last[main.yardstick])]
    said += [
        _against(main, mode, main.against[mode], last.get(mode))
        for mode in RIVALS
        if mode in main.against
    ]
    said += _controls(main, last)
    said += _nothing_to_choose(last)
    said += [_other(row) for row in adaptive if row is not main and not _is_yardstick(row)]
    return [*said, *tuned, _advice(last)]


def _is_yardstick(row: ComparisonRow) -> bool:
    """Whether a mode did what the yardstick did."""
    # A bank whose other members rest moves as the fixed set does, but for rounding.
    return row.ratio is not None and abs(row.ratio - 1.0) < ROUNDING and not row.switches


def _judged(rows: Sequence[ComparisonRow]) -> list[str]:
    return list(dict.fromkeys(r.sequence for r in rows if r.rte is not None and r.sequence != ALL))


def _where(rows: Sequence[ComparisonRow]) -> str:
    names = _judged(rows)
    return f"on {len(names)} test sequences" if len(names) > 1 else f"on {names[0]}"


def _interval(ratio: Ratio) -> str:
    ends = ratio.interval
    return "no interval" if ends is None else f"95 % interval {_end(ends[0])} to {_end(ends[1])}"


def _end(ratio: float) -> str:
    """An end of an interval; one that is near 1 has more digits, to show on which side it lies."""
    text = f"{ratio:.2f}"
    return f"{ratio:.3f}" if text == "1.00" and ratio != 1.0 else text


def _ratio(row: ComparisonRow) -> Ratio:
    assert row.ratio is not None
    return Ratio(row.ratio, row.ratio_interval)


def _times(row: ComparisonRow) -> str:
    return (
        f"{row.ratio:.2f} times the {_YARDSTICKS[row.yardstick]}'s error ({_interval(_ratio(row))})"
    )


def _surely(ratio: Ratio) -> str:
    """Whether a ratio is surely `less`, `more`, or `equal`; `open` or `unknown` otherwise."""
    if ratio.interval is None:
        return "unknown"
    low, high = ratio.interval
    if (high < 1.0 or low > 1.0) and abs(ratio.value - 1.0) >= NO_DIFFERENCE:
        return "less" if high < 1.0 else "more"
    return "equal" if low > 1.0 - NEARLY and high < 1.0 + NEARLY else "open"


def _gain(row: ComparisonRow, rows: Sequence[ComparisonRow]) -> str:
    ratio = _ratio(row)
    has, how = f"`{row.mode}` has {_times(row)}", _surely(ratio)
    # The parts of one recording are one.
    n = row.recordings or len(_judged(rows))
    few = rows[-1].sequence != ALL or n < MIN_RECORDINGS
    alone = " The interval speaks of these recordings alone." if few else ""
    if how == "unknown":
        return f"Whether adapting gains is not known, {_where(rows)}: {has}; {_UNSURE}."
    if how == "open":
        return f"Whether adapting gains is open, {_where(rows)}: {has}.{alone}"
    if how == "equal":
        return f"Adapting changed nothing that counts {_where(rows)}: {has}.{alone}"
    what = "gained" if how == "less" else "lost"
    percent = 100.0 * abs(ratio.value - 1.0)
    return f"Adapting {what} {percent:.0f} % {_where(rows)}: {has}.{alone}"


def _how_surely(row: ComparisonRow, rows: Sequence[ComparisonRow]) -> list[str]:
    """On how many sequences it is better, on which it is worse, and the worst tenth."""
    said = []
    if row.better is not None:
        of = [r for r in rows if r.mode == row.mode and r.ratio is not None and r.sequence != ALL]
        worse = [r.sequence for r in of if r.ratio is not None and r.ratio > 1.0 + NO_DIFFERENCE]
        on = f"on {row.worse} ({', '.join(worse)})" if worse else "on none"
        surely = ""
        if row.surely_better is not None:
            known = sum(r.ratio_interval is not None for r in of)
            which = "" if known == len(of) else f", of {known} long enough to tell"
            surely = f"; surely better on {row.surely_better}, surely worse on {row.surely_worse}"
            surely += which
        less = f"By more than 1 %, it has less error on {row.better} of {len(of)} sequences"
        said.append(f"{less}, and more {on}{surely}.")
    if row.worst_tenth is not None:
        said.append(
            f"In the worst tenth of {row.stretches} stretches it has {row.worst_tenth:.2f} times "
            f"the {_YARDSTICKS[row.yardstick]}'s error."
        )
    if row.gap_closed is not None and row.gap_closed > 0.0:
        share = f"It gains {100 * row.gap_closed:.0f} %"
        said.append(f"{share} of what the best set of each sequence would gain in hindsight.")
    return said


def _cost(row: ComparisonRow, yardstick: ComparisonRow) -> list[str]:
    if row.cpu_ms is None or not yardstick.cpu_ms:
        return []
    cores = "" if row.cores is None else f", {row.cores:.2f} cores at the sensor's rate"
    return [
        f"It takes {row.cpu_ms:.1f} ms of CPU time a scan{cores}: "
        f"{row.cpu_ms / yardstick.cpu_ms:.1f} times what the {_YARDSTICKS[row.yardstick]} takes."
    ]


def _cost_of_tuning(last: Mapping[str, ComparisonRow]) -> list[str]:
    """What the fixed set costs, if that differs from the baseline."""
    fixed, baseline = last["fixed"].cpu_ms, last["baseline"].cpu_ms
    if not fixed or not baseline or abs(fixed / baseline - 1.0) < _SAME_COST:
        return []
    return [
        f"The fixed set takes {fixed:.1f} ms of CPU time a scan, {fixed / baseline:.1f} times what "
        f"the baseline takes."
    ]


def _against(
    main: ComparisonRow, mode: str, ratio: Ratio, other: ComparisonRow | None = None
) -> str:
    """How the mode compares with another one, on the same frames, and in cost with a rival."""
    what, cost = RIVAL_WORDS.get(mode, f"`{mode}`"), ""
    if other is not None and other.cpu_ms is not None and main.cpu_ms is not None:
        cost = f", at {main.cpu_ms:.1f} ms of CPU time a scan against {other.cpu_ms:.1f}"
    has = f"`{main.mode}` has {ratio.value:.2f} times the error of {what}"
    return f"{has} ({_interval(ratio)}){cost}."


def _controls(main: ComparisonRow, last: Mapping[str, ComparisonRow]) -> list[str]:
    """What the same sets give if nothing is chosen, and what choosing adds."""
    added = {
        "less": "Choosing added to that",
        "more": "Choosing took from that",
        "equal": "Choosing added nothing to that",
        "open": "Whether choosing adds to that is open",
        "unknown": "Whether choosing adds to that is not known",
    }
    said = []
    for mode, what in CONTROLS.items():
        row, ratio = last.get(mode), main.against.get(mode)
        if row is not None and row.ratio is not None:
            said.append(f"{what} has {_times(row)}.")
            if ratio is not None and not _is_yardstick(main):
                how = added[_surely(ratio)]
                said.append(f"{how}: {_against(main, mode, ratio)}")
    return said


def _nothing_to_choose(last: Mapping[str, ComparisonRow]) -> list[str]:
    """That no choice of one set could gain, if that is so."""
    best = last.get(ORACLES[0])
    if best is None or best.ratio is None or best.ratio <= 1.0 - NO_DIFFERENCE:
        return []
    return [
        "In hindsight, the best set of each sequence would gain less than 1 %: one set for all is "
        "as good as any choice of one set for each."
    ]


def _other(row: ComparisonRow) -> str:
    how = {
        "less": "is better",
        "more": "is worse",
        "equal": "changed nothing that counts",
        "open": "does not surely differ",
    }
    if (sure := _surely(_ratio(row))) in how:
        return f"`{row.mode}` {how[sure]}: {_times(row)}."
    return f"`{row.mode}` has {_times(row)}; {_UNSURE}."


def _of_baseline(row: ComparisonRow, rows: Sequence[ComparisonRow]) -> list[str]:
    if row.ratio is None:
        return []
    has, how = f"the baseline has {_times(row)}", _surely(_ratio(row))
    if how == "unknown":
        return [f"Whether tuning gains is not known, {_where(rows)}: {has}."]
    if how == "open":
        return [f"Whether tuning gains is open, {_where(rows)}: {has}."]
    if how == "equal":
        return [f"No difference that counts between baseline and fixed set: {has}."]
    if how == "less":
        return [f"The baseline is better than the fixed set: {has}."]
    gained = 100.0 * (1.0 - 1.0 / row.ratio)
    return [f"Tuning alone gained {gained:.0f} % of the baseline's error: {has}."]


def _preferred(row: ComparisonRow) -> float:
    return _ratio(row).value * (1.0 - NEARLY * (row.mode == "paired"))


def _advice(last: Mapping[str, ComparisonRow]) -> str:
    """What to do: drive what is surely better than the yardstick, the best of it.

    The best of several is so by chance, too: `paired` is kept if it is nearly as good.
    """
    drivable = {m: r for m, r in last.items() if m not in (*ORACLES, *CONTROLS) and r.ratio}
    better = [row for row in drivable.values() if _surely(_ratio(row)) == "less"]
    yardstick = _YARDSTICKS[next(iter(last.values())).yardstick]
    if better:
        best = min(better, key=_preferred)
        called = RIVAL_WORDS.get(best.mode, f"`{best.mode}`")
        look = ""
        if best.worst_tenth is not None and (best.stretches or 0) >= ENOUGH_STRETCHES:
            look = ", and look at where it is worse (pictures)" if best.worst_tenth > 1.1 else ""
        return f"What to do: drive {called}{look}."
    others = [r for r in drivable.values() if r.mode != r.yardstick and not _is_yardstick(r)]
    if any(_surely(_ratio(row)) == "unknown" for row in others):
        return (
            f"What to do: replay {MIN_RECORDINGS} test recordings or more, or longer ones (at "
            f"least {MIN_BLOCKS} sub-trajectories each); without, nothing can be said of how sure "
            f"this is. Until then, drive the {yardstick}."
        )
    promising = [r for r in others if _ratio(r).value < 1.0 - NO_DIFFERENCE]
    if any(_surely(_ratio(row)) == "open" for row in promising):
        return f"What to do: replay more test sequences; until they decide, drive the {yardstick}."
    return f"What to do: drive the {yardstick}; nothing is surely better."
