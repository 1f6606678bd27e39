"""Draw charts with Vega-Lite: in a browser and, by vl-convert, as PNG and SVG without one."""

import json
import re
import textwrap
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune._system.files import replacing
from adaptune.report.charts import (
    Axis,
    Band,
    Chart,
    Drawn,
    Line,
    Panel,
    Points,
    Spans,
    Values,
    Words,
    chart_rows,
)
from adaptune.report.looks import Look, looks
from adaptune.report.tables import csv_text

_MAP = ("#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#9bd93c")
"""A colour map whose lightness rises, without colours too light for a white ground."""
_MOST_POINTS = 1500
"""Most points of a line that are drawn."""
_MANY, _OUTLINED = 1000, 150
"""Points from which on they are small, and up to which they have outlines."""


def _layer(item: Drawn) -> float:
    """What a panel shows, from the lowest to the highest."""
    place = float([*_DRAW].index(type(item)))
    if isinstance(item, Line):
        # Of lines that coincide, one is seen between the dashes of the other.
        return place + 0.5 * item.dashed - 0.6 * item.faint
    behind = isinstance(item, Points) and (item.faint or len(item.x) > _MANY)
    return place - 1.5 if behind else place


def numbers(values: Values, axis: Axis) -> NDArray[np.float64]:
    """Values along an axis as numbers; NaN for what is not finite, or not on a logarithmic axis."""
    made = np.array(values, np.float64)
    made[~np.isfinite(made) | ((made <= 0.0) & axis.log)] = np.nan
    return made


