"""What this process uses of the machine: its cores and its memory."""

import ctypes
import gc
import itertools
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

_before: set[int] | None = None
"""Cores that this process had before it was pinned alone."""
_OWN_GROUPS, _GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
_numbers = itertools.count(1)


def available() -> int:
    """Number of cores whose time this process and those that work beside it may use."""
    quotas = _granted("cpu", ["cpu.max"], ["cpu.cfs_quota_us", "cpu.cfs_period_us"])
    return min([len(shared_cores()), *(math.ceil(q / period) for q, period in quotas if q > 0)])


def spare_memory() -> float:
    """Bytes that all workers here together may take for prepared scans."""
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limits = _granted("memory", ["memory.max"], ["memory.limit_in_bytes"])
    return 0.25 * min([whole, *(limit for (limit,) in limits)])


def _granted(controller: str, *versions: Sequence[str]) -> Iterator[list[float]]:
    """What the control groups of this process, as a container's, say in files of either version."""
    lines = _OWN_GROUPS.read_text(encoding="utf-8").splitlines() if _OWN_GROUPS.exists() else ()
    for _, controllers, name in (line.split(":", 2) for line in lines):
        if controllers and controller not in controllers.split(","):
            continue
        group = _GROUPS / (controllers and controller) / name.lstrip("/")
        # A container sees its own group as the root.
        for folder, files in itertools.product((group, *group.parents), versions):
            with suppress(OSError, ValueError):  # there is none, or it says "max"
                said = " ".join((folder / file).read_text(encoding="ascii") for file in files)
                yield [float(word) for word in said.split()]


def shared_cores() -> set[int]:
    """The cores of this process and of those that work beside it, see `pin`."""
    return os.sched_getaffinity(0) if _before is None else _before


def pin(core: int, alone: bool = False) -> ExitStack:
    """Keep this process on one core until what it returns is closed.

    Open3D sums in an order that depends on its threads. Only on one core do its results repeat bit
    by bit. Running threads keep their cores: call this before the first use of Open3D. Numbers
    beyond the last core restart at the first. `alone` says that this process is the only one at
    work, also where it is pinned again meanwhile: then `next_core` gives others the rest.
    """
    global _before  # noqa: PLW0603 - the cores are those of the process
    pinned = ExitStack()
    cores, outer = os.sched_getaffinity(0), _before
    os.sched_setaffinity(0, {sorted(cores)[core % len(cores)]})
    _before = outer or (cores if alone else None)

    def unpin() -> None:
        global _before  # noqa: PLW0603
        os.sched_setaffinity(0, cores)
        _before = outer

    pinned.callback(unpin)
    return pinned


def next_core() -> int:
    """Core for another process that works beside this one.

    Each call gives the next core, after the one that `pin` gives to the number of this process.
    """
    cores = sorted(shared_cores())
    return cores[(os.getpid() + next(_numbers)) % len(cores)]


def other_core(number: int) -> int:
    """Core for the process of this number, from 0, of those that work for this one; see `pin`.

    They get the cores that this process does not use, as far as there are any.
    """
    cores = sorted(shared_cores())
    others = sorted(set(cores) - os.sched_getaffinity(0)) or cores[1:] or cores
    return others[number % len(others)]


def resident_megabytes() -> float:
    """Memory that this process takes at present, without the files that it maps."""
    _, resident, shared, *_ = Path("/proc/self/statm").read_text(encoding="ascii").split()
    return 1e-6 * (int(resident) - int(shared)) * os.sysconf("SC_PAGE_SIZE")


def release_memory() -> None:
    """Give memory that is free back to the system, so that what comes next is measured alone.

    Threads that prepare scans leave hundreds of megabytes to the C library, which keeps them.
    """
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)


@contextmanager
def freeing_large_arrays() -> Iterator[None]:
    """Let large arrays that are made meanwhile go back to the system as soon as they are free.

    By default, the C library keeps them among small ones. Where a process holds many arrays of
    different sizes and replaces them time after time, as prepared scans, the holes between them
    then take several times what they hold. It costs some time for each array.
    """
    global _n_blocks  # noqa: PLW0603 - the setting is that of the process
    mallopt = ctypes.CDLL(None).mallopt
    _n_blocks += 1
    mallopt(_M_MMAP_THRESHOLD, _LARGE)
    try:
        yield
    finally:
        _n_blocks -= 1
        if not _n_blocks:
            mallopt(_M_MMAP_THRESHOLD, _LARGEST)


_M_MMAP_THRESHOLD, _LARGE, _LARGEST = -3, 256 * 1024, 32 * 1024**2
"""The number of the setting in malloc.h; bytes of arrays that are kept apart, and to what glibc
raises that by itself as such arrays become free."""
_n_blocks = 0
"""In how many blocks of `freeing_large_arrays` this process is."""
