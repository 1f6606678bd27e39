"""Processes that drive, and keep the scans that they have prepared."""

import asyncio
import contextlib
import dataclasses
import logging
import os
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar
from uuid import uuid4

import numpy as np

from adaptune import __version__
from adaptune._system.forking import end_with_parent, fork_server
from adaptune._system.machine import pin, spare_memory
from adaptune._system.processes import how_it_ended
from adaptune._system.progress import Progress, unseen
from adaptune.errors import OUT_OF_MEMORY, AdaptuneError, MachineError, in_a_line, lacking
from adaptune.recording.cache import fingerprints
from adaptune.recording.scan import Recording
from adaptune.runs.archive import Frames
from adaptune.runs.record import Run
from adaptune.space import ParameterSet
from adaptune.study.sequences import StudySequences
from offline.drive import TrialSetup, drive_sets
from offline.frames import Segment, describe, with_measured_hops
from offline.shared_scans import SharedScans

MOST_DEATHS = 3
"""A task fails after so many workers have died at it."""
REPORT_EVERY = 0.5
"""Seconds after which a worker reports how far its task is."""


class WorkerError(AdaptuneError):
    """A worker that cannot do its task."""


class Task(NamedTuple):
    """Work on a sequence: describe it; or measure the hops along its frames; or drive."""

    sequence: str
    frames: Frames | None = None  # whose hops are measured
    segment: Segment | None = None  # along which sets are driven
    sets: Mapping[int, ParameterSet] = {}  # by trial number, what is driven on one pass
    most: float = np.inf  # seconds of CPU time above which a set is stopped
    bare: bool = False  # without the health check
    prepares: Hashable = None  # identifies the scans that the worker then holds prepared
    isolated: bool = False  # run classes of the user in processes of their own, also clean ones

    @property
    def key(self) -> Hashable:
        """Identifies it among the tasks of a run, also when it is run again."""
        return self.sequence, None if self.segment is None else self.segment.key, *self.sets

    def __str__(self) -> str:
        trials = f"trials {', '.join(map(str, self.sets))}" if self.sets else "its scans"
        return f"{self.sequence}, {trials}"


Result = Frames | Mapping[int, Sequence[Run]]
"""Of a task: the frames, or by trial number the drives, one for every repeat."""


class Death(NamedTuple):
    """The death of a worker at its task."""

    cause: str


class TaskProgress(NamedTuple):
    """A call of a task's `Progress`, on its way from a worker."""

    stage: str
    done: float  # scans
    total: int


Outcome = Result | AdaptuneError | Death

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


class Work(Protocol):
    """Gives out tasks; results may bring more of them."""

    def waits(self) -> bool:
        """Whether there is a task now."""
        ...

    def take(self, held: Collection[Hashable], others: Collection[Hashable], n: int) -> Task:
        """Take a task for one of `n` idle workers.

        It holds these prepared scans, the other workers hold `others`.
        """
        ...

    def note(self, task: Task, progress: TaskProgress) -> None:
        """Note how far a task is."""
        ...


def run(pool: Pool[W], work: Work) -> Iterator[tuple[Task, Result]]:
    """Run tasks, and yield each as it is done, with its result, until there are no more.

    If a worker dies, its task is run again; a WorkerError says that several died at the same one.
    An AdaptuneError that a task raised is raised here.
    """
    crew = _Crew(pool, work)
    while True:
        crew.start()
        finished, crew.finished = crew.finished, []
        yield from finished  # the workers work while their results are written
        if crew.failure is not None:
            raise crew.failure
        if not finished:
            if not crew.busy:
                return
            crew.wait()


