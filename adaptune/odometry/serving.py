"""Serve an odometry to other programs over sockets or standard input and output."""

import logging
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from adaptune.odometry import wire
from adaptune.odometry.base import BaseSettings, OdometryError, OdometryInstance
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.isolation import Limits
from adaptune.odometry.process import parse_address
from adaptune.odometry.registry import odometry_class
from adaptune.space import ParameterSet, ParameterSpace

_log = logging.getLogger(__name__)


def serve(reader: wire.Readable, writer: BinaryIO, name: str | None = None) -> None:
    """Do `wire.serve`, but let an odometry that is not clean run in a process of its own."""
    wire.serve(reader, writer, name, _make)


def _make(name: str, parameters: ParameterSet, settings: BaseSettings) -> OdometryInstance:
    return OdometryFactory(name, settings, ParameterSpace({}), Limits())(parameters)


def listen(address: str, name: str, ready: Callable[[str], None]) -> None:
    """Serve an odometry until interrupted, an instance of its own for each connection.

    Parameters
    ----------
    address
        ``tcp://HOST:PORT``, any free port if that is 0, or ``unix:PATH``.
    name
        The odometry.
    ready
        Called with the address when connections are accepted.
    """
    odometry_class(name)
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
    except (OSError, wire.WireError) as error:
        _log.warning("a conversation ended: %s", error)
    except Exception:
        _log.exception("a conversation ended")
