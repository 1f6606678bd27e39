"""Odometries in processes of their own: a crash ends that process and nothing else.

A small server imports the odometry once and forks a fresh process for every start. That takes
milliseconds, and global state of the odometry ends with its process.
"""

import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from typing import Annotated, Any, BinaryIO, NamedTuple, cast

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo

from adaptune.geometry import Poses
from adaptune.odometry import wire
from adaptune.odometry.base import (
    BaseSettings,
    LastMotion,
    Motions,
    OdometryError,
    OdometryInstance,
    Registration,
    Usage,
)
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet
from adaptune.strict import StrictModel

MOST_FAULTS = 10
"""An instance with so many faults does not start again: the rest of its sequence is lost."""

_TOLERANCE = 1e-3
"""By how much a rotation times its transpose may differ from the identity."""

_TAIL, _LINES = 1 << 14, 5
"""Messages quote the last lines, out of the last bytes, that a program wrote."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of programs that must not start threads of their own."""

_log = logging.getLogger(__name__)


def _in_study(argument: str, info: ValidationInfo) -> str:
    folder = (info.context or {}).get("folder")
    return argument if folder is None else argument.replace("{study}", str(folder))


Arguments = Annotated[tuple[Annotated[str, AfterValidator(_in_study)], ...], Field(min_length=1)]
"""A program and its arguments; ``{study}`` in them is the folder of the study's file."""


class Limits(StrictModel):
    """Limits of an odometry in a process of its own.

    Attributes
    ----------
    seconds : float
        Time for one scan.
    memory : float
        Gigabytes, in addition to what the process begins with.
    """

    seconds: float = Field(10.0, gt=0, le=1e6)
    memory: float = Field(4.0, gt=0, le=1e6)


