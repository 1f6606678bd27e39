"""Tables of a comparison, for the terminal, Markdown and LaTeX."""

from collections.abc import Mapping, Sequence
from typing import Any

from adaptune.report.tables import Listing
from online.statistics import ALL, ERROR_FACTOR, GAP, ORACLES, ComparisonRow, mean_of

_COUNTS = ("restarts", "switches")
_ERRORS = ("RTE [%]", "APE [m]", "RPE [m]", "height [%]", "KITTI [%]", "[deg/100 m]")
"""Columns of which the least is the best."""


def tables(rows: Sequence[ComparisonRow], length: float) -> list[Listing]:
    """The modes over all sequences, their errors on each, and errors as other tools define them.

    Parameters
    ----------
    rows
        Of one study.
    length
        Metres of a sub-trajectory.
    """
    made = [_of_modes(rows, length)]
    if rows[-1].sequence == ALL:
        made.append(_of_sequences(rows, length))
    standard = _standard(rows)
    return made if standard is None else [*made, standard]


_DRIVEN = {
    "baseline": "the odometry with its own parameters",
    "best_default": "of several odometries, the one that does best with its own parameters",
    "equal_cost": "the best set in training that costs no more than what is driven",
    "fixed": "the one set that is best in training",
    "adaptive": "what adapts with the least expected loss in training, or the fixed set",
    "untrained": "a bank without a model: sets around the baseline, weighed while driving",
    "even": "the bank with even weights: a control, which chooses nothing",
    "paper": "the set with the least expected error, as Koide et al. (IROS 2021) choose it",
    ORACLES[0]: "the best set of each sequence, known in hindsight only",
    ORACLES[1]: "the best set of every period between selections, known in hindsight only",
}
"""What each mode drives."""


def modes_in_words(rows: Sequence[ComparisonRow]) -> Listing:
    """What each mode of the tables drives, for readers without the guide."""
    modes = dict.fromkeys(row.mode for row in rows)
    cells = [{"mode": mode, "what it drives": _DRIVEN[mode]} for mode in modes]
    return Listing("What the modes are", cells)


def side_by_side(studies: Mapping[str, Sequence[ComparisonRow]]) -> list[Listing]:
    """Errors of several studies on each sequence, and over all, as in the paper's Table II.

    Parameters
    ----------
    studies
        The rows of each by its name. Sub-trajectories of all have the same length.
    """
    found = {
        (name, row.sequence, row.mode): row.rte for name, rows in studies.items() for row in rows
    }
    modes = {
        name: [m for m in dict.fromkeys(row.mode for row in rows) if m not in ORACLES]
        for name, rows in studies.items()
    }
    of_study = [{row.sequence for row in rows} - {ALL} for rows in studies.values()]
    every = [row.sequence for rows in studies.values() for row in rows if row.sequence != ALL]
    common = [name for name in dict.fromkeys(every) if all(name in of for of in of_study)]

    def line(label: str, sequences: Sequence[str]) -> dict[str, Any]:
        cells: dict[str, Any] = {"sequence": label}
        for name in studies:
            for mode in modes[name]:
                errors = [found.get((name, sequence, mode)) for sequence in sequences]
                cells[f"{name}: {mode}"] = mean_of(errors)
        return cells

    of_sequences = [line(name, [name]) for name in dict.fromkeys(every)]
    caption = ""
    if len(common) > 1:
        of_sequences.append(line("average", common))
        n = len(of_sequences) - 1 - len(common)
        caption = f"Average: over the {len(common)} sequences that all studies have." if n else ""
    changes = [
        {"study": name, **_change(row, rows)}
        for name, rows in studies.items()
        for row in _last(rows)
        if row.standard is not None and any(of.mode == "baseline" for of in rows)
    ]
    return [
        Listing("RTE [%] of all studies", of_sequences, caption, "row"),
        Listing("What each study changes against its baseline", changes),
    ]


def _last(rows: Sequence[ComparisonRow]) -> list[ComparisonRow]:
    """The rows over all sequences, or those of the only one."""
    return [row for row in rows if row.sequence == rows[-1].sequence]


