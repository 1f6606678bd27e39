"""Replay a recording as fast as it was recorded, with what the robot would not wait for."""

import contextlib
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import chain, islice
from multiprocessing.connection import Connection
from queue import Queue
from typing import Any, NamedTuple

from adaptune.bank.bank import CLOCK, Bank, Clock
from adaptune.errors import AdaptuneError
from adaptune.forking import fork_server
from adaptune.machine import shared_cores
from adaptune.odometry.base import Motions, OdometryInstance
from adaptune.odometry.tracker import HealthCheck, RegisteredScan
from adaptune.recording.scan import Imu, Scan, joined
from adaptune.selector import BACK, AnySelector, Schedule, TimedSelector
from adaptune.space import Selection
from adaptune.study.config import RealTimeConfig
from online.replay import Driver, ReplayRecord, Watch

# A selector in a process of its own: it describes a scan while the odometry works on it.


SLOTS = 4
"""Scans on their way."""
_START = 60.0
"""Seconds in which the process must be ready."""
_NICE = 10
"""By how much the priority of live evidence is lower."""

Make = Callable[[], AnySelector]
"""Makes the selector; it pickles."""


class Answer(NamedTuple):
    """What became of a scan."""

    stamp: int  # nanoseconds
    selection: Selection | None  # None where none was due
    cpu: float  # seconds that the process has used


class SelectorProcess:
    """Runs a `TimedSelector` in another process.

    Nothing waits longer than it is told to: a thread sends the scans. If the process is behind by
    `SLOTS` scans, it does not get the next one, but all of its motion later.

    Parameters
    ----------
    make
        Makes the selector in that process.
    period
        Seconds between selections.

    Attributes
    ----------
    unseen : int
        Scans that the process did not get.
    cpu : float
        Seconds of CPU time for the scans that it got.
    alive : bool
        Whether the process was there when it was last used.
    fixed : Selection
        What the selector falls back to.

    Raises
    ------
    AdaptuneError
        If the process cannot start.
    """

    def __init__(self, make: Make, period: float):
        self.period, self.unseen, self.cpu, self.alive = period, 0, 0.0, True
        self._owed = 0  # answers
        self._moved: Motions | None = None  # over the scans that were not shown
        self._stamp = 0  # of the last scan, shown or not
        context = fork_server(__name__)
        self._here, there = context.Pipe()
        given = there, make, period, sorted(shared_cores())
        self._process = context.Process(target=_run, args=given, daemon=True)
        self._process.start()
        there.close()
        self._to_send: Queue[Any] = Queue()
        self._sender = threading.Thread(target=self._send, daemon=True)
        self._sender.start()
        started: Selection | str = "it did not start in time"
        if self._here.poll(_START):
            with contextlib.suppress(EOFError, OSError):
                started = self._here.recv()
        if isinstance(started, str):
            self.close()
            raise AdaptuneError(f"the selector's process: {started}")
        self.fixed = started

    def show(self, stamp: int, scan: Scan, motions: Motions, seconds: float = 0.0) -> bool:
        """Show a scan, see `TimedSelector.update`; whether the process gets it.

        It waits at most so many seconds for the process to take another scan.
        """
        # Where the clock goes back, another drive begins, see `TimedSelector`.
        before = None if self._stamp - stamp > BACK else self._moved
        self._stamp = stamp
        moved = motions if before is None else _one_after_the_other(before, motions)
        self._take_answers()
        if self._owed == SLOTS:
            self._take_answers(seconds)
        if self._owed == SLOTS:
            self.unseen += 1
            self._moved = moved
            return False
        self._owed += 1
        self._moved = None
        self._to_send.put((stamp, scan, moved))
        return True

    def _send(self) -> None:
        with contextlib.suppress(OSError):  # who waits for the answers notices it
            while (shown := self._to_send.get()) is not None:
                self._here.send(shown)

    def answer_to(self, stamp: int, seconds: float) -> Answer | None:
        """Wait for what becomes of the scan of this stamp, at most so long.

        Answers to earlier scans are dropped.
        """
        end = time.perf_counter() + seconds
        while self.alive:
            answers = self._take_answers(max(end - time.perf_counter(), 0.0))
            if not answers:
                break
            if answers[-1].stamp == stamp:
                return answers[-1]
        return None

    def _take_answers(self, seconds: float = 0.0) -> list[Answer]:
        """The answers that are there, or the first that come in so many seconds."""
        found: list[Answer] = []
        try:
            while self.alive and self._here.poll(0.0 if found else seconds):
                answer = self._here.recv()
                self._owed -= 1
                self.cpu = answer.cpu
                found.append(answer)
        except (EOFError, OSError):
            self.alive = False
            _log.warning("the selector's process has ended; the last set stays")
        return found

    def close(self) -> None:
        """End the process."""
        self._to_send.put(None)
        self._sender.join(2.0)
        if self._sender.is_alive():
            self._process.kill()  # it takes no scan
            self._sender.join()
        self._here.close()
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _one_after_the_other(first: Motions, second: Motions) -> Motions:
    """The motion over two scans."""
    members = {trial: first.members[trial] @ T for trial, T in second.members.items()}
    T_previous_current = first.T_previous_current @ second.T_previous_current
    return Motions(T_previous_current, members, second.starts)


