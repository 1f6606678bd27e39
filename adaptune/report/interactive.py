"""A chart for a browser, as data and layouts of plotly.js."""

import html
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from adaptune.report.chart import (
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
)
from adaptune.report.paper import (
    DASHED,
    MANY,
    NO_DATA,
    UNKNOWN,
    Look,
    band_edges,
    colour_map,
    colours,
    is_empty,
    layered,
    looks,
    marks,
    numbers,
    plain,
    positive_extent,
    rows,
    shares_of,
    span_tints,
    thinned,
    wrapped,
)

# Where the panels of a chart lie in a browser: the layout of plotly.js.


WIDE, PRINTED, NARROW = 960, 680, 340
"""Pixels of width that layouts are made for: on a screen, on paper, and on a telephone."""
_LETTER, _LINE = 7.0, 16.0
"""Width of a letter and height of a line in pixels, about."""
_BAR = 78.0
"""Pixels that a colour bar takes."""
_RIGHT = 14.0
_LEAST = 120.0
"""Pixels of width that a panel has at least, if there are fewer columns."""
_MOST_LETTERS = 24  # of a name beside an axis, on a line
_DARK, _GRID = "#333333", "#e4e4e4"


class _Place(NamedTuple):
    """Where a panel lies, in pixels from the left and from the top of the picture."""

    left: float
    right: float
    top: float
    bottom: float


def layout(chart: Chart, width: int) -> dict[str, Any]:
    """The layout of a chart, made for so many pixels of width; see `WIDE`."""
    return _Layout(chart, width).made()


def literal(words: str) -> str:
    """Words as plotly.js prints them literally, which knows some HTML, TeX and templates."""
    escaped = html.escape(words, quote=False)
    return escaped.replace("{", "&#123;").replace("$", "&#36;").replace("\n", "<br>")


def ticks(low: float, high: float) -> list[float]:
    """Values to name on a logarithmic axis whose data lie between two numbers above zero."""
    decades = np.log10(high) - np.log10(low)  # the ratio may be too large for a number
    if decades < 0.5:
        beyond = 0.1 * (high - low) or 0.2 * low
        # Round steps: of ratios, 1 is named.
        values = MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(low - beyond, high + beyond)
        return [float(value) for value in values if value > 0.0]
    few = "1" if decades > 4.0 else "125" if decades > 1.3 else "12357"
    powers = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 1)
    return [float(f"{digit}e{power}") for power in powers for digit in few]


def suffix(i: int) -> str:
    """What plotly.js adds to the names of the axes of panel `i`."""
    return "" if i == 0 else str(i + 1)


