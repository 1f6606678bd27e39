"""Odometries in processes of their own: a crash ends that process and nothing else.

A small server imports the odometry once and forks a fresh process for every start. That takes
milliseconds, and global state of the odometry ends with its process.
"""

import os
import socket
import time
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, ValidationInfo, model_validator

from adaptune._system import processes
from adaptune._system.machine import next_core
from adaptune._system.strict import StrictModel
from adaptune.errors import OdometryError, UnavailableError
from adaptune.geometry import Poses
from adaptune.odometry import wire
from adaptune.odometry.base import WITHOUT_POSE, BaseSettings, Description, Registration, Usage
from adaptune.odometry.faults import Faulting, pose_fault
from adaptune.recording.scan import Scan
from adaptune.space import ParameterSet, Selection

SERVICE = "adaptune.odometry.registry"  # what a server does with an odometry


def _in_study(argument: str, info: ValidationInfo) -> str:
    folder = (info.context or {}).get("folder")
    return argument if folder is None else argument.replace("{study}", str(folder))


Arguments = Annotated[tuple[Annotated[str, AfterValidator(_in_study)], ...], Field(min_length=1)]
"""A program and its arguments; ``{study}`` in them is the folder of the study's file."""


class Limits(StrictModel):
    """Limits of an odometry in a process of its own."""

    seconds: float = Field(10.0, gt=0, le=1e6)  # for one scan
    memory: float = Field(4.0, gt=0, le=1e6)  # gigabytes, besides what the process begins with

    @property
    def bounds(self) -> processes.Bounds:
        """The limits as a server takes them."""
        late = f"a scan took longer than isolation.seconds = {self.seconds:g}"
        full = f"out of isolation.memory = {self.memory:g} GB"
        return processes.Bounds(self.seconds, self.memory, late, full)


