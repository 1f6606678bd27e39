"""Charts of what `adaptune validate` found."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from adaptune.charts.chart import Axis, Band, Chart, Drawn, Line, Mark, Panel, Points
from adaptune.drawing import POINTS
from offline.expected_loss import figures
from offline.objective import pareto_front
from offline.pictures import CANCELLING, RATIO, THRIFTY

MOST_NAMED = 8
"""With more recordings, stretches do not show of which they are."""
_FACTS = ("recording", "stretch", "fixed [%]")


def stretch_chart(rows: Sequence[Mapping[str, Any]]) -> Chart | None:
    """Ratio to the fixed set's error on every stretch left out, sorted: a panel for each mode.

    Parameters
    ----------
    rows
        Of ``stretches.json``.
    """
    recordings = [str(row["recording"]) for row in rows]
    panels = []
    for mode in (key for key in (rows[0] if rows else {}) if key not in _FACTS):
        ratios = np.array([row.get(mode, np.nan) for row in rows], float)
        # One that is the fixed set everywhere says nothing.
        if not np.isfinite(ratios).all() or (np.abs(ratios - 1.0) < 1e-9).all():
            continue
        panels.append(_stretch_panel(mode, ratios, recordings))
    if not panels:
        return None
    return Chart(
        "stretches",
        "Ratio to the fixed set's error on every stretch left out",
        tuple(panels),
        "Each point is a stretch that nothing was trained on, sorted by its ratio; below 1 the "
        "mode beats the fixed set. The band is the 95 % interval of the geometric mean over all "
        "stretches. Oracles know the errors in advance: they bound what choosing one set can gain.",
        columns=min(2, len(panels)),
    )


def _stretch_panel(mode: str, ratios: np.ndarray[Any, Any], recordings: Sequence[str]) -> Panel:
    order = np.argsort(ratios, kind="stable")
    rank = np.empty(len(ratios))
    rank[order] = np.arange(1, len(ratios) + 1)
    of = figures(np.log(ratios), recordings)
    ends = np.array([0.5, len(ratios) + 0.5])
    drawn: list[Drawn] = []
    if np.isfinite([of.low, of.high]).all() and of.low > 0.0:
        drawn.append(Band(ends, [of.low] * 2, [of.high] * 2, "95 % interval of the mean"))
    drawn += [
        Line(ends, [of.geometric] * 2, "geometric mean", dashed=True),
        Line(ends, [1.0, 1.0], "fixed", faint=True),
    ]
    named = dict.fromkeys(recordings)
    few = len(named) <= MOST_NAMED
    for name in named if few else ("stretch",):
        mine = [i for i, own in enumerate(recordings) if own == name or not few]
        texts = [recordings[i] for i in mine]
        drawn.append(Points(rank[mine], ratios[mine], name, texts=texts))
    title = f"{mode}: {of.geometric:.2f} ({of.low:.2f}-{of.high:.2f})"
    x = Axis("stretch, by rising ratio [-]", limits=(0.5, float(ends[1])))
    return Panel(x, Axis(RATIO, log=True), tuple(drawn), title)


def frontier_chart(rows: Sequence[Mapping[str, Any]], budget: float | None = None) -> Chart | None:
    """Error over cost of sets, banks and modes.

    Parameters
    ----------
    rows
        Of ``costs.json``, see `offline.frontier`.
    budget
        Milliseconds of CPU time a scan that may be spent, if there is a limit.
    """
    known = [r for r in rows if np.isfinite([r["ms a scan"], r["ratio"]]).all()]
    if not known:
        return None
    banks = {"bank of 2, 3, ... members": CANCELLING, "the same, by gain per cost": THRIFTY}
    others = [r for r in known if r["what"] not in POINTS and r["what"] not in banks.values()]
    drawn: list[Drawn] = []
    for what in dict.fromkeys(r["what"] for r in others):
        mine = [r for r in others if r["what"] == what]
        texts = [f"trial {r['name']}" for r in mine]
        drawn.append(Points(*_xy(mine), str(what), texts=texts))
    if others:
        x, y = _xy(others)
        front = pareto_front(np.column_stack([x, y]))
        drawn.append(Line(x[front], y[front], "Pareto front of the sets", steps=True))
    for label, what in banks.items():
        mine = [r for r in known if r["what"] == what]
        texts = [f"{r['name']} members" for r in mine]
        drawn += [Line(*_xy(mine), label), Points(*_xy(mine), label, texts=texts)] if mine else []
    drawn += [Points(*_xy([r]), str(r["what"])) for r in known if r["what"] in POINTS]
    drawn += [Mark(budget, "budget", "x")] if budget is not None else []
    drawn.append(Mark(1.0))
    ratios = _xy(known)[1]
    y_axis = Axis(RATIO, log=True, limits=(0.9 * float(ratios.min()), _top(ratios)))
    return Chart(
        "frontier",
        "Error over cost: sets, banks and modes",
        (Panel(Axis("CPU time a scan [ms]", log=True), y_axis, tuple(drawn)),),
        "Lower is better, and further left is cheaper. Banks and modes were chosen without what "
        "is left out. Sets with more than five times the fixed set's error are not shown.",
    )


def _xy(rows: Sequence[Mapping[str, Any]]) -> tuple[Any, Any]:
    found = np.array([(r["ms a scan"], r["ratio"]) for r in rows], float)
    return found[:, 0], found[:, 1]


def _top(ratios: np.ndarray[Any, Any]) -> float:
    return min(1.1 * float(ratios.max()), 5.0)
