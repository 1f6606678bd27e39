"""Pictures by matplotlib: colours and lines, plain numbers on the axes, and their files."""

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from adaptune.files import replacing

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
