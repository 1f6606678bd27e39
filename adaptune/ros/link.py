"""What carries messages between adaptune and a robot: ROS 1, or ROS 2."""

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import numpy as np
from pydantic import AfterValidator, Field

from adaptune.errors import AdaptuneError, OdometryError, in_a_line
from adaptune.space import ParameterSet

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


class LinkError(AdaptuneError):
    """A robot that cannot be reached, or that refuses what is asked of it."""


class RosLink(Protocol):
    """A node of adaptune's in a robot's ROS.

    Messages are those of `store`, by names such as ``sensor_msgs/msg/PointCloud2`` in ROS 1, too.
    Every method may be called from any thread.
    """

    store: "Typestore"  # the types of all messages
    is2: bool  # whether messages are serialised as in ROS 2

    def subscribe(
        self, topic: str, kind: str, take: Callable[[Any], None], raw: bool = False
    ) -> None:
        """Have every message of a topic taken, one after the other, in a thread of its own.

        With `raw`, they are taken as bytes, as they are serialised.
        """

    def advertise(self, topic: str, kind: str) -> Callable[[Any], None]:
        """Announce a topic; what is returned publishes a message on it."""

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Set parameters of another node; what it then holds, as far as it tells.

        There is a LinkError if the node is not there, does not answer, or refuses a value.
        """

    def topics(self) -> Mapping[str, str]:
        """The topics that somebody publishes now, and their types."""

    def why_unheard(self, topic: str) -> str:
        """Why others may get no messages of a topic, in words; empty where nothing is known."""

    @property
    def alive(self) -> bool:
        """Whether messages still pass."""

    def close(self) -> None:
        """Leave."""


_log = logging.getLogger(__name__)


def take_all(topic: str, messages: Iterable[Any], take: Callable[[Any], None]) -> threading.Thread:
    """Take message after message of a topic in a thread of its own, until they end."""

    def work() -> None:
        for message in messages:
            with telling(topic):
                take(message)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


@contextmanager
def telling(topic: str) -> Iterator[None]:
    """Log what goes wrong with a message."""
    try:
        yield
    except Exception as error:
        _log.warning("a message on %s is lost: %s", topic, in_a_line(error))


# Parameters of a node that somebody else wrote, set while it runs.

Run = Callable[[list[str]], tuple[int, str]]
"""Runs a command; its exit code, and what it wrote."""


def _names_both(command: tuple[str, ...]) -> tuple[str, ...]:
    words = " ".join(command)
    if lacking := [key for key in ("{name}", "{value}") if key not in words]:
        raise ValueError(f"names no {' and no '.join(lacking)} in its arguments")
    return command


SetCommand = Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(_names_both)]
"""A program that sets a parameter, and its arguments, with ``{node}``, ``{name}``, ``{value}``."""


class Steering:
    """Sets parameters of a node, through ROS, or by a program that `run` runs in place of it.

    The command is the program and its arguments, with ``{node}``, ``{name}`` and ``{value}``.
    """

    def __init__(
        self,
        node: str,
        set_parameters: Callable[[ParameterSet], Mapping[str, Any]],
        command: Sequence[str] | None,
        run: Run | None,
    ):
        self._node, self._set_parameters = node, set_parameters
        self._command, self._run = command, run
        self._told: set[str] = set()
        self._holds = False

    def apply(self, parameters: ParameterSet) -> None:
        """Set the parameters, and make sure that the node holds them where it tells.

        There is an `OdometryError` if it cannot be reached or holds other values, and a `LinkError`
        if it refuses them.
        """
        if self._command is not None:
            for name, value in parameters.items():
                self._set(self._command, name, value)
            return
        held = self._set_parameters(parameters)
        for name, value in parameters.items():
            if name not in held:
                self._warn(name)
            elif not equal_values(value, held[name]):
                raise OdometryError(f"{self._node} holds {name} = {held[name]}")
        if held and not self._holds:
            self._holds = True
            what = "%s holds what is set; a node that reads it only at its start does not tell"
            _log.info(what, self._node)

    def _warn(self, name: str) -> None:
        if name not in self._told:
            self._told.add(name)
            what = "%s: nobody says whether %s takes effect before the node starts again"
            _log.warning(what, self._node, name)

    def _set(self, command: Sequence[str], name: str, value: Any) -> None:
        values = {"{node}": self._node, "{name}": name, "{value}": _text(value)}
        arguments = []
        for argument in command:
            for key, text in values.items():
                argument = argument.replace(key, text)  # noqa: PLW2901
            arguments.append(argument)
        assert self._run is not None
        code, written = self._run(arguments)
        if code:
            words = " | ".join(written.split("\n")[-4:]).strip(" |")
            raise OdometryError(f"{' '.join(arguments)}: exit code {code}: {words}")


def equal_values(wanted: Any, held: Any) -> bool:
    """Whether a node holds what was set, but for the rounding of real numbers."""
    if isinstance(wanted, bool) or isinstance(held, bool):
        return bool(wanted is held)
    if isinstance(wanted, float) and isinstance(held, int | float):
        return bool(np.isclose(wanted, held, rtol=1e-5, atol=1e-9))
    return bool(wanted == held)


def _text(value: Any) -> str:
    # `1e-05` is a text to some readers of YAML, and `True` to others.
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return np.format_float_positional(value, trim="0")
    return str(value)
