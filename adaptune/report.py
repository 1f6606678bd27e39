"""What people look at: tables on the terminal, CSV and JSON beside them, and pictures."""

import csv
import io
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rich.box
from numpy.typing import NDArray
from rich.table import Table

from adaptune.files import replacing, write_text

COLOURS = {
    "baseline": "#7f7f7f",
    "fixed": "#1f77b4",
    "paper": "#ff7f0e",
    "paired": "#2ca02c",
    "bank": "#d62728",
}
STYLES: dict[str, dict[str, Any]] = {"fixed": {"lw": 4.0, "alpha": 0.35}}
"""Adaptive modes often take the fixed set, and must not hide it."""
_FEW = 10


class Track(NamedTuple):
    """One mode's way through a sequence, for the picture.

    Attributes
    ----------
    seconds : ndarray of shape (n,)
        Since the first scan.
    errors : ndarray of shape (n,)
        Sub-trajectory RTE in percent.
    restarted : ndarray of shape (n,)
    choice_seconds : ndarray of shape (m,)
    choices : dict
        For every parameter its values, of shape (m,).
    """

    seconds: NDArray[np.float64]
    errors: NDArray[np.float64]
    restarted: NDArray[np.bool_]
    choice_seconds: NDArray[np.float64]
    choices: Mapping[str, Sequence[Any]]


