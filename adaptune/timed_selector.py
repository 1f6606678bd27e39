"""A selector in a loop that must not stop: one call a scan, and a selection when one is due."""

import logging
import threading
from typing import Protocol

import numpy as np

from adaptune.odometry.base import Motions
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan

BACK = 10**9
"""Nanoseconds. Stamps that go back by more are of another drive: a clock was set, or a bag began
anew."""

_log = logging.getLogger(__name__)


class Selects(Protocol):
    """What chooses parameters on the way; see `Selector`."""

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """See a scan."""

    def select(self) -> Selection:
        """Choose what to apply."""

    def measure(self) -> None:
        """Measure how wrong the odometry was, for the next selections."""


class AnySelector(Selects, Protocol):
    """What a drive may rely on: it can begin anew, and knows what to apply where it fails."""

    def reset(self) -> None:
        """Forget all scans and selections."""

    def fall_back(self) -> Selection:
        """What to apply where nothing can be chosen."""


class Schedule:
    """Says when a selection is due: at the first scan, and at the first of every further period.

    Parameters
    ----------
    period
        In the unit of what `due` is asked, such as nanoseconds or metres.
    """

    def __init__(self, period: float):
        self._period = period
        self.reset()

    def reset(self) -> None:
        """Begin anew."""
        self._first: float | None = None
        self._n_periods = 0

    def due(self, now: float) -> bool:
        """Whether to select; `now` rises from call to call."""
        if self._first is None:
            self._first = now
        since = now - self._first
        if since < self._n_periods * self._period:
            return False
        self._n_periods = int(since // self._period) + 1
        return True


class TimedSelector:
    """Selects once a period, and never raises nor reads a file or a clock.

    Call `update` with every scan, from any thread. What goes wrong costs a selection and not the
    drive: the odometry then gets the fixed set, once, and the next period begins anew.

    Parameters
    ----------
    selector : Selector, UntrainedSelector, or what has their methods
        Nothing else may use it.
    period
        Seconds between selections, by the scans' stamps.
    distance
        Metres between selections; the period then does not count.

    Attributes
    ----------
    ignored : int
        Scans that were not newer than the one before.
    failed : int
        Scans at which the selector raised an error, which is logged.
    """

    def __init__(
        self,
        selector: AnySelector,
        period: float = 1.0,
        distance: float | None = None,
    ):
        if not (period if distance is None else distance) > 0:
            raise ValueError("period and distance must be above 0")
        self.ignored = self.failed = 0
        self._selector = selector
        self._by_distance = distance is not None
        self._schedule = Schedule(period * 1e9 if distance is None else distance)
        self._lock = threading.Lock()
        self._begin()

    def _begin(self) -> None:
        self._selector.reset()
        self._schedule.reset()
        self._stamp: int | None = None
        self._metres = 0.0
        self._unmeasured = self._failing = False
        self._owed: Selection | None = None  # for the next update to return

    def update(self, stamp: int, scan: Scan, motions: Motions) -> Selection | None:
        """See a scan, before it is registered, and select if that is due.

        A selection takes some milliseconds. After each, `measure` takes some tens of milliseconds;
        the next update does that first if nobody has done it.

        Parameters
        ----------
        stamp
            Nanoseconds. Scans that are not newer than the one before are ignored; if the stamp goes
            back by more than `BACK`, all is forgotten as before another drive.
        scan
            The scan.
        motions
            What the odometry moved over the scan before, see
            `adaptune.odometry.base.OdometryInstance`.

        Returns
        -------
        Selection or None
            What to apply before the scan is registered; None to leave the odometry as it is.
        """
        with self._lock:
            if self._stamp is not None and stamp <= self._stamp:
                if self._stamp - stamp <= BACK:
                    self.ignored += 1
                    return None
                _log.warning(
                    "the clock went back by %.1f s: the selector begins anew",
                    (self._stamp - stamp) * 1e-9,
                )
                self._begin()
            self._stamp = stamp
            if (owed := self._owed) is not None:
                self._owed = None
                return owed
            try:
                return self._selected(stamp, scan, motions)
            except Exception:
                return self._after_failure()

    def measure(self) -> None:
        """Measure how wrong the odometry was, for the next selections; else the next update does.

        Nothing is measured twice.
        """
        with self._lock:
            try:
                self._measure()
            except Exception:
                self._owed = self._after_failure()

    def _measure(self) -> None:
        if self._unmeasured:
            self._unmeasured = False
            self._selector.measure()

    def _selected(self, stamp: int, scan: Scan, motions: Motions) -> Selection | None:
        self._measure()
        self._selector.observe(stamp, scan, motions)
        moved = float(np.linalg.norm(motions.T_previous_current[:3, 3]))
        self._metres += moved if np.isfinite(moved) else 0.0
        if not self._schedule.due(self._metres if self._by_distance else stamp):
            return None
        selection = self._selector.select()
        self._unmeasured, self._failing = True, False
        return selection

    def _after_failure(self) -> Selection | None:
        """The fixed set, unless the odometry has it since the last failure."""
        self.failed += 1
        self._unmeasured = False
        self._selector.reset()
        if self._failing:
            return None
        self._failing = True
        _log.exception("no parameters can be selected; the fixed set is used")
        return self._selector.fall_back()