def _run(connection: Connection, make: Make, period: float, cores: list[int]) -> None:
    """Be the other process."""
    os.sched_setaffinity(0, cores)
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        try:
            selector = make()
        except AdaptuneError as error:
            connection.send(str(error))
            return
        timed = TimedSelector(selector, period)
        connection.send(selector.fall_back())
        before = time.process_time()
        with ThreadPoolExecutor(1, initializer=_lower_priority) as gentle:
            while True:
                stamp, scan, motions = connection.recv()
                selection = timed.update(stamp, scan, motions)
                connection.send(Answer(stamp, selection, time.process_time() - before))
                # Only a thread can have a lower priority for a while.
                gentle.submit(timed.measure).result()


def _lower_priority() -> None:
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)


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


def _read_ahead(scans: Iterable[Scan]) -> Iterator[Scan]:
    """Read in a thread; an error is raised here."""
    source, pool = iter(scans), ThreadPoolExecutor(1)
    try:
        read = deque(pool.submit(next, source, None) for _ in range(_AHEAD))
        while (scan := read.popleft().result()) is not None:
            read.append(pool.submit(next, source, None))
            yield scan
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def replay_in_real_time(
    scans: Iterable[Scan],
    odometry: OdometryInstance,
    health: HealthCheck,
    settings: RealTimeConfig,
    selector: SelectorProcess | None = None,
    watch: Watch = lambda _: None,
    what: str = "the replay",
    clock: Clock = CLOCK,
) -> ReplayRecord:
    """Replay a recording at the sensor's rate.

    While the odometry prepares a scan, the selector's process describes it. A selection that is
    late is dropped. The sensor goes by `clock`; for the rest see `online.replay.replay`.

    Raises
    ------
    AdaptuneError
        If there are no scans.
    """
    record = ReplayRecord(settings.rate)
    drive = RealTimeDrive(odometry, health, settings, selector, record, what, clock)
    source = _read_ahead(scans)
    first = list(islice(source, _AHEAD // 2))  # read before the first one is due
    every = chain(first, source)
    for arrival in arrivals(every, settings.rate, settings.queue, clock):
        drive.step(arrival)
        watch(record)
    drive.finish()
    return record.finish(odometry.usage, 0.0 if selector is None else selector.cpu)


class RealTimeDrive:
    """Takes scans as they come, and applies what is selected in time.

    A scan is described while it is prepared. `record` receives what becomes of each scan and each
    selection; for the rest see `replay_in_real_time`.
    """

    def __init__(
        self,
        odometry: OdometryInstance,
        health: HealthCheck,
        settings: RealTimeConfig,
        selector: SelectorProcess | None,
        record: ReplayRecord,
        what: str,
        clock: Clock = CLOCK,
    ):
        self.record, self._clock = record, clock
        self._odometry, self._selector = odometry, selector
        self._deadline = settings.deadline
        self._schedule = Schedule(1.0 if selector is None else selector.period * 1e9)
        fixed = None if selector is None else selector.fixed
        self._driver = Driver(odometry, health, fixed, what, record.note)

    def step(self, arrival: Arrival) -> RegisteredScan:
        """Select if that is due, and find the pose of a scan."""
        scan, due, dropped = arrival
        self.record.begin()
        self.record.dropped += dropped
        begin = self._clock.now()
        prepared = self._prepare(scan, due)
        step = self._driver.register(scan, prepared, self._clock.now() - begin)
        self.record.late.append(self._clock.now() - due)
        self.record.end(step)
        return step

    def finish(self) -> None:
        """Record what selector and bank have counted."""
        if self._selector is not None:
            self.record.unseen = self._selector.unseen
        if isinstance(self._odometry, Bank):
            late = self._odometry.late
            self.record.late_members = int(late.scans.sum())
            self.record.removed = int(late.removed.sum())

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
        shown = selector.show(scan.stamp, scan, self._driver.motions, wait)
        if not wanted:
            return odometry.prepare(scan)
        begin = self._clock.now()
        answer = selector.answer_to(scan.stamp, 0.5 * self._left(due)) if shown else None
        self.record.waited.append(self._clock.now() - begin)
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
        if answer is None or answer.selection is None:
            self.record.missed += 1
        else:
            self._driver.take(stamp, answer.selection, self._clock.now() - due)

    def _left(self, due: float) -> float:
        """Seconds to the deadline."""
        return max(self._deadline - (self._clock.now() - due), 0.0)
