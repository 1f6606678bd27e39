"""Waits for a child process, and ends all that it has started.

It also runs as a script of its own, between adaptune and a program of the user. It uses the
standard library only, and so begins in some milliseconds.
"""

import contextlib
import ctypes
import os
import resource
import select
import signal
import sys
import time
from typing import NamedTuple, NoReturn

_BETWEEN_SAMPLES = 200
"""Milliseconds."""
_UNTIL_DEAD = 0.001
"""Seconds between looks for processes that have not ended yet."""


class Ended(NamedTuple):
    """How a process ended, and what it and all that it started have used."""

    code: int  # exit code, or minus the number of the signal
    cpu: float  # seconds
    memory: float  # peak megabytes


def adopt_orphans() -> None:
    """Let this process be the parent of what its descendants leave behind."""
    ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # Linux's PR_SET_CHILD_SUBREAPER


def keep(child: int, connection: int, sampled: bool = False) -> Ended:
    """Wait until a child has ended, or the other side of a connection has gone; then end its rest.

    The child leads a session of its own. If sampled, the memory of it and its descendants is
    looked at a few times a second; otherwise it is that of the largest single process.
    """
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    poll = select.poll()
    poll.register(woken, select.POLLIN)
    poll.register(connection, select.POLLHUP | select.POLLRDHUP)
    peak, pid, status = 0.0, 0, 0
    while not pid:
        if sampled:
            peak = max(peak, sum(map(_resident, [child, *descendants(child)])))
        pid, status = os.waitpid(child, os.WNOHANG)
        # A child that ends from here on wakes this process up.
        for ready, _ in poll.poll(_BETWEEN_SAMPLES if sampled else None) if not pid else ():
            if ready == woken:
                os.read(woken, 1 << 10)
            else:
                poll.unregister(connection)
                _kill([child])
    _end_rest(child)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    memory = max(peak, used.ru_maxrss * 1024e-6)
    return Ended(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, memory)


def _end_rest(group: int) -> None:
    """End a process group, and all descendants that have left it."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(group, signal.SIGKILL)
    with contextlib.suppress(ChildProcessError):
        while True:
            _kill(descendants(os.getpid()))
            if os.waitpid(-1, os.WNOHANG) == (0, 0):
                time.sleep(_UNTIL_DEAD)


def _kill(processes: list[int]) -> None:
    for process in processes:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(process, signal.SIGKILL)


def descendants(ancestor: int) -> list[int]:
    """Descendants of a process."""
    found = [ancestor]
    for process in found:
        with contextlib.suppress(OSError):
            for task in os.listdir(f"/proc/{process}/task"):  # noqa: PTH208 (pathlib takes longer)
                found += map(int, _read(f"/proc/{process}/task/{task}/children").split())
    return found[1:]


def _resident(process: int) -> float:
    """Megabytes that a process holds now."""
    fields = _read(f"/proc/{process}/statm").split()
    return 1e-6 * int(fields[1]) * resource.getpagesize() if fields else 0.0


def used(process: int) -> tuple[float, float]:
    """CPU seconds of a process and of its children that have ended, and megabytes; 0 if it has."""
    fields = _read(f"/proc/{process}/stat").rpartition(b")")[2].split()
    ticks = sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK"), _resident(process)


def _read(path: str) -> bytes:
    """A file's content; nothing if the process has ended."""
    with contextlib.suppress(OSError), open(path, "rb") as file:  # noqa: PTH123
        return file.read()
    return b""


def main(connection: int, memory: float, command: list[str]) -> None:
    """Run a command with a limit on its address space in gigabytes, and report how it ended."""
    os.set_inheritable(connection, False)
    adopt_orphans()
    child = os.fork()
    if child == 0:
        _become(memory, command)
    # The program alone keeps its input and output open.
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    code, cpu, peak = keep(child, connection, sampled=True)
    with contextlib.suppress(OSError):
        os.write(connection, f"{code} {cpu} {peak}".encode())


def _become(memory: float, command: list[str]) -> NoReturn:
    try:
        os.setsid()
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # Python ignores it
        bound = int(memory * 1e9)
        resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
        os.execvp(command[0], command)
    except OSError as error:
        what = "not found" if isinstance(error, FileNotFoundError) else error.strerror
        os.write(2, f"{command[0]}: {what}\n".encode())
    finally:
        os._exit(127)


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]), sys.argv[3:])
