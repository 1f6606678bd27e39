"""Odometries that are programs which run on: scans in and poses out, one after the other."""

import contextlib
import logging
import os
import signal
import socket
import subprocess
import tempfile
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, Self, cast

from pydantic import Field, model_validator

from adaptune.odometry import wire
from adaptune.odometry.base import BaseSettings, Box, Description, OdometryError
from adaptune.odometry.isolation import (
    ONE_THREAD,
    Arguments,
    Isolated,
    Limits,
    bounded,
    last_lines,
    verdict,
)
from adaptune.odometry.registry import box_class
from adaptune.space import ParameterSet

_log = logging.getLogger(__name__)

_FIRST_ANSWER = 60.0
"""Seconds that a program may take to begin."""


def _parse(address: str) -> tuple[socket.AddressFamily, Any]:
    kind, colon, rest = address.partition(":")
    if kind == "unix" and colon and rest:
        return socket.AF_UNIX, rest
    host, _, port = rest.removeprefix("//").rpartition(":")
    if kind != "tcp" or not host or not port.isdigit():
        raise OdometryError(f"address: {address!r} is neither tcp://HOST:PORT nor unix:PATH")
    return socket.AF_INET, (host, int(port))


class Settings(BaseSettings):
    """How to reach a program that speaks `adaptune.odometry.wire`.

    Attributes
    ----------
    command : list of str, optional
        Starts it; it speaks over its standard input and output.
    address : str, optional
        Where it listens: ``tcp://HOST:PORT`` or ``unix:PATH``.
    settings : dict
        What the program is told as its settings.
    """

    command: Arguments | None = None
    address: str | None = None
    settings: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.command is None) == (self.address is None):
            raise ValueError("give a command or an address")
        return self


class Process(Isolated):
    """An odometry in a program of the user's.

    Each instance has a program, or a connection, of its own, and keeps it from start to start:
    a new one is wanted only after a fault.

    Parameters
    ----------
    parameters, limits
        See `Isolated`.
    settings
        How to reach the program.
    """

    settings_type = Settings
    _fresh = False

    def __init__(self, parameters: ParameterSet, settings: Settings, limits: Limits):
        self.name = None
        self.parameters = dict(parameters)
        self.faults: list[str] = []
        self.cpu = self.memory = self._cpu_before = 0.0
        self._settings = settings.settings
        self._limits = limits
        self._reach = settings
        self._stream: BinaryIO | None = None
        self._socket: socket.socket | None = None
        self._program: subprocess.Popen[bytes] | None = None
        self._written: Any = None

    @property
    def _called(self) -> str:
        return self._reach.command[0] if self._reach.command else str(self._reach.address)

    @staticmethod
    def describe(settings: Settings) -> Description:
        """What the program says of itself.

        Raises
        ------
        OdometryError
            If it cannot be reached, or says something else.
        """
        return _describe(settings.model_dump_json())

    def ask(self) -> Description:
        """Let the program describe itself."""
        self._stream = self._connect()
        try:
            self._send(wire.hello(None, self.parameters, self._settings))
            answer = self._receive()
            if answer is None:
                raise OdometryError(self.faults[-1])
            try:
                return wire.announced(answer)
            except wire.WireError as error:
                raise OdometryError(str(error)) from error
        finally:
            self.close()

    def close(self) -> None:
        """End the conversation, and the program if it was started here."""
        super().close()
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._program is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._program.pid, signal.SIGKILL)
            self._program.wait()
            self._program = None

    def _connect(self) -> BinaryIO:
        if self._reach.command is not None:
            self._socket = self._begin(self._reach.command)
        else:
            address = cast("str", self._reach.address)
            family, where = _parse(address)
            self._socket = socket.socket(family)
            try:
                self._socket.connect(where)
            except OSError as error:
                self._socket.close()
                raise OdometryError(f"nothing listens at {address} ({error.strerror})") from error
        self._socket.settimeout(max(self._limits.seconds, _FIRST_ANSWER))
        return cast("BinaryIO", self._socket.makefile("rwb"))

    def _begin(self, command: tuple[str, ...]) -> socket.socket:
        here, there = socket.socketpair()
        self._written = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the instance
        with there:
            self._program = subprocess.Popen(
                bounded(command, self._limits.memory),
                stdin=there.fileno(),
                stdout=there.fileno(),
                stderr=self._written,
                env=os.environ | ONE_THREAD,
                start_new_session=True,
            )
        return here

    def _receive(self) -> wire.Message | None:
        answer = super()._receive()
        if self._socket is not None:
            self._socket.settimeout(self._limits.seconds)
        return answer

    def _verdict(self, what: str) -> str:
        """How the program ended, if it did, and the last lines that it wrote."""
        if self._program is None:
            return what.replace("its process ended", "it ended the conversation")
        with contextlib.suppress(subprocess.TimeoutExpired):
            what = verdict(self._program.wait(0.5))
        words = last_lines(self._written)
        return f"{what}: {words}" if words else what


@cache
def _describe(settings: str) -> Description:
    reach = Settings.model_validate_json(settings)
    return Process({}, reach, Limits()).ask()


def anywhere(name: str, parameters: ParameterSet, settings: BaseSettings) -> Box:
    """An odometry in this process, or in one of its own if it is not clean."""
    if box_class(name).clean:
        return wire.here(name, parameters, settings)
    return Isolated(name, parameters, settings, Limits())


def listen(address: str, name: str, ready: Callable[[str], None]) -> None:
    """Answer all who connect, each with an instance of its own, until interrupted.

    Parameters
    ----------
    address
        ``tcp://HOST:PORT``, any free port if that is 0, or ``unix:PATH``.
    name
        Of the odometry.
    ready
        Called with the address when connections are accepted.

    Raises
    ------
    OdometryError
        If there is no such odometry, or the address cannot be had.
    """
    box_class(name)
    family, where = _parse(address)
    with socket.socket(family) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            server.bind(where)
        except OSError as error:
            raise OdometryError(f"{address}: cannot listen there ({error.strerror})") from error
        server.listen()
        if family == socket.AF_INET:
            host, port = server.getsockname()
            address = f"tcp://{host}:{port}"
        try:
            ready(address)
            while True:
                connection, _ = server.accept()
                threading.Thread(target=_converse, args=(connection, name), daemon=True).start()
        finally:
            if family == socket.AF_UNIX:
                Path(where).unlink(missing_ok=True)


def _converse(connection: socket.socket, name: str) -> None:
    """Answer one who has connected; what goes wrong ends this conversation only."""
    try:
        with connection, connection.makefile("rb") as reader, connection.makefile("wb") as writer:
            wire.serve(reader, writer, name, anywhere)
    except (OSError, wire.WireError) as error:
        _log.warning("a conversation ended: %s", error)
    except Exception:
        _log.exception("a conversation ended")
