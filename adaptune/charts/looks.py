"""How a chart looks, on paper and in a browser alike: colours, order, rows and what is thinned."""

import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from numpy.typing import NDArray

from adaptune.charts.chart import (
    Axis,
    Band,
    Bars,
    Chart,
    Drawn,
    Line,
    Mark,
    Panel,
    Points,
    Shares,
    Spans,
    Values,
)
from adaptune.drawing import LINES, OTHERS, POINTS

_COLOURS = tuple(OTHERS[i] for i in (4, 0, 2, 3, 5))  # yellow is too light for a line
_DASHES: tuple[tuple[float, ...], ...] = ((), (6.0, 2.0), (1.0, 1.5), (6.0, 2.0, 1.0, 2.0))
_MARKERS = ("o", "s", "^", "D", "v", "X", "P")
_HATCHES = ("", "///", "...", "\\\\\\", "xxx", "---")
_NAMELESS = "#666666"
DASHED = (4.0, 2.0)
"""Strokes and gaps of a line that is to be dashed, in widths of the line."""
TINTS = ("#dbe9f6", "#fbe3d0", "#dcefdc", "#efdff0", "#e8e8e8", "#fbf3c4")
"""Grounds of spans, from one name to the next."""
UNKNOWN = "#bbbbbb"
"""Colour of points without a number where colours say numbers."""
NO_DATA = "no data"
"""What an empty panel says."""
MOST = 3000
"""Most points of a line that are drawn."""
_MOST_FAINT = 600
MANY = 1000
"""Points from which on they are small, and lie below lines; in an SVG they are pixels."""


@dataclass(frozen=True)
class Look:
    """How whatever has one name is drawn."""

    colour: str
    width: float = 1.4  # of a line, in points
    dash: tuple[float, ...] = ()  # strokes and gaps, in widths of the line; none if it is solid
    marker: str = "o"  # as matplotlib names it
    hatch: str = ""  # likewise


def looks(chart: Chart) -> dict[str, Look]:
    """The look of each name in a chart, in the order in which they appear.

    Modes have theirs from `adaptune.drawing`. Other names differ in colour as well as in dashes,
    markers and hatches.
    """
    names = dict.fromkeys(name for panel in chart.panels for name in _names(panel))
    modes = {name: _mode(name) for name in names if name in LINES or name in POINTS}
    taken = {look.colour for look in modes.values()}
    colours = [colour for colour in _COLOURS if colour not in taken]
    others = {
        name: Look(colour, dash=dash, marker=marker, hatch=hatch)
        for name, colour, dash, marker, hatch in zip(
            (name for name in names if name and name not in modes),
            *map(cycle, (colours, _DASHES, _MARKERS, _HATCHES)),
            strict=False,
        )
    }
    known = {"": Look(_NAMELESS)} | modes | others
    return {name: known[name] for name in names}


def _mode(name: str) -> Look:
    line, point = LINES.get(name, {}), POINTS.get(name, {})
    dash = line["ls"][1] if "ls" in line else ()
    return Look((line or point)["color"], line.get("lw", 1.4), dash, point.get("marker", "o"))


def _names(panel: Panel) -> Iterator[str]:
    for item in panel.drawn:
        if isinstance(item, Shares):
            yield from item.names
        elif not isinstance(item, Mark):
            yield item.name


def layered(panel: Panel) -> list[Drawn]:
    """What a panel shows, the lowest first."""
    return sorted(panel.drawn, key=_layer)


def _layer(item: Drawn) -> float:
    if isinstance(item, Line | Points) and item.faint:
        return 4.0
    if isinstance(item, Points) and len(item.x) > MANY:
        return 4.5
    if isinstance(item, Line):
        # Equal lines of modes lie on each other from wide to narrow.
        return 5.0 + (list(LINES).index(item.name) if item.name in LINES else len(LINES)) / 100.0
    order = (Spans, Shares, Bars, Band, Mark)
    return float(order.index(type(item))) if isinstance(item, order) else 6.0


def rows(chart: Chart, columns: int) -> list[tuple[float, Sequence[Panel]]]:
    """The panels row by row, and how high each row is, of which 1 is usual."""
    cut = [chart.panels[i : i + columns] for i in range(0, len(chart.panels), columns)]
    return [(max(map(_height, panels)), panels) for panels in cut]


def _height(panel: Panel) -> float:
    """A square needs more of it, and names below each other need a line each."""
    names = len(panel.y.names or ())
    return max(panel.height * (1.5 if panel.equal else 1.0), 0.3 + 0.09 * names)


def span_tints(spans: Spans) -> list[tuple[float, float, str, str]]:
    """Begin, end, name and colour of each span that is shaded."""
    edges = np.asarray(spans.edges, float)
    different = list(dict.fromkeys(name for name in spans.names if name))
    return [
        (begin, end, name, TINTS[-2 if spans.name else different.index(name) % len(TINTS)])
        for begin, end, name in zip(edges[:-1], edges[1:], spans.names, strict=True)
        if name
    ]


