"""Forks processes in which odometries live, see `adaptune.odometry.isolation`.

Run with the number of a socket and the name of an odometry. It imports the odometry. For every
socket that it receives it forks a watcher, which forks the instance and reports how that ended.
"""

import contextlib
import os
import resource
import signal
import socket
import sys
import tempfile
from pathlib import Path
from typing import BinaryIO, NoReturn

from adaptune.cores import pin
from adaptune.odometry import wire
from adaptune.odometry.base import OdometryError
from adaptune.odometry.isolation import Limits, last_lines, verdict
from adaptune.odometry.registry import odometry_class


def main(control: socket.socket, name: str) -> None:
    """Fork an instance for every socket received, until the other side closes."""
    # The instance reports what cannot be imported.
    with contextlib.suppress(OdometryError):
        odometry_class(name)
    while True:
        limits, sockets, _, _ = socket.recv_fds(control, 1 << 12, 1)
        if not sockets:
            return
        if os.fork() == 0:
            control.close()
            with socket.socket(fileno=sockets[0]) as connection:
                _watch(connection, Limits.model_validate_json(limits))
            os._exit(0)
        os.close(sockets[0])
        # Collect watchers that have ended, or they stay as zombies.
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG) != (0, 0):
                pass


def _watch(connection: socket.socket, limits: Limits) -> None:
    """Run an instance in a child, and report how it ended if that was not well."""
    with tempfile.TemporaryFile() as output:
        child = os.fork()
        if child == 0:
            _run(connection, output.fileno(), limits)
        _, status = os.waitpid(child, 0)
        if status:
            code = os.waitstatus_to_exitcode(status)
            what = verdict(code)
            if code == -signal.SIGALRM:
                what = f"a scan took longer than isolation.seconds = {limits.seconds:g}"
            if last := last_lines(output):
                what = f"{what}: {last}"
            with contextlib.suppress(OSError), connection.makefile("wb") as writer:
                wire.send(writer, {"type": "fault", "message": what})


def _run(connection: socket.socket, output: int, limits: Limits) -> NoReturn:
    """Answer messages and end the process."""
    code = 1
    try:
        # Nothing else limits TBB's threads, and it sums in the order in which they finish.
        pin(os.getpid())
        os.dup2(output, 1)
        os.dup2(output, 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        statm = Path("/proc/self/statm")
        pages = int(statm.read_text().split()[0]) if statm.exists() else 0
        bound = pages * resource.getpagesize() + int(limits.memory * 1e9)
        resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
        with connection.makefile("rb") as reader, connection.makefile("wb") as writer:
            wire.serve(_Timed(reader, limits.seconds), writer)
        code = 0
    except MemoryError:
        os.write(2, f"\nout of isolation.memory = {limits.memory:g} GB\n".encode())
    except BaseException:
        sys.excepthook(*sys.exc_info())
        sys.stderr.flush()
    finally:
        # Exit handlers belong to the server.
        os._exit(code)


class _Timed:
    """A stream with a time limit from every read to the next, at which the process dies.

    The signal has no handler, so it also works inside compiled code.
    """

    def __init__(self, stream: BinaryIO, seconds: float):
        self._stream = stream
        self._seconds = seconds

    def read(self, size: int) -> bytes:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        data = self._stream.read(size)
        signal.setitimer(signal.ITIMER_REAL, self._seconds)
        return data


if __name__ == "__main__":
    main(socket.socket(fileno=int(sys.argv[1])), sys.argv[2])