class _Layout:
    def __init__(self, chart: Chart, width: int) -> None:
        self._panels = chart.panels
        self._narrow = width < PRINTED
        self._width = width
        wanted = max(1, min(chart.columns, len(chart.panels)))
        self._columns = 1 if self._narrow else wanted
        while self._columns > 1 and self._beside(self._columns)[-1] < _LEAST:
            self._columns -= 1
        # Panels of fewer columns do not lie as they did.
        self._shared = chart.shared_x and self._columns == wanted
        self._rows = rows(chart, self._columns)
        self._names = [name for name in looks(chart) if name]
        self._places = self._placed()

    def made(self) -> dict[str, Any]:
        """The layout for JSON."""
        legend = self._legend_height()
        height = round(self._bottom + legend)
        self._inner = max(place.bottom for place in self._places)
        first, last = self._places[0], self._places[self._columns - 1]
        made: dict[str, Any] = {
            "height": height,
            "margin": {
                "l": first.left,
                "r": self._width - last.right,
                "t": first.top,
                "b": height - self._inner,
                "pad": 0,
            },
            "paper_bgcolor": "white",
            "plot_bgcolor": "white",
            "barmode": "overlay",
            "font": {"family": "system-ui, sans-serif", "size": 13, "color": "#222222"},
            "hoverlabel": {"namelength": -1, "align": "left"},
            # A finger on a chart scrolls the page.
            "hovermode": "closest",
            "dragmode": False if self._narrow else "zoom",
            "showlegend": legend > 0,
            "uirevision": "kept",
            "legend": {
                "orientation": "h",
                "yref": "container",
                "y": 0.0,
                "yanchor": "bottom",
                "x": 0.0,
                "xref": "container",
                "xanchor": "left",
                "maxheight": 1.0,
                "tracegroupgap": 0,
                "groupclick": "togglegroup",
            },
            "shapes": [],
            "annotations": [],
        }
        for i, panel in enumerate(self._panels):
            self._panel(made, i, panel)
        return made

    def _placed(self) -> list[_Place]:
        """The place of each panel."""
        one = 280.0 if self._narrow else 340.0
        usual = one if len(self._rows) == 1 else 170.0 if self._shared else 0.8 * one
        before, after, width = self._beside(self._columns)
        self._across = width
        places: list[_Place] = []
        top = 0.0
        for height, panels in self._rows:
            above = max(map(self._above, range(len(places), len(places) + len(panels))))
            top += above
            high = max(usual * height, *map(self._least, panels))
            for c in range(len(panels)):
                left = sum(before[: c + 1]) + sum(after[:c]) + c * width
                places.append(_Place(left, left + width, top, top + high))
            under = range(len(places) - len(panels), len(places))
            top += high + max(map(self._below, under))
        self._bottom = top
        return places

    def _beside(self, n: int) -> tuple[list[float], list[float], float]:
        """Room left and right of the panels of each of `n` columns, and how wide panels are."""
        before = [max(map(self._before, self._panels[c::n])) for c in range(n)]
        after = [max(map(_after, self._panels[c::n])) for c in range(n)]
        return before, after, (self._width - sum(before) - sum(after)) / n

    def _before(self, panel: Panel) -> float:
        """Room for the numbers or names, and the label, left of a panel."""
        names = self._wrapped(panel.y)
        longest = max((len(part) for name in names for part in name.split("\n")), default=0)
        return max(62.0, 34.0 + _LETTER * longest)

    def _least(self, panel: Panel) -> float:
        """The height that names beside a panel need."""
        return sum(5.0 + _LINE * (name.count("\n") + 1) for name in self._wrapped(panel.y))

    def _wrapped(self, axis: Axis) -> list[str]:
        most = _MOST_LETTERS / 2 if self._narrow else _MOST_LETTERS
        return [wrapped(name, most) for name in axis.names or ()]

    def _above(self, i: int) -> float:
        """Room for a title, and for the names of spans, above a panel."""
        panel = self._panels[i]
        lines = len(self._title(panel).split("\n")) if panel.title else 0
        spans = any(isinstance(item, Spans) for item in panel.drawn) and self._tops(i)
        return 12.0 + _LINE * lines + 18.0 * spans

    def _below(self, i: int) -> float:
        """Room for the numbers or names, and the label, below a panel."""
        if self._shared and i + self._columns < len(self._panels):
            return 6.0
        names, turned = self._below_names(self._panels[i].x)
        if turned:
            return 52.0 + 0.6 * _LETTER * max(map(len, names))
        return 36.0 + _LINE * max((name.count("\n") + 1 for name in names), default=1)

    def _below_names(self, axis: Axis) -> tuple[list[str], bool]:
        """Names below an x axis, and whether they have to be turned to have room."""
        names = list(axis.names or ())
        room = self._across / _LETTER / max(len(names), 1) - 1.0
        folded = [wrapped(name, room) for name in names]
        if all(len(part) <= room for name in folded for part in name.split("\n")):
            return folded, False
        return names, True

    def _tops(self, i: int) -> bool:
        """Whether no panel that shares its x axis lies above a panel."""
        return not self._shared or i < self._columns

    def _title(self, panel: Panel) -> str:
        return wrapped(panel.title, (self._width / self._columns - 80.0) / _LETTER)

    def _legend_height(self) -> float:
        """Height of a legend, which is as wide as the panels."""
        if not self._names or all(map(is_empty, self._panels)):
            return 0.0
        lines, room = 0, 0.0
        for name in self._names:
            entry = 42.0 + _LETTER * len(name)
            if entry > room:
                lines, room = (
                    lines + 1,
                    self._places[self._columns - 1].right - self._places[0].left,
                )
            room -= entry
        return 14.0 + 20.0 * lines

    def _panel(self, made: dict[str, Any], i: int, panel: Panel) -> None:
        """Add the axes of a panel, and what is written and shaded on it."""
        place, empty = self._places[i], is_empty(panel)
        whole = self._places[self._columns - 1].right - self._places[0].left
        left, top = self._places[0].left, self._places[0].top
        across = [(place.left - left) / whole, (place.right - left) / whole]
        height = self._inner - top
        up = [1.0 - (place.bottom - top) / height, 1.0 - (place.top - top) / height]
        x = self._axis(panel, "x", across, (place.right - place.left) / _LETTER)
        y = self._axis(panel, "y", up, (place.bottom - place.top) / _LETTER)
        x["anchor"], y["anchor"] = f"y{suffix(i)}", f"x{suffix(i)}"
        if panel.equal:
            y["scaleanchor"] = f"x{suffix(i)}"
        if self._shared:
            if i >= self._columns:
                x["matches"] = f"x{suffix(i % self._columns)}"
            if i + self._columns < len(self._panels):
                x |= {"showticklabels": False, "title": {"text": ""}}
        made[f"xaxis{suffix(i)}"] = x
        made[f"yaxis{suffix(i)}"] = y
        self._write(made, i, panel)
        coloured = [p for p in panel.drawn if isinstance(p, Points) and p.colour is not None]
        if coloured and not empty:
            known = np.concatenate([colours(points) for points in coloured])
            middle = [across[1], 0.5 * (up[0] + up[1]), up[1] - up[0]]
            made[f"coloraxis{suffix(i)}"] = _colour_axis(coloured[0], known, middle)

    def _axis(self, panel: Panel, which: str, domain: list[float], room: float) -> dict[str, Any]:
        """One axis, whose label has room for so many letters on a line."""
        axis = panel.x if which == "x" else panel.y
        label = literal(wrapped(axis.label, room))
        made: dict[str, Any] = {
            "domain": domain,
            "title": {"text": label, "standoff": 6, "font": {"size": 13}},
            "showline": True,
            "linecolor": _DARK,
            "gridcolor": _GRID,
            "zeroline": False,
            "ticks": "outside",
            "ticklen": 4,
            "tickcolor": _DARK,
            "exponentformat": "none",
            "automargin": False,
            "tickfont": {"size": 12},
        }
        if is_empty(panel):
            return made | {"showticklabels": False, "ticks": "", "showgrid": False}
        if axis.names is not None:
            names, turned = (
                self._below_names(axis) if which == "x" else (self._wrapped(axis), False)
            )
            made |= {"tickvals": list(range(len(names))), "ticktext": list(map(literal, names))}
            made |= {"tickangle": -35 if turned else 0}
            made["range"] = list(axis.limits or (-0.6, len(names) - 0.4))
        elif axis.log and (extent := axis.limits or positive_extent(panel, which)):
            made |= {"type": "log", "tickvals": ticks(*extent), "minor": {"dtick": "D1"}}
            made |= {"ticktext": [plain(value) for value in made["tickvals"]]}
            if axis.limits and min(axis.limits) > 0.0:
                made["range"] = np.log10(axis.limits).tolist()
        elif axis.limits:
            made["range"] = list(axis.limits)
        return made

    def _write(self, made: dict[str, Any], i: int, panel: Panel) -> None:
        """Add the title of a panel, its spans and its marks."""
        refs = {"xref": f"x{suffix(i)}", "yref": f"y{suffix(i)}"}
        inside = {key: f"{ref} domain" for key, ref in refs.items()}
        notes = made["annotations"]
        if panel.title:
            lift = 2 + 18 * any(isinstance(item, Spans) for item in panel.drawn) * self._tops(i)
            title = literal(self._title(panel))
            size = {"font": {"size": 14}, "yshift": lift, "align": "left"}
            notes.append(_note(title, **inside, x=0.0, y=1.0, xanchor="left", **size))
        if is_empty(panel):
            notes.append(_note(NO_DATA, **inside, x=0.5, y=0.5, font={"color": "#666666"}))
            return
        for item in panel.drawn:
            if isinstance(item, Spans):
                self._spans(made, i, item)
        for k, mark in enumerate(marks(panel)):
            made["shapes"].append(_mark_line(mark, refs))
            log = (panel.x if mark.axis == "x" else panel.y).log
            if mark.words:
                notes.append(_mark_words(mark, refs, k % 2 == 0, log))

    def _spans(self, made: dict[str, Any], i: int, spans: Spans) -> None:
        place, panel = self._places[i], self._panels[i]
        whole = float(np.ptp(panel.x.limits or spans.edges)) or 1.0
        told = {shape.get("name") for shape in made["shapes"]} | {""}
        for begin, end, name, tint in span_tints(spans):
            ref = {"xref": f"x{suffix(i)}", "yref": f"y{suffix(i)} domain"}
            shape = {"type": "rect", "x0": begin, "x1": end, "y0": 0.0, "y1": 1.0, **ref}
            shape |= {"fillcolor": tint, "layer": "below", "line": {"width": 0}}
            if (of := literal(spans.name)) not in told:
                shape |= {"showlegend": True, "name": of}
                told.add(of)
            made["shapes"].append(shape)
            room = (end - begin) / whole * (place.right - place.left)
            middle = 0.5 * (begin + end)
            at = {
                "x": np.log10(middle) if panel.x.log else middle,
                "font": {"size": 12, "color": _DARK},
                **ref,
            }
            if not self._tops(i) or name == spans.name:
                continue
            if _LETTER * len(name) < room:
                made["annotations"].append(_note(literal(name), y=1.0, yanchor="bottom", **at))
            elif room > 13.0 and _LETTER * len(name) < place.bottom - place.top:
                turned = _note(literal(name), y=1.0, yanchor="top", textangle=-90, **at)
                made["annotations"].append(turned)


