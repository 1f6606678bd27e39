"""Draw a chart with matplotlib, as PNG and SVG."""

import re
import textwrap
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.files import replacing
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
    Values,
)

# What all pictures share: colours and lines, plain numbers on the axes, and their files.


# Colours that the colour-blind tell apart, most of them Okabe and Ito's. Lines that coincide
# lie on each other from wide to narrow and are dark and light in turn, so that each is seen, in
# grey, too. Modes on demand are dashed, each in its own way.
LINES: dict[str, dict[str, Any]] = {
    "baseline": {"color": "#bbbbbb", "lw": 10.2},
    "best_default": {"color": "#882255", "lw": 8.4},
    "equal_cost": {"color": "#56c8a0", "lw": 6.6},
    "fixed": {"color": "#0072b2", "lw": 4.8},
    "adaptive": {"color": "#e69f00", "lw": 3.0},
    "untrained": {"color": "#7b3294", "lw": 1.2},
    "even": {"color": "#66ccee", "lw": 1.7, "ls": (0, (2, 2))},
    "paper": {"color": "#000000", "lw": 0.9, "ls": (0, (4, 4))},
}
"""Lines of the modes, the lowest first."""
POINTS: dict[str, dict[str, Any]] = {
    "baseline": {"marker": "s", "color": "#999999"},
    "best_default": {"marker": "v", "color": "#882255"},
    "equal_cost": {"marker": "P", "color": "#56c8a0"},
    "fixed": {"marker": "*", "color": "#0072b2"},
    "one set": {"marker": "D", "color": "#d55e00"},
    "adaptive": {"marker": "o", "color": "#e69f00"},
    "paper": {"marker": "^", "color": "#000000"},
    "even": {"marker": "h", "color": "#66ccee"},
    "untrained": {"marker": "<", "color": "#7b3294"},
    "oracle, sequence": {"marker": "_", "color": "#009e73", "ms": 12, "mew": 4.0},
    "oracle, period": {"marker": "x", "color": "#009e73"},
}
"""Markers of the modes."""
OTHERS = ("#56b4e9", "#f0e442", "#009e73", "#cc79a7", "#d55e00", "#999999")
"""Colours of what is not a mode, from one thing to the next."""

_STYLE: Any = {
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": "medium",
    "axes.titlelocation": "left",
    "axes.formatter.limits": (-6, 6),
    "axes.formatter.useoffset": False,
    "legend.frameon": False,
    "legend.fontsize": "small",
    "figure.dpi": 110,
    # Names are printed literally, and text in an SVG can be searched. No name changes its bytes.
    "text.parse_math": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "adaptune",
}


@contextmanager
def picture(files: Iterable[Path], width: float, height: float) -> Iterator[Any]:
    """Give the block a white figure of some inches, and write it when the block ends well.

    Parameters
    ----------
    files
        Their suffixes say in which format; see `as_png_and_svg`.
    width, height
        Inches.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")
        # The user's own style might be dark.
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
        yield figure
        # Laid out once; `savefig` would also draw everything twice.
        layout: Any = figure.get_layout_engine()
        layout.execute(figure)
        figure.set_layout_engine("none")
        for file in files:
            with replacing(file) as temporary:
                if file.suffix == ".svg":
                    svg: Any = FigureCanvasSVG(figure)
                    # Without a date, the same picture has the same bytes.
                    svg.print_svg(temporary, metadata={"Date": None})
                else:
                    png: Any = FigureCanvasAgg(figure)
                    png.print_png(temporary)


def as_png_and_svg(path: Path) -> tuple[Path, Path]:
    """The files of a picture: the PNG at `path`, and the SVG beside it."""
    return path, path.with_suffix(".svg")


def plain(value: float, _: object = None) -> str:
    """A number as a tick label: 0.6, and not 6 x 10^-1."""
    return np.format_float_positional(value, precision=6, fractional=False, trim="-")


def log_scale(axes: Any, which: str = "y") -> None:
    """Make the x or y axis logarithmic, with plain numbers, once its data are drawn."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator

    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = axis.get_view_interval()
    decades = np.log10(high / low)
    if decades > 0.5:
        few = (1.0,) if decades > 4.0 else (1.0, 2.0, 5.0)
        axis.set_major_locator(LogLocator(subs=few if decades > 1.3 else (*few, 3.0, 7.0)))
    else:
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(plain)
    axis.set_minor_formatter(NullFormatter())


def colour_map() -> Any:
    """A colour map whose lightness rises, without colours too light for a white ground."""
    import matplotlib
    from matplotlib.colors import ListedColormap

    return ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.85, 256)))


# How a chart looks, on paper and in a browser alike: colours, order, rows and what is thinned.


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

    Modes have theirs. Other names differ in colour as well as in dashes,
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
