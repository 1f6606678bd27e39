"""Processes that run trials, and keep the sequences that they have prepared."""

import contextlib
import multiprocessing as mp
import os
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from typing import Generic, Literal, NamedTuple, Protocol, Self, TypeVar

from adaptune.archive import Frames, Trial
from adaptune.errors import AdaptuneError, in_a_line
from adaptune.processes import apart, how_it_ended, pin
from adaptune.space import ParameterSet
from offline.trial import PreparedSequence, TrialSetup

MOST_DEATHS = 3
"""A task fails after so many workers have died at it."""
REPORT_EVERY = 0.5
"""Seconds after which a worker reports how far its task is."""


class WorkerError(AdaptuneError):
    """A worker that cannot do its task."""


class Task(NamedTuple):
    """Trials to run on one pass over a sequence."""

    sequence: str
    numbers: tuple[int, ...]  # trial numbers
    sets: tuple[ParameterSet, ...]  # the parameter sets of the trials
    whole: bool = False  # run them from end to end, without restarts at the reference
    frames: bool = False  # return the frames, which all trials on the sequence share, too
    apart: bool = False  # run classes of the user in processes of their own, also clean ones

    @property
    def key(self) -> tuple[str, tuple[int, ...]]:
        """What identifies it among the tasks of a run, also when it is run again."""
        return self.sequence, self.numbers

    def __str__(self) -> str:
        trials = f"trials {', '.join(map(str, self.numbers))}" if self.numbers else "its scans"
        return f"{self.sequence}, {trials}"


class TaskResult(NamedTuple):
    """The result of a task; the frames are there if the task asks for them."""

    trials: list[Trial]
    frames: Frames | None


class Death(NamedTuple):
    """The death of a worker at its task."""

    cause: str
    killed: bool = True  # from outside, as systems do where the memory is full


Work = Literal["reading", "running", "registering hops of"]


class TaskProgress(NamedTuple):
    """How far a task is that goes on."""

    stage: Work
    done: int  # scans
    total: int


Outcome = TaskResult | AdaptuneError | Death

Report = Callable[[TaskProgress], None]
"""Called now and then by a task."""

W = TypeVar("W", bound=Hashable)
"""Identifies a worker of a pool."""


class Pool(Protocol[W]):
    """Workers that do one task at a time, here or elsewhere."""

    def workers(self) -> Collection[W]:
        """The workers, also those that start with their first task."""
        ...

    def start(self, worker: W, task: Task) -> None:
        """Give an idle worker a task."""
        ...

    def wait(self) -> Sequence[tuple[W, Outcome | TaskProgress]]:
        """Wait for some of the tasks, and return their outcomes; there may be none.

        A task without an outcome may return how far it is.
        """
        ...


def run(
    pool: Pool[W],
    tasks: Sequence[Task],
    report: Callable[[Task, TaskProgress], None] = lambda *_: None,
) -> Iterator[tuple[Task, TaskResult, int]]:
    """Run tasks, and yield each as it is done, with its result and the number of workers at work.

    A task goes to a worker that has prepared its sequence, if there is one. If a worker dies,
    another one runs its task again. `report` is called about tasks that go on.

    Raises
    ------
    AdaptuneError
        What a task raised.
    WorkerError
        If several workers died at the same task.
    """
    queue = _Queue(pool, tasks, report)
    while queue.open:
        queue.start()
        finished, queue.finished = queue.finished, []
        # The workers work while their results are written.
        n_running = len(queue.running)
        for task, result in finished:
            yield task, result, n_running
        if queue.failure is not None:
            raise queue.failure
        queue.wait()


class _Queue(Generic[W]):
    """Tasks that wait, run, and are finished."""

    def __init__(
        self, pool: Pool[W], tasks: Sequence[Task], report: Callable[[Task, TaskProgress], None]
    ):
        self.waiting = list(tasks)
        self.running: dict[W, Task] = {}
        self.finished: list[tuple[Task, TaskResult]] = []
        self.failure: AdaptuneError | None = None
        self._pool, self._report = pool, report
        self._deaths = Counter[tuple[str, tuple[int, ...]]]()
        self._near: dict[W, set[str]] = {}

    @property
    def open(self) -> bool:
        # A failure is raised even if nothing runs any more.
        return bool(self.waiting or self.running or self.finished or self.failure)

    def start(self) -> None:
        """Give waiting tasks to idle workers."""
        for worker in self._pool.workers() if self.waiting and self.failure is None else ():
            if self.waiting and worker not in self.running:
                task = _pick(self.waiting, self._near, worker)
                self.waiting.remove(task)
                self._near.setdefault(worker, set()).add(task.sequence)
                self.running[worker] = task
                self._pool.start(worker, task)

    def wait(self) -> None:
        """Wait for some of the tasks."""
        for worker, outcome in self._pool.wait() if self.waiting or self.running else ():
            if isinstance(outcome, TaskProgress):
                self._report(self.running[worker], outcome)
                continue
            task = self.running.pop(worker)
            if isinstance(outcome, TaskResult):
                self.finished.append((task, outcome))
            elif isinstance(outcome, AdaptuneError):
                self.failure = outcome
            else:
                self._near.pop(worker, None)
                self._again(task, outcome)

    def _again(self, task: Task, death: Death) -> None:
        # A class that is not as clean as it says then costs its own trial only.
        task = task._replace(apart=True)
        self.waiting.insert(0, task)
        self._deaths[task.key] += 1
        if self._deaths[task.key] == MOST_DEATHS:
            help_ = "what they wrote above may say why"
            if death.killed:
                help_ = "if they were out of memory, lower offline.workers"
            self.failure = WorkerError(
                f"{MOST_DEATHS} workers died ({death.cause}) on {task}; {help_}"
            )


