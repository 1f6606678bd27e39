"""Pictures of the offline stage: Pareto fronts, and the sequences left out."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.report.paper import LINES, OTHERS, POINTS, as_png_and_svg, log_scale, picture
from offline.objective import pareto_front

RATIO = "error over the fixed set's [-]"
_FEWER = {"marker": "v", "color": "#cc79a7", "ls": "--"}
_FAILS = 5.0
"""Ratio to the fixed set's error above which a set is not drawn."""
_SPREAD = 20.0
"""Largest over least value from which on an axis is logarithmic."""


THRIFTY = "bank, thrifty"
"""A bank whose next member gains most for its cost."""
CANCELLING = "bank, cancelling"
"""A bank whose next member lowers the error most."""


class Point(NamedTuple):
    """Something that could be driven."""

    what: str  # an odometry's set, a bank, or a mode
    name: str  # the trial's number, or the number of members
    cost: float  # milliseconds of CPU time a scan
    ratio: float  # geometric mean over the recordings of the ratio to the fixed set's error

    def row(self) -> dict[str, Any]:
        """The row of a table."""
        return {"what": self.what, "name": self.name, "ms a scan": self.cost, "ratio": self.ratio}


def draw_front(
    path: Path,
    names: Sequence[str],
    values: NDArray[np.float64],
    front: NDArray[np.float64],
    marked: Mapping[str, Sequence[float]],
) -> None:
    """Draw the Pareto front and all sets, one panel for each two consecutive objectives.

    Parameters
    ----------
    path
        Of the PNG; the SVG lies beside it.
    names
        Of the objectives, with their units.
    values
        Of all sets that keep the limits, of shape (n, n_objectives).
    front
        Of those on the front, by a rising first objective.
    marked
        By name the values of the sets to mark.
    """
    n = len(names) - 1
    with picture(as_png_and_svg(path), 1.0 + 5.0 * n, 5.0) as figure:
        for i, axes in enumerate(figure.subplots(1, n, squeeze=False)[0]):
            axes.plot(*values[:, i : i + 2].T, ".", color="#999999", label="tried")
            # With more objectives than are drawn, the front is no line.
            line: Any = {"ls": "-", "drawstyle": "steps-post"} if n == 1 else {"ls": ""}
            line |= {"marker": "o", "color": "#d55e00"}
            axes.plot(*front[:, i : i + 2].T, label="Pareto front", **line)
            for name, of_set in marked.items():
                look: Any = {"ms": 13, "mfc": "none", "mew": 2.0, "ls": ""} | POINTS[name]
                axes.plot(*of_set[i : i + 2], label=name, **look)
            for which, column in (("x", i), ("y", i + 1)):
                drawn = np.append(values[:, column], [of_set[column] for of_set in marked.values()])
                if drawn.min() > 0.0 and drawn.max() > _SPREAD * drawn.min():
                    log_scale(axes, which)
            axes.set(xlabel=names[i], ylabel=names[i + 1])
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))


class LeftOutResults(NamedTuple):
    """Results on what was left out of training."""

    # By mode, the ratio to the fixed set's error on each recording.
    ratios: Mapping[str, NDArray[np.float64]]
    sequences: Sequence[str]  # their names
    # Of every stretch; the gain is the ratio to the fixed set's error, of shape (n,).
    familiarity: NDArray[np.float64]
    gain: NDArray[np.float64]
    portfolio: NDArray[np.float64]  # ratio if the best of 1, 2, ... sets were known
    learning: Sequence[Mapping[str, Any]]  # rows of a learning curve, or none
    banks: Sequence[Mapping[str, Any]]  # rows of banks of several sizes, or none


def draw_validation(path: Path, title: str, found: LeftOutResults) -> None:
    """Draw results on the sequences left out; `path` is that of the PNG."""
    panels: list[Callable[[Any, LeftOutResults], None]] = [_draw_sequences]
    if not np.isnan(found.familiarity).all() and (found.gain != 1.0).any():
        panels.append(_draw_familiarity)
    panels.append(_draw_sizes)
    width = max(6.0, 0.35 * len(found.sequences))
    with picture(as_png_and_svg(path), width + 4.5 * (len(panels) - 1), 5.5) as figure:
        figure.suptitle(f"{title}: each part left out in turn", x=0.01, ha="left")
        parts = figure.subfigures(1, len(panels), width_ratios=[width, *[4.5] * (len(panels) - 1)])
        for part, draw in zip(np.atleast_1d(parts), panels, strict=True):
            axes = part.subplots()
            # Wide, to be seen below what is equal to it.
            axes.axhline(1.0, **LINES["fixed"], label="fixed set")
            draw(axes, found)
            axes.set_ylabel(RATIO)
            handles, labels = axes.get_legend_handles_labels()
            ncols = 3 if draw is _draw_sequences else 1
            part.legend(handles, labels, loc="outside lower center", ncols=ncols)