def _after(panel: Panel) -> float:
    """Room for a colour bar right of a panel."""
    coloured = any(isinstance(p, Points) and p.colour is not None for p in panel.drawn)
    return _RIGHT + _BAR * (coloured and not is_empty(panel))


def _note(words: str, **where: Any) -> dict[str, Any]:
    where = {"yanchor": "bottom"} | where
    return {"text": words, "showarrow": False, "borderpad": 0} | where


def _mark_line(mark: Mark, refs: dict[str, str]) -> dict[str, Any]:
    across = "x" if mark.axis == "y" else "y"
    line = {"color": _DARK, "width": 1.2, "dash": "6px,4px"}
    whole = {f"{across}ref": refs[f"{across}ref"] + " domain", f"{across}0": 0, f"{across}1": 1}
    place = {f"{mark.axis}0": mark.at, f"{mark.axis}1": mark.at}
    return {"type": "line", "line": line, "layer": "below", **refs, **whole, **place}


def _mark_words(mark: Mark, refs: dict[str, str], right: bool, log: bool) -> dict[str, Any]:
    """The words on a mark, which change sides from one to the next."""
    at = float(np.log10(mark.at)) if log else mark.at
    style: dict[str, Any] = {"bgcolor": "rgba(255,255,255,0.8)", "font": {"size": 12}, **refs}
    if mark.axis == "y":
        style |= {"xref": f"{refs['xref']} domain", "xanchor": "right" if right else "left"}
        return _note(literal(mark.words), x=1.0 if right else 0.0, y=at, yshift=1, **style)
    style |= {"yref": f"{refs['yref']} domain", "textangle": -90, "xanchor": "right"}
    return _note(literal(mark.words), x=at, y=1.0, **style, yanchor="top", xshift=-1)


