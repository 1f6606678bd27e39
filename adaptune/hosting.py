"""User code in processes of its own: whatever it does there ends that process and nothing else.

Python code is imported once, by a server that then forks a fresh process for each use of it.
Programs run under a keeper. Both end with this process, and so does all that they have started.
"""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from adaptune import keeper
from adaptune.errors import AdaptuneError
from adaptune.keeper import Ended
from adaptune.odometry.wire import Message, Readable, SocketStream, WireError, receive, send

IMPORT_SECONDS = 60.0
"""An import of user code may take so long."""

_TAIL, _LINES = 1 << 14, 5
"""Messages quote the last lines, out of the last bytes, that a program wrote."""

_CONTROL = re.compile(r"\x1b\[[0-9;]*[A-Za-z]|\x1b\][^\x07]*\x07?|[\x00-\x08\x0b-\x1f]")
"""What colours a terminal, or sets its title."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of programs that must not start threads of their own."""


class HostError(AdaptuneError):
    """User code that cannot be imported, or that does not answer."""


class RefusedError(HostError):
    """What user code, or what runs it, refuses in words of its own."""


def verdict(code: int) -> str:
    """How a process ended, by its exit code, or minus the signal's number."""
    if code >= 0:
        return f"its process ended with code {code}"
    known = -code in set(signal.Signals)
    by = signal.Signals(-code).name if known else f"signal {-code}"
    return f"its process was ended by {by}"


def last_lines(output: BinaryIO) -> str:
    """The last lines that a process wrote to a file."""
    size = output.seek(0, os.SEEK_END)
    output.seek(max(size - _TAIL, 0))
    return plain_lines(output.read())


def plain_lines(written: bytes) -> str:
    """The last lines of what a process wrote, without colours and empty ones."""
    lines = _CONTROL.sub("", written.decode(errors="replace")).splitlines()
    return " | ".join([line.strip() for line in lines if line.strip()][-_LINES:])


def quoting(what: str, output: BinaryIO) -> str:
    """What happened, and the last lines that a process wrote, if any."""
    words = last_lines(output)
    return f"{what}: {words}" if words else what


class Program:
    """A program of the user in a session of its own, under a keeper.

    Parameters
    ----------
    command
        The program and its arguments.
    memory
        Limit on the address space of each of its processes, in gigabytes.
    core
        The only core that it may use; None for those of this process.
    streams
        Of `subprocess.Popen`: its input and output, and its folder.
    """

    def __init__(
        self, command: Sequence[str], memory: float, core: int | None = None, **streams: Any
    ):
        self._here, there = socket.socketpair()
        under = [sys.executable, "-I", "-S", keeper.__file__, str(there.fileno()), str(memory)]
        with there:
            self._keeper = subprocess.Popen(
                [*under, *command],
                pass_fds=[there.fileno()],
                env=os.environ | ONE_THREAD,
                start_new_session=True,
                **streams,
            )
        if core is not None:
            # The keeper has not begun yet.
            os.sched_setaffinity(self._keeper.pid, {core})

    def wait(self, seconds: float) -> Ended | None:
        """Wait for the program to end; None if it runs longer."""
        self._here.settimeout(seconds)
        try:
            code, cpu, memory = self._here.recv(1 << 10).split()
        except TimeoutError:
            return None
        except (OSError, ValueError):  # the keeper itself was killed
            return Ended(-signal.SIGKILL, 0.0, 0.0)
        return Ended(int(code), float(cpu), float(memory))

    def end(self) -> Ended | None:
        """End it with all that it has started, and say what it has used."""
        with contextlib.suppress(OSError):
            self._here.shutdown(socket.SHUT_WR)
        return self.wait(5.0)

    def close(self) -> None:
        """End it with all that it has started."""
        self._here.close()
        self._keeper.wait()


class Service(NamedTuple):
    """What a server does with user code.

    Attributes
    ----------
    module : str
        Its function ``load(name)`` imports the user code. Others, of a stream to read, one to write
        and the name, answer messages until the stream ends.
    environment : dict
        Additional variables.
    """

    module: str
    environment: tuple[tuple[str, str], ...] = ()


class Bounds(NamedTuple):
    """Limits of a process that a server forks.

    Attributes
    ----------
    seconds : float
        Time for each message; 0 for no limit.
    memory : float
        Gigabytes, in addition to what the process begins with; 0 for no limit.
    late, full : str
        What is said where one of them is exceeded.
    core : int, optional
        The only core that it may use.
    """

    seconds: float = 0.0
    memory: float = 0.0
    late: str = "it took too long"
    full: str = "out of memory"
    core: int | None = None


