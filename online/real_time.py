"""Replay a recording as fast as it was recorded, with what the robot would not wait for."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice
from queue import Queue
from typing import Any, NamedTuple

import numpy as np

from adaptune.odometry.bank import Bank
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.tracker import RegisteredScan
from adaptune.sequence.imu import Imu, joined
from adaptune.sequence.scan import Scan
from adaptune.study.config import RealTimeConfig
from adaptune.timed_selector import Schedule
from online.replay import Meter, Progressed, RealTimeRecord, Replay, Watch, recorded
from online.safety import Choice, Driver
from online.selector_process import Answer, SelectorProcess

_AHEAD = 32
"""Scans that are read before they are due."""

_log = logging.getLogger(__name__)


class Arrival(NamedTuple):
    """A scan that the odometry takes."""

    scan: Scan
    due: float  # when the sensor gave it, on the clock of `time.perf_counter`
    dropped: int  # scans before it that waited too long


def arrivals(scans: Iterable[Scan], rate: float, queue: int) -> Iterator[Arrival]:
    """Scans, each when it is due or as soon as it is asked for after that.

    What an IMU measured before a scan that is dropped goes to the scan after it.

    Parameters
    ----------
    scans
        In order of time.
    rate, queue
        See `RealTimeConfig`.
    """
    source = iter(scans)
    ahead = next(source, None)
    if ahead is None:
        return
    first, begin = ahead.stamp, time.perf_counter()
    waiting: deque[tuple[Scan, float]] = deque()
    imus: list[Imu] = []
    dropped = 0
    while ahead is not None or waiting:
        while ahead is not None:
            due = begin + (ahead.stamp - first) * 1e-9 / rate
            if due > (now := time.perf_counter()):
                if waiting:
                    break
                time.sleep(due - now)
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


def outlook(stamps: Sequence[int], settings: RealTimeConfig, core_ms: float) -> str:
    """Whether this machine can hold the rate, in words; nothing if that is not known.

    Parameters
    ----------
    stamps
        Nanoseconds, of the first scans.
    settings
        Rate and queue.
    core_ms
        Milliseconds that a scan keeps the busiest core at work.
    """
    if len(stamps) < 2 or not np.isfinite(core_ms):
        return ""
    interval = float(np.median(np.diff(stamps))) * 1e-6 / settings.rate
    needs = f"a scan takes about {core_ms:.0f} ms, and there is one every {interval:.0f} ms"
    if core_ms <= interval:
        return f"{needs}: this machine holds the rate"
    if not settings.queue:
        return f"{needs}: the odometry will lag behind"
    return f"{needs}: about {1.0 - interval / core_ms:.0%} of the scans will be dropped"


def _read_ahead(scans: Iterable[Scan]) -> Iterator[Scan]:
    """Read in a thread; an error is raised here."""
    read: Queue[Scan | BaseException | None] = Queue(_AHEAD)
    stop = threading.Event()

    def work() -> None:
        try:
            for scan in scans:
                if stop.is_set():
                    return
                read.put(scan)
            read.put(None)
        except BaseException as error:
            read.put(error)

    threading.Thread(target=work, daemon=True).start()
    try:
        while (found := read.get()) is not None:
            if isinstance(found, BaseException):
                raise found
            yield found
    finally:
        stop.set()
        while not read.empty():
            read.get_nowait()


def replay_in_real_time(
    scans: Iterable[Scan],
    odometry: OdometryInstance,
    health: HealthCheck,
    settings: RealTimeConfig,
    selector: SelectorProcess | None = None,
    watch: Watch = lambda _: None,
    what: str = "the replay",
    core_ms: float = np.nan,
) -> Replay:
    """Replay a recording at the sensor's rate.

    While the odometry prepares a scan, the selector's process describes it.

    Parameters
    ----------
    scans, odometry, health, what
        See `online.replay.replay`.
    settings
        Rate, deadline and queue.
    selector
        Chooses the parameters; without one they stay. What is late is dropped.
    watch
        Called after every scan.
    core_ms
        Milliseconds that a scan keeps the busiest core at work, if they are known.

    Raises
    ------
    AdaptuneError
        If there are no scans.
    """
    source = _read_ahead(scans)
    first = list(islice(source, _AHEAD // 2))
    if said := outlook([scan.stamp for scan in first], settings, core_ms):
        _log.info("%s: %s", what, said)
    steps, choices, meter = list[RegisteredScan](), list[Choice](), Meter()
    drive = RealTimeDrive(odometry, health, settings, selector, choices.append, what)
    for arrival in arrivals(chain(first, source), settings.rate, settings.queue):
        meter.begin()
        steps.append(drive.step(arrival))
        meter.end()
        done, newest = len(steps) + drive.record.dropped, choices[-1] if choices else None
        watch(Progressed(done, steps[-1], newest, drive.record))
    usage = odometry.usage
    if selector is not None:
        usage = usage._replace(elsewhere=usage.elsewhere + selector.cpu)
    return recorded(steps, choices, meter, usage, drive.finished())


class RealTimeDrive:
    """Takes scans as they come, and applies what is selected in time.

    A scan is described while it is prepared.

    Parameters
    ----------
    odometry, health, settings, selector, what
        See `replay_in_real_time`.
    note
        Called with every choice, also with those that are not applied.

    Attributes
    ----------
    record : RealTimeRecord
        How it keeps up.
    """

    def __init__(
        self,
        odometry: OdometryInstance,
        health: HealthCheck,
        settings: RealTimeConfig,
        selector: SelectorProcess | None,
        note: Callable[[Choice], None],
        what: str,
    ):
        self.record = RealTimeRecord(settings.rate)
        self._odometry, self._selector = odometry, selector
        self._deadline, self._note = settings.deadline, note
        self._schedule = Schedule(1.0 if selector is None else selector.period * 1e9)
        fixed = None if selector is None else selector.fixed
        self._driver = Driver(odometry, health, fixed, what, note)

    def step(self, arrival: Arrival) -> RegisteredScan:
        """Select if that is due, and find the pose of a scan."""
        scan, due, dropped = arrival
        self.record.dropped += dropped
        begin = time.perf_counter()
        prepared = self._prepare(scan, due)
        seconds = time.perf_counter() - begin
        found = self._driver.register_prepared(scan, prepared, seconds)
        self.record.late.append(time.perf_counter() - due)
        return found

    def finished(self) -> RealTimeRecord:
        """The record, with what selector and bank have counted."""
        if self._selector is not None:
            self.record.unseen = self._selector.unseen
        if isinstance(self._odometry, Bank):
            late, trials = self._odometry.late, self._odometry.trials
            pairs = zip(trials, late.scans.tolist(), strict=True)
            self.record.late_members = {trial: scans for trial, scans in pairs if scans}
            self.record.removed = tuple(np.array(trials)[late.removed].tolist())
        return self.record

    def _prepare(self, scan: Scan, due: float) -> Any:
        """Prepare a scan with the parameters that it is registered with.

        The odometry waits for a selection until half the time to the deadline is over, and takes
        one that comes while it prepares the scan.
        """
        odometry, selector = self._odometry, self._selector
        if selector is None:
            return odometry.prepare(scan)
        wanted = self._schedule.due(scan.stamp)
        wait = self._left(due) if wanted else 0.0
        shown = selector.show(scan.stamp, scan, odometry.motions, wait)
        if not wanted:
            return odometry.prepare(scan)
        begin = time.perf_counter()
        answer = selector.answer_to(scan.stamp, 0.5 * self._left(due)) if shown else None
        self.record.waited.append(time.perf_counter() - begin)
        if answer is not None:
            self._take(answer, scan.stamp, due)
            return odometry.prepare(scan)
        prepared, preparation = odometry.prepare(scan), odometry.preparation
        if shown and self._left(due):
            answer = selector.answer_to(scan.stamp, 0.0)
        self._take(answer, scan.stamp, due)
        return prepared if odometry.preparation == preparation else odometry.prepare(scan)

    def _take(self, answer: Answer | None, stamp: int, due: float) -> None:
        """Apply what was selected, if it is there."""
        assert self._selector is not None
        for old in self._selector.too_late():
            self._note(Choice(old.stamp, old.selection, old.seconds, "too late"))
        if answer is None or answer.selection is None:
            self.record.missed += 1
            return
        self._driver.take(stamp, answer.selection, time.perf_counter() - due)

    def _left(self, due: float) -> float:
        """Seconds to the deadline."""
        return max(self._deadline - (time.perf_counter() - due), 0.0)
