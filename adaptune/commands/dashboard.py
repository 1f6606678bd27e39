"""What a replay, or a drive, does now: a dashboard for the terminal."""

import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from rich.table import Table
from rich.text import Text

from adaptune.report.drawing import plain
from adaptune.space import Selection
from online.replay import ReplayRecord

NEWEST = 1000
"""Scans, and selections, whose milliseconds are shown."""


class _Line(NamedTuple):
    name: str
    words: str
    style: str = ""


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
        now = time.perf_counter()
        if what != self._what:
            self._what, self._begun = what, now
            self._first = record.steps[-1].stamp
            self._scan_ms: deque[float] = deque(maxlen=NEWEST)
            self._selection_ms: deque[float] = deque(maxlen=NEWEST)
            self._restarts = self._n_choices = self._rejected = 0
            self._choice = None
        step, choice = record.steps[-1], record.newest
        self._now, self._total, self._record = now, total, record
        self._scan_ms.append(1e3 * (step.prepare_seconds + step.register_seconds))
        self._restarts += step.unhealthy is not None
        if choice is not None and choice is not self._choice:
            self._n_choices += 1
            self._rejected += bool(choice.why_not)
            self._selection_ms.append(1e3 * choice.seconds)
        self._choice = choice

    def __rich__(self) -> Table:
        table = Table.grid(padding=(0, 2))
        table.add_column(style="bold")
        table.add_column()
        for name, words, style in self._lines() if self._what else ():
            table.add_row(Text(name), Text(words, style))
        return table

    def _lines(self) -> Iterator[_Line]:
        record = self._record
        driven = (record.steps[-1].stamp - self._first) * 1e-9
        speed = driven / max(self._now - self._begun, 1e-9)
        yield _Line(self._what, f"{driven:.1f} s driven, {speed:.1f} times as fast as recorded")
        of = f" of {self._total}" if self._total else ""
        restarts = f", restarted {self._restarts} times" if self._restarts else ""
        yield _Line("scans", f"{record.done}{of}{restarts}; {_in_ms(self._scan_ms)} a scan")
        if record.rate is not None:
            late = 1e3 * np.array(list(record.late)[-NEWEST:])
            words = f"pose {_in_ms(late)} after the scan; scans dropped: {record.dropped}"
            if record.missed:
                words += f", selections missed: {record.missed}"
            is_late = record.dropped + record.missed > 0
            yield _Line("latency", words, "yellow" if is_late else "")
        if self._choice is None:
            return
        rejected = f", {self._rejected} not applied" if self._rejected else ""
        yield _Line("selections", f"{self._n_choices}{rejected}; {_in_ms(self._selection_ms)}")
        yield from _chosen(self._choice.selection)
        if why := self._choice.why_not or self._choice.fallen_back:
            yield _Line("warning", why, "yellow")


def _chosen(selection: Selection) -> Iterator[_Line]:
    """Of a selection: the set or weights, what is predicted, and what was measured."""
    if selection.weights is None:
        values = ", ".join(
            f"{name} {_short(value)}" for name, value in selection.parameters.items()
        )
        yield _Line("chosen", f"trial {selection.trial}: {values}")
    else:
        yield _Line("weights", _weights(selection.weights))
    if np.isfinite(selection.predicted_error):
        fixed = f"{selection.predicted_fixed:.3f} %"
        yield _Line("predicted", f"{selection.predicted_error:.3f} %, of the fixed set {fixed}")
    if np.isfinite(selection.estimated_error):
        low, high = selection.estimated_low, selection.estimated_high
        words = f"{selection.estimated_error:.3f} % ({low:.3f}-{high:.3f} %)"
        yield _Line("measured", words)
    if selection.lost:
        yield _Line("lost", "do not rely on the pose", "bold red")


def _weights(weights: Mapping[int, float]) -> str:
    heaviest = sorted(weights.items(), key=lambda pair: -pair[1])
    return ", ".join(f"trial {trial} {100.0 * weight:.0f} %" for trial, weight in heaviest)


def _short(value: object) -> str:
    return plain(value) if isinstance(value, int | float) else str(value)


def _in_ms(values: Iterable[float]) -> str:
    """Median and 99th percentile."""
    half, most = np.percentile(list(values) or [0.0], (50, 99))
    return f"{half:.1f} ms (99 %: {most:.1f})"
