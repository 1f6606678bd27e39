"""Replay a recording as fast as it was recorded, with what the robot would not wait for."""

import logging
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain, islice
from typing import Any, NamedTuple

from adaptune.bank.bank import CLOCK, Bank, Clock
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.tracker import RegisteredScan
from adaptune.recording.scan import Imu, Scan, joined, read_ahead
from adaptune.runs.loop import AfterScan, Driver
from adaptune.runs.record import Run
from adaptune.selector import Periods
from adaptune.study.config import RealTimeConfig
from online.selector_process import Answer, SelectorProcess

_AHEAD = 32
"""Scans that are read before they are due."""

_log = logging.getLogger(__name__)


class Arrival(NamedTuple):
    """A scan that the odometry takes."""

    scan: Scan
    due: float  # when the sensor gave it, by the drive's clock
    dropped: int  # scans before it that waited too long


def arrivals(
    scans: Iterable[Scan],
    rate: float,
    queue: int,
    clock: Clock = CLOCK,
) -> Iterator[Arrival]:
    """Scans, each when it is due or as soon as it is asked for after that.

    What an IMU measured before a scan that is dropped goes to the scan after it.

    For `rate` and `queue` see `RealTimeConfig`; the sensor goes by `clock`.
    """
    source = iter(scans)
    ahead = next(source, None)
    if ahead is None:
        return
    first, begin = ahead.stamp, clock.now()
    waiting: deque[tuple[Scan, float]] = deque()
    imus: list[Imu] = []
    dropped = 0
    while ahead is not None or waiting:
        while ahead is not None:
            due = begin + (ahead.stamp - first) * 1e-9 / rate
            if due > (now := clock.now()):
                if waiting:
                    break
                clock.sleep(due - now)
                continue
            waiting.append((ahead, due))
            if queue and len(waiting) > queue:
                imus += [imu for imu in (waiting.popleft()[0].imu,) if imu is not None]
                dropped += 1
            ahead = next(source, None)
        scan, due = waiting.popleft()
        if imus and scan.imu is not None:
            scan = replace(scan, imu=joined([*imus, scan.imu]))
        yield Arrival(scan, due, dropped)
        imus, dropped = [], 0


def replay_in_real_time(
    scans: Iterable[Scan],
    odometry: OdometryInstance,
    health: HealthCheck,
    settings: RealTimeConfig,
    selector: SelectorProcess | None = None,
    watch: AfterScan = lambda _: None,
    what: str = "the replay",
    clock: Clock = CLOCK,
) -> Run:
    """Replay a recording at the sensor's rate.

    While the odometry prepares a scan, the selector's process describes it. A selection that is
    late is dropped. The sensor goes by `clock`; for the rest see `adaptune.runs.loop.replay`.
    """
    run = Run(settings.rate)
    drive = RealTimeDrive(odometry, health, settings, selector, run, what, clock)
    source = read_ahead(scans, _AHEAD)
    first = list(islice(source, _AHEAD // 2))  # read before the first one is due
    every = chain(first, source)
    for arrival in arrivals(every, settings.rate, settings.queue, clock):
        drive.step(arrival)
        watch(run)
    drive.finish()
    return run.finish(odometry, 0.0 if selector is None else selector.cpu)


class RealTimeDrive:
    """Takes scans as they come, and applies what is selected in time.

    `run` receives what becomes of each scan and each selection; for the rest see
    `replay_in_real_time`.
    """

    def __init__(
        self,
        odometry: OdometryInstance,
        health: HealthCheck,
        settings: RealTimeConfig,
        selector: SelectorProcess | None,
        run: Run,
        what: str,
        clock: Clock = CLOCK,
    ):
        self.run, self._clock = run, clock
        self._odometry, self._selector = odometry, selector
        self._deadline = settings.deadline
        self._periods = Periods(1.0 if selector is None else selector.period * 1e9)
        fallback = None if selector is None else selector.fallback
        self._driver = Driver(odometry, health, fallback, what, run.note)

    def step(self, arrival: Arrival) -> RegisteredScan:
        """Select if that is due, and find the pose of a scan."""
        scan, due, dropped = arrival
        self.run.begin()
        self.run.dropped += dropped
        begin = self._clock.now()
        prepared = self._prepare(scan, due)
        step = self._driver.register(scan, prepared, self._clock.now() - begin)
        self.run.late.append(self._clock.now() - due)
        self.run.end(step)
        return step

    def finish(self) -> None:
        """Record what selector and bank have counted, and what was not confirmed."""
        self._driver.give_up()
        if self._selector is not None:
            self.run.unseen = self._selector.unseen
        if isinstance(self._odometry, Bank):
            late = self._odometry.late
            self.run.late_members = int(late.scans.sum())
            self.run.removed = int(late.removed.sum())

    def _prepare(self, scan: Scan, due: float) -> Any:
        """Prepare a scan with the parameters that it is registered with.

        The odometry waits for a selection until half the time to the deadline is over, and takes
        one that comes while it prepares the scan.
        """
        odometry, selector = self._odometry, self._selector
        if selector is None:
            return odometry.prepare(scan)
        wanted = self._periods.due(scan.stamp)
        wait = self._left(due) if wanted else 0.0
        shown = selector.show(scan.stamp, scan, self._driver.motions, wait)
        if not wanted:
            return odometry.prepare(scan)
        begin = self._clock.now()
        answer = selector.answer_to(scan.stamp, 0.5 * self._left(due)) if shown else None
        self.run.waited.append(self._clock.now() - begin)
        if answer is not None:
            self._take(answer, scan.stamp, due)
            return odometry.prepare(scan)
        prepared, preparation = odometry.prepare(scan), odometry.preparation
        if shown and self._left(due):
            answer = selector.answer_to(scan.stamp, 0.0)
        self._take(answer, scan.stamp, due)
        return prepared if odometry.preparation == preparation else odometry.prepare(scan)

    def _take(self, answer: Answer | None, stamp: int, due: float) -> None:
        if answer is None or answer.selection is None:
            self.run.missed += 1
        else:
            self._driver.take(stamp, answer.selection, self._clock.now() - due)

    def _left(self, due: float) -> float:
        return max(self._deadline - (self._clock.now() - due), 0.0)
