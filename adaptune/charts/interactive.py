"""A chart for a browser, as data and layouts of plotly.js."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.charts.chart import (
    Axis,
    Band,
    Bars,
    Chart,
    Drawn,
    Line,
    Panel,
    Points,
    Shares,
)
from adaptune.charts.looks import (
    DASHED,
    MANY,
    UNKNOWN,
    Look,
    band_edges,
    colours,
    is_empty,
    layered,
    looks,
    numbers,
    shares_of,
    thinned,
)
from adaptune.charts.placing import NARROW, PRINTED, WIDE, layout, literal, suffix
from adaptune.drawing import plain

_PIXELS = 4.0 / 3.0  # of a point
_MARKERS = {
    "o": "circle",
    "s": "square",
    "^": "triangle-up",
    "v": "triangle-down",
    "D": "diamond",
    "d": "diamond-tall",
    "p": "pentagon",
    "h": "hexagon",
    "H": "hexagon2",
    "x": "x-thin",
    "X": "x",
    "P": "cross",
    "+": "cross-thin",
    "*": "star",
    "_": "line-ew",
    "|": "line-ns",
    "<": "triangle-left",
    ">": "triangle-right",
    ".": "circle",
}
_PATTERNS = {"": "", "///": "/", "...": ".", "\\\\\\": "\\", "xxx": "x", "---": "-"}


def figure(chart: Chart) -> dict[str, Any]:
    """A chart for plotly.js.

    Returns
    -------
    Its ``data``, and its ``layouts`` by the pixels of width that each is made for, the widest
    first. Panels lie below each other in the last one. All is ready for JSON.
    """
    widths = (WIDE, PRINTED, NARROW)
    layouts = [{"width": width, "layout": layout(chart, width)} for width in widths]
    return {"data": _Traces(chart).made, "layouts": layouts}


def _listed(values: NDArray[np.float64]) -> list[float | None]:
    """Numbers for JSON, short; it knows no NaN."""
    return [None if np.isnan(value) else float(f"{value:.6g}") for value in values]


def _faded(colour: str, alpha: float) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha:g})"


class _Traces:
    """The traces of a chart."""

    def __init__(self, chart: Chart) -> None:
        self.made: list[dict[str, Any]] = []
        self._looks = looks(chart)
        self._in_legend = _legend_items(chart)
        self._i = 0
        for self._i, panel in enumerate(chart.panels):
            for item in () if is_empty(panel) else layered(panel):
                self._add(item, panel)

    def _add(self, item: Drawn, panel: Panel) -> None:
        match item:
            case Line():
                self._line(item, panel)
            case Points():
                self._points(item, panel)
            case Band():
                self._band(item, panel)
            case Bars():
                self._bars(item, panel)
            case Shares():
                self._shares(item, panel)
            case _:
                pass  # marks and spans belong to the layout

    def _put(self, name: str, shown: bool, **trace: Any) -> None:
        """Keep a trace; a click on a name in the legend hides it in all panels."""
        places = {"xaxis": f"x{suffix(self._i)}", "yaxis": f"y{suffix(self._i)}"}
        legend: dict[str, Any] = {"name": literal(name), "showlegend": shown}
        if name:
            legend |= {"legendgroup": name, "legendrank": 1000 + list(self._looks).index(name)}
        self.made.append({"type": "scatter", **places, **legend, **trace})

    def _shown(self, name: str, item: Drawn) -> bool:
        return bool(name) and self._in_legend[name] is item

    def _line(self, line: Line, panel: Panel) -> None:
        look = self._looks[line.name]
        x, y = numbers(line.x, panel.x), numbers(line.y, panel.y)
        kept = thinned(x, y, faint=line.faint)
        width = _PIXELS * (min(look.width, 1.0) if line.faint else look.width)
        style: dict[str, Any] = {"color": look.colour, "width": round(width, 2)}
        if dash := DASHED if line.dashed else look.dash:
            style["dash"] = ",".join(f"{stroke * width:.1f}px" for stroke in dash)
        if line.steps:
            style["shape"] = "hv"
        self._put(
            line.name,
            self._shown(line.name, line),
            x=_listed(x[kept]),
            y=_listed(y[kept]),
            mode="lines",
            line=style,
            opacity=0.35 if line.faint else 1.0,
            connectgaps=False,
            **({"hoverinfo": "skip"} if line.faint else _hover(panel)),
        )

    def _points(self, points: Points, panel: Panel) -> None:
        look = self._looks[points.name]
        x, y = numbers(points.x, panel.x), numbers(points.y, panel.y)
        marker = points.marker or look.marker
        thin = marker in "_x+|"
        many = len(x) > MANY
        style: dict[str, Any] = {
            "symbol": _MARKERS[marker],
            "size": 5 if many else 12 if marker in "*_" else 8,
            "opacity": 0.35 if points.faint else 0.75 if many else 1.0,
            "color": look.colour,
            "line": {"width": 2 if thin else 0.0 if points.faint or many else 0.7},
        }
        style["line"]["color"] = look.colour if thin else "#000000"
        known, told = np.isfinite(x) & np.isfinite(y), _hover(panel, points.texts)
        shown = self._shown(points.name, points)
        if points.colour is None:
            self._markers(points, (x, y), known, shown, {"marker": style, **told})
            return
        colour = colours(points)
        coloured = known & np.isfinite(colour)
        # The legend shows no colour that would say a number.
        nowhere = {"x": [None], "y": [None], "mode": "markers"}
        self._put(points.name, shown, **nowhere, marker=style | {"color": "#666666"})
        given = {"marker": style | {"color": UNKNOWN}, **told}
        self._markers(points, (x, y), known & ~coloured, False, given)
        scale = np.log10(colour[coloured]) if points.log_colour else colour[coloured]
        style |= {"color": _listed(scale), "coloraxis": f"coloraxis{suffix(self._i)}"}
        style["line"] = {"width": 0, "color": "#000000"}
        self._markers(points, (x, y), coloured, False, {"marker": style, **told})

    def _markers(
        self,
        points: Points,
        xy: tuple[NDArray[np.float64], NDArray[np.float64]],
        some: NDArray[np.bool_],
        shown: bool,
        style: dict[str, Any],
    ) -> None:
        if not some.any():
            return
        if points.texts is not None:
            style = {
                **style,
                "text": [literal(points.texts[i]) for i in np.flatnonzero(some).tolist()],
            }
        x, y = (_listed(values[some]) for values in xy)
        self._put(points.name, shown, x=x, y=y, mode="markers", **style)

    def _band(self, band: Band, panel: Panel) -> None:
        """An area around each stretch without gaps."""
        look = self._looks[band.name]
        x, low, high = band_edges(band, panel)
        kept = thinned(x, low, high)
        x, low, high = x[kept], low[kept], high[kept]
        around: list[list[float]] = [[], []]
        known = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
        cuts = np.flatnonzero(np.diff(known)) + 1
        for some in np.split(np.arange(len(x)), cuts):
            if len(some) and known[some[0]]:
                around[0] += [*x[some], *x[some][::-1], np.nan]
                around[1] += [*high[some], *low[some][::-1], np.nan]
        self._put(
            band.name,
            self._shown(band.name, band),
            x=_listed(np.array(around[0])),
            y=_listed(np.array(around[1])),
            mode="lines",
            fill="toself",
            hoverinfo="skip",
            line={"width": 0.8, "color": _faded(look.colour, 0.6)},
            fillcolor=_faded(look.colour, 0.25),
            **_pattern(look, "fillpattern", 0.25),
        )

    def _bars(self, bars: Bars, panel: Panel) -> None:
        look = self._looks[bars.name]
        along, across = (panel.y, panel.x) if bars.flat else (panel.x, panel.y)
        x, ends = numbers(bars.x, along), numbers(bars.heights, across)
        main, other = ("x", "y") if bars.flat else ("y", "x")
        marker = {"color": look.colour, "line": {"color": "#000000", "width": 0.7}}
        trace: dict[str, Any] = {main: _listed(ends - bars.base), other: _listed(x)}
        if bars.base:
            trace["base"] = bars.base
        low = high = np.full(len(x), np.nan)
        if bars.low is not None and bars.high is not None:
            low, high = numbers(bars.low, across), numbers(bars.high, across)
            errors = {"type": "data", "symmetric": False, "color": "#000000", "thickness": 1.2}
            errors["array"] = _listed(np.maximum(high - ends, 0.0))
            errors["arrayminus"] = _listed(np.maximum(ends - low, 0.0))
            trace[f"error_{main}"] = errors | {"width": 3}
        told = [
            literal(_named(at, along) + f": {plain(end)}")
            + (f" ({plain(a)} to {plain(b)})" if np.isfinite([a, b]).all() else "")
            for at, end, a, b in zip(x, ends, low, high, strict=True)
        ]
        self._put(
            bars.name,
            self._shown(bars.name, bars),
            **trace | {"type": "bar", "orientation": "h" if bars.flat else "v"},
            width=bars.width,
            hovertext=told,
            hoverinfo="text+name",
            marker=marker | _pattern(look, "pattern"),
        )

    def _shares(self, shares: Shares, panel: Panel) -> None:
        x = numbers(shares.x, panel.x)
        for name, part in zip(shares.names, shares_of(shares), strict=True):
            look = self._looks[name]
            self._put(
                name,
                self._shown(name, shares),
                x=_listed(x),
                y=_listed(part),
                mode="lines",
                stackgroup="shares",
                line={"shape": "hv", "width": 0.7, "color": "#000000"},
                fillcolor=look.colour,
                **_pattern(look, "fillpattern"),
                **_hover(panel),
            )


def _legend_items(chart: Chart) -> dict[str, Drawn]:
    """For every name the item that its entry in the legend shows."""
    best: dict[str, Drawn] = {}
    ranks = (Line, Points, Bars, Shares, Band)
    items = [item for panel in chart.panels if not is_empty(panel) for item in layered(panel)]
    for item in sorted(
        (i for i in items if isinstance(i, ranks)), key=lambda i: ranks.index(type(i))
    ):
        for name in item.names if isinstance(item, Shares) else (item.name,):
            best.setdefault(name, item)
    return best


def _pattern(look: Look, key: str, opacity: float = 0.6) -> dict[str, Any]:
    if not _PATTERNS[look.hatch]:
        return {}
    drawn = {"shape": _PATTERNS[look.hatch], "fgcolor": "#000000", "fgopacity": opacity}
    return {key: drawn | {"size": 8, "solidity": 0.15, "fillmode": "overlay"}}


def _named(value: float, axis: Axis) -> str:
    """A value among the names of an axis; bars beside each other lie beside the value."""
    if axis.names is None or np.isnan(value):
        return plain(value)
    i = round(value)
    return axis.names[i] if 0 <= i < len(axis.names) else plain(value)


def _hover(panel: Panel, texts: Sequence[str] | None = None) -> dict[str, str]:
    """What a browser tells of a point."""
    shown = [f"{literal(panel.x.label)}: %{{x}}", f"{literal(panel.y.label)}: %{{y}}"]
    shown += ["%{text}"] * (texts is not None)
    return {"hovertemplate": "<br>".join(shown) + "<extra>%{fullData.name}</extra>"}