class Isolated(Faulting):
    """An odometry in another process, by default a new one with every start.

    If that process ends, or returns an invalid pose, this is a *fault*: the pose of that scan is
    NaN, and so are all that follow until a new start. A fault quotes the last lines that the
    odometry wrote.

    Settings are checked, or as the other process receives them. The limits are those of each
    process. A `transport` leads to a process that is not forked from a server that has imported the
    odometry: it stays from start to start, and is a new one only after a fault.
    """

    isolated = True
    _checks_poses: ClassVar[bool] = True
    _answered: ClassVar[float] = 0.0  # when any in this process answered last

    def __init__(
        self,
        name: str,
        parameters: ParameterSet,
        settings: BaseModel | dict[str, Any],
        limits: Limits,
        transport: processes.Transport | None = None,
    ):
        super().__init__(name, parameters)
        self._cpu = self._cpu_before = self._memory = 0.0  # of the other processes
        self._waited = 0.0  # seconds for poses, since the process began
        plain = settings if isinstance(settings, dict) else settings.model_dump(mode="json")
        self._settings = plain
        self._odometry = name if transport is None else None  # a program is one odometry
        self._fresh = transport is None  # each start needs a new process
        if transport is None:
            # Nothing else limits TBB's threads, and it sums in the order in which they finish.
            bounds = limits.bounds._replace(core=next_core())
            transport = processes.Forked(SERVICE, name, "converse", bounds)
        self._conversation = processes.Conversation(transport)
        self._busy = False

    @property
    def ended(self) -> bool:
        return not self._conversation.alive

    @property
    def usage(self) -> Usage:
        return Usage(self._cpu, self._memory, other_cpu=self._cpu)

    @property
    def busy(self) -> bool:
        return self._busy

    def ready(self, seconds: float) -> bool:
        return self._conversation.ready(seconds)

    def start(
        self, prepared: Scan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self._last_motion.start(T_odom_sensor, T_previous_current)
        if self._fresh:
            self.close()
        if self.ended and (self.given_up or self.begin() is None):
            return
        header, arrays = self._scan(prepared)
        self._ask(
            {**header, "type": "start"}, **arrays, pose=T_odom_sensor, motion=T_previous_current
        )

    def begin(self) -> processes.Message | None:
        """Begin a process; its answer, None after a fault, which is an error the first time."""
        self._cpu_before, self._waited = self._cpu, 0.0
        try:
            self._conversation.open()
        except UnavailableError:
            raise
        except (OdometryError, processes.HostError) as error:
            # One that has run can be gone for good.
            if not self.faults:
                raise OdometryError(str(error)) from error
            self.note_fault(str(error))
            return None
        return self._ask(wire.hello(self._odometry, self.parameters, self._settings))

    def _scan(self, prepared: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """A prepared scan as a message."""
        return {"stamp": prepared.stamp}, wire.scan_arrays(prepared)

    def submit(self, prepared: Any) -> None:
        self._submitted, self._busy = prepared.stamp, True
        self._asked = time.perf_counter()
        header, arrays = self._scan(prepared)
        self._conversation.send({**header, "type": "register"}, **arrays)

    def _collect(self) -> Registration:
        """The answer to the submitted scan; NaN if there is none, or a wrong one."""
        answer = self._receive()
        now = time.perf_counter()
        # Of several that are asked at once, each is waited for after the one before.
        self._waited += now - max(self._asked, Isolated._answered)
        Isolated._answered = now
        self._busy = False
        if answer is None:
            return WITHOUT_POSE
        try:
            T_odom_sensor = np.asarray(answer.arrays["pose"], np.float64)
            late, registered = answer.header["stamp"] - self._submitted, answer.header["registered"]
            cpu, memory = self._used(answer.header)
            wrong = pose_fault(T_odom_sensor) if self._checks_poses else None
            if late:
                wrong = f"of another time, {1e-9 * late:+.3f} s from the scan's"
            wrong = wrong and f"a pose {wrong}"
        except KeyError as error:
            wrong = f"an answer without {error}"
        except (TypeError, ValueError) as error:
            wrong = f"an answer of other types ({error})"
        if wrong:
            return self.note_fault(f"it gave {wrong}")
        self._cpu = self._cpu_before + cpu
        self._memory = max(self._memory, memory)
        return Registration(T_odom_sensor.copy(), bool(registered))

    def _used(self, header: dict[str, Any]) -> tuple[float, float]:
        """CPU seconds and megabytes, as the process tells them, or else as they are seen."""
        cpu = memory = 0.0
        if "cpu" not in header:
            # Of one that runs elsewhere, nothing is seen but how long it takes.
            cpu, memory = self._conversation.transport.used() or (self._waited, 0.0)
        return float(header.get("cpu", cpu)), float(header.get("memory", memory))

    def apply(self, selection: Selection) -> None:
        self.parameters |= selection.parameters
        self._ask({"type": "configure", "parameters": selection.parameters})

    def close(self) -> None:
        self._conversation.close()

    def _ask(self, header: dict[str, Any], **arrays: Any) -> processes.Message | None:
        self._conversation.send(header, **arrays)
        return self._receive()

    def _receive(self) -> processes.Message | None:
        """Wait for the answer; None if there is none, with a fault if the process has ended."""
        if not self._conversation.alive:
            return None
        try:
            return self._conversation.receive()
        except processes.RefusedError as error:
            raise OdometryError(f"{self.name}: {error}") from error
        except processes.HostError as error:
            self.note_fault(str(error))
            return None


FIRST_ANSWER = 60.0  # seconds that a program may need to begin


class ProcessSettings(BaseSettings):
    """How to reach a program that speaks `adaptune.odometry.wire`, see ``docs/programs.md``.

    A command uses its standard input and output. Results of another `version` do not count.
    """

    command: Arguments | None = None
    address: str | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    version: str | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.command is None) == (self.address is None):
            raise ValueError("give a command or an address")
        return self


class ProgramTransport(processes.Transport):
    """A program of the user on this machine, which is started, or listens at an address."""

    def __init__(self, settings: ProcessSettings, limits: Limits):
        self.name = settings.command[0] if settings.command else str(settings.address)
        self.bounds = limits.bounds
        self._command, self._address = settings.command, settings.address
        # A program may use several cores, unless this process must not.
        self._core = next_core() if len(os.sched_getaffinity(0)) == 1 else None
        self._program: processes.Program | None = None

    def connect(self) -> processes.SocketStream:
        connection = self._begin() if self._address is None else _reached(self._address)
        connection.settimeout(max(self.bounds.seconds, FIRST_ANSWER))
        return processes.SocketStream(connection)

    def _begin(self) -> socket.socket:
        here, there = socket.socketpair()
        with there:
            self._program = processes.Program(
                self._command or (),
                self.bounds.memory,
                self._core,
                stdin=there.fileno(),
                stdout=there.fileno(),
            )
        return here

    def why(self, what: str) -> str:
        if self._program is None:
            return what.replace("its process ended", "it ended the conversation")
        if (ended := self._program.wait(0.5)) is not None:
            what = processes.how_it_ended(ended.code)
        return processes.quoting(what, self._program.last_lines())

    def used(self) -> tuple[float, float] | None:
        return None if self._program is None else self._program.used()[1:]

    def close(self) -> None:
        if self._program is not None:
            self._program.close()
            self._program = None


def _reached(address: str) -> socket.socket:
    """Connect to ``tcp://HOST:PORT`` or ``unix:PATH``."""
    kind, _, rest = address.partition(":")
    host, _, port = rest.removeprefix("//").rpartition(":")
    is_file = kind == "unix" and rest != ""
    if not is_file and (kind != "tcp" or not host or not port.isdigit()):
        raise OdometryError(f"address: {address!r} is neither tcp://HOST:PORT nor unix:PATH")
    connection = socket.socket(socket.AF_UNIX if is_file else socket.AF_INET)
    try:
        if is_file:
            with processes.socket_name(Path(rest)) as name:
                connection.connect(name)
        else:
            connection.connect((host, int(port)))
    except OSError as error:
        connection.close()
        what = f"nothing listens at {address} ({error.strerror})"
        raise OdometryError(f"{what}: start the program there first") from error
    return connection


class UserProgram(Isolated):
    """An odometry in a program of the user, each instance with its own program or connection."""

    settings_type: ClassVar[type[BaseSettings]]
    transport_type: ClassVar[Any]

    def __init__(self, parameters: ParameterSet, settings: Any, limits: Limits):
        transport = self.transport_type(settings, limits)
        super().__init__(transport.name, parameters, settings.settings, limits, transport)

    @classmethod
    def instance(
        cls,
        parameters: ParameterSet,
        settings: Any,
        limits: Limits,
        read: object = None,  # noqa: ARG003
    ) -> Self:
        """Make an instance, as all programs of the user are made; it reads no recording."""
        return cls(parameters, settings, limits)

    @staticmethod
    def own_file(parameters: ParameterSet, settings: Any) -> None:
        """It has none: parameters reach it in messages."""

    @classmethod
    def describe(cls, settings: Any) -> Description:
        """What the program reports about itself; an error if it cannot be reached."""
        return described(cls, settings.model_dump_json())


@cache
def described(cls: type[UserProgram], settings: str, version: str = "") -> Description:  # noqa: ARG001
    """What a program of this version reports about itself; it is ended then."""
    program = cls({}, cls.settings_type.model_validate_json(settings), Limits())
    try:
        if (answer := program.begin()) is None:
            raise OdometryError(program.faults[-1])
        return wire.announced(answer)
    finally:
        program.close()


class Process(UserProgram):
    """An odometry in a program of the user on this machine."""

    settings_type = ProcessSettings
    transport_type = ProgramTransport