def table(title: str, rows: Sequence[Mapping[str, Any]], caption: str = "") -> Table:
    """Rows of equal keys as a table that fits 80 columns where it can.

    Numbers stand to the right, and a gap where the first column changes. Keys that start with an
    underscore are for files only.
    """
    made = Table(
        title=title,
        title_justify="left",
        caption=caption,
        caption_justify="left",
        box=rich.box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    keys = [key for key in (rows[0] if rows else {}) if not key.startswith("_")]
    for key in keys:
        numbers = all(isinstance(row[key], int | float | None) for row in rows)
        made.add_column(
            key, justify="right" if numbers else "left", no_wrap=key == keys[0], overflow="fold"
        )
    for i, row in enumerate(rows):
        if i and len(rows) > 1 and rows[i - 1][keys[0]] != row[keys[0]] and _grouped(rows, keys[0]):
            made.add_row()
        made.add_row(*(_cell(row[key]) for key in keys))
    return made


def _grouped(rows: Sequence[Mapping[str, Any]], key: str) -> bool:
    return len({row[key] for row in rows}) < len(rows)


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "-"
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < _FEW else f"{value:.1f}"
    return str(value)


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of equal keys as CSV, with a header."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def write_rows(folder: Path, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows of equal keys as ``<name>.csv`` and ``<name>.json``."""
    plain = [{key.lstrip("_"): value for key, value in row.items()} for row in rows]
    write_text(folder / f"{name}.csv", csv_text(plain))
    # JSON knows no NaN.
    finite = [
        {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}
        for row in plain
    ]
    write_text(folder / f"{name}.json", json.dumps(finite, indent=2) + "\n")


def draw_tracks(
    path: Path,
    title: str,
    length: float,
    tracks: Mapping[str, Track],
    logarithmic: Collection[str] = (),
) -> None:
    """Draw errors and chosen parameters over time, as PNG.

    Parameters
    ----------
    path
        The picture.
    title
        What it shows.
    length
        Metres of a sub-trajectory.
    tracks
        By mode.
    logarithmic
        Names of the parameters to draw in log scale.
    """
    from matplotlib.figure import Figure

    names = list(next(iter(tracks.values())).choices)
    heights = [2.4] + [1.0] * len(names)
    figure = Figure(figsize=(10, 1.0 + 1.6 * sum(heights)), layout="constrained")
    axes = figure.subplots(
        1 + len(names), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    for mode, track in tracks.items():
        colour = COLOURS.get(mode, "#9467bd")
        known = np.isfinite(track.errors)
        mean = f"{track.errors[known].mean():.2f} %" if known.any() else "no reference"
        style = {"color": colour} | STYLES.get(mode, {"lw": 1.3})
        axes[0].plot(track.seconds, track.errors, label=f"{mode} ({mean})", **style)
        restarts = track.seconds[track.restarted]
        if len(restarts):
            axes[0].plot(
                restarts,
                np.full(len(restarts), 1.02),
                "v",
                color=colour,
                ms=4,
                clip_on=False,
                transform=axes[0].get_xaxis_transform(),
            )
        for axis, name in zip(axes[1:], names, strict=True):
            values = list(track.choices[name])
            # The last choice holds until the end.
            x = np.append(track.choice_seconds, track.seconds[-1])
            axis.step(x, [*values, values[-1]], where="post", **style)
            if name in logarithmic:
                axis.set_yscale("log")
            axis.set_ylabel(name.replace("_", "\n"), fontsize=8)
    axes[0].set_ylabel(f"RTE over {length:g} m [%]")
    if any(np.isfinite(t.errors).any() for t in tracks.values()):
        axes[0].set_yscale("log")
    axes[0].set_title(title, loc="left")
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False)
    axes[-1].set_xlabel("time [s]      (triangles: the health check started the odometry anew)")
    for axis in axes:
        axis.grid(alpha=0.3)
    with replacing(path) as beside:
        figure.savefig(beside, dpi=110)


def draw_front(
    path: Path, names: Sequence[str], values: NDArray[np.float64], front: NDArray[np.float64]
) -> None:
    """Draw a Pareto front among all that was tried, as PNG: every two objectives that follow.

    Parameters
    ----------
    path
        The picture.
    names
        Of the objectives.
    values
        Of all sets, of shape (n, n_objectives).
    front
        Of those on the front, of shape (m, n_objectives).
    """
    from matplotlib.figure import Figure

    n = len(names) - 1
    figure = Figure(figsize=(1.0 + 5.0 * n, 4.5), layout="constrained")
    for i, axis in enumerate(figure.subplots(1, n, squeeze=False)[0]):
        axis.plot(values[:, i], values[:, i + 1], ".", color=COLOURS["baseline"], label="tried")
        axis.plot(front[:, i], front[:, i + 1], "o-", color=COLOURS["fixed"], label="Pareto front")
        axis.set_xlabel(names[i])
        axis.set_ylabel(names[i + 1])
        axis.grid(alpha=0.3)
    axis.legend(frameon=False)
    with replacing(path) as beside:
        figure.savefig(beside, dpi=110)


def draw_validation(
    path: Path,
    title: str,
    ratios: Mapping[str, NDArray[np.float64]],
    sequences: Sequence[str],
    familiarity: NDArray[np.float64],
    gain: NDArray[np.float64],
    portfolio: NDArray[np.float64],
    learning: Sequence[Mapping[str, Any]],
    banks: Sequence[Mapping[str, Any]],
) -> None:
    """Draw what was found on the sequences left out, as PNG.

    Parameters
    ----------
    path
        The picture.
    title
        What it shows.
    ratios
        By mode, the ratio to the fixed set's error on each sequence.
    sequences
        Their names.
    familiarity, gain
        Of every frame; the ratio to the fixed set's error, of shape (n,).
    portfolio
        Ratio if the best of 1, 2, ... sets were known.
    learning
        Rows of a learning curve, or none.
    banks
        Rows of banks of several sizes, or none.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(13, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{title}: error over the fixed set's on sequences left out")
    by_sequence, by_novelty, by_size = figure.subplots(1, 3, width_ratios=(2, 1, 1))
    at = np.arange(len(sequences))
    for mode, of_mode in ratios.items():
        if mode != "fixed":
            by_sequence.plot(
                at,
                of_mode,
                {"oracle, sequence": "_", "oracle, period": "x"}.get(mode, "o"),
                color=COLOURS.get(mode, "#999999"),
                label=mode,
                alpha=0.6 if mode == "baseline" else 1.0,
            )
    by_sequence.set_xticks(at, sequences, rotation=60, ha="right")
    by_sequence.set_yscale("log")
    by_sequence.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    by_sequence.yaxis.set_major_formatter("{x:g}")
    by_sequence.yaxis.set_minor_formatter("")
    by_sequence.legend(fontsize="small", ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    default = "bank" if "bank" in ratios else "paired"
    known = ~np.isnan(familiarity)
    if known.any():
        order = np.argsort(familiarity[known], kind="stable")
        parts = [p for p in np.array_split(order, 10) if len(p)]
        by_novelty.plot(
            [familiarity[known][p].mean() for p in parts],
            [np.exp(np.log(gain[known][p]).mean()) for p in parts],
            "o-",
            color=COLOURS[default],
        )
    by_novelty.set_xlabel("familiarity (0: unlike all training)")
    by_novelty.set_title(f"{default}, tenths of the frames", fontsize="medium")
    by_size.plot(
        np.arange(1, len(portfolio) + 1),
        portfolio,
        "s--",
        color="#bbbbbb",
        label="of so many sets the best, if known",
    )
    counted = ["sets"]
    for rows, column, colour, what, label in (
        (banks, "instances", COLOURS["bank"], "instances", "bank, by its instances"),
        (learning, "sequences", "#555555", "training sequences", f"{default}, by sequences"),
    ):
        if not rows:
            continue
        counted.append(what)
        middle = np.array([row["geometric"] for row in rows])
        bounds = [[row[key] for row in rows] for key in ("low", "high")]
        by_size.errorbar(
            [row[column] for row in rows],
            middle,
            np.abs(bounds - middle),
            fmt="o-",
            color=colour,
            capsize=3,
            label=label,
        )
    by_size.set_xlabel("; ".join(counted))
    by_size.legend(fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0))
    for axes in (by_sequence, by_novelty, by_size):
        axes.axhline(1.0, color=COLOURS["fixed"], lw=1.0)
        axes.grid(alpha=0.3)
    with replacing(path) as beside:
        figure.savefig(beside, format="png", dpi=110)