class _Crew(Generic[W]):
    """The workers of a pool, and what each does."""

    def __init__(self, pool: Pool[W], work: Work):
        self.finished: list[tuple[Task, Result]] = []
        self.failure: AdaptuneError | None = None
        self._pool, self._work = pool, work
        self._running: dict[W, Task] = {}
        self._held: dict[W, set[Hashable]] = {}  # the scans that each has prepared
        self._again: list[Task] = []
        self._deaths = Counter[Hashable]()
        self._suspects: set[int] = set()  # trials at which a worker died

    @property
    def busy(self) -> bool:
        """Whether there is anything to do, or to wait for."""
        return bool(self._running or self._again or self._work.waits())

    def start(self) -> None:
        """Give tasks to idle workers."""
        workers = self._pool.workers() if self.failure is None else ()
        idle = [worker for worker in workers if worker not in self._running]
        for left, worker in zip(range(len(idle), 0, -1), idle, strict=True):
            if not self._again and not self._work.waits():
                return
            held = self._held.setdefault(worker, set())
            others = set().union(*(keys for w, keys in self._held.items() if w != worker))
            task = self._again.pop() if self._again else self._work.take(held, others, left)
            # A class that is not as clean as it says then costs its own trials only.
            task = task._replace(isolated=not self._suspects.isdisjoint(task.sets))
            if task.prepares is not None:
                held.add(task.prepares)
            self._running[worker] = task
            self._pool.start(worker, task._replace(prepares=None))  # which need not pickle

    def wait(self) -> None:
        """Wait for some of the tasks."""
        for worker, outcome in self._pool.wait():
            if isinstance(outcome, TaskProgress):
                self._work.note(self._running[worker], outcome)
                continue
            task = self._running.pop(worker)
            if isinstance(outcome, AdaptuneError):
                self.failure = outcome
            elif isinstance(outcome, Death):
                del self._held[worker]
                self._try_again(task, outcome.cause)
            else:
                self.finished.append((task, outcome))

    def _try_again(self, task: Task, cause: str) -> None:
        self._work.note(task, TaskProgress("running", 0, 1))
        self._again.append(task)
        self._suspects |= set(task.sets)
        self._deaths[task.key] += 1
        if self._deaths[task.key] == MOST_DEATHS:
            help_ = "; if they were out of memory, lower offline.workers" * ("KILL" in cause)
            self.failure = WorkerError(
                f"{MOST_DEATHS} workers died ({cause}) on {task}; what they wrote above may say "
                f"why{help_}"
            )


MOST_PREPARED = 1.5e9
"""Bytes of prepared scans that a worker keeps; others are prepared again on each pass."""


class Bench:
    """What a worker works with: recordings that it has opened, and scans that it has prepared."""

    def __init__(self, setup: TrialSetup, memory: float):
        self._setup = setup
        self._isolated = setup._replace(odometry=setup.odometry.changed(user_code=False))
        self._memory = min(memory, MOST_PREPARED)
        self._recordings: dict[str, Recording] = {}
        self._shared: dict[bool, SharedScans] = {}

    def run(self, task: Task, progress: Progress) -> Result:
        """Do a task."""
        setup = self._setup
        if (segment := task.segment) is None and task.frames is None:
            return describe(setup.config, setup.sequences, task.sequence, progress)
        if task.sequence not in self._recordings:
            self._recordings[task.sequence] = setup.sequences.open(task.sequence)
        scans = self._recordings[task.sequence]
        if task.frames is not None:
            return with_measured_hops(scans, task.frames, progress)
        setup = self._isolated if task.isolated else setup
        if task.isolated not in self._shared:  # other instances take scans in another way
            self._shared = {task.isolated: SharedScans(self._memory)}
        shared, sets = self._shared[task.isolated], task.sets
        assert segment is not None
        limits = task.most, task.bare
        drives = drive_sets(setup, shared, scans, segment, sets.values(), *limits, progress)
        return dict(zip(sets, drives, strict=True))


def attempt(bench: Bench, task: Task, progress: Progress = unseen) -> Result | AdaptuneError:
    """Do a task; return an exception instead of raising it."""
    try:
        return bench.run(task, progress)
    except AdaptuneError as error:
        return error
    except Exception as error:
        if said := OUT_OF_MEMORY if isinstance(error, MemoryError) else lacking(error):
            return MachineError(f"{task}: {said}")
        return WorkerError(f"{task}:\n{traceback.format_exc()}")


class Workers:
    """Processes on this machine, which share `memory` bytes, or less, for prepared scans.

    Use it as a context: leaving it ends the processes.
    """

    def __init__(self, setup: TrialSetup, n: int, memory: float):
        self.setup = setup
        self.n = n
        self.memory = memory
        self._workers: dict[int, tuple[ForkServerProcess, Connection]] = {}
        self._busy: set[int] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process, connection in self._workers.values():
            process.terminate()
            connection.close()
        for process, _connection in self._workers.values():
            process.join()

    def workers(self) -> Collection[int]:
        """See `Pool`."""
        return range(self.n)

    def start(self, worker: int, task: Task) -> None:
        """See `Pool`."""
        if worker not in self._workers or not self._workers[worker][0].is_alive():
            self._workers[worker] = self._spawn(worker)
        self._busy.add(worker)
        with contextlib.suppress(BrokenPipeError):  # `wait` notices it
            self._workers[worker][1].send(task)

    def wait(self) -> list[tuple[int, Outcome | TaskProgress]]:
        """See `Pool`."""
        ready = wait([self._workers[w][1] for w in self._busy])
        outcomes: list[tuple[int, Outcome | TaskProgress]] = []
        for w in [w for w in self._busy if self._workers[w][1] in ready]:
            process, connection = self._workers[w]
            try:
                outcomes.append((w, connection.recv()))
            except (EOFError, OSError):
                connection.close()
                process.join()
                outcomes.append((w, Death(how_it_ended(process.exitcode or 0))))
            if not isinstance(outcomes[-1][1], TaskProgress):
                self._busy.remove(w)
        return outcomes

    def _spawn(self, w: int) -> tuple[ForkServerProcess, Connection]:
        context = fork_server("offline.frames", "offline.drive", "adaptune.model.descriptor")
        here, there = context.Pipe()
        given = (there, os.getpid() + w, self.memory / self.n)
        process = context.Process(target=_serve, args=given, daemon=True)
        process.start()
        there.close()
        with contextlib.suppress(BrokenPipeError):  # `wait` notices it
            here.send(self.setup)
        return process, here