def _pick(waiting: list[Task], near: dict[W, set[str]], worker: W) -> Task:
    """Prefer a task whose sequence this worker has prepared, then one that nobody has."""
    here = near.get(worker, set())
    elsewhere = set().union(*near.values()) - here
    return min(waiting, key=lambda t: (t.sequence not in here, t.sequence in elsewhere))


class Sequences:
    """The sequences that a worker has prepared, as many as its memory holds."""

    def __init__(self, setup: TrialSetup, memory: float):
        self._setup = setup
        self._apart = replace(setup, odometry=setup.odometry.allowing(user_code=False))
        self._memory = memory
        self._ready: dict[tuple[str, bool], PreparedSequence] = {}

    def run(self, task: Task, report: Report) -> TaskResult:
        """Do a task."""
        setup = self._apart if task.apart else self._setup
        sequence = self._prepared(setup, task, report)
        advance = partial(_report, report, "running")
        trials = setup.run(sequence, task.sets, task.whole, advance)
        frames = None
        if task.frames:
            frames = sequence.measured_frames(partial(_report, report, "registering hops of"))
        return TaskResult(trials, frames)

    def _prepared(self, setup: TrialSetup, task: Task, report: Report) -> PreparedSequence:
        key = task.sequence, setup is self._setup
        sequence = self._ready.pop(key, None)
        if sequence is None:
            # Make room: drop the sequences that were not used for longest.
            while self._ready and sum(s.nbytes for s in self._ready.values()) > self._memory / 2:
                del self._ready[next(iter(self._ready))]
            free = self._memory - sum(s.nbytes for s in self._ready.values())
            advance = partial(_report, report, "reading")
            with apart():
                sequence = setup.prepare(task.sequence, free, advance)
        self._ready[key] = sequence
        return sequence


def _report(report: Report, stage: Work, done: int, total: int) -> None:
    report(TaskProgress(stage, done, total))


def attempt(
    sequences: Sequences, task: Task, report: Report = lambda _: None
) -> TaskResult | AdaptuneError:
    """Do a task; return an exception instead of raising it."""
    try:
        return sequences.run(task, report)
    except AdaptuneError as error:
        return error
    except Exception:
        return WorkerError(f"{task}:\n{traceback.format_exc()}")


class _Worker(NamedTuple):
    process: ForkServerProcess
    connection: Connection


class Workers:
    """Processes on this machine, which share `memory` bytes for prepared scans.

    Use it as a context: leaving it ends the processes.
    """

    def __init__(self, setup: TrialSetup, n: int, memory: float):
        self.setup = setup
        self.n = n
        self.memory = memory
        # A process forked from one with threads may deadlock. A small server that has imported
        # what workers need forks them in milliseconds.
        self._context = mp.get_context("forkserver")
        self._context.set_forkserver_preload(["offline.trial", "adaptune.model.descriptor"])
        self._workers: dict[int, _Worker] = {}
        self._busy: set[int] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers.values():
            worker.process.terminate()
            worker.connection.close()
        for worker in self._workers.values():
            worker.process.join()

    def workers(self) -> Collection[int]:
        """See `Pool`."""
        return range(self.n)

    def start(self, worker: int, task: Task) -> None:
        """See `Pool`."""
        if worker not in self._workers or not self._workers[worker].process.is_alive():
            self._workers[worker] = self._spawn(worker)
        self._busy.add(worker)
        with contextlib.suppress(BrokenPipeError):  # `wait` notices it
            self._workers[worker].connection.send(task)

    def wait(self) -> list[tuple[int, Outcome | TaskProgress]]:
        """See `Pool`."""
        ready = wait([self._workers[w].connection for w in self._busy])
        outcomes: list[tuple[int, Outcome | TaskProgress]] = []
        for w in [w for w in self._busy if self._workers[w].connection in ready]:
            process, connection = self._workers[w]
            try:
                outcomes.append((w, connection.recv()))
            except (EOFError, OSError):
                connection.close()
                process.join()
                code = process.exitcode or 0
                outcomes.append((w, Death(how_it_ended(code), code == -signal.SIGKILL)))
            if not isinstance(outcomes[-1][1], TaskProgress):
                self._busy.remove(w)
        return outcomes

    def _spawn(self, w: int) -> _Worker:
        here, there = self._context.Pipe()
        given = (there, os.getpid() + w, self.memory / self.n)
        process = self._context.Process(target=_serve, args=given, daemon=True)
        process.start()
        there.close()
        with contextlib.suppress(BrokenPipeError):  # `wait` notices it
            here.send(self.setup)
        return _Worker(process, here)


def _serve(connection: Connection, core: int, memory: float) -> None:
    # Ctrl-C reaches all processes; the driver decides what happens.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.setsid()  # user code may end its process group
    pin(core)
    try:
        sequences = Sequences(connection.recv(), memory)
    except Exception as error:
        connection.send(WorkerError(f"a worker cannot import what it needs: {in_a_line(error)}"))
        return
    report = now_and_then(connection.send)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            connection.send(attempt(sequences, connection.recv(), report))


def now_and_then(report: Report) -> Report:
    """Report once in `REPORT_EVERY` seconds, and when all scans are done."""
    last = time.monotonic()

    def some(progress: TaskProgress) -> None:
        nonlocal last
        now = time.monotonic()
        if progress.done == progress.total or now - last > REPORT_EVERY:
            last = now
            report(progress)

    return some
