"""Show results: tables on the terminal, CSV and JSON files, and pictures."""

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
"""Adaptive modes often select the fixed set. Its line must stay visible below theirs."""
_FEW = 10


class Track(NamedTuple):
    """Errors and selections of one mode along a sequence."""

    seconds: NDArray[np.float64]  # since the first scan, of shape (n,)
    errors: NDArray[np.float64]  # sub-trajectory RTE in percent, of shape (n,)
    restarted: NDArray[np.bool_]  # of shape (n,)
    choice_seconds: NDArray[np.float64]  # of shape (m,)
    choices: Mapping[str, Sequence[Any]]  # for every parameter its values, of shape (m,)


def table(title: str, rows: Sequence[Mapping[str, Any]], caption: str = "") -> Table:
    """Rows of equal keys as a table that fits 80 columns where it can.

    Numbers are aligned to the right. A gap separates groups of equal first columns. Keys that
    start with an underscore are for files only.
    """
    space: Any = {"box": rich.box.SIMPLE_HEAD, "pad_edge": False, "padding": (0, 1, 0, 0)}
    made = Table(title=title, caption=caption, **space)
    made.title_justify = made.caption_justify = "left"
    keys = [key for key in (rows[0] if rows else {}) if not key.startswith("_")]
    for key in keys:
        numbers = all(isinstance(row[key], int | float | None) for row in rows)
        side: Any = "right" if numbers else "left"
        made.add_column(key, justify=side, no_wrap=key == keys[0], overflow="fold")
    grouped = bool(rows) and len({row[keys[0]] for row in rows}) < len(rows)
    for i, row in enumerate(rows):
        if i and grouped and rows[i - 1][keys[0]] != row[keys[0]]:
            made.add_row()
        made.add_row(*(_cell(row[key]) for key in keys))
    return made


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
    """Draw errors and selected parameters of each mode over time, as PNG.

    `length` is that of a sub-trajectory in metres; `logarithmic` are the parameters in log scale.
    """
    from matplotlib.figure import Figure

    names = list(next(iter(tracks.values())).choices)
    heights = [2.4] + [1.0] * len(names)
    figure = Figure(figsize=(10, 1.0 + 1.6 * sum(heights)), layout="constrained")
    axes = figure.subplots(
        1 + len(names), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    for mode, track in tracks.items():
        style = {"color": COLOURS.get(mode, "#9467bd")} | STYLES.get(mode, {"lw": 1.3})
        _draw_errors(axes[0], mode, track, style)
        for axis, name in zip(axes[1:], names, strict=True):
            values = list(track.choices[name])
            # The last choice holds until the end.
            x = np.append(track.choice_seconds, track.seconds[-1])
            axis.step(x, [*values, values[-1]], where="post", **style)
            if name in logarithmic:
                axis.set_yscale("log")
            axis.set_ylabel(name.replace("_", "\n"), fontsize=8)
    axes[0].set_ylabel(f"RTE over {length:g} m [%]")
    if any((np.isfinite(t.errors) & (t.errors > 0.0)).any() for t in tracks.values()):
        axes[0].set_yscale("log")
    axes[0].set_title(title, loc="left")
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False)
    axes[-1].set_xlabel("time [s]      (triangles: the health check restarted the odometry)")
    for axis in axes:
        axis.grid(alpha=0.3)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw_errors(axis: Any, mode: str, track: Track, style: Mapping[str, Any]) -> None:
    known = np.isfinite(track.errors)
    mean = f"{track.errors[known].mean():.2f} %" if known.any() else "no reference"
    axis.plot(track.seconds, track.errors, label=f"{mode} ({mean})", **style)
    restarts = track.seconds[track.restarted]
    if len(restarts):
        top = {"clip_on": False, "transform": axis.get_xaxis_transform()}
        axis.plot(restarts, np.full(len(restarts), 1.02), "v", color=style["color"], ms=4, **top)


