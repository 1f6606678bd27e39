"""Odometries in processes of their own, which may end without taking anything with them.

A small server that has imported the odometry forks a fresh process for every start: that takes
milliseconds, and what an odometry keeps beside its instances is gone with its process.
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
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo

from adaptune.geometry import Poses
from adaptune.odometry import wire
from adaptune.odometry.base import BaseSettings, OdometryError, Registration
from adaptune.odometry.registry import box_class
from adaptune.sequence import Scan
from adaptune.space import ParameterSet

MOST_FAULTS = 10
"""After so many an instance is not started again: what is left of its sequence is lost."""

_SHAKE = 1e-3
"""By which a rotation times its transpose may depart from the identity."""

_TAIL, _LINES = 1 << 14, 5
"""Of what it has written, the last lines of the last bytes are told."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of programs that must not start threads of their own."""

_log = logging.getLogger(__name__)


def _in_study(argument: str, info: ValidationInfo) -> str:
    folder = (info.context or {}).get("folder")
    return argument if folder is None else argument.replace("{study}", str(folder))


Arguments = Annotated[tuple[Annotated[str, AfterValidator(_in_study)], ...], Field(min_length=1)]
"""A program and its arguments; ``{study}`` in them is the folder of the study's file."""


class Limits(BaseModel):
    """What an odometry in a process of its own may take.

    Attributes
    ----------
    seconds : float
        For one scan.
    memory : float
        Gigabytes, beside what the process begins with.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    seconds: float = Field(10.0, gt=0)
    memory: float = Field(4.0, gt=0)


class Isolated:
    """An odometry that lives in another process, a new one with every start.

    What ends that process, or makes no sense as a pose, is a *fault*: the pose of that scan is
    NaN, and so are all that follow until a new start.

    Parameters
    ----------
    name
        Of the odometry.
    parameters, settings
        See `Odometry`.
    limits
        What it may take.

    Attributes
    ----------
    faults : list of str
        What went wrong, each with the last lines that the odometry wrote.
    cpu : float
        Seconds that its processes have computed.
    memory : float
        Megabytes that they took at most, what they began with included.
    """

    _fresh = True
    """Whether each start wants a new process."""

    def __init__(self, name: str, parameters: ParameterSet, settings: BaseSettings, limits: Limits):
        self.name: str | None = name
        self.parameters = box_class(name).space.baseline | parameters
        self.faults: list[str] = []
        self.cpu = self.memory = 0.0
        self._cpu_before = 0.0
        self._settings = settings.model_dump(mode="json")
        self._limits = limits
        self._stream: BinaryIO | None = None

    @property
    def _called(self) -> str:
        """What it goes by where something is told of it."""
        return str(self.name)

    def prepare(self, scan: Scan) -> Scan:
        """See `Odometry.prepare`; the other process prepares."""
        return scan

    def start(
        self, prepared: Scan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """See `Odometry.start`.

        Raises
        ------
        OdometryError
            If the odometry refuses its parameters or the scan.
        """
        if self._fresh:
            self.close()
        if self._stream is None:
            if len(self.faults) >= MOST_FAULTS:
                return
            self._stream = self._connect()
            self._ask(wire.hello(self.name, self.parameters, self._settings))
        self._ask(
            {"type": "start", "stamp": prepared.stamp},
            **wire.scan_arrays(prepared),
            pose=T_odom_sensor,
            motion=T_previous_current,
        )

    def register(self, prepared: Scan) -> Registration:
        """See `Odometry.register`."""
        self.request(prepared)
        return self.result()

    def request(self, prepared: Scan) -> None:
        """Begin to `register`: several instances may be at work at once."""
        self._asked = prepared.stamp
        self._send({"type": "register", "stamp": prepared.stamp}, **wire.scan_arrays(prepared))

    def result(self) -> Registration:
        """What became of the `request`."""
        answer = self._receive()
        if answer is None:
            return Registration(np.full((4, 4), np.nan), registered=False)
        try:
            T_odom_sensor = np.asarray(answer.arrays["pose"], np.float64)
            late, registered = answer.header["stamp"] - self._asked, answer.header["registered"]
            cpu, memory = (float(answer.header.get(key, 0.0)) for key in ("cpu", "memory"))
        except (KeyError, TypeError, ValueError) as error:
            lacking = isinstance(error, KeyError)
            told = f"without {error}" if lacking else f"of other types ({error})"
            self._fault(f"it gave an answer {told}")
            return Registration(np.full((4, 4), np.nan), registered=False)
        what = nonsense(T_odom_sensor)
        if late:
            what = f"of another time, {1e-9 * late:+.3f} s from the scan's"
        if what is not None:
            self._fault(f"it gave a pose {what}")
            return Registration(np.full((4, 4), np.nan), registered=False)
        self.cpu = self._cpu_before + cpu
        self.memory = max(self.memory, memory)
        return Registration(T_odom_sensor.copy(), bool(registered))

    def configure(self, parameters: ParameterSet) -> None:
        """See `Odometry.configure`."""
        self.parameters |= parameters
        self._ask({"type": "configure", "parameters": parameters})

    def close(self) -> None:
        """End the other process."""
        if self._stream is not None:
            with contextlib.suppress(OSError):
                self._stream.close()
            self._stream = None
            self._cpu_before = self.cpu

    def __del__(self) -> None:
        self.close()

    def _ask(self, header: dict[str, Any], **arrays: Any) -> None:
        self._send(header, **arrays)
        self._receive()

    def _send(self, header: dict[str, Any], **arrays: Any) -> None:
        if self._stream is not None:
            # One that does not listen any more has told why, or will have ended.
            with contextlib.suppress(OSError):
                wire.send(self._stream, header, **arrays)

    def _receive(self) -> wire.Message | None:
        """Wait for the answer; None if there is none any more."""
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
        if answer.header.get("type") == "fault":
            self._fault(str(answer.header.get("message")))
            return None
        if answer.header.get("type") == "refused":
            raise OdometryError(f"{self._called}: {answer.header.get('message')}")
        return answer

    def _connect(self) -> BinaryIO:
        """A stream to a process that has yet to be told which odometry it is."""
        assert self.name is not None
        return _fork(self.name, self._limits)

    def _verdict(self, what: str) -> str:
        """What is known of the end of a conversation; a process that ended has told by itself."""
        return what

    def _fault(self, what: str) -> None:
        self.close()
        self.faults.append(what)
        _log.warning("%s with %s: %s", self._called, self.parameters, what)
        if len(self.faults) == MOST_FAULTS:
            _log.warning("%s: that was fault number %d, giving up", self._called, MOST_FAULTS)


def nonsense(T_odom_sensor: Poses) -> str | None:
    """What is wrong with a pose, if anything."""
    if T_odom_sensor.shape != (4, 4):
        return f"of shape {T_odom_sensor.shape}"
    if not np.isfinite(T_odom_sensor).all():
        return "that is not finite"
    R = T_odom_sensor[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _SHAKE or np.linalg.det(R) < 0:
        return "that is not rigid"
    return None


def verdict(code: int) -> str:
    """How a process ended, by its exit code, or minus the signal's number."""
    if code >= 0:
        return f"its process ended with code {code}"
    return f"its process was ended by {signal.Signals(-code).name}"


