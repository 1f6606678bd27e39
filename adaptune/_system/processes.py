"""User code in processes of its own, where it ends nothing else, and messages to it.

Python code is imported once, by a server. For every socket that this receives it forks a watcher,
which forks a fresh process and reports how that ended. Programs run under a keeper. All of them end
with this process. A message is a JSON header, and arrays as raw bytes.
"""

import contextlib
import json
import math
import os
import re
import resource
import signal
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import wait
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from adaptune._system import keeper
from adaptune._system.keeper import Ended, adopt_orphans, keep
from adaptune.errors import AdaptuneError, in_a_line

_LENGTH = struct.Struct("<I")
_LONGEST_HEADER, _LARGEST_ARRAY = 1 << 24, 1 << 30  # bytes


class SocketStream:
    """A socket as a stream of messages, which tells whether one has come: nothing is read ahead."""

    def __init__(self, connection: socket.socket):
        self._socket = connection
        self._writer = connection.makefile("wb")
        self.write, self.writelines = self._writer.write, self._writer.writelines
        self.flush = self._writer.flush

    def read(self, size: int, /) -> bytearray:
        """Read so many bytes; fewer only at the end."""
        data, n = bytearray(size), 0
        with memoryview(data) as room:
            while n < size and (more := self._socket.recv_into(room[n:])):
                n += more
        del data[n:]
        return data

    def ready(self, seconds: float) -> bool:
        """Whether a message, or the end, is there, or comes in so many seconds."""
        return bool(wait([self._socket], max(seconds, 0.0)))

    def close(self) -> None:
        """Close the socket."""
        try:
            self._writer.close()
        finally:
            self._socket.close()

    def limit(self, seconds: float) -> None:
        """Change the time after which there is a `TimeoutError`, if there is such a time."""
        if self._socket.gettimeout() is not None:
            self._socket.settimeout(seconds)

    def end(self) -> None:
        """End the conversation, for all processes that share the socket and threads that read."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)


@contextmanager
def socket_name(path: Path) -> Iterator[str]:
    """A name for a socket's file for the block: the system takes no names above 107 bytes."""
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


class WireError(AdaptuneError):
    """A stream without messages of this version."""


class Message(NamedTuple):
    """A message: its header, ``type`` included, and its arrays by name."""

    header: dict[str, Any]
    arrays: dict[str, NDArray[Any]]


def send(
    stream: "BinaryIO | SocketStream", header: Mapping[str, Any], **arrays: NDArray[Any] | None
) -> None:
    """Write a message; arrays that are None are left out."""
    given = {name: np.ascontiguousarray(a) for name, a in arrays.items() if a is not None}
    layout = [[name, a.dtype.str, list(a.shape)] for name, a in given.items()]
    encoded = json.dumps({**header, "arrays": layout}).encode()
    stream.write(_LENGTH.pack(len(encoded)) + encoded)
    stream.writelines(a.data.cast("B") for a in given.values() if a.size)
    stream.flush()


def receive(stream: "BinaryIO | SocketStream | _Timed") -> Message | None:
    """Read a message, or None where the stream has ended; else there is a `WireError`."""
    first = stream.read(_LENGTH.size)
    if not first:
        return None
    try:
        (length,) = _LENGTH.unpack(first)
        if length > _LONGEST_HEADER:
            raise WireError("the stream holds no message of adaptune's: write nothing else to it")
        header = json.loads(_exactly(stream, length))
        arrays = {}
        for name, kind, shape in header.pop("arrays"):
            if not 0 <= (size := math.prod(shape) * np.dtype(kind).itemsize) <= _LARGEST_ARRAY:
                raise WireError(f"the stream holds no message of adaptune's ({name}: {shape})")
            arrays[name] = np.frombuffer(_exactly(stream, size), kind).reshape(shape)
    except (struct.error, ValueError, LookupError, TypeError, SyntaxError, AttributeError) as error:
        raise WireError(f"the stream holds no message of adaptune's ({error})") from error
    return Message(header, arrays)


def _exactly(stream: "BinaryIO | SocketStream | _Timed", size: int) -> bytes | bytearray:
    data = stream.read(size)
    if len(data) < size:
        raise WireError("the stream ends in the middle of a message")
    return data


IMPORT_SECONDS = 60.0  # an import of user code may take so long

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


def how_it_ended(code: int) -> str:
    """How a process ended, by its exit code, or minus the signal's number."""
    if code >= 0:
        return f"its process ended with code {code}"
    known = -code in set(signal.Signals)
    by = signal.Signals(-code).name if known else f"signal {-code}"
    why = " (it wrote too large a file)" if -code == signal.SIGXFSZ else ""
    return f"its process was ended by {by}{why}"


def last_lines(output: BinaryIO) -> str:
    """The last lines that a process wrote to a file."""
    size = output.seek(0, os.SEEK_END)
    output.seek(max(size - _TAIL, 0))
    return plain_lines(output.read())