UNBOUNDED = Bounds()


class Server(NamedTuple):
    """A process that has imported user code, and the socket that asks it to fork."""

    process: subprocess.Popen[bytes]
    control: socket.socket


@cache
def server(service: Service, name: str) -> Server:
    """Server of a piece of user code, started at the first call.

    Raises
    ------
    HostError
        If it cannot be imported, with the last lines that it wrote.
    """
    here, there = socket.socketpair(type=socket.SOCK_SEQPACKET)
    path = os.pathsep.join(folder or str(Path.cwd()) for folder in sys.path)
    arguments = [str(there.fileno()), str(IMPORT_SECONDS), service.module, name]
    with there, tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            # Modules are found where this process finds them, and nowhere else.
            [sys.executable, "-P", "-m", "adaptune.forkserver", *arguments],
            pass_fds=[there.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=os.environ | dict(service.environment) | {"PYTHONPATH": path},
            # Ctrl-C is for this process only.
            start_new_session=True,
        )
        there.close()
        try:
            wrong = _wait_for_import(process, here)
        except RefusedError:
            process.wait()
            raise
        if wrong is not None:
            here.close()
            raise HostError(f"{name}: {quoting(wrong, output)}")
    return Server(process, here)


def _wait_for_import(process: subprocess.Popen[bytes], control: socket.socket) -> str | None:
    """Wait until a server has imported user code; how it went wrong, if it did."""
    control.settimeout(IMPORT_SECONDS)
    what = f"it cannot be imported: that took longer than {IMPORT_SECONDS:g} s"
    with contextlib.suppress(TimeoutError):
        if answer := control.recv(1 << 16):
            control.settimeout(None)
            if refused := json.loads(answer):
                raise RefusedError(refused)
            return None
        with contextlib.suppress(subprocess.TimeoutExpired):
            what = f"it cannot be imported: {verdict(process.wait(1.0))}"
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return what


def connect(service: Service, name: str, do: str, bounds: Bounds) -> SocketStream:
    """A stream to a fresh process, in which a function `do` of the service answers messages."""
    if server(service, name).process.poll() is not None:
        server.cache_clear()
    here, there = socket.socketpair()
    with there:
        request = json.dumps([do, bounds]).encode()
        socket.send_fds(server(service, name).control, [request], [there.fileno()])
    return SocketStream(here)


class Hosted:
    """A conversation with user code in a process of its own, which the first message begins.

    Parameters
    ----------
    service, name, do, bounds
        See `connect`.
    """

    def __init__(self, service: Service, name: str, do: str, bounds: Bounds = UNBOUNDED):
        self._to = service, name, do, bounds
        self._stream: SocketStream | None = None

    def ask(self, header: Mapping[str, Any], **arrays: Any) -> Message:
        """Send a message and wait for the answer.

        Raises
        ------
        HostError
            It names the user code, and says why there is no answer.
        RefusedError
            What the other process refuses.
        """
        if self._stream is None:
            self._stream = connect(*self._to)
        # A process that does not listen any more has said why, or has ended.
        with contextlib.suppress(OSError):
            send(self._stream, header, **arrays)
        what = "its process ended"
        with contextlib.suppress(OSError, WireError):
            answer = receive(self._stream)
            if answer is not None and answer.header.get("type") == "done":
                return answer
            if answer is not None and answer.header.get("type") == "refused":
                raise RefusedError(str(answer.header["message"]))
            what = what if answer is None else str(answer.header.get("message"))
        self.close()
        raise HostError(f"{self._to[1]}: {what}")

    def close(self) -> None:
        """End the process."""
        if self._stream is not None:
            with contextlib.suppress(OSError):
                self._stream.close()
            self._stream = None

    def __del__(self) -> None:
        self.close()


def answer_all(
    reader: Readable, writer: BinaryIO, answer: Callable[[Message], Mapping[str, Any]]
) -> None:
    """Answer messages until the stream ends; an `AdaptuneError` is passed on.

    Parameters
    ----------
    reader, writer
        The stream.
    answer
        Gives what the answer to a message holds; arrays in it are sent as such.
    """
    while (message := receive(reader)) is not None:
        try:
            found = answer(message)
        except AdaptuneError as error:
            send(writer, {"type": "refused", "message": str(error)})
            continue
        arrays = {key: value for key, value in found.items() if isinstance(value, np.ndarray)}
        rest = {key: value for key, value in found.items() if key not in arrays}
        send(writer, {"type": "done", **rest}, **arrays)
