"""Processes that run trials, each keeping the sequences it has prepared."""

import contextlib
import multiprocessing as mp
import os
import signal
import traceback
from collections.abc import Collection, Hashable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from typing import NamedTuple, Protocol, Self, TypeVar

from adaptune.archive import Frames, Trial
from adaptune.cores import pin
from adaptune.errors import AdaptuneError
from adaptune.space import ParameterSet
from adaptune.study import Study
from offline.trial import PreparedSequence, run_trials

MOST_DEATHS = 3
"""Of workers at the same task."""


class WorkerError(AdaptuneError):
    """A worker that could not do its task."""


class Task(NamedTuple):
    """Trials to run on one pass over a sequence.

    Attributes
    ----------
    sequence : str
    numbers : tuple of int
        Of the trials.
    sets : tuple of dict
        Their parameter sets.
    whole : bool
        Run them without new starts at the reference.
    frames : bool
        Tell what all trials on the sequence share, too.
    """

    sequence: str
    numbers: tuple[int, ...]
    sets: tuple[ParameterSet, ...]
    whole: bool = False
    frames: bool = False

    def __str__(self) -> str:
        return f"{self.sequence}, trials {', '.join(map(str, self.numbers))}"


class Result(NamedTuple):
    """What came of a task.

    Attributes
    ----------
    trials : list of Trial
    frames : Frames, optional
        If they were asked for.
    """

    trials: list[Trial]
    frames: Frames | None


class Death(NamedTuple):
    """Of a worker at its task, with what is known of it."""

    cause: str


Outcome = Result | AdaptuneError | Death


W = TypeVar("W", bound=Hashable)
"""What tells the workers of a pool apart."""


class Pool(Protocol[W]):
    """Workers that do one task at a time, wherever they are."""

    def workers(self) -> Collection[W]:
        """Those that are there, or come when they are given a task."""
        ...

    def start(self, worker: W, task: Task) -> None:
        """Give an idle worker a task."""
        ...

    def wait(self) -> list[tuple[W, Outcome]]:
        """Wait for some of the tasks, and tell what came of them; at times of none."""
        ...


def run(pool: Pool[W], tasks: Sequence[Task]) -> Iterator[tuple[Task, Result, int]]:
    """Run tasks, and yield each as it comes, with its result and the number of trials running.

    Tasks go to workers that have their sequence prepared, where there are such. What a worker
    died at is run again by another.

    Raises
    ------
    AdaptuneError
        What a task raised.
    WorkerError
        If several workers died at the same task.
    """
    waiting = list(tasks)
    running: dict[W, Task] = {}
    finished: list[tuple[Task, Result]] = []
    failure: AdaptuneError | None = None
    deaths: dict[int, int] = {}
    near: dict[W, set[str]] = {}
    # What the last task raises is still to be told when nothing runs.
    while waiting or running or finished or failure is not None:
        for worker in pool.workers() if waiting and failure is None else ():
            if waiting and worker not in running:
                task = _pick(waiting, near, worker)
                waiting.remove(task)
                near.setdefault(worker, set()).add(task.sequence)
                running[worker] = task
                pool.start(worker, task)
        # The workers are at work again while what they gave is written.
        n_running = sum(len(task.numbers) for task in running.values())
        for task, result in finished:
            yield task, result, n_running
        finished = []
        if failure is not None:
            raise failure
        for worker, outcome in pool.wait() if waiting or running else ():
            task = running.pop(worker)
            if isinstance(outcome, Result):
                finished.append((task, outcome))
            elif isinstance(outcome, AdaptuneError):
                failure = outcome
            else:
                near.pop(worker, None)
                waiting.insert(0, task)
                deaths[id(task)] = deaths.get(id(task), 0) + 1
                if deaths[id(task)] == MOST_DEATHS:
                    failure = WorkerError(
                        f"{MOST_DEATHS} workers died ({outcome.cause}) on {task}; if they were "
                        f"out of memory, lower offline.memory or offline.workers"
                    )


def _pick(waiting: list[Task], near: dict[W, set[str]], worker: W) -> Task:
    """A task on a sequence that is ready here, else on one that is ready nowhere."""
    here = near.get(worker, set())
    elsewhere = set().union(*near.values()) - here
    return min(waiting, key=lambda t: (t.sequence not in here, t.sequence in elsewhere))


class Sequences:
    """The sequences that a worker has prepared, as many as its memory holds.

    Parameters
    ----------
    study
        The study.
    memory
        Bytes that prepared scans may take.
    """

    def __init__(self, study: Study, memory: float):
        self._study = study
        self._memory = memory
        self._ready: dict[str, PreparedSequence] = {}

    def run(self, task: Task) -> Result:
        """Do a task."""
        sequence = self._prepared(task.sequence)
        trials = run_trials(self._study, sequence, task.sets, task.whole)
        return Result(trials, sequence.frames if task.frames else None)

    def _prepared(self, name: str) -> PreparedSequence:
        sequence = self._ready.pop(name, None)
        if sequence is None:
            # Make room for the newcomer by letting go of those not used for longest.
            while self._ready and sum(s.nbytes for s in self._ready.values()) > self._memory / 2:
                del self._ready[next(iter(self._ready))]
            free = self._memory - sum(s.nbytes for s in self._ready.values())
            sequence = PreparedSequence(self._study, name, free)
        self._ready[name] = sequence
        return sequence


def attempt(sequences: Sequences, task: Task) -> Result | AdaptuneError:
    """Do a task, and return what it raises."""
    try:
        return sequences.run(task)
    except AdaptuneError as error:
        return error
    except Exception:
        return WorkerError(f"{task}:\n{traceback.format_exc()}")


class _Worker(NamedTuple):
    process: ForkServerProcess
    connection: Connection


class Workers:
    """Processes on this machine.

    Use it as a context: leaving it ends the processes.

    Parameters
    ----------
    study
        The study; each process gets its share of its memory.
    n
        Number of processes.
    """

    def __init__(self, study: Study, n: int):
        self.study = study
        self.n = n
        # A process forked from one with threads may deadlock; one forked from a small server that
        # has imported what workers need starts in milliseconds.
        self._context = mp.get_context("forkserver")
        self._context.set_forkserver_preload(["offline.trial"])
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
        with contextlib.suppress(BrokenPipeError):  # reading from it will tell
            self._workers[worker].connection.send(task)

    def wait(self) -> list[tuple[int, Outcome]]:
        """See `Pool`."""
        ready = wait([self._workers[w].connection for w in self._busy])
        outcomes: list[tuple[int, Outcome]] = []
        for w in [w for w in self._busy if self._workers[w].connection in ready]:
            self._busy.remove(w)
            process, connection = self._workers[w]
            try:
                outcomes.append((w, connection.recv()))
            except (EOFError, OSError):
                connection.close()
                process.join()
                outcomes.append((w, Death(f"exit code {process.exitcode}")))
        return outcomes

    def _spawn(self, w: int) -> _Worker:
        here, there = self._context.Pipe()
        memory = self.study.config.offline.memory * 1e9 / self.n
        process = self._context.Process(
            target=_serve, args=(there, self.study, os.getpid() + w, memory), daemon=True
        )
        process.start()
        there.close()
        return _Worker(process, here)


def _serve(connection: Connection, study: Study, core: int, memory: float) -> None:
    # Ctrl-C reaches the whole group; the driver decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pin(core)
    sequences = Sequences(study, memory)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            connection.send(attempt(sequences, connection.recv()))
