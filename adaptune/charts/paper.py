"""Draw a chart with matplotlib, as PNG and SVG."""

from collections.abc import Callable, Mapping
from pathlib import Path
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
    Mark,
    Panel,
    Points,
    Shares,
    Spans,
)
from adaptune.charts.looks import (
    DASHED,
    MANY,
    NO_DATA,
    UNKNOWN,
    Look,
    band_edges,
    colours,
    is_empty,
    layered,
    looks,
    marks,
    numbers,
    rows,
    shares_of,
    span_tints,
    thinned,
    wrapped,
)
from adaptune.drawing import as_png_and_svg, colour_map, log_scale, picture

_LETTER = 0.077
"""Width of a letter of a small text in inches, about."""
_WIDTHS = (7.2, 9.6, 12.6)
"""Widths of pictures of one, two, and more columns in inches."""
_BEHIND_WORDS = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}


def draw_chart(path: Path, chart: Chart) -> None:
    """Draw a chart as PNG, and as SVG beside it.

    Parameters
    ----------
    path
        Of the PNG.
    chart
        What to draw.
    """
    import matplotlib

    columns = max(1, min(chart.columns, len(chart.panels)))
    width = _WIDTHS[min(columns, len(_WIDTHS)) - 1]
    cut = rows(chart, columns)
    usual = 3.3 if len(cut) == 1 else 1.8 if chart.shared_x else 2.7
    heights = [usual * height for height, _ in cut]
    height = sum(heights) + 1.0
    with picture(as_png_and_svg(path), width, height) as figure:
        matplotlib.rcParams["hatch.linewidth"] = 0.5
        figure.suptitle(wrapped(chart.title, width / 0.09), x=0.01, ha="left", fontsize="large")
        shape: Any = {"squeeze": False, "height_ratios": heights}
        grid = figure.subplots(
            len(cut), columns, sharex="col" if chart.shared_x else "none", **shape
        )
        drawing = _Drawing(looks(chart), width / columns - 1.0)
        for i, axes in enumerate(grid.flat):
            if i >= len(chart.panels):
                axes.remove()
                continue
            above = i >= columns and chart.shared_x
            below = i + columns < len(chart.panels) and chart.shared_x
            drawing.panel(axes, chart.panels[i], heights[i // columns], (above, below))
        drawing.legend(figure, width)


class _Drawing:
    """The panels of one picture, and what its legend holds."""

    def __init__(self, looks_of: Mapping[str, Look], width: float) -> None:
        self._looks = looks_of
        self._width = width  # of a panel, in inches
        self._handles: dict[str, list[Any]] = {}

    def panel(self, axes: Any, panel: Panel, height: float, beside: tuple[bool, bool]) -> None:
        """Draw a panel; `beside` is whether ones that share its x axis lie above and below."""
        above, below = beside
        empty = is_empty(panel)
        if empty:
            axes.text(0.5, 0.5, NO_DATA, ha="center", color="#666666", transform=axes.transAxes)
            axes.set(xticks=[], yticks=[])
        for i, item in enumerate(() if empty else layered(panel)):
            if isinstance(item, Spans):
                self._spans(axes, item, panel, height, named=not above)
            elif not isinstance(item, Mark):
                self._draw(axes, item, panel, 2.0 + 0.01 * i)
        for i, mark in enumerate(() if empty else marks(panel)):
            _draw_mark(axes, mark, right=i % 2 == 0)
        axes.set_axisbelow(True)
        for which, axis in (("x", panel.x), ("y", panel.y)):
            self._scale(axes, which, axis)
        if panel.equal:
            axes.set_aspect("equal", adjustable="datalim")
        if below:
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel(wrapped(panel.x.label, self._width / _LETTER))
            axes.tick_params(labelbottom=True)
        axes.set_ylabel(wrapped(panel.y.label, height / _LETTER))
        if panel.title:
            spans = any(isinstance(item, Spans) for item in panel.drawn) and not above
            title = wrapped(panel.title, self._width / _LETTER)
            axes.set_title(title, pad=20.0 if spans else 6.0)

    def legend(self, figure: Any, width: float) -> None:
        """Draw the legend below the panels."""
        if not self._handles:
            return
        longest = max(map(len, self._handles))
        columns = max(1, int(width / (longest * _LETTER + 0.75)))
        names = [name for name in self._looks if name in self._handles]
        handles = [tuple(self._handles[name]) for name in names]
        options: Any = {"loc": "outside lower center", "handlelength": 3.0}
        figure.legend(handles, names, ncols=columns, **options)

    def _named(self, name: str, *handles: Any) -> None:
        """Keep one of each kind of thing for the legend."""
        if name:
            kept = self._handles.setdefault(name, [])
            kept += [h for h in handles if type(h) not in map(type, kept)]

    def _draw(self, axes: Any, item: Drawn, panel: Panel, order: float) -> None:
        draw: dict[type, Callable[..., None]] = {
            Line: self._line,
            Points: self._points,
            Band: self._band,
            Bars: self._bars,
            Shares: self._shares,
        }
        draw[type(item)](axes, item, panel, order)

    def _line(self, axes: Any, line: Line, panel: Panel, order: float) -> None:
        look = self._looks[line.name]
        x, y = numbers(line.x, panel.x), numbers(line.y, panel.y)
        kept = thinned(x, y, faint=line.faint)
        dash = DASHED if line.dashed else look.dash
        (drawn,) = axes.plot(
            x[kept],
            y[kept],
            color=look.colour,
            lw=min(look.width, 1.0) if line.faint else look.width,
            ls=(0, dash) if dash else "-",
            alpha=0.35 if line.faint else 1.0,
            drawstyle="steps-post" if line.steps else "default",
            dash_capstyle="butt",
            solid_capstyle="butt" if look.width > 2.0 else "projecting",
            zorder=order,
        )
        self._named(line.name, drawn)

    def _points(self, axes: Any, points: Points, panel: Panel, order: float) -> None:
        look = self._looks[points.name]
        x, y = numbers(points.x, panel.x), numbers(points.y, panel.y)
        many = len(x) > MANY
        marker = points.marker or look.marker
        thin = marker in "_x+|"
        style: Any = {
            "marker": marker,
            "s": 9.0 if many else 60.0 if marker in "*P_" else 26.0,
            "alpha": 0.35 if points.faint else 0.7 if many else 1.0,
            "rasterized": many,
            "zorder": order,
            "lw": 1.5 if thin else 0.3,
        }
        edge: Any = {} if thin else {"edgecolors": "none" if points.faint or many else "black"}
        if points.colour is None:
            drawn = (
                axes.scatter(x, y, color=look.colour, **style)
                if thin
                else axes.scatter(x, y, facecolors=look.colour, **edge, **style)
            )
        else:
            drawn = self._coloured(axes, points, (x, y), style | edge)
        self._named(points.name, drawn)

    def _coloured(
        self, axes: Any, points: Points, xy: tuple[NDArray[Any], NDArray[Any]], style: Any
    ) -> Any:
        """Points whose colours say a number; those without one are grey."""
        from matplotlib.colors import LogNorm, Normalize

        x, y = xy
        colour = colours(points)
        known = np.isfinite(colour)
        grey = axes.scatter(x[~known], y[~known], **(style | {"color": UNKNOWN}))
        if not known.any():
            return grey
        norm: Any = (LogNorm if points.log_colour else Normalize)(
            colour[known].min(), colour[known].max()
        )
        style = style | {"c": colour[known], "cmap": colour_map(), "norm": norm}
        drawn = axes.scatter(x[known], y[known], **style)
        bar = axes.figure.colorbar(drawn, ax=axes, pad=0.02, fraction=0.06, aspect=25)
        bar.set_label(wrapped(points.colour_label, 30))
        bar.solids.set(alpha=1.0, rasterized=True)
        if points.log_colour:
            log_scale(bar.ax)
        return drawn

    def _band(self, axes: Any, band: Band, panel: Panel, order: float) -> None:
        look = self._looks[band.name]
        x, low, high = band_edges(band, panel)
        kept = thinned(x, low, high)
        drawn = axes.fill_between(
            *(x[kept], low[kept], high[kept]),
            facecolor=(look.colour, 0.25),
            edgecolor=(look.colour, 0.6),
            hatch=look.hatch,
            lw=0.6,
            zorder=order,
        )
        self._named(band.name, drawn)

    def _bars(self, axes: Any, bars: Bars, panel: Panel, order: float) -> None:
        look = self._looks[bars.name]
        along, across = (panel.y, panel.x) if bars.flat else (panel.x, panel.y)
        x, ends = numbers(bars.x, along), numbers(bars.heights, across)
        style: Any = {"color": look.colour, "hatch": look.hatch, "ec": "black", "lw": 0.5}
        style["zorder"] = order
        if bars.flat:
            drawn = axes.barh(x, ends - bars.base, bars.width, left=bars.base, **style)
        else:
            drawn = axes.bar(x, ends - bars.base, bars.width, bottom=bars.base, **style)
        if bars.low is not None and bars.high is not None:
            low, high = numbers(bars.low, across), numbers(bars.high, across)
            beyond = np.maximum([ends - low, high - ends], 0.0)
            errors = {"xerr" if bars.flat else "yerr": beyond}
            place = (ends, x) if bars.flat else (x, ends)
            axes.errorbar(
                *place, **errors, fmt="none", ecolor="black", lw=1.0, capsize=2.5, zorder=order
            )
        if len(x):
            self._named(bars.name, drawn.patches[0])

    def _shares(self, axes: Any, shares: Shares, panel: Panel, order: float) -> None:
        x = numbers(shares.x, panel.x)
        drawn = axes.stackplot(
            x,
            shares_of(shares),
            colors=[self._looks[name].colour for name in shares.names],
            step="post",
            edgecolor="black",
            lw=0.4,
            zorder=order,
        )
        for name, area in zip(shares.names, drawn, strict=True):
            area.set_hatch(self._looks[name].hatch)
            self._named(name, area)

    def _spans(self, axes: Any, spans: Spans, panel: Panel, height: float, named: bool) -> None:
        """Shade stretches, and write their names above them, or turned where they are short."""
        tinted = span_tints(spans)
        whole = float(np.ptp(panel.x.limits or spans.edges)) or 1.0
        for begin, end, name, tint in tinted:
            ground = axes.axvspan(begin, end, color=tint, lw=0, zorder=0.1)
            axes.axvline(end, color="white", lw=1.0, zorder=0.2)
            self._named(spans.name, ground)
            inches = (end - begin) / whole * self._width
            words: Any = {"fontsize": "small", "transform": axes.get_xaxis_transform()}
            words |= {"ha": "center", "color": "#333333", "clip_on": False}
            if not named or name == spans.name:
                continue
            if len(name) * _LETTER < inches:
                axes.text(0.5 * (begin + end), 1.01, name, va="bottom", **words)
            elif inches > 0.14 and len(name) * _LETTER < height - 0.3:
                words |= {"rotation": 90, "va": "top", "zorder": 7.0}
                axes.text(0.5 * (begin + end), 0.98, name, **words)

    def _scale(self, axes: Any, which: str, axis: Axis) -> None:
        """Names, logarithm and limits of an axis, once its data are drawn."""
        if axis.names is not None:
            room = self._width / _LETTER / max(len(axis.names), 1) if which == "x" else 30.0
            labels = [wrapped(name, room) for name in axis.names]
            fits = which == "y" or max(len(n) for n in "\n".join(labels).split("\n")) <= room
            turned: Any = {} if fits else {"rotation": 35, "ha": "right", "rotation_mode": "anchor"}
            labels = labels if fits else list(axis.names)
            axes.set(**{f"{which}ticks": range(len(labels))})
            axes.set(**{f"{which}lim": axis.limits or (-0.6, len(labels) - 0.4)})
            getattr(axes, f"set_{which}ticklabels")(labels, fontsize="small", **turned)
            return
        limits = {f"{which}lim": axis.limits} if axis.limits else {}
        smallest = axes.dataLim.minposx if which == "x" else axes.dataLim.minposy
        if axis.log and np.isfinite(smallest):
            axes.set(**{f"{which}scale": "log"}, **limits)
            log_scale(axes, which)
        axes.set(**limits)


def _draw_mark(axes: Any, mark: Mark, right: bool) -> None:
    """A line and its words, which change sides from one mark to the next."""
    style: Any = {"color": "#333333", "lw": 1.0, "ls": (0, (5, 3)), "zorder": 1.9}
    along = mark.axis == "y"
    (axes.axhline if along else axes.axvline)(mark.at, **style)
    if not mark.words:
        return
    words: Any = {"textcoords": "offset points", "fontsize": "small", "bbox": _BEHIND_WORDS}
    words |= {"zorder": 8.0, "annotation_clip": False}
    if along:
        place: Any = {"xytext": (-3 if right else 3, 2), "ha": "right" if right else "left"}
        place |= {"xy": (1.0 if right else 0.0, mark.at), "xycoords": axes.get_yaxis_transform()}
        axes.annotate(mark.words, va="bottom", **place, **words)
    else:
        place = {"xy": (mark.at, 1.0), "xycoords": axes.get_xaxis_transform()}
        place |= {"xytext": (-2, -3), "ha": "right", "va": "top", "rotation": 90}
        axes.annotate(mark.words, **place, **words)
