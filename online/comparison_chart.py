"""The chart of a comparison: the ratio of each mode's error, over all sequences and on each."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from adaptune.charts.chart import (
    Axis,
    Chart,
    Charts,
    Drawn,
    Line,
    Mark,
    Panel,
    Points,
    charts_of,
)
from online.comparison_row import ALL, ComparisonRow

_VERSUS = "vs "
_LINE, _BELOW = 0.12, 0.3
"""Height of a mode's line, and by which share of it the ratios on each sequence lie lower."""
_MOST_NAMED = 6
"""Sequences that each have a look of their own."""


def charts_of_comparison(rows: Sequence[ComparisonRow]) -> Charts:
    """The chart of a comparison, or why there is none."""
    chart = comparison_chart([row.columns() for row in rows])
    return charts_of((chart or "No ratios of errors: no sequence has a reference.",))


def comparison_chart(rows: Sequence[Mapping[str, Any]]) -> Chart | None:
    """Ratios to the yardstick's error, a line for each mode, the least at the top.

    Parameters
    ----------
    rows
        Of ``comparison.json``, see `online.comparison_row.ComparisonRow.columns`.
    """
    versus = next((key for key in (rows[0] if rows else {}) if key.startswith(_VERSUS)), "")
    yardstick = versus.removeprefix(_VERSUS)
    known = [
        row
        for row in rows
        if row.get(versus) is not None and row["mode"] != yardstick and not row.get("twin")
    ]
    if not known:
        return None
    # Those over all sequences, or on the only one.
    last = [row for row in known if row["sequence"] == known[-1]["sequence"]]
    last.sort(key=lambda row: float(row[versus]), reverse=True)
    place = {str(row["mode"]): float(i) for i, row in enumerate(last)}
    of_sequences = [row for row in known if row["sequence"] != ALL and row["mode"] in place]
    several = last[0]["sequence"] == ALL
    where = "geometric mean over all sequences" if several else str(last[0]["sequence"])
    drawn: list[Drawn] = [
        *_intervals(last),
        _ratios(last, versus, place, where),
        Mark(1.0, axis="x"),
    ]
    if several:
        drawn += _of_sequences(of_sequences, versus, place)
    x = Axis(f"error over that of {yardstick} [-]", log=True)
    y = Axis("", names=tuple(place))
    height = 0.3 + _LINE * len(place)
    return Chart(
        "comparison",
        f"Error of each mode over that of {yardstick}, on the test sequences",
        (Panel(x, y, tuple(drawn), height=height),),
        f"Left of the dashed line means less error than {yardstick}, right of it more; the least "
        f"error is at the top. Intervals are shown where the recordings are long enough, or many "
        f"enough." + (" Below each mean are the ratios on each sequence." if several else ""),
    )


def _intervals(rows: Sequence[Mapping[str, Any]]) -> list[Drawn]:
    """The intervals of rows, one below the other, where there are some."""
    ends = [
        (row["ratio_low"], row["ratio_high"], i)
        for i, row in enumerate(rows)
        if row.get("ratio_low") is not None and row.get("ratio_high") is not None
    ]
    x = [value for low, high, _ in ends for value in (low, high, np.nan)]
    y = [float(i) for *_, i in ends for _ in range(3)]
    return [Line(x, y, "95 % interval")] if ends else []


def _ratios(
    rows: Sequence[Mapping[str, Any]],
    versus: str,
    place: Mapping[str, float],
    name: str,
    shift: float = 0.0,
    **look: Any,
) -> Points:
    """Ratios of some rows, each on the line of its mode, or a share of a line below it."""
    x = [float(row[versus]) for row in rows]
    y = [place[str(row["mode"])] - shift for row in rows]
    texts = [f"{row['mode']}, {row['sequence']}" for row in rows]
    return Points(x, y, name, texts=texts, **look)


def _of_sequences(
    rows: Sequence[Mapping[str, Any]], versus: str, place: Mapping[str, float]
) -> list[Drawn]:
    """The ratios on each sequence; of many they have the same look."""
    names = list(dict.fromkeys(str(row["sequence"]) for row in rows))
    if len(names) > _MOST_NAMED:
        return [_ratios(rows, versus, place, "each sequence", _BELOW, faint=True, marker="o")]
    return [
        _ratios([row for row in rows if row["sequence"] == name], versus, place, name, _BELOW)
        for name in names
    ]