def draw_front(
    path: Path, names: Sequence[str], values: NDArray[np.float64], front: NDArray[np.float64]
) -> None:
    """Draw the Pareto front and all sets, one panel for each two consecutive objectives, as PNG.

    `names` are those of the objectives; `values` are of all sets, `front` of those on the front, of
    shape (n, n_objectives).
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
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


class LeftOutResults(NamedTuple):
    """Results on the sequences that were left out of training."""

    # By mode, the ratio to the fixed set's error on each sequence.
    ratios: Mapping[str, NDArray[np.float64]]
    sequences: Sequence[str]  # their names
    # Of every frame; the gain is the ratio to the fixed set's error, of shape (n,).
    familiarity: NDArray[np.float64]
    gain: NDArray[np.float64]
    portfolio: NDArray[np.float64]  # ratio if the best of 1, 2, ... sets were known
    learning: Sequence[Mapping[str, Any]]  # rows of a learning curve, or none
    banks: Sequence[Mapping[str, Any]]  # rows of banks of several sizes, or none


def draw_validation(path: Path, title: str, found: LeftOutResults) -> None:
    """Draw results on the sequences left out, as PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4.5), layout="constrained")
    figure.suptitle(f"{title}: error over the fixed set's on sequences left out")
    by_sequence, by_novelty, by_size = figure.subplots(1, 3, width_ratios=(2, 1, 1))
    default = "bank" if "bank" in found.ratios else "paired"
    _draw_sequences(by_sequence, found)
    _draw_novelty(by_novelty, found, default)
    _draw_sizes(by_size, found, default)
    for axes in (by_sequence, by_novelty, by_size):
        axes.axhline(1.0, color=COLOURS["fixed"], lw=1.0)
        axes.grid(alpha=0.3)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)


def _draw_sequences(axes: Any, found: LeftOutResults) -> None:
    """Ratios of every mode on each sequence."""
    from matplotlib.ticker import LogLocator

    at = np.arange(len(found.sequences))
    for mode, of_mode in found.ratios.items():
        if mode != "fixed":
            marker = {"oracle, sequence": "_", "oracle, period": "x"}.get(mode, "o")
            colour, alpha = COLOURS.get(mode, "#999999"), 0.6 if mode == "baseline" else 1.0
            axes.plot(at, of_mode, marker, color=colour, label=mode, alpha=alpha)
    axes.set_xticks(at, found.sequences, rotation=60, ha="right")
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    axes.legend(fontsize="small", ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _draw_novelty(axes: Any, found: LeftOutResults, default: str) -> None:
    """Gain of the default rule over familiarity."""
    known = ~np.isnan(found.familiarity)
    if known.any():
        familiarity, gain = found.familiarity[known], found.gain[known]
        parts = [p for p in np.array_split(np.argsort(familiarity, kind="stable"), 10) if len(p)]
        means = [np.exp(np.log(gain[p]).mean()) for p in parts]
        axes.plot([familiarity[p].mean() for p in parts], means, "o-", color=COLOURS[default])
    axes.set_xlabel("familiarity (0: unlike all training)")
    axes.set_title(f"{default}, tenths of the frames", fontsize="medium")


def _draw_sizes(axes: Any, found: LeftOutResults, default: str) -> None:
    """Ratio over the number of sets, of members and of training sequences."""
    label = "of so many sets the best, if known"
    sizes = np.arange(1, len(found.portfolio) + 1)
    axes.plot(sizes, found.portfolio, "s--", color="#bbbbbb", label=label)
    counted = "sets"
    for rows, column, colour, what, label in (
        (found.banks, "instances", COLOURS["bank"], "instances", "bank, by its instances"),
        (found.learning, "sequences", "#555555", "training sequences", f"{default}, by sequences"),
    ):
        if not rows:
            continue
        counted += f"; {what}"
        middle = np.array([row["geometric"] for row in rows])
        error = np.abs([[row[key] for row in rows] for key in ("low", "high")] - middle)
        x = [row[column] for row in rows]
        axes.errorbar(x, middle, error, fmt="o-", color=colour, capsize=3, label=label)
    axes.set_xlabel(counted)
    axes.legend(fontsize="small", loc="lower center", bbox_to_anchor=(0.5, 1.0))
