"""A selector in a process of its own: it describes a scan while the odometry works on it."""

import contextlib
import logging
import multiprocessing
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory
from typing import Any, NamedTuple

import numpy as np

from adaptune.cores import shared_cores
from adaptune.errors import AdaptuneError
from adaptune.odometry import wire
from adaptune.odometry.base import Motions
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan
from adaptune.timed_selector import AnySelector, TimedSelector

SLOTS = 4
"""Scans on their way."""
_START = 60.0
"""Seconds in which the process must be ready."""
MOST_LATE = 100
"""Selections that came too late and are remembered."""
_NICE = 10
"""By how much the priority of live evidence is lower."""

Make = Callable[[], AnySelector | None]
"""Makes the selector; it pickles."""

_log = logging.getLogger(__name__)


class Answer(NamedTuple):
    """What became of a scan."""

    stamp: int  # nanoseconds
    selection: Selection | None  # None where none was due
    seconds: float  # from the scan's arrival in the process
    cpu: float  # seconds that the process has used


class LateSelection(NamedTuple):
    """A selection that nobody waited for."""

    stamp: int  # nanoseconds, of its scan
    selection: Selection
    seconds: float  # that it took in the process


class SelectorProcess:
    """Runs a `TimedSelector` in another process.

    Nothing waits longer than it is told to. Scans pass through memory that both processes share.
    If the process is behind by `SLOTS` scans, it does not get the next one, but all of its motion
    later.

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
        self._slots: list[SharedMemory] = []
        self._free: list[int] = []
        self._moved: Motions | None = None  # over the scans that were not shown
        self._too_late: deque[LateSelection] = deque(maxlen=MOST_LATE)
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
        self._here, there = context.Pipe()
        given = there, make, period, sorted(shared_cores())
        self._process = context.Process(target=_run, args=given, daemon=True)
        self._process.start()
        there.close()
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
        moved = motions if self._moved is None else _one_after_the_other(self._moved, motions)
        arrays = {k: a for k, a in wire.scan_arrays(scan).items() if a is not None}
        slot = self._slot(sum(_padded(array.nbytes) for array in arrays.values()), seconds)
        if slot is None:
            self.unseen += 1
            self._moved = moved
            return False
        layout, offset = [], 0
        for name, array in arrays.items():
            there = np.ndarray(array.shape, array.dtype, self._slots[slot].buf, offset)
            there[...] = array
            layout.append((name, array.dtype.str, array.shape, offset))
            offset += _padded(array.nbytes)
        self._moved = None
        with contextlib.suppress(OSError):
            self._here.send((slot, self._slots[slot].name, layout, stamp, moved))
        return True

    def _slot(self, size: int, seconds: float) -> int | None:
        """A free slot for so many bytes; None if there is none in so many seconds."""
        self._keep(self._take_answers())
        if not self._free and len(self._slots) == SLOTS:
            self._keep(self._take_answers(seconds))
            if not self._free:
                return None
        if not self._free:
            self._slots.append(SharedMemory(create=True, size=max(size, 1)))
            return len(self._slots) - 1
        slot = self._free.pop()
        if self._slots[slot].size < size:
            _remove(self._slots[slot])
            self._slots[slot] = SharedMemory(create=True, size=size)
        return slot

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
                self._keep(answers[:-1])
                return answers[-1]
            self._keep(answers)
        return None

    def too_late(self) -> "list[LateSelection]":
        """Selections that came after nobody waited for them, since this was last asked."""
        late = list(self._too_late)
        self._too_late.clear()
        return late

    def _keep(self, answers: "Sequence[Answer]") -> None:
        for stamp, selection, seconds, _ in answers:
            if selection is not None:
                self._too_late.append(LateSelection(stamp, selection, seconds))

    def _take_answers(self, seconds: float = 0.0) -> list[Answer]:
        """The answers that are there, or the first that come in so many seconds."""
        found: list[Answer] = []
        try:
            while self.alive and self._here.poll(0.0 if found else seconds):
                slot, answer = self._here.recv()
                self._free.append(slot)
                self.cpu = answer.cpu
                found.append(answer)
        except (EOFError, OSError):
            self.alive = False
            _log.warning("the selector's process has ended; the last set stays")
        return found

    def close(self) -> None:
        """End the process."""
        self._here.close()
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        for memory in self._slots:
            _remove(memory)
        self._slots, self._free = [], []


def _remove(memory: SharedMemory) -> None:
    memory.close()
    memory.unlink()


def _padded(size: int) -> int:
    """A multiple of eight bytes."""
    return -(-size // 8) * 8


def _one_after_the_other(first: Motions, second: Motions) -> Motions:
    """The motion over two scans."""
    members = {trial: first.members[trial] @ T for trial, T in second.members.items()}
    T_previous_current = first.T_previous_current @ second.T_previous_current
    return Motions(T_previous_current, members, second.starts)


def _run(connection: Connection, make: Make, period: float, cores: list[int]) -> None:
    """Be the other process."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, cores)
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        try:
            gentle = _Gentle(make())
        except AdaptuneError as error:
            connection.send(str(error))
            return
        timed = TimedSelector(gentle, period)
        connection.send(gentle.fall_back())
        before = time.process_time()
        seen: dict[int, SharedMemory] = {}
        while True:
            slot, name, layout, stamp, motions = connection.recv()
            begin = time.perf_counter()
            if slot not in seen or seen[slot].name != name:
                seen[slot] = SharedMemory(name)
            arrays = {
                key: np.ndarray(shape, kind, seen[slot].buf, offset).copy()
                for key, kind, shape, offset in layout
            }
            scan = wire.to_scan(wire.Message({"stamp": stamp}, arrays))
            selection = timed.update(stamp, scan, motions)
            seconds = time.perf_counter() - begin
            answer = Answer(stamp, selection, seconds, time.process_time() - before)
            connection.send((slot, answer))
            timed.measure()


class _Gentle:
    """A selector that measures in a thread of lower priority than what else runs."""

    def __init__(self, selector: Any):
        self._selector = selector
        self._thread = ThreadPoolExecutor(1, initializer=_lower_priority)
        self._measuring: Future[None] | None = None

    def measure(self) -> None:
        """Begin to measure."""
        self._measuring = self._thread.submit(self._selector.measure)

    def __getattr__(self, name: str) -> Any:
        # All else waits until it is measured.
        if (measuring := self._measuring) is not None:
            self._measuring = None
            measuring.result()
        return getattr(self._selector, name)


def _lower_priority() -> None:
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
