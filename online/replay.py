"""Replay a recording in lockstep, selecting parameters on the way."""

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, MutableSequence
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.machine import resident_megabytes
from adaptune.model.rules import BASELINE
from adaptune.odometry.base import Motions, OdometryInstance
from adaptune.odometry.faults import MAX_SHARE_WITHOUT_POSE
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.tracker import RegisteredScan, Tracker
from adaptune.recording.scan import Scan
from adaptune.selector import REMEMBERED, SETTLING, AnySelector, Periods, used_instead
from adaptune.space import Selection
from adaptune.trajectory import Trajectory

_SAMPLED = 10
"""Scans from one look at the memory to the next."""
_log = logging.getLogger(__name__)


class Choice(NamedTuple):
    """A selection that was made."""

    stamp: int  # nanoseconds, of the scan that it was made from and first applied to
    selection: Selection
    seconds: float  # to describe the scan and choose; in real time, until it counts
    why_not: str = ""  # it was not applied; empty if it was
    fallen_back: str = ""  # why it is the fixed set; empty if it was chosen


class Driver:
    """Drives an odometry, scan after scan.

    Where the health check finds no pose or an impossible one, where a switch fails, and where the
    odometry ends, it returns to the fixed set. A single set with which that happened is not applied
    for `REMEMBERED` seconds; a bank keeps its members. Where the baseline has just taken the place
    of another set, the odometry only restarts: it was lost already.

    Without a `fixed` set, the odometry stays as it is, and a failed switch is an error. `what` is
    driven, for the log. `note` is called with every choice, also with those that are not applied.
    """

    def __init__(
        self,
        odometry: OdometryInstance,
        health: HealthCheck,
        fixed: Selection | None,
        what: str = "the drive",
        note: Callable[[Choice], None] = lambda _: None,
    ):
        self._odometry, self._fixed, self._what, self._note = odometry, fixed, what, note
        self._tracker = Tracker(odometry, health, None if fixed is None else self._unhealthy)
        self._applied = fixed
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
            if self._fixed is None:
                raise
            if why:
                # The next selection tries again.
                self._applied = self._fixed
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
        applied, fixed = self._applied, self._fixed
        if applied is None or fixed is None:
            return False
        newest = applied if self._asked is None else self._asked.selection
        if newest[:3] == fixed[:3] and not newest.resting:
            return False
        is_baseline = applied.weights is None and applied.trial == BASELINE
        if is_baseline and stamp - self._since <= SETTLING:
            return False
        return self._fall_back(stamp, applied, f"the health check found {what}")

    def _fall_back(self, stamp: int, failed: Selection, why: str) -> bool:
        fixed = self._fixed
        assert fixed is not None
        if failed.weights is None and failed.trial != fixed.trial:
            self._avoided[failed.trial] = stamp + round(REMEMBERED * 1e9)
        return self._ask(Choice(stamp, fixed, 0.0, fallen_back=why))

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


