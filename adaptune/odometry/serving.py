"""Serve an odometry to other programs over sockets or standard input and output."""

import logging
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from adaptune import processes
from adaptune.errors import OdometryError
from adaptune.odometry import wire
from adaptune.odometry.base import Description, Registration
from adaptune.odometry.registry import (
    check_served,
    declare,
    declare_here,
    is_user_class,
    make_here,
    odometry_class,
)
from adaptune.odometry.remote import Isolated, Limits, parse_address
from adaptune.recording.scan import Scan
from adaptune.space import ParameterSet, Selection

_log = logging.getLogger(__name__)


class _Guarding(Isolated):
    """An odometry in a process of its own; where it ends, there is a `HostError`."""

    def configure(self, parameters: ParameterSet) -> None:
        self.apply(Selection(0, parameters))

    def register(self, prepared: Scan) -> Registration:
        registration = super().register(prepared)
        if self.faults and not np.isfinite(registration.T_odom_sensor).all():
            raise processes.HostError(self.faults[-1])
        return registration


def serve(reader: processes.Readable, writer: BinaryIO, name: str | None = None) -> None:
    """Serve an odometry, or each that a hello names, until the stream ends.

    One that is not clean runs in a process of its own.
    """
    if name is not None:
        declare(check_served(name), {})
    processes.answer_all(reader, writer, wire.conversation(name, _make))


def _make(name: str, parameters: ParameterSet, settings: Any) -> tuple[Any, Description]:
    checked, described = declare(check_served(name), settings).sound(name)
    if described.clean and not is_user_class(name):
        return make_here(name, parameters, settings)
    return _Guarding(name, parameters, checked, Limits()), described


def listen(address: str, name: str, ready: Callable[[str], None]) -> None:
    """Serve an odometry until interrupted, an instance of its own for each connection.

    The address is ``tcp://HOST:PORT``, any free port if that is 0, or ``unix:PATH``. `ready` is
    called with it when connections are accepted.
    """
    declare(check_served(name), {})
    family, where = parse_address(address)
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
    """Answer one connection; an error ends this conversation only."""
    try:
        with connection, connection.makefile("rb") as reader, connection.makefile("wb") as writer:
            serve(reader, writer, name)
    except (OSError, processes.WireError) as error:
        _log.warning("a conversation ended: %s", error)
    except Exception:
        _log.exception("a conversation ended")


# What runs in a process of its own for an odometry, see `adaptune.processes`.


def load(name: str) -> None:
    """Import the odometry."""
    odometry_class(name)


def converse(name: str) -> processes.Answer:
    """Be an instance."""
    return wire.conversation(name, make_here)


def describe(name: str) -> processes.Answer:
    """Answer what `adaptune.odometry.registry.declare` asks."""

    def answer(message: processes.Message) -> dict[str, Any]:
        folder = message.header["folder"]
        found = declare_here(name, message.header["settings"], Path(folder) if folder else None)
        described = found.description
        assert described is not None  # it is a class
        return {
            **described._asdict(),
            **wire.about(described),
            "settings": found.settings and found.settings.model_dump(mode="json"),
            "mistakes": [[list(mistake.key), mistake.message] for mistake in found.mistakes],
        }

    return answer
