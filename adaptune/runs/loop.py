"""Replay a recording in lockstep, selecting parameters on the way."""

import logging
import time
from collections.abc import Callable, Iterable
from typing import Any

from adaptune.errors import AdaptuneError
from adaptune.model.rules import BASELINE
from adaptune.odometry.base import Motions, OdometryInstance
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.tracker import RegisteredScan, Tracker
from adaptune.recording.scan import Scan
from adaptune.runs.record import Choice, Run
from adaptune.selector import REMEMBERED, SETTLING, AnySelector, Periods, used_instead
from adaptune.space import Selection

_log = logging.getLogger(__name__)


class Driver:
    """Drives an odometry, scan after scan.

    Where the health check finds no pose or an impossible one, where a switch fails, and where the
    odometry ends, it returns to the `fallback`: the fixed set, or in a bank even weights of those
    that never rest. A single set with which that happened is not applied for `REMEMBERED` seconds;
    a bank keeps its members. Where the baseline has just taken the place of another set, the
    odometry only restarts: it was lost already.

    Without a `fallback`, the odometry stays as it is, and a failed switch is an error. `what` is
    driven, for the log. `note` is called with every choice, also with those that are not applied.
    """

    def __init__(
        self,
        odometry: OdometryInstance,
        health: HealthCheck,
        fallback: Selection | None,
        what: str = "the drive",
        note: Callable[[Choice], None] = lambda _: None,
    ):
        self._odometry, self._fallback, self._what, self._note = odometry, fallback, what, note
        self._tracker = Tracker(odometry, health, None if fallback is None else self._unhealthy)
        self._applied = fallback
        self._asked: Choice | None = None  # what the odometry has not confirmed yet
        self._since = 0  # when that was first applied
        self._first: int | None = None  # stamp
        self._avoided: dict[int, int] = {}  # until when, by trial

    def take(self, stamp: int, selection: Selection, seconds: float = 0.0) -> None:
        """Apply a selection, before the scan of this stamp is registered; it took so long."""
        choice = Choice(stamp, selection, seconds)
        if selection.weights is None and stamp < self._avoided.get(selection.trial, stamp):
            self._note(choice._replace(why_not="the odometry failed with it"))
            return
        self._ask(choice)

    def _ask(self, choice: Choice) -> bool:
        """Ask for a selection alone; whether the odometry takes it, as far as is known."""
        self.give_up()
        self._asked = choice
        return self._settle(choice.stamp, self._odometry.apply)

    def give_up(self) -> None:
        """Note that what is not confirmed is no longer asked for."""
        if self._asked is not None:
            self._note(self._asked._replace(why_not="not confirmed in time"))
            self._asked = None

    def _settle(self, stamp: int, apply: Callable[[Selection], None] = lambda _: None) -> bool:
        """Note what became of what is asked for; whether it was not refused."""
        if (choice := self._asked) is None:
            return True
        selection, why = choice.selection, choice.fallen_back
        try:
            apply(selection)
            if not self._odometry.confirmed():
                return True
        except AdaptuneError as error:
            self._asked = None
            if self._fallback is None:
                raise
            if why:
                # The next selection tries again.
                self._applied = self._fallback
                what = "%s: %s at %.1f s; nor can the fixed set: %s"
                _log.warning(what, self._what, why, self._seconds(choice.stamp), error)
            else:
                self._note(choice._replace(why_not=str(error)))
                why = f"trial {selection.trial} cannot be applied: {error}"
                self._fall_back(stamp, selection, why)
            return False
        self._asked = None
        if why:
            seconds, used = self._seconds(choice.stamp), used_instead(selection)
            _log.warning("%s: %s at %.1f s; %s", self._what, why, seconds, used)
        else:
            self._tell(choice)
        if self._applied is None or self._applied.trial != selection.trial:
            self._since = stamp
        self._applied = selection
        self._note(choice._replace(seconds=choice.seconds + 1e-9 * (stamp - choice.stamp)))
        return True

    @property
    def motions(self) -> Motions:
        """See `Tracker.motions`."""
        return self._tracker.motions

    def register(
        self, scan: Scan, prepared: Any = None, seconds: float | None = None
    ) -> RegisteredScan:
        """Find the pose of the next scan, which the odometry may have prepared in so long."""
        self._first = scan.stamp if self._first is None else self._first
        self._settle(scan.stamp)
        if seconds is None:
            return self._tracker.register(scan)
        return self._tracker.register_prepared(scan.stamp, prepared, seconds, scan)

    def _unhealthy(self, stamp: int, what: str) -> bool:
        """Return to what is safe, unless it is in use; whether it was not.

        All members of a bank join in.
        """
        applied, fallback = self._applied, self._fallback
        if applied is None or fallback is None:
            return False
        newest = applied if self._asked is None else self._asked.selection
        if newest.same_as(fallback) and not newest.resting:
            return False
        is_baseline = applied.weights is None and applied.trial == BASELINE
        if is_baseline and stamp - self._since <= SETTLING:
            return False
        return self._fall_back(stamp, applied, f"the health check found {what}")

    def _fall_back(self, stamp: int, failed: Selection, why: str) -> bool:
        fallback = self._fallback
        assert fallback is not None
        if failed.weights is None and failed.trial != fallback.trial:
            self._avoided[failed.trial] = stamp + round(REMEMBERED * 1e9)
        return self._ask(Choice(stamp, fallback, 0.0, fallen_back=why))

    def _seconds(self, stamp: int) -> float:
        """Since the first scan."""
        return 0.0 if self._first is None else (stamp - self._first) * 1e-9

    def _tell(self, choice: Choice) -> None:
        """Log whether it is lost, where that has changed since the last selection."""
        lost = choice.selection.lost
        if lost != (self._applied is not None and self._applied.lost):
            who = "odometry" if choice.selection.weights is None else "bank"
            does = f"{'is lost' if lost else 'goes on'} at {self._seconds(choice.stamp):.1f} s"
            why = f": {choice.selection.why}" if lost and choice.selection.why else ""
            _log.warning("%s: the %s %s%s", self._what, who, does, why)


AfterScan = Callable[[Run], None]
"""Called after every scan."""


def replay(
    scans: Iterable[Scan],
    odometry: OdometryInstance,
    health: HealthCheck,
    selector: AnySelector | None = None,
    period: float = 1.0,
    watch: AfterScan = lambda _: None,
    what: str = "the replay",
    fallback: Selection | None = None,
) -> Run:
    """Replay a recording, as fast as it goes and always the same way.

    Selections are made as `Periods` says, from a scan and before it is registered.

    Parameters
    ----------
    scans
        In order of time.
    odometry, health, fallback, what
        See `Driver`.
    selector
        Chooses the parameters; without one they stay.
    period
        Seconds between selections.

    Raises
    ------
    AdaptuneError
        If there are no scans.
    OdometryError
        If the odometry cannot change its parameters, and there is no `fallback` to return to.
    """
    run, periods = Run(), Periods(period * 1e9)
    driver = Driver(odometry, health, fallback, what, run.note)
    for scan in scans:
        run.begin()
        if selector is not None:
            selector.observe(scan.stamp, scan, driver.motions)
            if periods.due(scan.stamp):
                t = time.perf_counter()
                selection = selector.select()
                driver.take(scan.stamp, selection, time.perf_counter() - t)
                selector.measure()
        run.end(driver.register(scan))
        watch(run)
    return run.finish(odometry)
