"""Which cores a process may use."""

import os
from collections.abc import Callable


def available() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def pin(core: int) -> Callable[[], None]:
    """Keep this process on one core, where the system can, and return how to undo it.

    Open3D sums in an order that depends on its threads: only on one core do its results repeat
    bit by bit. Threads that run already keep their cores, so this comes before Open3D's first use.
    Numbers beyond the last core begin anew at the first.
    """
    if not hasattr(os, "sched_setaffinity"):
        return lambda: None
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {sorted(cores)[core % len(cores)]})
    return lambda: os.sched_setaffinity(0, cores)