def plain_lines(written: bytes) -> str:
    """The last lines of what a process wrote, without colours and empty ones."""
    lines = _CONTROL.sub("", written.decode(errors="replace")).splitlines()
    return " | ".join([line.strip() for line in lines if line.strip()][-_LINES:])


def quoting(what: str, words: str) -> str:
    """What happened, and the last lines that a process wrote, if any."""
    return f"{what}: {words}" if words else what


class Program:
    """A program of the user in a session of its own, under a keeper.

    The memory limits the address space of each of its processes, in gigabytes. `core` is the only
    one that it may use; None for those of this process. Other options are those of
    `subprocess.Popen`; what it writes is kept for `last_lines`, if no stream takes it.
    """

    out_of_memory = False  # as a container tells

    def __init__(
        self,
        command: Sequence[str],
        memory: float,
        core: int | None = None,
        environment: Mapping[str, str] | None = None,
        **options: Any,
    ):
        self._ended: Ended | None = None
        self._output = output = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the instance
        streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
        self._here, there = socket.socketpair()
        under = [sys.executable, "-I", "-S", keeper.__file__, str(there.fileno()), str(memory)]
        with there:
            self._keeper = subprocess.Popen(
                [*under, *command],
                pass_fds=[there.fileno()],
                env=os.environ | ONE_THREAD | dict(environment or {}),
                start_new_session=True,
                **(streams | options),
            )
        if core is not None:
            # The keeper has not begun yet.
            os.sched_setaffinity(self._keeper.pid, {core})

    def wait(self, seconds: float) -> Ended | None:
        """Wait for the program to end; None if it runs longer."""
        if self._ended is None:
            self._here.settimeout(seconds)
            try:
                code, cpu, memory = self._here.recv(1 << 10).split()
                self._ended = Ended(int(code), float(cpu), float(memory))
            except TimeoutError:
                return None
            except (OSError, ValueError):  # the keeper itself was killed
                self._ended = Ended(-signal.SIGKILL, 0.0, 0.0)
        return self._ended

    def ended(self) -> int | None:
        """Exit code, or minus the signal's number; None while it runs."""
        ended = self.wait(1e-3)
        return None if ended is None else ended.code

    def last_lines(self) -> str:
        """The last lines that it wrote."""
        return last_lines(self._output)

    def hold_to_cores(self) -> None:
        """Only containers have a limit."""

    def used(self) -> Ended:
        """CPU seconds and megabytes of what runs now, or of all until it ended."""
        if self._ended is not None:
            return self._ended
        running = keeper.descendants(self._keeper.pid)
        used = [keeper.used(process) for process in running]
        return Ended(0, sum(cpu for cpu, _ in used), sum(memory for _, memory in used))

    def end(self) -> Ended | None:
        """End it with all that it has started, and say what it has used."""
        with contextlib.suppress(OSError):
            self._here.shutdown(socket.SHUT_WR)
        return self.wait(5.0)

    def close(self) -> None:
        """End it with all that it has started."""
        self._here.close()
        self._keeper.wait()


class Bounds(NamedTuple):
    """Limits of a process that a server forks."""

    seconds: float = 0.0  # time for each message; 0 for no limit
    memory: float = 0.0  # gigabytes, in addition to what the process begins with; 0 for no limit
    late: str = "it took too long"  # what is said where one of them is exceeded
    full: str = "out of memory"
    core: int | None = None  # the only core that it may use


class Server(NamedTuple):
    """A process that has imported user code, and the socket that asks it to fork."""

    process: subprocess.Popen[bytes]
    control: socket.socket


servers: dict[tuple[str, str], Server] = {}
"""By service and name; each ends with this process, or where it is dropped."""


def forget_servers() -> None:
    """Import user code anew from here on."""
    while servers:
        servers.popitem()[1].control.close()


