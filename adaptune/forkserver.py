"""Forks processes in which user code lives, see `adaptune.hosting`.

Run with the number of a socket, the time for the import, the module of a service and the name of
the user code. For every socket that it receives it forks a watcher, which forks the process and
reports how that ended.
"""

import contextlib
import json
import math
import os
import resource
import signal
import socket
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import BinaryIO, NoReturn

from adaptune.errors import AdaptuneError, in_a_line
from adaptune.hosting import Bounds, quoting, verdict
from adaptune.keeper import adopt_orphans, keep
from adaptune.odometry.wire import send

_LONGER = 5
"""Seconds by which the limit on the import is longer here: it is for servers left behind."""


def main(control: socket.socket, seconds: float, module: str, name: str) -> None:
    """Fork a process for every socket received, until the other side closes."""
    signal.alarm(math.ceil(seconds) + _LONGER)
    service, refused = import_module(module), None
    try:
        service.load(name)
    except AdaptuneError as error:
        refused = str(error)
    signal.alarm(0)
    control.send(json.dumps(refused).encode())
    while refused is None:
        request, sockets, _, _ = socket.recv_fds(control, 1 << 12, 1)
        if not sockets:
            break
        if os.fork() == 0:
            control.close()
            do, bounds = json.loads(request)
            with socket.socket(fileno=sockets[0]) as connection:
                _watch(connection, service, do, name, Bounds(*bounds))
            os._exit(0)
        os.close(sockets[0])
        # Collect watchers that have ended, or they stay as zombies.
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG) != (0, 0):
                pass
    # With all that the import has started.
    os.killpg(0, signal.SIGKILL)


def _watch(
    connection: socket.socket, service: ModuleType, do: str, name: str, bounds: Bounds
) -> None:
    """Run a process, end all that it has started, and report how it ended if that was not well."""
    os.setsid()
    adopt_orphans()
    with tempfile.TemporaryFile() as output:
        child = os.fork()
        if child == 0:
            os.setsid()
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            _run(connection, service, do, name, bounds)
        code = keep(child, connection.fileno()).code
        if code:
            what = bounds.late if code == -signal.SIGALRM else verdict(code)
            fault = {"type": "fault", "message": quoting(what, output)}
            with contextlib.suppress(OSError), connection.makefile("wb") as writer:
                send(writer, fault)


def _run(
    connection: socket.socket, service: ModuleType, do: str, name: str, bounds: Bounds
) -> NoReturn:
    """Answer messages and end the process."""
    code = 1
    try:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if bounds.core is not None:
            os.sched_setaffinity(0, {bounds.core})
        if bounds.memory:
            statm = Path("/proc/self/statm")
            pages = int(statm.read_text().split()[0]) if statm.exists() else 0
            bound = pages * resource.getpagesize() + int(bounds.memory * 1e9)
            resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
        with connection.makefile("rb") as reader, connection.makefile("wb") as writer:
            getattr(service, do)(_Timed(reader, bounds.seconds), writer, name)
        code = 0
    except MemoryError:
        os.write(2, f"\n{bounds.full}\n".encode())
    except BaseException as error:
        os.write(2, f"\n{in_a_line(error)}\n".encode(errors="replace"))
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
    main(socket.socket(fileno=int(sys.argv[1])), float(sys.argv[2]), sys.argv[3], sys.argv[4])
