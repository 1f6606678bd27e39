"""Tables of a comparison, for the terminal and Markdown."""

from collections.abc import Mapping, Sequence
from typing import Any

from adaptune.model.registry import rule_class
from adaptune.paired import ERROR_FACTOR, MIN_RECORDINGS
from adaptune.report.tables import Listing
from online.statistics import ALL, ORACLE, ComparisonRow

YARDSTICKS = {"fixed": "fixed set", "baseline": "baseline"}


def tables(rows: Sequence[ComparisonRow], length: float) -> list[Listing]:
    """The modes over all sequences, their errors on each, and errors as other tools define them.

    `length` is a sub-trajectory's, in metres.
    """
    made = [_of_modes(rows, length)]
    if rows[-1].sequence == ALL:
        made.append(_of_sequences(rows, length))
    return [*made, *_standard(rows)]


def controls(rows: Sequence[ComparisonRow], length: float) -> list[Listing]:
    """All modes with their errors, ratios and costs, where there are others than on the front."""
    if {row.mode for row in rows} <= {"baseline", "fixed", "adaptive", "untrained", ORACLE}:
        return []
    whole, ratio = _of_modes(rows, length), f"vs {rows[0].yardstick}"
    kept = ("mode", "RTE [%]", ratio, "95 %", "worst tenth", "restarts", "cost [ms]")
    cells = [{k: v for k, v in row.items() if k in kept} for row in whole.rows]
    return [Listing(whole.title, cells)]


_DRIVEN = {
    "baseline": "the odometry with its own parameters",
    "fixed": "the one set that is best in training within the budget",
    "untrained": "a bank without a model: sets around the baseline, weighed while driving",
    "even": "the bank with even weights: a control, which chooses nothing",
    ORACLE: "the best set of each sequence, known in hindsight only",
}
"""What each mode drives that is no selection rule."""


def modes_in_words(rows: Sequence[ComparisonRow]) -> Listing:
    """What each mode of the tables drives, for readers without the guide."""
    modes = dict.fromkeys(row.mode for row in rows)
    cells = [
        {"mode": mode, "what it drives": _DRIVEN.get(mode) or rule_class(mode).sentence}
        for mode in modes
    ]
    return Listing("What the modes are", cells)


def last_rows(rows: Sequence[ComparisonRow]) -> list[ComparisonRow]:
    """The rows over all sequences, or those of the only one."""
    return [row for row in rows if row.sequence == rows[-1].sequence]


def _of_modes(rows: Sequence[ComparisonRow], length: float) -> Listing:
    last = last_rows(rows)
    cells = [row.summary_columns() for row in last]
    # A column in which nothing is known, or nothing happened, tells nothing.
    empty = {k for k in cells[0] if all(row[k] is None for row in cells)} - {"RTE [%]"}
    empty |= {k for k in ("restarts", "switches") if not any(row[k] for row in cells)}
    cells = [{k: v for k, v in row.items() if k not in empty} for row in cells]
    n = len({row.sequence for row in rows if row.rte is not None} - {ALL})
    where = f"on {n} sequences" if last[0].sequence == ALL else f"on {last[0].sequence}"
    return Listing(f"RTE over {length:g} m {where}", cells, _caption(rows, cells[0]))


def _caption(rows: Sequence[ComparisonRow], shown: Mapping[str, Any]) -> str:
    yardstick = rows[0].yardstick
    said = [
        "Intervals of 95 %: from blocks of both modes' errors at the same scans, where there are "
        f"enough; with fewer than {MIN_RECORDINGS} test recordings, they speak of these alone.",
        f"vs {yardstick}: geometric mean of the ratios to the {YARDSTICKS[yardstick]}'s RTE."
        * (rows[-1].sequence == ALL),
        "Worst tenth: that mean over the worst tenth of the segments." * ("worst tenth" in shown),
        "Better / worse: sequences on which the error is less or more by 1 %."
        * ("better / worse" in shown),
        "The oracle knows the errors: the best set of each sequence."
        * any(row.mode == ORACLE for row in rows),
        "Estimated: by the odometry itself while driving, without the reference."
        * any(row.estimated is not None for row in rows),
        f"An estimated reference is wrong itself, by about as much as is told, which pulls ratios "
        f"towards 1; intervals allow for {ERROR_FACTOR:g} times that."
        * any(row.reference == "estimated" for row in rows),
    ]
    return " ".join(filter(None, said))


def _of_sequences(rows: Sequence[ComparisonRow], length: float) -> Listing:
    """One row a sequence: the error of each mode."""
    modes = [mode for mode in dict.fromkeys(row.mode for row in rows) if mode != ORACLE]
    judged = len({row.reference for row in rows if row.sequence != ALL}) > 1
    cells = []
    for name in dict.fromkeys(row.sequence for row in rows):
        by_mode = {row.mode: row for row in rows if row.sequence == name}
        line: dict[str, Any] = {"sequence": "average" if name == ALL else name}
        line |= {mode: by_mode[mode].rte if mode in by_mode else None for mode in modes}
        if judged:
            line["reference"] = "" if name == ALL else next(iter(by_mode.values())).reference
        cells.append(line)
    return Listing(f"RTE [%] over {length:g} m on each sequence", cells)


def _standard(rows: Sequence[ComparisonRow]) -> list[Listing]:
    last = [row for row in last_rows(rows) if row.standard is not None]
    if not last:
        return []
    kitti = any(row.standard is not None and bool(row.standard.kitti.lengths) for row in last)
    title = "Errors as evo" + (" and KITTI's benchmark define them" if kitti else " defines them")
    of_all, judged = last[0].sequence == ALL, any(row.reference == "estimated" for row in rows)
    caption = (
        "APE after alignment, RPE from scan to scan: root mean squares. Height: mean drift over "
        "the sub-trajectories, in percent of their length."
        + " An estimated reference counts as if it were true." * judged
        + " KITTI: mean over the lengths in the last column; needs 100 m." * kitti
        + " Means over the sequences" * of_all
        + "; KITTI over the sub-trajectories of all sequences" * (of_all and kitti)
        + "." * of_all
    )
    cells = [row.standard_columns(kitti) for row in last]
    return [Listing(title, cells, caption)]
