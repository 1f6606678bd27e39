"""What runs in a process of its own for an odometry, see `adaptune.processes`."""

from pathlib import Path
from typing import Any

from adaptune import processes
from adaptune.odometry import wire
from adaptune.odometry.registry import declare_here, make_here, odometry_class


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
            "mistakes": [[list(mistake.where), mistake.what] for mistake in found.mistakes],
        }

    return answer
