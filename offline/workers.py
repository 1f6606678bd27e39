"""Processes that run trials, each keeping the sequences it has prepared."""

import contextlib
import multiprocessing as mp
import os
import signal
import traceback
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from typing import NamedTuple, Self

from adaptune.archive import Archive
from adaptune.cores import pin
from adaptune.errors import AdaptuneError
from adaptune.space import ParameterSet
from adaptune.study import Study
from offline.trial import PreparedSequence, run_trials


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
    """

    sequence: str
    numbers: tuple[int, ...]
    sets: tuple[ParameterSet, ...]
    whole: bool = False


class _Worker(NamedTuple):
    process: ForkServerProcess
    connection: Connection


class Workers:
    """A pool whose processes are given tasks on sequences they have already prepared.

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
        self._workers: list[_Worker] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.process.terminate()
            worker.connection.close()
        for worker in self._workers:
            worker.process.join()

    def run(self, tasks: Sequence[Task]) -> Iterator[Task]:
        """Run tasks, and yield each when its results are in the archive.

        Raises
        ------
        AdaptuneError
            What a task raised.
        WorkerError
            If a worker died twice at the same task.
        """
        waiting = list(tasks)
        idle = list(range(self.n))
        running: dict[int, Task] = {}
        deaths: dict[int, int] = {}
        near: list[set[str]] = [set() for _ in idle]
        while waiting or running:
            while idle and waiting:
                w = idle.pop(0)
                task = self._pick(waiting, near, w)
                waiting.remove(task)
                near[w].add(task.sequence)
                running[w] = task
                with contextlib.suppress(BrokenPipeError):  # reading from it will tell
                    self._connection(w).send(task)
            ready = wait([self._workers[w].connection for w in running])
            for w in [w for w in running if self._workers[w].connection in ready]:
                task = running.pop(w)
                idle.append(w)
                try:
                    failure = self._workers[w].connection.recv()
                except (EOFError, OSError):
                    code = self._bury(w)
                    near[w] = set()
                    deaths[id(task)] = deaths.get(id(task), 0) + 1
                    if deaths[id(task)] > 1:
                        raise WorkerError(
                            f"a worker died twice (exit code {code}) on {task.sequence}, trials "
                            f"{', '.join(map(str, task.numbers))}; if it was out of memory, lower "
                            f"offline.memory or offline.workers"
                        ) from None
                    waiting.insert(0, task)
                    continue
                if failure is not None:
                    raise failure
                yield task

    def _pick(self, waiting: list[Task], near: list[set[str]], w: int) -> Task:
        """A task on a sequence that is ready here, else on one that is ready nowhere."""
        elsewhere = set().union(*near) - near[w]
        return min(waiting, key=lambda t: (t.sequence not in near[w], t.sequence in elsewhere))

    def _connection(self, w: int) -> Connection:
        while len(self._workers) <= w:
            self._workers.append(self._spawn(len(self._workers)))
        if not self._workers[w].process.is_alive():
            self._workers[w] = self._spawn(w)
        return self._workers[w].connection

    def _spawn(self, w: int) -> _Worker:
        here, there = self._context.Pipe()
        memory = self.study.config.offline.memory * 1e9 / self.n
        process = self._context.Process(
            target=_serve, args=(there, self.study, os.getpid() + w, memory), daemon=True
        )
        process.start()
        there.close()
        return _Worker(process, here)

    def _bury(self, w: int) -> int | None:
        worker = self._workers[w]
        worker.connection.close()
        worker.process.join()
        return worker.process.exitcode


def _serve(connection: Connection, study: Study, core: int, memory: float) -> None:
    # Ctrl-C reaches the whole group; the driver decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pin(core)
    archive = Archive(study.folder / "trials")
    ready: dict[str, PreparedSequence] = {}
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            task: Task = connection.recv()
            failure: AdaptuneError | None = None
            try:
                _do(task, study, archive, ready, memory)
            except AdaptuneError as error:
                failure = error
            except Exception:
                failure = WorkerError(
                    f"{task.sequence}, trials {', '.join(map(str, task.numbers))}:\n"
                    f"{traceback.format_exc()}"
                )
            connection.send(failure)


def _do(
    task: Task, study: Study, archive: Archive, ready: dict[str, PreparedSequence], memory: float
) -> None:
    sequence = ready.pop(task.sequence, None)
    if sequence is None:
        # Make room for the newcomer by letting go of those not used for longest.
        while ready and sum(s.nbytes for s in ready.values()) > memory / 2:
            del ready[next(iter(ready))]
        free = memory - sum(s.nbytes for s in ready.values())
        sequence = PreparedSequence(study, task.sequence, free)
        archive.write_frames(task.sequence, sequence.frames)
    ready[task.sequence] = sequence
    trials = run_trials(study, sequence, task.sets, task.whole)
    for number, trial in zip(task.numbers, trials, strict=True):
        archive.write(task.sequence, number, trial, task.whole)
