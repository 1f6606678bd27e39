"""Picture of an estimated reference."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from adaptune.drawing import log_scale, picture
from adaptune.reference.estimated import EstimatedReference
from adaptune.reference.stored import StoredEstimate

_KNOWN, _UNKNOWN = "#0072b2", "#d55e00"
_MARGIN = 20.0
"""Metres around the known path in which the unknown is drawn."""
_LONGEST_BREAK = 20.0
"""Seconds; longer ones are drawn as this."""


def draw_estimate(
    path: Path, title: str, found: EstimatedReference, stored: StoredEstimate, length: float
) -> None:
    """Draw the path, the residuals of the registrations, and where it is not to be trusted.

    Parameters
    ----------
    path
        PNG or SVG.
    title
        First line.
    found, stored
        The reference, and what is known about it.
    length
        Metres over which the title tells the error.
    """
    with picture((path,), 11.0, 4.6) as figure:
        of_path, of_residuals = figure.subplots(1, 2, width_ratios=(1.0, 1.4))
        figure.suptitle(f"{title}: {_in_words(stored, length)}", x=0.01, ha="left")
        _draw_path(of_path, found)
        _draw_residuals(of_residuals, found)


def _in_words(stored: StoredEstimate, length: float) -> str:
    error = stored.error(length)
    wrong = "" if math.isnan(error) else f", wrong by {error:.2g} % over {length:g} m"
    share = 100.0 * stored.unknown_share
    unknown = f", unknown for {max(share, 0.1):.1f} % of the scans" if share else ""
    return f"{stored.metres:.0f} m{wrong}{unknown}"


def _draw_path(axes: Any, found: EstimatedReference) -> None:
    x, y = found.T_world_sensor[:, :2, 3].T
    known = found.known
    if known.any():
        # Beyond a gap, the unknown path may lead anywhere.
        inside = [(a > a[known].min() - _MARGIN) & (a < a[known].max() + _MARGIN) for a in (x, y)]
        shown = inside[0] & inside[1]
        axes.plot(*(np.where(shown, a, np.nan) for a in (x, y)), color=_UNKNOWN, lw=1.0, ls=":")
    axes.plot(*(np.where(known, a, np.nan) for a in (x, y)), color=_KNOWN, lw=1.8)
    axes.plot(x[:1], y[:1], "o", color="black", ms=5)
    axes.annotate("start", (x[0], y[0]), textcoords="offset points", xytext=(5, 5))
    axes.set_aspect("equal", "datalim")
    axes.set(title="path", xlabel="x [m]", ylabel="y [m]")


def _draw_residuals(axes: Any, found: EstimatedReference) -> None:
    seconds = (found.stamps - found.stamps[0]) * 1e-9
    # A long break, as between two recordings, would hide all else.
    drawn = np.append(0.0, np.cumsum(np.minimum(np.diff(seconds), _LONGEST_BREAK)))
    of = found.registrations
    at, differs = drawn[of.end], 100.0 * of.residual
    failed = np.isnan(differs)
    top = 2.0 * float(np.max(differs[~failed], initial=1.0))
    for which, label, style in (
        (of.accepted, "agree", {"marker": ".", "color": _KNOWN, "ms": 3}),
        (~of.accepted & ~failed, "differ", {"marker": "x", "color": _UNKNOWN, "ms": 5}),
        (failed, "failed", {"marker": "|", "color": "#999999", "ms": 6}),
    ):
        if which.any():
            y = np.where(failed, top, np.maximum(differs, 0.01))[which]
            axes.plot(at[which], y, ls="none", label=f"{int(which.sum())} {label}", **style)
    for gap in found.gaps():
        span = np.interp((gap.begin, gap.end), seconds, drawn)
        axes.axvspan(*span, color=_UNKNOWN, alpha=0.15, lw=0)
    log_scale(axes)
    title = "registrations over 2, 5 and 10 m"
    shortened = drawn[-1] < seconds[-1] - 1e-6
    time = f"time [s], breaks drawn as {_LONGEST_BREAK:g} s" if shortened else "time [s]"
    axes.set(title=title, xlabel=time, ylabel="differ from the reference by [cm], logarithmic")
    if len(at):
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