def _of_modes(rows: Sequence[ComparisonRow], length: float) -> Listing:
    """One row a mode."""
    last = _last(rows)
    cells = [row.summary_columns() for row in last]
    # A column in which nothing is known, or nothing happened, tells nothing.
    empty = {k for k in cells[0] if all(row[k] is None for row in cells)} - {"RTE [%]"}
    empty |= {k for k in _COUNTS if not any(row[k] for row in cells)}
    cells = [{k: v for k, v in row.items() if k not in empty} for row in cells]
    for row, of in zip(cells, last, strict=True):
        row["_in_hindsight"] = of.mode in ORACLES
    n = len({row.sequence for row in rows if row.rte is not None} - {ALL})
    where = f"on {n} sequences" if last[0].sequence == ALL else f"on {last[0].sequence}"
    repeats = f", {last[0].repeats} replays each" if last[0].repeats > 1 else ""
    return Listing(
        f"RTE over {length:g} m {where}{repeats}", cells, _caption(rows, cells[0]), _ERRORS
    )


def _caption(rows: Sequence[ComparisonRow], shown: Mapping[str, Any]) -> str:
    said = [
        "Intervals of 95 %: paired block bootstrap, seed 0, where there is enough to draw from."
    ]
    yardstick = {"fixed": "fixed set", "baseline": "baseline"}[rows[0].yardstick]
    if rows[-1].sequence == ALL:
        said.append(
            f"vs {rows[0].yardstick}: geometric mean of the ratios to the {yardstick}'s RTE."
        )
    if "worst tenth" in shown:
        said.append("Worst tenth: that mean over the worst tenth of the stretches.")
    if "better / worse" in shown:
        said.append("Better / worse: sequences on which the error is less or more by 1 %.")
    if any(row.mode in ORACLES for row in rows):
        said.append(
            "Oracles know the errors: the best set of each sequence, and of every period. Much of "
            "the latter is chance, out of reach of any choice."
        )
    if GAP in shown:
        said.append("Gap closed: share of what the best set of each sequence, in hindsight, gains.")
    if any(row.estimated is not None for row in rows):
        said.append("Estimated: by the odometry itself while driving, without the reference.")
    if any(row.reference == "estimated" for row in rows):
        said.append(
            f"The error of an estimated reference pulls ratios towards 1, or hides what a mode has "
            f"in common with it; intervals allow for {ERROR_FACTOR:g} times its estimate."
        )
    return " ".join(said)


def _of_sequences(rows: Sequence[ComparisonRow], length: float) -> Listing:
    """One row a sequence: the error of each mode."""
    modes = [mode for mode in dict.fromkeys(row.mode for row in rows) if mode not in ORACLES]
    judged = len({row.reference for row in rows if row.sequence != ALL}) > 1
    cells = []
    for name in dict.fromkeys(row.sequence for row in rows):
        of = {row.mode: row for row in rows if row.sequence == name}
        line: dict[str, Any] = {"sequence": "average" if name == ALL else name}
        line |= {mode: of[mode].rte if mode in of else None for mode in modes}
        if judged:
            line["reference"] = "" if name == ALL else next(iter(of.values())).reference
        cells.append(line)
    return Listing(f"RTE [%] over {length:g} m on each sequence", cells, "", "row")


def _standard(rows: Sequence[ComparisonRow]) -> Listing | None:
    """Errors as evo and KITTI's benchmark define them."""
    last = [row for row in _last(rows) if row.standard is not None]
    if not last:
        return None
    kitti = any(row.standard is not None and row.standard.kitti.lengths for row in last)
    title = "Errors as evo" + (" and KITTI's benchmark define them" if kitti else " defines them")
    caption = "APE after alignment, RPE from scan to scan: root mean squares."
    caption += " Height: mean drift over the sub-trajectories, in percent of their length."
    if any(row.reference == "estimated" for row in rows):
        caption += " An estimated reference counts as if it were true."
    if kitti:
        caption += " KITTI: mean over the lengths in the last column; needs 100 m."
    if last[0].sequence == ALL:
        caption += " Means over the sequences" + (
            "; KITTI over the sub-trajectories of all sequences." if kitti else "."
        )
    cells = [row.standard_columns(kitti) for row in last]
    for row in cells:
        del row["sequence"]
    return Listing(title, cells, caption, _ERRORS)


def _change(row: ComparisonRow, rows: Sequence[ComparisonRow]) -> dict[str, Any]:
    """Errors of a mode, and by how many percent they differ from the baseline's."""
    (before,) = [other for other in _last(rows) if other.mode == "baseline"]
    assert row.standard is not None
    assert before.standard is not None
    cells: dict[str, Any] = {"mode": row.mode}
    pairs = {
        "RTE [%]": (row.rte, before.rte),
        "RPE [m]": (row.standard.rpe, before.standard.rpe),
        "APE [m]": (row.standard.ape, before.standard.ape),
    }
    for key, (mine, others) in pairs.items():
        cells[key], change = mine, f"{key[:3]} change [%]"
        cells[change] = f"{100 * (mine / others - 1):+.1f}" if mine and others else None
    return cells
