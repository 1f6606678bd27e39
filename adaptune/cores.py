"""Which cores a process may use."""

import ctypes
import gc
import itertools
import os
import resource
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

from adaptune.errors import AdaptuneError


def resident_megabytes() -> float:
    """Memory that this process takes at present, without the files that it maps.

    Where the system does not tell, the most so far.
    """
    try:
        _, resident, shared, *_ = Path("/proc/self/statm").read_text(encoding="ascii").split()
    except OSError:
        return 1e-3 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return 1e-6 * (int(resident) - int(shared)) * os.sysconf("SC_PAGE_SIZE")


def release_memory() -> None:
    """Give memory that is free back to the system, so that what comes next is measured alone.

    Threads that prepare scans leave hundreds of megabytes to the C library, which keeps them.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # glibc has it
        trim(0)


@contextmanager
def apart() -> Iterator[None]:
    """Let large arrays that are made meanwhile go back to the system as soon as they are free.

    By default, the C library keeps them among small ones. Where a process holds many arrays of
    different sizes and replaces them time after time, as prepared scans, the holes between them
    then take several times what they hold. It costs some time for each array.
    """
    global _apart  # noqa: PLW0603 - the setting is that of the process
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # only glibc has it
        yield
        return
    _apart += 1
    mallopt(_M_MMAP_THRESHOLD, _LARGE)
    try:
        yield
    finally:
        _apart -= 1
        if not _apart:
            mallopt(_M_MMAP_THRESHOLD, _LARGEST)


_M_MMAP_THRESHOLD, _LARGE, _LARGEST = -3, 256 * 1024, 32 * 1024**2
"""The number of the setting in malloc.h; bytes of arrays that are kept apart, and to what glibc
raises that by itself as such arrays become free."""
_apart = 0
"""In how many blocks of `apart` this process is."""
_before: set[int] | None = None
"""Cores that this process had before it was pinned alone."""
_numbers = itertools.count(1)


def available() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def shared_cores() -> set[int]:
    """The cores of this process and of those that work beside it, see `pin`; empty if unknown."""
    if _before is None and hasattr(os, "sched_getaffinity"):
        return os.sched_getaffinity(0)
    return set(_before or ())


def together() -> int:
    """How many they are."""
    return len(shared_cores()) or available()


def pin(core: int, alone: bool = False) -> Callable[[], None]:
    """Keep this process on one core, if the system can, and return a function that undoes it.

    Open3D sums in an order that depends on its threads. Only on one core do its results repeat bit
    by bit. Running threads keep their cores: call this before the first use of Open3D. Numbers
    beyond the last core restart at the first.

    Parameters
    ----------
    core
        Number of the core, among those of this process.
    alone
        Whether this process is the only one at work: then `next_core` gives others the rest.
    """
    global _before  # noqa: PLW0603 - the cores are those of the process
    if not hasattr(os, "sched_setaffinity"):
        return lambda: None
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {sorted(cores)[core % len(cores)]})
    _before = cores if alone else None

    def unpin() -> None:
        global _before  # noqa: PLW0603
        os.sched_setaffinity(0, cores)
        _before = None

    return unpin


def next_core() -> int | None:
    """Core for another process that works beside this one; None if the system cannot keep it there.

    Each call gives the next core, after the one that `pin` gives to the number of this process.
    """
    if not hasattr(os, "sched_getaffinity"):
        return None
    cores = sorted(_before or os.sched_getaffinity(0))
    return cores[(os.getpid() + next(_numbers)) % len(cores)]


def other_core(number: int) -> int | None:
    """Core for the process of this number, from 0, of those that work for this one; see `pin`.

    They get the cores that this process does not use, as far as there are any.
    """
    cores = sorted(shared_cores())
    if not cores:
        return None
    others = sorted(set(cores) - os.sched_getaffinity(0)) or cores[1:] or cores
    return others[number % len(others)]


@contextmanager
def processes(most: int, preload: Sequence[str] = ()) -> Iterator[Executor]:
    """Processes to compute in, one a core; those of the block's tasks that wait end with it.

    Parameters
    ----------
    most
        No more processes than this.
    preload
        Modules that all of them need: they are imported once.

    Raises
    ------
    AdaptuneError
        If a process ends before its time.
    """
    # A process forked from one with threads may deadlock.
    context = get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    n = max(1, min(most, available()))
    pool = ProcessPoolExecutor(n, context, _ignore_interrupts)
    try:
        yield pool
    except BrokenProcessPool as error:
        raise AdaptuneError("a process was ended from outside; was the memory full?") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _ignore_interrupts() -> None:
    # Ctrl-C reaches all processes; the first of them decides what happens.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
