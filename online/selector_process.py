"""A selector in a process of its own: it describes a scan while the odometry works on it."""

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from queue import Queue
from typing import Any, NamedTuple

from adaptune._system.forking import fork_server
from adaptune._system.machine import shared_cores
from adaptune.errors import AdaptuneError
from adaptune.odometry.base import Motions
from adaptune.recording.scan import Scan
from adaptune.selector import BACK, AnySelector, TimedSelector
from adaptune.space import Selection

_log = logging.getLogger(__name__)

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
    """Runs the `TimedSelector` of what `make` makes in another process.

    Nothing waits longer than it is told to: a thread sends the scans. If the process is behind by
    `SLOTS` scans, it does not get the next one, but all of its motion later.

    Raises
    ------
    AdaptuneError
        If the process cannot start.
    """

    def __init__(self, make: Make, period: float):
        self.period = period  # seconds between selections
        self.unseen = 0  # scans that the process did not get
        self.cpu = 0.0  # seconds of CPU time for those that it got
        self.alive = True  # when it was last used
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
        self.fallback = started  # what the selector falls back to

    def show(self, stamp: int, scan: Scan, motions: Motions, seconds: float = 0.0) -> bool:
        """Show a scan, see `TimedSelector.update`; whether the process gets it.

        It waits at most so many seconds for the process to take another scan.
        """
        # Where the clock goes back, another drive begins, see `TimedSelector`.
        before = None if self._stamp - stamp > BACK else self._moved
        self._stamp = stamp
        moved = motions if before is None else _joined(before, motions)
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
        while answers := self._take_answers(max(end - time.perf_counter(), 0.0)):
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


def _joined(first: Motions, second: Motions) -> Motions:
    members = {trial: first.members[trial] @ T for trial, T in second.members.items()}
    T_previous_current = first.T_previous_current @ second.T_previous_current
    return Motions(T_previous_current, members, second.starts)


def _run(connection: Connection, make: Make, period: float, cores: list[int]) -> None:
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