@dataclass(eq=False, repr=False)
class ReplayRecord:
    """What a replay, or a drive, did at each scan and at each selection so far."""

    rate: float | None = None  # times as fast as it was recorded; None if in lockstep
    tell: Callable[[Choice], None] = lambda _: None  # called with every choice
    steps: MutableSequence[RegisteredScan] = field(default_factory=list)  # (n,)
    choices: MutableSequence[Choice] = field(default_factory=list)  # those that were applied
    rejected: MutableSequence[Choice] = field(default_factory=list)  # those that were not
    newest: Choice | None = None  # applied or not
    cpu_ms: float = math.nan  # milliseconds of CPU time a scan, in all processes, without reading
    memory: float = 0.0  # most megabytes of all processes
    lacking: int = 0  # scans without a pose
    first_pose: float = 0.0  # seconds from the first scan to the odometry's first pose
    faults: tuple[str, ...] = ()  # of the odometry, as it says them
    # In real time:
    dropped: int = 0  # scans that the odometry did not get
    missed: int = 0  # selections that were not there at their deadline
    unseen: int = 0  # scans that the selector did not get
    # (n,): seconds from a scan's arrival to its pose
    late: MutableSequence[float] = field(default_factory=list)
    waited: MutableSequence[float] = field(default_factory=list)  # seconds for each selection
    late_members: int = 0  # scans at which members of a bank were late, over all members
    removed: int = 0  # members that were always late

    def __post_init__(self) -> None:
        self._cpu, self._n = 0.0, 0

    def __repr__(self) -> str:
        what = f"{self.done} scans, {len(self.choices)} selections, {self.restarted.sum()} restarts"
        return f"<ReplayRecord: {what}>"

    @property
    def done(self) -> int:
        """Scans so far, with those that were dropped."""
        return self._n + self.dropped

    @property
    def trajectory(self) -> Trajectory:
        """The odometry's."""
        stamps = np.array([step.stamp for step in self.steps], np.int64)
        return Trajectory(stamps, np.array([step.T_odom_sensor for step in self.steps]))

    @property
    def restarted(self) -> NDArray[np.bool_]:
        """Frames at which the health check restarted the odometry, of shape (n,)."""
        return np.array([step.unhealthy is not None for step in self.steps])

    @property
    def unhealthy(self) -> dict[str, int]:
        """How often the health check found what."""
        return dict(Counter(s.unhealthy for s in self.steps if s.unhealthy is not None))

    def note(self, choice: Choice) -> None:
        """Note a selection."""
        self.newest = choice
        (self.rejected if choice.why_not else self.choices).append(choice)
        self.tell(choice)

    def begin(self) -> None:
        """A scan is there: its CPU time counts from now on."""
        self._begun = time.process_time()

    def end(self, step: RegisteredScan) -> None:
        """Note where the odometry is, by the scan that has begun."""
        self._cpu += time.process_time() - self._begun
        if self._n % _SAMPLED == 0:
            self.memory = max(self.memory, resident_megabytes())
        self._n += 1
        self.steps.append(step)

    def finish(self, odometry: OdometryInstance, other_cpu: float = 0.0) -> Self:
        """Sum up, with what the odometry used and its faults, and what else took CPU seconds.

        An AdaptuneError says that there was no scan.
        """
        if not self._n:
            raise AdaptuneError("there is no scan to replay; check start and stop")
        # Scans before the first pose are unknown, unless they are so many that it has failed.
        waiting = sum(1 for _ in takewhile(lambda step: not step.begun, self.steps))
        if 0 < waiting < MAX_SHARE_WITHOUT_POSE * self._n:
            stamps = self.steps[waiting].stamp, self.steps[0].stamp
            self.first_pose = 1e-9 * (stamps[0] - stamps[1])
            del self.steps[:waiting], self.late[:waiting]
        usage, self.faults = odometry.usage, tuple(odometry.faults)
        self.cpu_ms = 1e3 * (self._cpu + usage.other_cpu + other_cpu) / self._n
        self.memory += usage.memory or 0.0
        self.lacking = max(usage.lacking, self.unhealthy.get("no_pose", 0))
        return self


Watch = Callable[[ReplayRecord], None]
"""Called after every scan."""


def replay(
    scans: Iterable[Scan],
    odometry: OdometryInstance,
    health: HealthCheck,
    selector: AnySelector | None = None,
    period: float = 1.0,
    watch: Watch = lambda _: None,
    what: str = "the replay",
    fixed: Selection | None = None,
) -> ReplayRecord:
    """Replay a recording, as fast as it goes and always the same way.

    Selections are made as `Periods` says, from a scan and before it is registered.

    Parameters
    ----------
    scans
        In order of time.
    odometry, health, fixed, what
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
        If the odometry cannot change its parameters, and there is no `fixed` to return to.
    """
    record, periods = ReplayRecord(), Periods(period * 1e9)
    driver = Driver(odometry, health, fixed, what, record.note)
    for scan in scans:
        record.begin()
        if selector is not None:
            selector.observe(scan.stamp, scan, driver.motions)
            if periods.due(scan.stamp):
                t = time.perf_counter()
                selection = selector.select()
                driver.take(scan.stamp, selection, time.perf_counter() - t)
                selector.measure()
        record.end(driver.register(scan))
        watch(record)
    return record.finish(odometry)