def bounded(command: Sequence[str], memory: float, *limits: str) -> list[str]:
    """A command whose address space is bounded by so many gigabytes, and by more of ulimit's."""
    bounds = "; ".join(f"ulimit {limit}" for limit in (f"-v {round(memory * 1e6)}", *limits))
    return ["/bin/sh", "-c", f'{bounds}; exec "$@"', "sh", *command]


def last_lines(output: BinaryIO) -> str:
    """The last lines that a process wrote to a file."""
    size = output.seek(0, os.SEEK_END)
    output.seek(max(size - _TAIL, 0))
    lines = output.read().decode(errors="replace").strip().splitlines()
    return " | ".join(lines[-_LINES:])


class _Server(NamedTuple):
    process: subprocess.Popen[bytes]
    control: socket.socket


@cache
def _server(name: str) -> _Server:
    """What forks instances of an odometry, begun when the first one is wanted."""
    here, there = socket.socketpair(type=socket.SOCK_SEQPACKET)
    path = os.pathsep.join(filter(None, sys.path))
    with there:
        process = subprocess.Popen(
            [sys.executable, "-m", "adaptune.odometry.forkserver", str(there.fileno()), name],
            pass_fds=[there.fileno()],
            stdin=subprocess.DEVNULL,
            env=os.environ | ONE_THREAD | {"PYTHONPATH": path},
            # Ctrl-C is for the process that drives.
            start_new_session=True,
        )
    return _Server(process, here)


def _fork(name: str, limits: Limits) -> BinaryIO:
    """A stream to a fresh process."""
    if _server(name).process.poll() is not None:
        _server.cache_clear()
    here, there = socket.socketpair()
    with here, there:
        request = limits.model_dump_json().encode()
        socket.send_fds(_server(name).control, [request], [there.fileno()])
        return cast("BinaryIO", here.makefile("rwb"))
