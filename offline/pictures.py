"""Picture of a Pareto front."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.report.paper import POINTS, as_png_and_svg, log_scale, picture

_SPREAD = 20.0
"""Largest over least value from which on an axis is logarithmic."""


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
