"""Which cores a process may use."""

import os
from collections.abc import Callable


def available() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def pin(core: int) -> Callable[[], None]:
    """Keep this process on one core, if the system can, and return a function that undoes it.

    Open3D sums in an order that depends on its threads. Only on one core do its results repeat bit
    by bit. Running threads keep their cores: call this before the first use of Open3D. Numbers
    beyond the last core restart at the first.
    """
    if not hasattr(os, "sched_setaffinity"):
        return lambda: None
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {sorted(cores)[core % len(cores)]})
    return lambda: os.sched_setaffinity(0, cores)
