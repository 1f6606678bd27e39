"""How charts look: a colour, a marker and dashes for each name."""

from dataclasses import dataclass
from itertools import cycle

from adaptune.report.charts import Band, Chart, Spans


@dataclass(frozen=True)
class Look:
    """How whatever has one name is drawn."""

    colour: str
    dash: tuple[float, ...] = ()  # strokes and gaps in pixels; none if it is solid
    shape: str = "circle"  # of a marker, as Vega names it, or an SVG path


_STAR = "M0,-1.2 L.3,-.4 L1.1,-.4 L.5,.1 L.7,.95 L0,.5 L-.7,.95 L-.5,.1 L-1.1,-.4 L-.3,-.4 Z"
_CROSS = "M-1,-.7 L-.7,-1 L0,-.3 L.7,-1 L1,-.7 L.3,0 L1,.7 L.7,1 L0,.3 L-.7,1 L-1,.7 L-.3,0 Z"
# Colours that the colour-blind tell apart, most of them Okabe and Ito's.
MODES = {
    "baseline": Look("#999999", shape="square"),
    "fixed": Look("#0072b2", shape=_STAR),
    "standby": Look("#882255", shape="triangle-down"),
    "adaptive": Look("#e69f00"),
    "untrained": Look("#7b3294", shape="triangle-left"),
    "even": Look("#117733", (3, 3), "triangle-right"),
    "paper": Look("#000000", (4, 4), "triangle-up"),
}
"""Looks of the modes; the lines of the first lie lowest."""
_COLOURS = ("#d55e00", "#56b4e9", "#009e73", "#cc79a7", "#888888", "#b8a800")
_DASHES: tuple[tuple[float, ...], ...] = ((), (8, 3), (2, 3), (8, 3, 2, 3))
_SHAPES = ("circle", "square", "triangle-up", "diamond", "triangle-down", _CROSS, "cross")
_PLACES = ("#8c510a", "#35a79c", "#c51b7d", "#7fbc41", "#555555", "#b8a800")
"""Colours of places; no mode has them."""
_SHADE = "#555555"
"""Colour of segments that are no places."""
_SHARE_COLOURS = ("#c97f00", "#f0b84d", "#8f5a00", "#f8dba5", "#b0885a")
"""Colours of shares that have no look of their own."""


def looks(chart: Chart) -> dict[str, Look]:
    """The look of each name in a chart, in the order in which they appear; modes have theirs."""
    items = [item for panel in chart.panels for item in panel.drawn]
    spans = (item for item in items if isinstance(item, Spans) and not item.name)
    places = dict.fromkeys(name for item in spans for name in item.names if name)
    shares = dict.fromkeys(b.name for b in items if isinstance(b, Band) and b.share)
    known = dict(zip(shares, map(Look, cycle(_SHARE_COLOURS)), strict=False)) | MODES
    known |= dict(zip(places, map(Look, cycle(_PLACES)), strict=False))
    known |= {item.name: Look(_SHADE) for item in items if isinstance(item, Spans) and item.name}
    names = dict.fromkeys(name for item in items if (name := getattr(item, "name", ""))) | places
    taken = {known[name].colour for name in names if name in known}
    colours = cycle([colour for colour in _COLOURS if colour not in taken])
    made = map(Look, colours, cycle(_DASHES), cycle(_SHAPES))
    return {name: known[name] if name in known else next(made) for name in names}