def _serve(connection: Connection, core: int, memory: float) -> None:
    end_with_parent()
    os.setsid()  # user code may end its process group
    pin(core)
    try:
        bench = Bench(connection.recv(), memory)
    except Exception as error:
        connection.send(WorkerError(f"a worker cannot import what it needs: {in_a_line(error)}"))
        return
    progress = now_and_then(connection.send)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            connection.send(attempt(bench, connection.recv(), progress))


def now_and_then(send: Callable[[TaskProgress], None]) -> Progress:
    """Send progress once in `REPORT_EVERY` seconds, and when all scans are done."""
    last = time.monotonic()

    def some(text: str, done: float, of: int, remark: str = "", /) -> None:  # noqa: ARG001
        nonlocal last
        now = time.monotonic()
        if done == of or now - last > REPORT_EVERY:
            last = now
            send(TaskProgress(text, done, of))

    return some


_TIMEOUT = 10.0
_PERIOD = 1.0

_log = logging.getLogger(__name__)


class ClusterError(AdaptuneError):
    """A cluster that cannot be used."""


class Cluster:
    """The workers of a Dask cluster, as a `Pool`.

    A worker reads the recordings, which must be under the same path there. Leaving it as a context
    cancels the tasks that are not done. A ClusterError says that it cannot be reached, has no
    workers, or workers of another version.
    """

    def __init__(self, setup: TrialSetup, names: Iterable[str], address: str):
        try:
            import distributed
        except ImportError as error:
            raise ClusterError("--cluster needs Dask: pip install 'adaptune[dask]'") from error
        self._killed = distributed.KilledWorker
        self._address = address
        # Workers run in other folders.
        sequences = dataclasses.replace(setup.sequences, folder=setup.sequences.folder.absolute())
        # Alarms need a main thread, and Dask runs tasks in others: processes end what hangs.
        odometry = setup.odometry.changed(user_code=False, program_input=sequences.program_input)
        self._setup = setup._replace(odometry=odometry, sequences=sequences)
        self._files = {name: contents(sequences, name) for name in names}
        # Distinguishes this campaign from others on the same workers.
        self._token = uuid4().hex
        self._hosts: dict[str, str] = {}  # of every worker
        self._futures: dict[str, Any] = {}
        self._done = threading.Event()
        try:
            with ThreadPoolExecutor(1) as beside:  # a notebook's own thread has a loop that runs
                kind = beside.submit(lambda: asyncio.run(_what_answers(address))).result()
            if kind != "Scheduler":
                raise ClusterError(
                    f"--cluster {address}: {kind} answers there, and no scheduler; name the "
                    f"address that `dask scheduler` says (its dashboard has another port)"
                )
            self._client = distributed.Client(address, timeout=_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise ClusterError(
                f"--cluster {address}: cannot be reached ({error}); start a scheduler there "
                f"(`dask scheduler`), or leave --cluster out"
            ) from error
        with contextlib.ExitStack() as undo:
            undo.callback(self._client.close)
            if not self.workers():
                help_ = f"start some with `dask worker {address}`"
                raise ClusterError(f"--cluster {address}: has no workers; {help_}")
            undo.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(Exception):
            self._client.cancel(list(self._futures.values()), force=True)
        self._client.close()

    def workers(self) -> Collection[str]:
        """See `Pool`."""
        hosts = self._found()
        if new := [worker for worker in hosts if worker not in self._hosts]:
            self._check(new)
        if self._hosts and not hosts:
            _log.warning("%s: no worker is left; waiting for others", self._address)
        self._hosts = hosts
        return list(hosts)

    def start(self, worker: str, task: Task) -> None:
        """See `Pool`."""
        # Workers of a host keep to different cores.
        of_host = [other for other, host in self._hosts.items() if host == self._hosts[worker]]
        future = self._client.submit(
            perform,
            self._token,
            self._setup,
            self._files[task.sequence],
            task,
            of_host.index(worker),
            1 / len(of_host),
            workers=[worker],
            allow_other_workers=False,
            pure=False,
        )
        future.add_done_callback(lambda _: self._done.set())
        self._futures[worker] = future

    def wait(self) -> list[tuple[str, Outcome]]:
        """See `Pool`."""
        # Dask does not report the death of a worker: look now and then.
        self._done.wait(_PERIOD)
        self._done.clear()
        hosts = self._found()
        outcomes = []
        for worker, future in list(self._futures.items()):
            if future.done() or worker not in hosts:
                del self._futures[worker]
                outcomes.append((worker, self._outcome(worker, future, hosts)))
        return outcomes

    def _outcome(self, worker: str, future: Any, hosts: Collection[str]) -> Outcome:
        # Dask waits for ever for a result that its worker has taken along.
        while future.status == "finished" and worker in hosts:
            with contextlib.suppress(TimeoutError, self._killed):
                outcome: Outcome = future.result(timeout=_TIMEOUT)
                return outcome
            hosts = self._found()
        if future.status == "error":
            error = future.exception()
            if not isinstance(error, self._killed):
                return ClusterError(f"worker {worker}: {in_a_line(error)}")
        self._client.cancel([future], force=True)
        return Death(f"worker {worker} has gone")

    def _found(self) -> dict[str, str]:
        """The host of every worker that the scheduler knows."""
        if self._client.status == "running":
            with contextlib.suppress(OSError):
                known = self._client.scheduler_info(n_workers=-1)["workers"]
                return {worker: about["host"] for worker, about in known.items()}
        raise ClusterError(
            f"--cluster {self._address}: the scheduler has gone; run the same command again to "
            f"resume"
        )

    def _check(self, workers: list[str]) -> None:
        """Refuse workers of another version."""

        def version() -> str:
            # Dask sends an inner function as code, so it runs without adaptune.
            from importlib.metadata import version

            return version("adaptune")

        versions = self._client.run(version, workers=workers, on_error="return")
        for worker, found in versions.items():
            if isinstance(found, OSError):
                continue  # it has gone again
            if found != __version__:
                what = "no adaptune" if isinstance(found, Exception) else f"adaptune {found}"
                raise ClusterError(
                    f"--cluster {self._address}: worker {worker} has {what}, and this is "
                    f"{__version__}; install the same version there"
                )


async def _what_answers(address: str) -> str:
    """What listens at an address, as Scheduler; Dask waits for an introduction without a limit."""
    from distributed import Security, rpc

    secured = Security().get_connection_args("client")
    async with rpc(address, timeout=_TIMEOUT, connection_args=secured) as there:
        with contextlib.suppress(TimeoutError, MemoryError):
            return str((await asyncio.wait_for(there.identity(), _TIMEOUT + 1.0))["type"])
    return "something else"


def contents(sequences: StudySequences, name: str) -> dict[Path, str]:
    """The files of a sequence with their `fingerprints`, the folder of files that have but one."""
    found: dict[Path, str] = {}
    for files in sequences.files(name):
        known = fingerprints(files) if files else []
        named = files if len(known) == len(files) else [files[0].parent]
        found |= zip(named, known, strict=True)
    return found


def check_files(sequences: StudySequences, name: str, there: Mapping[Path, str]) -> None:
    """On a worker, refuse files of a sequence other than those where the campaign was started.

    A ClusterError names a file that is missing here, or has another content.
    """
    here: dict[Path, str] = {}
    try:
        here = contents(sequences, name)
    except AdaptuneError as error:
        if all(path.exists() for path in there):
            raise ClusterError(str(error)) from error
    for path in {**there, **here}:
        if here.get(path) != there.get(path):
            what = "has another content than where you run this" if path.exists() else "is missing"
            raise ClusterError(
                f"{path}: {what}; copy it there under the same path, or share its folder with all "
                f"machines"
            )


_lock = threading.Lock()
_held: tuple[str, Bench] | None = None


def perform(
    token: str, setup: TrialSetup, files: Mapping[Path, str], task: Task, core: int, share: float
) -> Outcome:
    """On a worker, do a task, with the scans that earlier tasks of the campaign have prepared.

    They take this `share` of the machine's memory for them.
    """
    global _held  # noqa: PLW0603 (a Dask worker keeps nothing else from task to task)
    check_files(setup.sequences, task.sequence, files)
    with _lock:
        pin(core)
        if _held is None or _held[0] != token:
            _held = token, Bench(setup, share * spare_memory())
        return attempt(_held[1], task)
