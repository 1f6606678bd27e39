"""Charts of selections: how familiar the surroundings were, and how long all took."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from adaptune.charts.chart import Axis, Chart, Drawn, Line, Mark, Panel, Points
from online.replayed_sequence import ModeReplay, ReplayedSequence

_BINS = 40
_RATIO = "error over the fixed set's [-]"


def familiarity_chart(replayed: ReplayedSequence) -> Chart | None:
    """Familiarity of the surroundings at each selection, over time and against the gain."""
    known = {mode: of for mode, of in replayed.modes.items() if np.isfinite(of.familiarity).any()}
    if not known:
        return None
    drawn: list[Drawn] = [] if replayed.scenes is None else [replayed.scenes]
    drawn += [Line(of.track.choice_seconds, of.familiarity, mode) for mode, of in known.items()]
    y = Axis("familiarity [-]", limits=(0.0, 1.02))
    panels = [Panel(Axis("time [s]"), y, tuple(drawn))]
    fixed = replayed.modes.get("fixed")
    if fixed is not None:
        ratios = {m: period_ratios(of, fixed) for m, of in known.items() if m != "fixed"}
        points = tuple(
            Points(known[mode].familiarity, of, mode)
            for mode, of in ratios.items()
            if np.isfinite(of).any()
        )
        if points:
            x = Axis("familiarity [-]", limits=(0.0, 1.02))
            panels.append(Panel(x, Axis(_RATIO, log=True), (*points, Mark(1.0))))
    return Chart(
        f"{replayed.name}-familiarity",
        f"{replayed.name}: how familiar the surroundings were",
        tuple(panels),
        "How much the training knows about surroundings like those at each selection: 0 means "
        "unlike all training. Below, the error until the next selection over the fixed set's on "
        "the same scans: a mode that loses where familiarity is low should not trust its training "
        "there.",
    )


def period_ratios(of: ModeReplay, fixed: ModeReplay) -> NDArray[np.float64]:
    """Mean error from each selection to the next over that of the fixed set, of shape (m,).

    NaN where either is unknown.
    """
    edges = of.track.span

    def means(one: ModeReplay) -> NDArray[np.float64]:
        kept = np.isfinite(one.track.errors)
        seconds, errors = one.track.seconds[kept], one.track.errors[kept]
        number = np.searchsorted(edges, seconds, side="right") - 1
        number = np.clip(number, 0, len(edges) - 2)
        counts = np.bincount(number, minlength=len(edges) - 1)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.bincount(number, errors, len(edges) - 1) / counts)

    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(means(of) / means(fixed))


def latency_chart(replayed: ReplayedSequence) -> Chart | None:
    """How long selections and scans took in each mode, as histograms."""
    period = _scan_period(replayed.modes)
    kinds: dict[str, Callable[[ModeReplay], NDArray[np.float64]]] = {
        "to select": lambda of: of.selection_ms,
        "to prepare and register a scan": lambda of: of.scan_ms,
        "from a scan to its pose, in real time": lambda of: of.late_ms,
    }
    panels = []
    for what, get in kinds.items():
        times = {mode: ms for mode, of in replayed.modes.items() if (ms := _positive(get(of))).size}
        if not times:
            continue
        selects = what == "to select"
        marks = () if selects else (Mark(period, "scan period", "x"),)
        panels.append(
            Panel(
                Axis(f"time {what} [ms]", log=True),
                Axis(f"share of the {'selections' if selects else 'scans'} [%]"),
                (*histograms(times), *marks),
            )
        )
    if not panels:
        return None
    return Chart(
        f"{replayed.name}-latency",
        f"{replayed.name}: how long it took",
        tuple(panels),
        "Histograms with bins of equal width on the logarithmic axis. What lies right of the scan "
        "period takes longer than there is until the next scan.",
    )


def _positive(ms: NDArray[np.float64]) -> NDArray[np.float64]:
    return ms[np.isfinite(ms) & (ms > 0.0)]


def _scan_period(modes: Mapping[str, ModeReplay]) -> float:
    """Milliseconds from scan to scan."""
    seconds = next(iter(modes.values())).track.seconds
    return 1e3 * float(np.median(np.diff(seconds))) if len(seconds) > 1 else np.nan


def histograms(times: Mapping[str, NDArray[np.float64]]) -> list[Line]:
    """Share of each mode's times in bins that all modes have, in percent, as steps.

    Parameters
    ----------
    times
        By mode, positive numbers.
    """
    every = np.concatenate(list(times.values()))
    edges = np.geomspace(0.99 * every.min(), 1.01 * every.max(), _BINS + 1)
    made = []
    for mode, ms in times.items():
        shares = 100.0 * np.histogram(ms, edges)[0] / len(ms)
        made.append(Line(edges, [*shares, 0.0], mode, steps=True))
    return made