def _rgb(colour: Sequence[float]) -> str:
    red, green, blue = (round(255 * part) for part in colour[:3])
    return f"rgb({red},{green},{blue})"


def _colour_axis(points: Points, known: Any, middle: list[float]) -> dict[str, Any]:
    """What the colours of a panel's points mean; plotly.js knows no logarithmic colours."""
    x, y, length = middle
    label = {"text": literal(wrapped(points.colour_label, 30)), "side": "right"}
    bar: dict[str, Any] = {
        "x": x,
        "xanchor": "left",
        "xpad": 8,
        "y": y,
        "len": length,
        "thickness": 12,
        "title": label | {"font": {"size": 13}},
        "outlinewidth": 0,
        "ypad": 0,
        "tickfont": {"size": 12},
        "exponentformat": "none",
    }
    known = known[np.isfinite(known)]
    steps = colour_map()(np.linspace(0.0, 1.0, 11))
    scale = [
        [i / 10, f"rgb({r},{g},{b})"]
        for i, (r, g, b, _) in enumerate(np.round(255 * steps).astype(int).tolist())
    ]
    made: dict[str, Any] = {"colorscale": scale, "colorbar": bar, "showscale": len(known) > 0}
    if points.log_colour and len(known):
        low, high = np.log10([known.min(), known.max()])
        made |= {"cmin": low, "cmax": high}
        shown = [
            value for value in ticks(known.min(), known.max()) if low <= np.log10(value) <= high
        ]
        bar |= {"tickvals": np.log10(shown).tolist(), "ticktext": [plain(value) for value in shown]}
    return made


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