class Isolated(OdometryInstance):
    """An odometry that lives in another process, a new one with every start.

    If that process ends, or returns an invalid pose, this is a *fault*: the pose of that scan is
    NaN, and so are all that follow until a new start. A fault quotes the last lines that the
    odometry wrote.

    Parameters
    ----------
    name
        The odometry.
    parameters, settings
        See `Odometry`.
    limits
        What each process may use.
    """

    faults: Sequence[str] = ()
    _fresh = True  # each start needs a new process

    def __init__(self, name: str, parameters: ParameterSet, settings: BaseSettings, limits: Limits):
        self.name = name
        self.parameters = dict(parameters)
        self._cpu = self._cpu_before = self._memory = 0.0  # as the other processes report
        self._hello: dict[str, Any] = {
            "odometry": name,
            "settings": settings.model_dump(mode="json"),
        }
        self._limits = limits
        self._stream: BinaryIO | None = None
        self._last_motion = LastMotion()

    @property
    def usage(self) -> Usage:
        return Usage(self._cpu, self._memory)

    @property
    def motions(self) -> Motions:
        return self._last_motion.motions

    def prepare(self, scan: Scan) -> Scan:
        return scan  # the other process prepares

    def start(
        self, prepared: Scan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self._last_motion.start(T_odom_sensor, T_previous_current)
        if self._fresh:
            self.close()
        if self._stream is None:
            if len(self.faults) >= MOST_FAULTS:
                return
            self._stream = self._connect()
            self._ask(wire.hello(**self._hello, parameters=self.parameters))
        self._ask(
            {"type": "start", "stamp": prepared.stamp},
            **wire.scan_arrays(prepared),
            pose=T_odom_sensor,
            motion=T_previous_current,
        )

    def submit(self, prepared: Scan) -> None:
        self._submitted = prepared.stamp
        self._send({"type": "register", "stamp": prepared.stamp}, **wire.scan_arrays(prepared))

    def collect(self) -> Registration:
        registration = self._registration()
        self._last_motion.move(registration.T_odom_sensor)
        return registration

    def _registration(self) -> Registration:
        """The answer to the submitted scan; NaN if there is none, or a wrong one."""
        answer, lost = self._receive(), Registration(np.full((4, 4), np.nan), registered=False)
        if answer is None:
            return lost
        try:
            T_odom_sensor = np.asarray(answer.arrays["pose"], np.float64)
            late, registered = answer.header["stamp"] - self._submitted, answer.header["registered"]
            cpu, memory = (float(answer.header.get(key, 0.0)) for key in ("cpu", "memory"))
            wrong = pose_fault(T_odom_sensor)
            if late:
                wrong = f"of another time, {1e-9 * late:+.3f} s from the scan's"
            wrong = wrong and f"a pose {wrong}"
        except KeyError as error:
            wrong = f"an answer without {error}"
        except (TypeError, ValueError) as error:
            wrong = f"an answer of other types ({error})"
        if wrong:
            self._fault(f"it gave {wrong}")
            return lost
        self._cpu = self._cpu_before + cpu
        self._memory = max(self._memory, memory)
        return Registration(T_odom_sensor.copy(), bool(registered))

    def apply(self, selection: Selection) -> None:
        self.configure(selection.parameters)

    def configure(self, parameters: ParameterSet) -> None:
        """Change parameters between scans; the others stay."""
        self.parameters |= parameters
        self._ask({"type": "configure", "parameters": parameters})

    def close(self) -> None:
        if self._stream is not None:
            with contextlib.suppress(OSError):
                self._stream.close()
            self._stream = None
            self._cpu_before = self._cpu

    def __del__(self) -> None:
        self.close()

    def _ask(self, header: dict[str, Any], **arrays: Any) -> wire.Message | None:
        self._send(header, **arrays)
        return self._receive()

    def _send(self, header: dict[str, Any], **arrays: Any) -> None:
        if self._stream is not None:
            # A process that does not listen any more has said why, or has ended.
            with contextlib.suppress(OSError):
                wire.send(self._stream, header, **arrays)

    def _receive(self) -> wire.Message | None:
        """Wait for the answer; None if there is none."""
        if self._stream is None:
            return None
        answer, what = None, "its process ended"
        try:
            answer = wire.receive(self._stream)
        except TimeoutError:
            what = f"a scan took longer than isolation.seconds = {self._limits.seconds:g}"
        except OSError:
            pass
        except wire.WireError as error:
            what = str(error)
        if answer is None:
            self._fault(self._verdict(what))
            return None
        kind, message = map(answer.header.get, ("type", "message"))
        if kind == "refused":
            raise OdometryError(f"{self.name}: {message}")
        if kind == "fault":
            self._fault(str(message))
            return None
        return answer

    def _connect(self) -> BinaryIO:
        """A stream to a new process, which first receives a hello."""
        if fork_server(self.name).process.poll() is not None:
            fork_server.cache_clear()
        here, there = socket.socketpair()
        with here, there:
            request = self._limits.model_dump_json().encode()
            socket.send_fds(fork_server(self.name).control, [request], [there.fileno()])
            return cast("BinaryIO", here.makefile("rwb"))

    def _verdict(self, what: str) -> str:
        """Add to `what` how the process ended; here the process itself reports that."""
        return what

    def _fault(self, what: str) -> None:
        self.close()
        self.faults = [*self.faults, what]
        _log.warning("%s with %s: %s", self.name, self.parameters, what)
        if len(self.faults) == MOST_FAULTS:
            _log.warning("%s: fault number %d, it does not start again", self.name, MOST_FAULTS)


def pose_fault(T_odom_sensor: Poses) -> str | None:
    """What is wrong with a pose, if anything."""
    if T_odom_sensor.shape != (4, 4):
        return f"of shape {T_odom_sensor.shape}"
    if not np.isfinite(T_odom_sensor).all():
        return "that is not finite"
    R = T_odom_sensor[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(R) < 0:
        return "that is not rigid"
    return None


def verdict(code: int) -> str:
    """How a process ended, by its exit code, or minus the signal's number."""
    if code >= 0:
        return f"its process ended with code {code}"
    return f"its process was ended by {signal.Signals(-code).name}"


def bounded(command: Sequence[str], memory: float, *limits: str) -> list[str]:
    """A command with a limit on its address space in gigabytes, and further limits of ulimit."""
    bounds = "; ".join(f"ulimit {limit}" for limit in (f"-v {round(memory * 1e6)}", *limits))
    return ["/bin/sh", "-c", f'{bounds}; exec "$@"', "sh", *command]


def end_group(process: subprocess.Popen[bytes]) -> None:
    """End a process that leads a session, and its children."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def last_lines(output: BinaryIO) -> str:
    """The last lines that a process wrote to a file."""
    size = output.seek(0, os.SEEK_END)
    output.seek(max(size - _TAIL, 0))
    lines = output.read().decode(errors="replace").strip().splitlines()
    return " | ".join(lines[-_LINES:])


class ForkServer(NamedTuple):
    """A process that forks instances of an odometry, and the socket that asks it to."""

    process: subprocess.Popen[bytes]
    control: socket.socket


@cache
def fork_server(name: str) -> ForkServer:
    """Fork server of an odometry, started at the first call."""
    here, there = socket.socketpair(type=socket.SOCK_SEQPACKET)
    path = os.pathsep.join(filter(None, sys.path))
    with there:
        process = subprocess.Popen(
            [sys.executable, "-m", "adaptune.odometry.forkserver", str(there.fileno()), name],
            pass_fds=[there.fileno()],
            stdin=subprocess.DEVNULL,
            env=os.environ | ONE_THREAD | {"PYTHONPATH": path},
            # Ctrl-C is for this process only.
            start_new_session=True,
        )
    return ForkServer(process, here)
