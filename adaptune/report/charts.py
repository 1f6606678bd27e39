"""A chart as data: what is drawn, and not how; `adaptune.report.drawing` draws it."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Values = NDArray[Any] | Sequence[Any]
"""Numbers, or words."""


@dataclass(frozen=True)
class Axis:
    """An axis; its label names the unit."""

    label: str
    log: bool = False
    names: tuple[str, ...] | None = None  # of the values 0, 1, 2, ..., where it has names
    limits: tuple[float, float] | None = None  # where they do not follow from the data


@dataclass(frozen=True)
class Line:
    """A line through points, or steps that last until the next point."""

    x: Values
    y: Values  # NaN interrupts it
    name: str  # in the legend; of a mode or a place, its own, whose colour it then has
    steps: bool = False
    dashed: bool = False
    faint: bool = False  # lies in the background
    width: float = 1.8  # pixels


@dataclass(frozen=True)
class Points:
    """Markers."""

    x: Values
    y: Values
    name: str  # in the legend; of a mode, the mode's, whose colour and marker they then have
    colour: Values | None = None  # finite numbers, on a colour bar; by logarithm if all are > 0
    colour_label: str = ""
    texts: Values | None = None  # what is told of each point in a browser
    faint: bool = False
    shape: str | None = None  # of the markers, see `adaptune.report.looks.Look`


@dataclass(frozen=True)
class Band:
    """The space between two lines, as of an interval."""

    x: Values
    low: Values
    high: Values
    name: str
    share: bool = False  # of a whole: one of several on each other, in steps, see `shares`


@dataclass(frozen=True)
class Spans:
    """Segments along x that are shaded and named, such as the scenes of a course."""

    edges: Values  # of shape (n + 1,)
    names: tuple[str, ...]  # of shape (n,); an empty name is not shaded
    name: str = ""  # in the legend, if any


@dataclass(frozen=True)
class Words:
    """Names at points; one that would lie on another is left out."""

    x: Values
    y: Values
    words: Values


Drawn = Line | Points | Band | Spans | Words


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    x: Axis
    y: Axis
    drawn: tuple[Drawn, ...]
    title: str = ""
    equal: bool = False  # one metre is as long along x as along y
    height: float = 1.0  # relative to the other rows


@dataclass(frozen=True)
class Chart:
    """A figure of one panel or several."""

    key: str  # names its files and its anchor
    title: str
    panels: tuple[Panel, ...]  # row by row
    caption: str = ""  # what it shows, in a sentence or two
    columns: int = 1
    shared_x: bool = False  # panels below each other have the same x axis, unless they are `equal`


def shares(x: Values, parts: NDArray[np.float64], names: Iterable[str]) -> list[Band]:
    """Shares of a whole, of shape (k, n), stacked; each lasts until the next of n points."""
    ends = np.vstack([np.zeros(len(x)), np.cumsum(np.nan_to_num(parts), axis=0)])
    return [Band(x, ends[i], ends[i + 1], name, share=True) for i, name in enumerate(names)]


def chart_rows(chart: Chart) -> list[dict[str, Any]]:
    """What a chart draws as rows of a table: a point each, with its panel and its name."""
    rows = []
    for number, panel in enumerate(chart.panels, start=1):
        for item in panel.drawn:
            if isinstance(item, Words):
                continue  # they name what is drawn
            columns = {column: getattr(item, key, None) for key, column in _PARTS.items()}
            if isinstance(item, Spans):
                columns |= {"text": item.names, "x": item.edges[:-1]}
            columns = {column: of for column, of in columns.items() if of is not None}
            about = {"panel": panel.title or number, "name": item.name}
            about |= {"x axis": panel.x.label, "y axis": panel.y.label}
            for values in zip(*columns.values(), strict=True):
                of_point = about | dict(zip(columns, values, strict=True))
                rows.append({key: of_point.get(key) for key in _CSV_COLUMNS})
    return rows


_PARTS = {key: key.removesuffix("s") for key in ("x", "y", "low", "high", "colour", "texts")}
_CSV_COLUMNS = ("panel", "name", *_PARTS.values(), "x axis", "y axis")
"""Of `chart_rows`."""
Charts = Iterator[Chart | str | None]
"""Charts of a part of a study; of what is missing, a sentence that says what to run, or None."""