def _draw_sequences(axes: Any, found: LeftOutResults) -> None:
    """Ratios of every mode on each sequence, side by side."""
    modes = [mode for mode in found.ratios if mode != "fixed"]
    at = np.arange(len(found.sequences))
    for mode, shift in zip(modes, np.linspace(-0.3, 0.3, len(modes)), strict=True):
        axes.plot(at + shift, found.ratios[mode], label=mode, **{"ls": "", "ms": 6} | POINTS[mode])
    axes.set_xticks(at, found.sequences, rotation=60, ha="right", rotation_mode="anchor")
    axes.set_title("on each sequence")
    log_scale(axes)


def _draw_familiarity(axes: Any, found: LeftOutResults) -> None:
    """Gain of `adaptive` over familiarity."""
    label = "adaptive, each stretch"
    axes.plot(found.familiarity, found.gain, label=label, **POINTS["adaptive"] | {"ls": ""})
    axes.set_xlabel("familiarity [-] (0: unlike all training)")
    axes.set_title("where scans are known and new")


def _draw_sizes(axes: Any, found: LeftOutResults) -> None:
    """Ratio over the number of sets, of members and of training stretches."""
    from matplotlib.ticker import MaxNLocator

    sizes = np.arange(1, len(found.portfolio) + 1)
    known = "best of so many sets, if known"
    axes.plot(sizes, found.portfolio, "s--", color="#999999", label=known)
    most = max(1.0, float(found.portfolio.max()))
    fewer, number = "adaptive, trained on so many", ["sets"]
    for rows, column, counted, look, label in (
        (found.banks, "instances", "members", POINTS["adaptive"], "bank of so many members"),
        (found.learning, "stretches", "training stretches", _FEWER, fewer),
    ):
        if rows:
            number.append(counted)
            middle = np.array([row["geometric"] for row in rows])
            error = np.abs([[row[key] for row in rows] for key in ("low", "high")] - middle)
            most = max(most, float(middle.max()))
            x = [row[column] for row in rows]
            axes.errorbar(x, middle, error, capsize=3, label=label, **look)
    # The interval of two stretches may reach to the sky.
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, 0.0), min(high, 2.0 * most))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel(f"number of {', or '.join(number)} [-]")
    axes.set_title("with more to choose from" + (" (95 % intervals)" if len(number) > 1 else ""))


def draw_frontier(path: Path, title: str, points: Sequence[Point], budget: float | None) -> None:
    """Draw error against cost of sets, banks and modes; `path` is that of the PNG."""
    kinds = [p.what for p in points if p.what not in POINTS]
    banks = [what for what in (CANCELLING, THRIFTY) if what in kinds]
    sets = [p for p in points if p.what in set(kinds) - set(banks)]
    with picture(as_png_and_svg(path), 8.0, 5.5) as figure:
        axes = figure.subplots()
        odometries = dict.fromkeys(p.what for p in sets)
        looks = zip(odometries, itertools.cycle(OTHERS), itertools.cycle("os^vDPX"), strict=False)
        for what, color, marker in looks:
            mine = [(p.cost, p.ratio) for p in sets if p.what == what]
            axes.plot(*zip(*mine, strict=True), marker, ms=5, color=color, alpha=0.8, label=what)
        front = pareto_front(np.array([(p.cost, p.ratio) for p in sets]).reshape(-1, 2))
        line = np.array([(sets[i].cost, sets[i].ratio) for i in front]).reshape(-1, 2).T
        axes.plot(*line, drawstyle="steps-post", color="#999999", lw=1.0, label="front of the sets")
        for what, style in zip(banks, ("-", "--"), strict=False):
            of = [p for p in points if p.what == what]
            costs, ratios = [p.cost for p in of], [p.ratio for p in of]
            axes.plot(costs, ratios, f"k{style}", marker=".", lw=1.2, label=f"{what}: 2, 3, ...")
        for point in points:
            if point.what in POINTS:
                # A star is mostly empty.
                size = 18 if POINTS[point.what]["marker"] == "*" else 11
                look: Any = {"ms": size, "mec": "white", "ls": ""} | POINTS[point.what]
                axes.plot(point.cost, point.ratio, label=point.what, zorder=5, **look)
        if budget is not None:
            axes.axvline(budget, color="#d55e00", lw=1.0, ls=":", label="budget")
        axes.axhline(1.0, color="#0072b2", lw=0.8)
        axes.set(xlabel="CPU time a scan [ms]", ylabel=RATIO, title=f"{title}: error against cost")
        # Sets that fail are not compared.
        ratios = [p.ratio for p in points]
        axes.set_ylim(0.9 * min(ratios), min(1.1 * max(ratios), _FAILS))
        log_scale(axes, "x")
        log_scale(axes)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside right center")
