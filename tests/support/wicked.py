"""Modules of users that go wrong when they are imported, and processes that are made to."""

import contextlib
import os
import signal
import time
from pathlib import Path

from adaptune._system.processes import server

IMPORTS = {
    "exit": ("import sys\nprint('no licence')\nsys.exit(0)", "ended with code 0: no licence"),
    "end": ("import os\nos._exit(3)", "ended with code 3"),
    "segmentation fault": ("import ctypes\nctypes.string_at(0)", "ended by SIGSEGV"),
    "sleep": ("import time\ntime.sleep(1e9)", "cannot be imported: that took longer than 1 s"),
    "raise": ("raise ValueError('no camera')", "ended with code 1: .*ValueError: no camera"),
    "kill": ("import os\nos.killpg(0, 9)", "ended by SIGKILL"),
}


def gone(process):
    """Whether a process has ended, or waits for nothing but its parent's notice."""
    try:
        stat = Path(f"/proc/{process}/stat").read_text()
        return stat.rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def wait_until_gone(pids, seconds=10.0):
    end = time.monotonic() + seconds
    while not all(map(gone, pids)) and time.monotonic() < end:
        time.sleep(0.02)
    assert [process for process in pids if not gone(process)] == []


# A child in the program's own session, and one that leaves it.


def children(process):
    """Numbers of the processes that a process has started; none if it has ended."""
    path = Path(f"/proc/{process}/task/{process}/children")
    with contextlib.suppress(OSError):
        return list(map(int, path.read_text().split()))
    return []


def tell(service, name, what=signal.SIGKILL):
    """Send a signal to all processes of an odometry; its server has a watcher for each."""
    for watcher in children(server(service, name).process.pid):
        for process in children(watcher):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, what)