def numbers(values: Values, axis: Axis) -> NDArray[np.float64]:
    """Values along an axis as numbers; what is not finite becomes NaN."""
    if axis.names is not None:
        place = {name: float(i) for i, name in enumerate(axis.names)}
        values = [place[value] if isinstance(value, str) else value for value in values]
    made = np.array(values, np.float64)
    made[~np.isfinite(made)] = np.nan
    return made


def colours(points: Points) -> NDArray[np.float64]:
    """What the colours of points say; NaN where they say nothing, also on a logarithmic scale."""
    made = numbers(points.colour if points.colour is not None else (), Axis(""))
    if points.log_colour:
        made[~(made > 0.0)] = np.nan
    return made


def shares_of(shares: Shares) -> NDArray[np.float64]:
    """Shares of shape (k, n); what is not known is none."""
    made = np.array(shares.shares, np.float64).reshape(len(shares.names), len(shares.x))
    return np.where(np.isfinite(made), made, 0.0)


def band_edges(band: Band, panel: Panel) -> tuple[NDArray[np.float64], ...]:
    """x, low and high of a band; a logarithmic axis has no zero, so that low stays above it."""
    low, high = numbers(band.low, panel.y), numbers(band.high, panel.y)
    if panel.y.log:
        low = np.where(low > 0.0, low, 0.1 * high)
    return numbers(band.x, panel.x), low, high


def marks(panel: Panel) -> list[Mark]:
    """The marks that lie on a panel's axes; a logarithmic axis has no zero."""
    found = [item for item in panel.drawn if isinstance(item, Mark)]
    axes = {"x": panel.x, "y": panel.y}
    return [mark for mark in found if _lies_on(mark.at, axes[mark.axis])]


def _lies_on(value: float, axis: Axis) -> bool:
    low, high = sorted(axis.limits or (-np.inf, np.inf))
    return bool(low <= value <= high) and (value > 0.0 or not axis.log)


def is_empty(panel: Panel) -> bool:
    """Whether a panel has no data to show."""
    return not any(np.isfinite(x + y).any() for x, y in _coordinates(panel))


def positive_extent(panel: Panel, which: str) -> tuple[float, float] | None:
    """Least and greatest of the values above zero along the x or y axis; None without any."""
    found = [at[which == "y"].ravel() for at in _coordinates(panel)]
    found += [np.array([m.at]) for m in panel.drawn if isinstance(m, Mark) and m.axis == which]
    values = np.concatenate([np.empty(0), *found])
    values = values[values > 0.0]
    return (float(values.min()), float(values.max())) if len(values) else None


def _coordinates(panel: Panel) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """X and y of what a panel shows."""
    for item in panel.drawn:
        match item:
            case Line() | Points():
                yield numbers(item.x, panel.x), numbers(item.y, panel.y)
            case Band():
                x, low, high = band_edges(item, panel)
                yield x, np.array([low, high])
            case Bars(flat=True):
                yield numbers(item.heights, panel.x), numbers(item.x, panel.y)
            case Bars():
                yield numbers(item.x, panel.x), numbers(item.heights, panel.y)
            case Shares():
                yield numbers(item.x, panel.x), shares_of(item)


def thinned(*columns: NDArray[np.float64], faint: bool = False) -> NDArray[np.intp]:
    """Which points of a line to draw where it has many.

    Of each stretch the lowest and the highest of every column stay, and a gap stays a gap.

    Parameters
    ----------
    columns
        Coordinates, each of shape (n,); NaN interrupts the line.
    faint
        Whether the line lies in the background, where fewer points will do.

    Returns
    -------
    Indices, which rise.
    """
    n, most = len(columns[0]), _MOST_FAINT if faint else MOST
    if n <= most:
        return np.arange(n)
    gaps = np.isnan(np.sum(columns, axis=0))
    kept = {0, n - 1}
    for some in np.array_split(np.arange(n), most // (2 * len(columns) + 2)):
        missing = gaps[some]
        kept.add(int(some[0]))
        if missing.any():
            kept.add(int(some[missing.argmax()]))
        if known := some[~missing].tolist():
            for column in columns:
                there = column[known]
                kept |= {known[int(there.argmin())], known[int(there.argmax())]}
    return np.array(sorted(kept))


def wrapped(words: str, letters: float) -> str:
    """Words on lines of at most so many letters, where they can be broken."""
    lines = words.splitlines() or [""]
    width = max(int(letters), 8)
    lines = [re.sub(rf"\S{{{width + 1},}}", lambda long: _cut(long[0], width), s) for s in lines]
    return "\n".join(part for line in lines for part in textwrap.wrap(line, width) or [""])


def _cut(name: str, width: int) -> str:
    """A long name with spaces where it is best broken: after underscores, slashes and points."""
    parts = [""]
    for part in re.split(r"(?<=[_/.])", name):
        if parts[-1] and len(parts[-1] + part) > width:
            parts.append("")
        parts[-1] += part
    return " ".join(parts)