def thinned(*columns: NDArray[np.float64]) -> NDArray[np.intp]:
    """Indices of the points of a line to draw where it has many.

    Of each segment the lowest and the highest of every column stay, and a gap stays a gap.
    """
    n = len(columns[0])
    if n <= _MOST_POINTS:
        return np.arange(n)
    kept = [0, n - 1]
    for some in np.array_split(np.arange(n), _MOST_POINTS // (2 * len(columns) + 2)):
        missing = np.isnan([column[some] for column in columns]).any(axis=0)
        kept += [some[0], some[missing.argmax()]]
        there = some[~missing]
        for column in columns if len(there) else ():
            kept += [there[column[there].argmin()], there[column[there].argmax()]]
    return np.unique(np.array(kept, np.intp))


def wrapped(words: str, letters: float) -> list[str]:
    """Words on lines of at most so many letters, where they can be broken."""
    width = max(int(letters), 8)
    return [part for line in words.splitlines() for part in textwrap.wrap(line, width)] or [""]


Spec = dict[str, Any]
_WIDTH, _LETTER, _LINE = 900, 6.5, 14
"""Pixels: width of a chart, width of a letter, about, and height of a line of words."""
_DARK = "#333333"
_Extent = dict[str, tuple[float, float]]
_CONFIG: Spec = {
    "font": "Liberation Sans, Arial, Helvetica, sans-serif",
    "view": {"stroke": None},
    "axis": {
        "gridColor": "#e6e6e6",
        "labelColor": _DARK,
        "titleColor": _DARK,
        "labelFontSize": 12,
        "titleFontSize": 12,
        "titleFontWeight": "normal",
        "labelLimit": 400,
        "titleLimit": 900,
        "labelFlush": False,
    },
    "legend": {"labelFontSize": 12, "titleFontSize": 12, "titleFontWeight": "normal"},
    "title": {"anchor": "start", "fontSize": 13, "fontWeight": "normal", "color": _DARK},
    "text": {"fontSize": 12},
    "concat": {"spacing": 18},
}


def spec(chart: Chart, titled: bool = True) -> Spec:
    """A chart as a specification of Vega-Lite 6; `titled` if its title stands above it."""
    columns = max(1, min(chart.columns, len(chart.panels)))
    rows = [chart.panels[i : i + columns] for i in range(0, len(chart.panels), columns)]
    legends = sum(max(map(_legend_width, chart.panels[c::columns])) for c in range(columns))
    width = round((_WIDTH - legends) / columns)
    usual = 300.0 if len(rows) == 1 else 150.0 if chart.shared_x else 240.0
    every = {"": Look(_DARK)} | looks(chart)
    sharing = [chart.shared_x and not panel.equal for panel in chart.panels]
    own = [_extent(panel, "x") for panel, s in zip(chart.panels, sharing, strict=True) if s]
    panels = []
    for i, panel in enumerate(chart.panels):
        high = round(usual * max(map(_height, rows[i // columns])))
        extent = {which: _extent(panel, which) for which in "xy"}
        if sharing[i]:
            extent["x"] = min(x[0] for x in own), max(x[1] for x in own)
        if panel.equal:
            extent, high = _equal(extent, width, 1.6 * high)
        below = sharing[i] and i + columns < len(chart.panels)
        panels.append(_Drawing(panel, every, {"x": width, "y": high}, extent).spec(below))
    resolve = {"scale": {"color": "independent"}}
    row = {"concat": panels, "columns": columns, "resolve": resolve}
    made: Spec = {
        "$schema": "https://vega.github.io/schema/vega-lite/v6.json",
        "vconcat": [*_legend(chart, every), row],
        "config": _CONFIG,
        "background": "white",
        "padding": 8,
    }
    if titled:
        title = wrapped(chart.title, _WIDTH / 9.0)
        made["title"] = {"text": title, "fontSize": 16, "offset": 14}
    return made


def draw_chart(chart: Chart, *files: Path) -> None:
    """Draw a chart into files by their suffix: PNG, SVG, PDF, or CSV with its data."""
    import vl_convert

    svg = vl_convert.vegalite_to_svg(spec(chart))
    # Vega numbers on from picture to picture; the same picture has the same bytes.
    ids = re.findall(r'(?<= id=")[a-z]+_?\d+(?=")', svg)
    for i, name in enumerate(dict.fromkeys(ids)):
        svg = svg.replace(f'"{name}"', f'"id-{i}"').replace(f"#{name})", f"#id-{i})")
    for file in files:
        with replacing(file) as temporary:
            suffix = file.suffix.lower()
            if suffix in (".svg", ".csv"):
                text = svg if suffix == ".svg" else csv_text(chart_rows(chart))
                temporary.write_text(text, "utf-8")
            elif suffix == ".pdf":
                temporary.write_bytes(vl_convert.svg_to_pdf(svg))
            else:
                temporary.write_bytes(vl_convert.svg_to_png(svg, scale=1.5))


def _height(panel: Panel) -> float:
    """How high a panel is, of which 1 is usual: names below each other need a line each."""
    return max(panel.height, 0.3 + 0.09 * len(panel.y.names or ()))


def _legend_width(panel: Panel) -> float:
    """Pixels for what stands left and right of a panel."""
    names = [part for name in panel.y.names or () for part in wrapped(name, 32)]
    coloured = (isinstance(item, Points) and item.colour is not None for item in panel.drawn)
    bar = not panel.equal and any(coloured)
    return 44.0 + max(22.0, _LETTER * max(map(len, names), default=0)) + 110.0 * bar


def _coordinates(panel: Panel) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """X and y of what a panel shows, flat."""
    for item in panel.drawn:
        match item:
            case Line(x, y) | Points(x, y):
                yield numbers(x, panel.x), numbers(y, panel.y)
            case Band(x, low, high):
                yield numbers(x, panel.x), numbers(low, panel.y)
                yield numbers(x, panel.x), numbers(high, panel.y)


def _is_empty(panel: Panel) -> bool:
    return not any(np.isfinite(x).any() and np.isfinite(y).any() for x, y in _coordinates(panel))


def _extent(panel: Panel, which: str) -> tuple[float, float]:
    """Where an axis begins and ends."""
    axis = panel.x if which == "x" else panel.y
    if axis.limits is not None:
        return axis.limits
    if axis.names is not None:
        return -0.6, len(axis.names) - 0.4
    values = np.concatenate([[], *(pair[which == "y"] for pair in _coordinates(panel))])
    values = values[np.isfinite(values)]
    if not len(values):
        return 1.0, 10.0
    low, high = float(values.min()), float(values.max())
    # A line may begin at the edge; points are not cut.
    named = any(isinstance(item, Words) for item in panel.drawn)
    marked = any(isinstance(item, Points) and not item.faint for item in panel.drawn)
    share = 0.06 if which == "y" or named else 0.03 if marked else 0.01
    if axis.log:
        beyond = max((high / low) ** share, 1.0 + share)
        return low / beyond, high * beyond
    beyond = share * (high - low) or 0.1 * abs(high) or 1.0
    begins = low == 0.0 < high and not (which == "x" and (marked or named))
    return (low if begins else low - beyond), high + beyond


def _equal(extent: _Extent, width: int, most: float) -> tuple[_Extent, int]:
    """Extents on which a metre along x is as long as one along y, and the height for them."""
    (left, right), (low, high) = extent.values()
    metre = width / (right - left)
    height = float(np.clip(metre * (high - low), 0.12 * width, most))
    metre = min(metre, height / (high - low))
    x, y = 0.5 * (left + right), 0.5 * (low + high)
    half_x, half_y = 0.5 * width / metre, 0.5 * height / metre
    return {"x": (x - half_x, x + half_x), "y": (y - half_y, y + half_y)}, round(height)


def _table(**columns: Any) -> Spec:
    """Columns as the data of a mark; what is not finite is left out."""

    def cell(value: Any) -> Any:
        if isinstance(value, str):
            return value
        return float(f"{value:.6g}") if np.isfinite(value) else None

    rows = zip(*([cell(value) for value in column] for column in columns.values()), strict=True)
    return {"values": [dict(zip(columns, row, strict=True)) for row in rows]}


class _Drawing:
    """A panel; along x and y, `size` is in pixels."""

    def __init__(
        self, panel: Panel, every: dict[str, Look], size: dict[str, int], extent: _Extent
    ) -> None:
        self._panel, self._looks, self._size, self._extent = panel, every, size, extent
        self._axes = {"x": panel.x, "y": panel.y}

    def spec(self, below: bool) -> Spec:
        """The panel; `below` is whether one that shares its x axis lies there."""
        panel, (width, height) = self._panel, self._size.values()
        self._x, self._y = self._channel("x", hidden=below), self._channel("y")
        made: Spec = {"width": width, "height": height}
        if panel.title:
            words = wrapped(panel.title, width / _LETTER)
            made["title"] = {"text": words, "offset": 6, "frame": "group"}
        if _is_empty(panel):
            for channel in (self._x, self._y):
                channel["axis"] |= {"values": []}
            empty = self._drawn({"type": "point"}, {"x": [np.nan], "y": [np.nan]})
            middle = {"x": 0.5 * width, "y": 0.5 * height}
            text = {"type": "text", "text": "no data", "color": "#666666", **middle}
            said = {"data": _table(i=[0]), "mark": text, "encoding": {}}
            return made | {"layer": [empty, said]}
        layers = [_DRAW[type(item)](self, item) for item in sorted(panel.drawn, key=_layer)]
        layers += [self._span_names(item) for item in panel.drawn if isinstance(item, Spans)]
        return made | {"layer": [*chain(*layers)]}

    def _channel(self, which: str, hidden: bool = False) -> Spec:
        axis, size, (low, high) = self._axes[which], self._size[which], self._extent[which]
        drawn: Spec = {"tickCount": max(size // (70 if which == "x" else 36), 2)}
        if axis.names is not None:
            room = size / len(axis.names) / _LETTER if which == "x" else 32
            names = [wrapped(name, room) for name in axis.names]
            turned = which == "x" and max(len(part) for name in names for part in name) > room
            names = [[name] for name in axis.names] if turned else names
            drawn = {"values": list(range(len(names)))}
            drawn["labelExpr"] = f"{json.dumps(names)}[datum.value]"
            drawn |= {"grid": False} | ({"labelAngle": -35} if turned else {})
        elif axis.log:
            # Over less than a decade, Vega itself may name only 1.
            named = {"labelExpr": "format(datum.value, '~r')"}
            drawn |= named if high < 10.0 * low else {"format": "~r"}
        title: Any = wrapped(axis.label, size / _LETTER) if axis.label else None
        if hidden:
            title, drawn = None, drawn | {"labels": False, "ticks": False}
        if which == "y":
            drawn |= {"minExtent": 44}
        scale: Spec = {"type": "log"} if axis.log else {"type": "linear", "zero": False}
        scale |= {"domain": [low, high], "nice": False}
        made: Spec = {"field": which, "type": "quantitative", "title": title}
        return made | {"scale": scale, "axis": drawn}

    def _drawn(self, mark: Spec, data: dict[str, Any], **encoding: Any) -> Spec:
        """A mark at x and y, and up to x2 and y2 where the data have them."""
        ends = {name: {"field": name} for name in ("x2", "y2") if name in data}
        every = {"x": self._x, "y": self._y} | ends | encoding
        return {"data": _table(**data), "mark": {"clip": True} | mark, "encoding": every}

    def _line(self, line: Line) -> Iterator[Spec]:
        x, y = numbers(line.x, self._panel.x), numbers(line.y, self._panel.y)
        kept, look = thinned(x, y), self._looks[line.name]
        mark = {
            "type": "line",
            "strokeJoin": "round",
            "tooltip": line.name,
            "interpolate": "step-after" if line.steps else "linear",
            "color": look.colour,
            "strokeWidth": 1.2 if line.faint else line.width,
            "opacity": 0.4 if line.faint else 1.0,
            "strokeDash": (5, 3) if line.dashed else look.dash,
        }
        # Drawn in the order of the points, and not from left to right.
        yield self._drawn(mark, {"x": x[kept], "y": y[kept]}, order={"value": None})

    def _points(self, points: Points) -> Iterator[Spec]:
        panel, look, many = self._panel, self._looks[points.name], len(points.x) > _MANY
        columns: dict[str, Any] = {"x": numbers(points.x, panel.x), "y": numbers(points.y, panel.y)}
        shape = points.shape or look.shape
        mark: Spec = {"type": "point", "filled": True, "shape": shape, "color": look.colour}
        mark["size"] = 12 if many else 60 if shape.startswith("M") else 45
        mark["opacity"] = 0.35 if points.faint else 0.7 if many else 1.0
        if not points.faint and len(points.x) <= _OUTLINED:
            mark |= {"stroke": "black", "strokeWidth": 0.5}
        tips = [
            {"field": which, "title": axis.label or which, "format": ".4~g"}
            for which, axis in self._axes.items()
        ]
        if points.texts is not None:
            columns["text"] = points.texts
            tips.insert(0, {"field": "text", "title": points.name or "point"})
        encoding: Spec = {"tooltip": tips}
        if points.colour is not None and len(points.colour):
            columns["c"] = np.array(points.colour, float)
            log = bool((columns["c"] > 0.0).all())
            encoding["color"] = self._colour_bar(points.colour_label, log)
        yield self._drawn(mark, columns, **encoding)

    def _colour_bar(self, words: str, log: bool) -> Spec:
        legend: Spec = {"title": wrapped(words, 16), "gradientOpacity": 1.0, "tickCount": 5}
        legend["gradientLength"] = min(self._size["y"] - 40, 220)
        if self._panel.equal:
            legend |= {"title": words, "orient": "bottom", "titleOrient": "left"}
            legend |= {"gradientLength": 0.5 * self._size["x"], "gradientThickness": 10}
        scale: Spec = {"type": "log"} if log else {"type": "linear", "zero": False}
        scale |= {"range": _MAP, "nice": False}
        legend |= {"format": "~r"} if log else {}
        return {"field": "c", "type": "quantitative", "scale": scale, "legend": legend}

    def _band(self, band: Band) -> Iterator[Spec]:
        look, panel = self._looks[band.name], self._panel
        x, high = numbers(band.x, panel.x), numbers(band.high, panel.y)
        low = numbers(band.low, panel.y)
        if panel.y.log:
            low = np.where(np.isfinite(high) & np.isnan(low), self._extent["y"][0], low)
        kept = thinned(x, low, high)
        mark: Spec = {"type": "area", "tooltip": band.name, "color": look.colour}
        if band.share:
            mark |= {"interpolate": "step-after", "stroke": "white", "strokeWidth": 0.5}
        else:
            mark |= {"fillOpacity": 0.25, "stroke": look.colour, "strokeOpacity": 0.6}
        yield self._drawn(mark, {"x": x[kept], "y": low[kept], "y2": high[kept]})

    def _spans(self, spans: Spans) -> Iterator[Spec]:
        for begin, end, name in _shaded(spans):
            mark: Spec = {"type": "rect", "stroke": "white", "tooltip": None, "clip": True}
            mark |= {"color": self._looks[spans.name or name].colour, "fillOpacity": 0.15}
            encoding = {"x": self._x, "x2": {"field": "x2"}}
            yield {"data": _table(x=[begin], x2=[end]), "mark": mark, "encoding": encoding}

    def _span_names(self, spans: Spans) -> Iterator[Spec]:
        """The names of segments above them, or turned where they are short."""
        low, high = self._extent["x"]
        for begin, end, name in _shaded(spans):
            pixels, needed = (end - begin) / (high - low) * self._size["x"], _LETTER * len(name)
            too_long = needed > pixels and (pixels < 13 or needed > self._size["y"])
            if too_long or name == spans.name:
                continue
            words: Spec = {"text": name, "fontSize": 11, "y": -4}
            if needed > pixels:
                words |= {"y": 4, "angle": -90, "align": "right", "baseline": "middle"}
            yield from _read_anywhere(words, _table(x=[0.5 * (begin + end)]), {"x": self._x})

    def _pixels(self, which: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
        ends = np.array(self._extent[which])
        if self._axes[which].log:
            ends, values = np.log(ends), np.log(values)
        return np.interp(values, ends, [0.0, self._size[which]])

    def _words(self, words: Words) -> Iterator[Spec]:
        x, y = numbers(words.x, self._panel.x), numbers(words.y, self._panel.y)
        right, up = self._pixels("x", x), self._pixels("y", y)
        shown: list[int] = []
        for i, text in enumerate(words.words):
            wide = [_LETTER * (0.5 * len(text + words.words[k]) + 1.0) for k in shown]
            near = np.abs(right[shown] - right[i]) < wide
            if not (near & (np.abs(up[shown] - up[i]) < 1.3 * _LINE)).any():
                shown.append(i)
                at, encoding = _table(x=x[[i]], y=y[[i]]), {"x": self._x, "y": self._y}
                yield from _read_anywhere({"text": text, "dy": -8}, at, encoding)


_DRAW: dict[type, Callable[[_Drawing, Any], Iterator[Spec]]] = {
    Spans: _Drawing._spans,
    Band: _Drawing._band,
    Line: _Drawing._line,
    Points: _Drawing._points,
    Words: _Drawing._words,
}
"""What draws each kind of item; the first lies lowest."""


def _shaded(spans: Spans) -> list[tuple[float, float, str]]:
    """Begin, end and name of each segment that is shaded."""
    edges = np.asarray(spans.edges, float).tolist()
    every = zip(edges[:-1], edges[1:], spans.names, strict=True)
    return [span for span in every if span[2]]


def _read_anywhere(words: Spec, data: Spec, encoding: Spec) -> Iterator[Spec]:
    """A text, with white behind it, so that it is read on whatever lies there."""
    text = {"type": "text", "color": _DARK, "baseline": "bottom"} | words
    halo = {"stroke": "white", "strokeWidth": 4, "strokeOpacity": 0.8}
    for mark in (text | halo, text):
        yield {"data": data, "mark": mark, "encoding": encoding}


def _legend(chart: Chart, every: dict[str, Look]) -> list[Spec]:
    """The legend above the panels, of a view that shows nothing else: a symbol of each name."""
    items = [item for panel in chart.panels for item in panel.drawn]
    written = {word for item in items if isinstance(item, Words) for word in item.words}
    seen = [item for item in sorted(items, key=_layer) if not isinstance(item, Words)]
    seen.sort(key=lambda item: isinstance(item, Band) and item.share)  # a share hides its line
    symbols = {item.name: _symbol(item, every[item.name]) for item in seen if item.name}
    names = [name for name in every if name in symbols and name not in written]
    if not names or all(map(_is_empty, chart.panels)):
        return []
    columns = max(int(_WIDTH / (_LETTER * max(map(len, names)) + 50.0)), 1)
    legend: Spec = {"title": None, "orient": "top", "columns": columns, "labelLimit": _WIDTH}
    legend |= {"offset": 0, "symbolSize": 120, "symbolStrokeWidth": 2.0, "symbolOpacity": 1.0}
    colours, shapes, dashes = zip(*(symbols[name] for name in names), strict=True)
    ranges = {"fill": colours, "stroke": colours, "shape": shapes, "strokeDash": dashes}
    named: Spec = {"field": "name", "type": "nominal", "legend": legend}
    encoding = {key: named | {"scale": {"domain": names, "range": ranges[key]}} for key in ranges}
    view = {"width": _WIDTH - 60, "height": 1, "data": {"values": []}, "mark": "point"}
    return [view | {"encoding": encoding}]


def _symbol(item: Line | Points | Band | Spans, look: Look) -> tuple[str, str, tuple[float, ...]]:
    """Colour, shape and dashes of what stands for an item in the legend."""
    if isinstance(item, Line):
        return look.colour, "stroke", (5, 3) if item.dashed else look.dash
    if isinstance(item, Points):
        colour = look.colour if item.colour is None else _MAP[3]
        return colour, item.shape or look.shape, ()
    return look.colour, "square", ()
