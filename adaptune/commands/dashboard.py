"""What a replay, or a drive, does now: a dashboard for the terminal."""

import time
from collections.abc import Iterable, Iterator

import numpy as np
from rich.table import Table
from rich.text import Text

from adaptune.report.drawing import plain
from adaptune.space import Selection
from online.replay import ReplayRecord

NEWEST = 1000
"""Scans, and selections, whose milliseconds are shown."""


class Dashboard:
    """Shows what was told last; rich renders it as often as it likes."""

    def __init__(self) -> None:
        self._what = ""

    def look(self, what: str, total: int, record: ReplayRecord) -> None:
        """Take note of a scan.

        Parameters
        ----------
        what
            What is replayed or driven; where it changes, all begins anew.
        total
            How many scans there are; 0 if nobody knows.
        record
            What became of the scans so far.
        """
        step = record.steps[-1]
        if what != self._what:
            self._what, self._begun, self._first = what, time.perf_counter(), step.stamp
            self._restarts = 0
        self._restarts += step.unhealthy is not None
        self._total, self._record = total, record

    def __rich__(self) -> Table:
        table = Table.grid(padding=(0, 2))
        table.add_column(style="bold")
        table.add_column()
        for name, words, *style in self._lines() if self._what else ():
            table.add_row(Text(name), Text(words, *style))
        return table

    def _lines(self) -> Iterator[tuple[str, ...]]:
        """Names, words and, of some, styles."""
        record = self._record
        # Copies: the replay goes on.
        steps = list(record.steps)[-NEWEST:]
        driven = (steps[-1].stamp - self._first) * 1e-9
        speed = driven / max(time.perf_counter() - self._begun, 1e-9)
        yield self._what, f"{driven:.1f} s driven, {speed:.1f} times as fast as recorded"
        of = f" of {self._total}" if self._total else ""
        restarts = f", restarted {self._restarts} times" if self._restarts else ""
        took = _in_ms(step.prepare_seconds + step.register_seconds for step in steps)
        yield "scans", f"{record.done}{of}{restarts}; {took} a scan"
        if record.rate is not None:
            words = f"pose {_in_ms(list(record.late)[-NEWEST:])} after the scan"
            words += f"; scans dropped: {record.dropped}, selections missed: {record.missed}"
            yield "latency", words, "yellow" if record.dropped + record.missed else ""
        if (choice := record.newest) is None:
            return
        applied, rejected = list(record.choices), list(record.rejected)
        took = _in_ms(one.seconds for one in (applied + rejected)[-NEWEST:])
        yield "selections", f"{took}; not applied: {len(rejected)}"
        yield from _chosen(choice.selection)
        if why := choice.why_not or choice.fallen_back:
            yield "warning", why, "yellow"


def _chosen(selection: Selection) -> Iterator[tuple[str, ...]]:
    """Of a selection: the set or weights, what is predicted, and what was measured."""
    if selection.weights is None:
        values = ", ".join(
            f"{name} {plain(value) if isinstance(value, int | float) else value}"
            for name, value in selection.parameters.items()
        )
        yield "chosen", f"trial {selection.trial}: {values}"
    else:
        heaviest = sorted(selection.weights.items(), key=lambda pair: -pair[1])
        yield "weights", ", ".join(f"trial {trial} {100.0 * w:.0f} %" for trial, w in heaviest)
    if np.isfinite(selection.predicted_error):
        fixed = f"{selection.predicted_fixed:.3f} %"
        yield "predicted", f"{selection.predicted_error:.3f} %, of the fixed set {fixed}"
    if np.isfinite(selection.estimated_error):
        low, high = selection.estimated_low, selection.estimated_high
        yield "measured", f"{selection.estimated_error:.3f} % ({low:.3f}-{high:.3f} %)"
    if selection.lost:
        yield "lost", "do not rely on the pose", "bold red"


def _in_ms(seconds: Iterable[float]) -> str:
    """Median and 99th percentile, in milliseconds."""
    half, most = 1e3 * np.percentile(list(seconds) or [0.0], (50, 99))
    return f"{half:.1f} ms (99 %: {most:.1f})"
