"""Odometries in programs of the user that receive scans and return poses, one after the other."""

import socket
import tempfile
from functools import cache
from typing import Any, Self

from pydantic import Field, model_validator

from adaptune import hosting
from adaptune.cores import available
from adaptune.odometry import wire
from adaptune.odometry.base import BaseSettings, Description, OdometryError
from adaptune.odometry.isolation import Arguments, Isolated, Limits
from adaptune.space import ParameterSet

FIRST_ANSWER = 60.0
"""Seconds that a program may need to begin."""


def parse_address(address: str) -> tuple[socket.AddressFamily, Any]:
    """Socket family and address of ``tcp://HOST:PORT`` or ``unix:PATH``; else an error."""
    kind, colon, rest = address.partition(":")
    if kind == "unix" and colon and rest:
        return socket.AF_UNIX, rest
    host, _, port = rest.removeprefix("//").rpartition(":")
    if kind != "tcp" or not host or not port.isdigit():
        raise OdometryError(f"address: {address!r} is neither tcp://HOST:PORT nor unix:PATH")
    return socket.AF_INET, (host, int(port))


class ProcessSettings(BaseSettings):
    """How to reach a program that speaks `adaptune.odometry.wire`.

    Attributes
    ----------
    command : list of str, optional
        Starts the program, which uses its standard input and output.
    address : str, optional
        Where the program listens: ``tcp://HOST:PORT`` or ``unix:PATH``.
    settings : dict
        Settings that the program receives.
    version : str, optional
        Version of the program. Change it where its file stays the same and the program does not, as
        with a container or a shared library: results of the version before do not count any more.
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


class UserProgram(Isolated):
    """An odometry in a program of the user, wherever that runs.

    Each instance has its own program or connection. It keeps that from start to start, and needs a
    new one only after a fault.
    """

    _fresh = False

    @classmethod
    def instance(
        cls,
        parameters: ParameterSet,
        settings: Any,
        limits: Limits,
        read: object = None,  # noqa: ARG003
    ) -> Self:
        """Make an instance, as all programs of the user are made; it reads no recording."""
        make: Any = cls
        made: Self = make(parameters, settings, limits)
        return made

    def _receive(self) -> wire.Message | None:
        """Wait for the answer; only the first may take longer than a scan."""
        answer = super()._receive()
        if self._stream is not None:
            self._stream.limit(self._limits.seconds)
        return answer


class Process(UserProgram):
    """An odometry in a program of the user on this machine.

    Parameters
    ----------
    parameters, limits
        See `Isolated`.
    settings
        How to reach the program.
    """

    settings_type = ProcessSettings

    def __init__(self, parameters: ParameterSet, settings: ProcessSettings, limits: Limits):
        name = settings.command[0] if settings.command else str(settings.address)
        super().__init__(name, parameters, settings, limits)
        self._hello = {"odometry": None, "settings": settings.settings}
        self._reach = settings
        self._socket: socket.socket | None = None
        self._program: hosting.Program | None = None
        self._written: Any = None

    @staticmethod
    def describe(settings: ProcessSettings) -> Description:
        """What the program reports about itself; an error if it cannot be reached."""
        return _describe(settings.model_dump_json())

    def close(self) -> None:
        super().close()
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._program is not None:
            self._program.close()
            self._program = None

    def _connect(self) -> wire.SocketStream:
        address = self._reach.address
        if address is None:
            self._socket = self._begin(self._reach.command or ())
        else:
            family, where = parse_address(address)
            self._socket = socket.socket(family)
            try:
                self._socket.connect(where)
            except OSError as error:
                self._socket.close()
                what = f"nothing listens at {address} ({error.strerror})"
                raise OdometryError(f"{what}: start the program there first") from error
        self._socket.settimeout(max(self._limits.seconds, FIRST_ANSWER))
        return wire.SocketStream(self._socket)

    def _begin(self, command: tuple[str, ...]) -> socket.socket:
        here, there = socket.socketpair()
        self._written = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the instance
        with there:
            self._program = hosting.Program(
                command,
                self._limits.memory,
                stdin=there.fileno(),
                stdout=there.fileno(),
                stderr=self._written,
                # A program may use several cores, unless this process must not.
                core=self._core if available() == 1 else None,
            )
        return here

    def _verdict(self, what: str) -> str:
        """Add how the program ended, if it did, and the last lines that it wrote."""
        if self._program is None:
            return what.replace("its process ended", "it ended the conversation")
        if (ended := self._program.wait(0.5)) is not None:
            what = hosting.verdict(ended.code)
        return hosting.quoting(what, self._written)


@cache
def _describe(settings: str) -> Description:
    return announced_by(Process({}, ProcessSettings.model_validate_json(settings), Limits()))


def announced_by(program: UserProgram) -> Description:
    """What a program reports about itself; it is ended then."""
    try:
        program._stream = program._connect()
        answer = program._ask(wire.hello(**program._hello, parameters={}))
        if answer is None:
            raise OdometryError(program.faults[-1])
        return wire.announced(answer)
    finally:
        program.close()
