"""Processes of adaptune's own modules, forked by one server that has imported these."""

import contextlib
import os
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from multiprocessing import current_process, forkserver, get_context, parent_process
from multiprocessing.context import ForkServerContext
from multiprocessing.util import get_temp_dir

from adaptune._system.machine import available, shared_cores
from adaptune.errors import AdaptuneError


def end_with_parent() -> None:
    """End this process where the one that it computes for has ended, whatever it does by then."""
    # Ctrl-C reaches all processes; the first of them decides what happens.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)  # its containers and programs end with it

    threading.Thread(target=watch, daemon=True).start()


def fork_server(*preload: str) -> ForkServerContext:
    """What forks processes that have imported some modules; it is started if there is none."""
    if current_process().daemon:
        help_ = "call adaptune in the main process, or in threads"
        raise AdaptuneError(f"a process of multiprocessing.Pool may start no others: {help_}")
    # A process forked from one with threads may deadlock.
    context = get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    _name_sockets()
    # A fresh Python looks for modules where it begins, before it looks among its own. Processes
    # have the folder and the path of this one again.
    with contextlib.chdir("/"), contextlib.ExitStack() as undo:
        undo.callback(os.sched_setaffinity, 0, os.sched_getaffinity(0))
        os.sched_setaffinity(0, shared_cores())  # all, where this process is pinned
        forkserver.ensure_running()
    return context


@cache
def _name_sockets() -> None:
    """Let multiprocessing give its sockets short names, however long TMPDIR is: `socket_name`."""
    folder = tempfile.gettempdir()
    tempfile.tempdir = f"/proc/{os.getpid()}/fd/{os.open(folder, os.O_PATH)}"  # stays open
    try:
        get_temp_dir()
    finally:
        tempfile.tempdir = folder


@contextmanager
def processes(most: int, preload: Sequence[str] = ()) -> Iterator[Executor]:
    """At most so many processes to compute in, one a core; tasks that wait end with the block.

    All of them need the modules to preload, which are imported once. There is an `AdaptuneError`
    if a process ends before its time.
    """
    n = max(1, min(most, available()))
    context = fork_server(*preload)
    pool = ProcessPoolExecutor(n, context, end_with_parent)
    try:
        yield pool
    except BrokenProcessPool as error:
        raise AdaptuneError(
            "a process was ended from outside (was the memory full?), or a script lacks "
            '`if __name__ == "__main__":`'
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)
