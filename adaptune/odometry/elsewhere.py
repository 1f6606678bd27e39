"""What runs in a process of its own for an odometry, see `adaptune.hosting`."""

from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from adaptune import hosting
from adaptune.odometry import member_process, wire
from adaptune.odometry.declaration import declare_here
from adaptune.odometry.registry import odometry_class


def load(name: str) -> None:
    """Import the odometry."""
    odometry_class(name)


def converse(reader: wire.Readable, writer: BinaryIO, name: str) -> None:
    """Be an instance."""
    wire.serve(reader, writer, name)


def members(reader: wire.Readable, writer: BinaryIO, _: str) -> None:
    """Be members of a bank."""
    member_process.serve(reader, writer)


def describe(reader: wire.Readable, writer: BinaryIO, name: str) -> None:
    """Answer what `adaptune.odometry.declaration.declare` asks."""
    hosting.answer_all(reader, writer, partial(_declared, name))


def _declared(name: str, message: wire.Message) -> dict[str, Any]:
    folder = message.header["folder"]
    found = declare_here(name, message.header["settings"], Path(folder) if folder else None)
    described = found.description
    assert described is not None  # it is a class
    return wire.about(described) | {
        "warm_up": list(described.warm_up),
        "whole": described.whole,
        "clean": found.clean,
        "module": found.module,
        "settings": found.settings and found.settings.model_dump(mode="json"),
        "mistakes": [[list(mistake.key), mistake.message] for mistake in found.mistakes],
    }