def server(service: str, name: str) -> Server:
    """Server of a piece of user code, started at the first call, and again where it has ended.

    The service is a module. Its function ``load(name)`` imports the user code, and others make an
    `Answer` from the name. If it is not imported, a `HostError` has the last lines that it wrote.
    """
    if known := servers.get((service, name)):
        if known.process.poll() is None:
            return known
        known.control.close()
    here, there = socket.socketpair(type=socket.SOCK_SEQPACKET)
    path = os.pathsep.join(folder or str(Path.cwd()) for folder in sys.path)
    arguments = [str(there.fileno()), str(IMPORT_SECONDS), service, name]
    with there, tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            # Modules are found where this process finds them, and nowhere else.
            [sys.executable, "-P", "-m", "adaptune._system.processes", *arguments],
            pass_fds=[there.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=os.environ | ONE_THREAD | {"PYTHONPATH": path},
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
            raise HostError(f"{name}: {quoting(wrong, last_lines(output))}")
    started = servers[service, name] = Server(process, here)
    return started


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
            what = f"it cannot be imported: {how_it_ended(process.wait(1.0))}"
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return what


class Transport:
    """Another process, and the way to it: forked from a server, behind a socket, in a container."""

    name: str  # what messages call it
    bounds: Bounds

    def connect(self) -> SocketStream:
        """Begin the process, or reach it."""
        raise NotImplementedError

    def why(self, what: str) -> str:
        """What has happened, and how the process ended, if that is known."""
        return what

    def used(self) -> tuple[float, float] | None:
        """CPU seconds and megabytes that are seen of it from here, for one that tells nothing."""
        return None

    def close(self) -> None:
        """End the process, if it does not end with its stream."""


@dataclass(frozen=True)
class Forked(Transport):
    """A fresh process in which a function `do` of a service answers messages."""

    service: str
    name: str
    do: str
    bounds: Bounds = Bounds()  # noqa: RUF009 - it never changes

    def connect(self) -> SocketStream:
        """Fork it; a `HostError` if the user code cannot be imported."""
        here, there = socket.socketpair()
        with there:
            request = json.dumps([self.do, self.bounds]).encode()
            control = server(self.service, self.name).control
            socket.send_fds(control, [request], [there.fileno()])
        return SocketStream(here)


class Conversation:
    """Messages to another process, and its answers."""

    def __init__(self, transport: Transport):
        self.transport = transport
        self._stream: SocketStream | None = None

    @property
    def alive(self) -> bool:
        """Whether the process was there when it was last used."""
        return self._stream is not None

    def open(self) -> None:
        """Begin the process if there is none; raises what `connect` of the transport does."""
        if self._stream is None:
            self._stream = self.transport.connect()

    def send(self, header: Mapping[str, Any], **arrays: Any) -> None:
        """Send a message, if there is a process."""
        if self._stream is not None:
            # A process that does not listen any more has said why, or has ended.
            with contextlib.suppress(OSError):
                send(self._stream, header, **arrays)

    def ready(self, seconds: float) -> bool:
        """Whether `receive` has something to give in so many seconds."""
        return self._stream is None or self._stream.ready(seconds)

    def receive(self) -> Message:
        """Wait for the next answer.

        A `HostError` says why there is none; the conversation is over then. A `RefusedError` says
        what the other process refuses, and does not end it.
        """
        return accepted(self.next_message())

    def next_message(self) -> Message:
        """Wait for the next answer, which may be a refusal."""
        what, answer = "its process ended", None
        try:
            if self._stream is not None:
                answer = receive(self._stream)
                self._stream.limit(self.transport.bounds.seconds)
        except TimeoutError:
            what = self.transport.bounds.late
        except OSError:
            pass
        except WireError as error:
            what = str(error).replace("stream", f"stream of {self.transport.name}", 1)
        if answer is not None and answer.header.get("type") != "fault":
            return answer
        said = "" if answer is None else answer.header.get("message", "it does not say why")
        what = self.transport.why(what) if answer is None else str(said)
        self.close()
        raise HostError(what)

    def ask(self, header: Mapping[str, Any], **arrays: Any) -> Message:
        """Send a message, to a new process if there is none, and `receive` the answer."""
        self.open()
        self.send(header, **arrays)
        try:
            return self.receive()
        except RefusedError:
            raise
        except HostError as error:
            raise HostError(f"{self.transport.name}: {error}") from error

    def close(self) -> None:
        """End the process."""
        if self._stream is not None:
            with contextlib.suppress(OSError):
                self._stream.close()
            self._stream = None
        self.transport.close()

    def __del__(self) -> None:
        self.close()


def accepted(answer: Message) -> Message:
    """An answer; a `RefusedError` if it says that it cannot be done."""
    if answer.header.get("type") == "refused":
        raise RefusedError(str(answer.header.get("message", "it does not say why")))
    return answer


Answer = Callable[[Message], Mapping[str, Any] | None]
"""Gives what the answer to a message holds, arrays as such; None if there is no answer."""


def answer_all(reader: "BinaryIO | _Timed", writer: BinaryIO, answer: Answer) -> None:
    """Answer messages until the stream ends; what an `AdaptuneError` says is refused."""
    while (message := receive(reader)) is not None:
        try:
            reply = answer(message)
        except AdaptuneError as error:
            reply = {"type": "refused", "message": str(error)}
        if reply is not None:
            arrays = {key: value for key, value in reply.items() if isinstance(value, np.ndarray)}
            rest = {key: value for key, value in reply.items() if key not in arrays}
            send(writer, {"type": "done", **rest}, **arrays)


def main(control: socket.socket, seconds: float, module: str, name: str) -> None:
    """Fork a process for every socket received, until the other side closes."""
    signal.alarm(math.ceil(seconds) + 5)  # for servers left behind, so a little later than there
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
            what = bounds.late if code == -signal.SIGALRM else how_it_ended(code)
            fault = {"type": "fault", "message": quoting(what, last_lines(output))}
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
            pages = int(Path("/proc/self/statm").read_text().split()[0])
            bound = pages * resource.getpagesize() + int(bounds.memory * 1e9)
            resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
        with connection.makefile("rb") as reader, connection.makefile("wb") as writer:
            answer_all(_Timed(reader, bounds.seconds), writer, getattr(service, do)(name))
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
