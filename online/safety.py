"""Applies what is selected, and returns to the fixed set where that or the odometry goes wrong."""

import logging
from collections.abc import Callable
from typing import Any, NamedTuple

from adaptune.errors import AdaptuneError
from adaptune.model.paired import BASELINE
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.tracker import RegisteredScan, Tracker
from adaptune.selection import Selection
from adaptune.selector import NEW
from adaptune.sequence.scan import Scan

AVOIDED = 60 * 10**9
"""Nanoseconds for which a set is not applied after the odometry failed with it."""

_log = logging.getLogger(__name__)


class Choice(NamedTuple):
    """A selection that was made."""

    stamp: int  # nanoseconds, of the scan that it was made from and first applied to
    selection: Selection
    seconds: float  # to describe the scan and choose; in real time, from its arrival
    why_not: str = ""  # it was not applied; empty if it was
    fallen_back: str = ""  # why it is the fixed set; empty if it was chosen


class Driver:
    """Drives an odometry, scan after scan.

    Where the health check finds no pose or an impossible one, where a switch fails, and where the
    odometry ends, it returns to the fixed set. A single set with which that happened is not applied
    for `AVOIDED`; a bank keeps its members. Where the baseline has just taken the place of another
    set, the odometry only restarts: it was lost already.

    Parameters
    ----------
    odometry
        A new instance.
    health
        The odometry is restarted where its motion is not healthy.
    fixed
        What it returns to; None leaves the odometry as it is, and a failed switch is an error.
    what
        What is driven, for the log.
    note
        Called with every choice, also with those that are not applied.
    """

    def __init__(
        self,
        odometry: OdometryInstance,
        health: HealthCheck,
        fixed: Selection | None,
        what: str,
        note: Callable[[Choice], None],
    ):
        self._odometry, self._fixed, self._what, self._note = odometry, fixed, what, note
        self._tracker = Tracker(odometry, health, None if fixed is None else self._unhealthy)
        self._applied = fixed
        self._since = 0  # when that was first applied
        self._first: int | None = None  # stamp
        self._avoided: dict[int, int] = {}  # until when, by trial

    def take(self, stamp: int, selection: Selection, seconds: float) -> None:
        """Apply a selection, before the scan of this stamp is registered."""
        choice = Choice(stamp, selection, seconds)
        if selection.weights is None and stamp < self._avoided.get(selection.trial, stamp):
            self._note(choice._replace(why_not="the odometry failed with it"))
            return
        try:
            self._odometry.apply(selection)
        except AdaptuneError as error:
            if self._fixed is None:
                raise
            why = f"trial {selection.trial} cannot be applied: {error}"
            self._note(choice._replace(why_not=str(error)))
            self._fall_back(stamp, selection, why)
            return
        self._tell(choice)
        if self._applied is None or self._applied.trial != selection.trial:
            self._since = stamp
        self._applied = selection
        self._note(choice)

    def register(self, scan: Scan) -> RegisteredScan:
        """Find the pose of the next scan."""
        self._first = scan.stamp if self._first is None else self._first
        return self._tracker.register(scan)

    def register_prepared(self, scan: Scan, prepared: Any, seconds: float) -> RegisteredScan:
        """Find the pose of the next scan, which the odometry has prepared."""
        self._first = scan.stamp if self._first is None else self._first
        return self._tracker.register_prepared(scan.stamp, prepared, seconds, scan)

    def _unhealthy(self, stamp: int, what: str) -> bool:
        """Return to the fixed set, unless it is in use; whether it was not.

        All members of a bank join in.
        """
        applied, fixed = self._applied, self._fixed
        if applied is None or fixed is None:
            return False
        if applied[:3] == fixed[:3] and not applied.resting:
            return False
        is_baseline = applied.weights is None and applied.trial == BASELINE
        if is_baseline and stamp - self._since <= NEW:
            return False
        return self._fall_back(stamp, applied, f"the health check found {what}")

    def _fall_back(self, stamp: int, failed: Selection, why: str) -> bool:
        """Apply the fixed set; whether that worked."""
        fixed = self._fixed
        assert fixed is not None
        if failed.weights is None and failed.trial != fixed.trial:
            self._avoided[failed.trial] = stamp + AVOIDED
        seconds = self._seconds(stamp)
        # Where that fails, too, the next selection tries again.
        self._applied = fixed
        try:
            self._odometry.apply(fixed)
        except AdaptuneError as error:
            what = "%s: %s at %.1f s; nor can the fixed set: %s"
            _log.warning(what, self._what, why, seconds, error)
            return False
        _log.warning("%s: %s at %.1f s; the fixed set is used", self._what, why, seconds)
        self._note(Choice(stamp, fixed, 0.0, fallen_back=why))
        return True

    def _seconds(self, stamp: int) -> float:
        """Since the first scan."""
        return 0.0 if self._first is None else (stamp - self._first) * 1e-9

    def _tell(self, choice: Choice) -> None:
        """Log what has changed since the last selection: who rests, and whether it is lost."""
        before = frozenset() if self._applied is None else self._applied.resting
        now = choice.selection.resting
        for trial in sorted(before ^ now):
            does = "rests" if trial in now else "joins in"
            seconds = self._seconds(choice.stamp)
            _log.info("%s: trial %d %s at %.1f s", self._what, trial, does, seconds)
        lost = choice.selection.lost
        if lost != (self._applied is not None and self._applied.lost):
            who = "odometry" if choice.selection.weights is None else "bank"
            does = "is lost" if lost else "goes on"
            _log.warning(
                "%s: the %s %s at %.1f s", self._what, who, does, self._seconds(choice.stamp)
            )
