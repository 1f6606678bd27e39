"""Parameters of a node that somebody else wrote, set while it runs."""

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from adaptune.errors import OdometryError
from adaptune.space import ParameterSet

_log = logging.getLogger(__name__)

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
    """Sets parameters of a node, through ROS, or by a `SetCommand` that `run` runs."""

    def __init__(
        self,
        node: str,
        set_parameters: Callable[[ParameterSet], Mapping[str, Any]],
        command: Sequence[str] | None,
        run: Run | None,
    ):
        self._node, self._set_parameters = node, set_parameters
        self._command, self._run = command, run
        self._warned_of: set[str] = set()

    def apply(self, parameters: ParameterSet) -> None:
        """Set the parameters, and make sure that the node holds them where it tells.

        There is an `OdometryError` if it holds others or is not reached, a `LinkError` if it
        refuses.
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
        if held:
            _say_that_it_holds(self._node)

    def _warn(self, name: str) -> None:
        if name not in self._warned_of:
            self._warned_of.add(name)
            what = "%s does not report whether %s, which was set, applies before it starts again"
            _log.warning(what, self._node, name)

    def _set(self, command: Sequence[str], name: str, value: Any) -> None:
        text = _text(value)
        arguments = [
            argument.replace("{node}", self._node).replace("{name}", name).replace("{value}", text)
            for argument in command
        ]
        assert self._run is not None
        code, written = self._run(arguments)
        if code:
            words = " | ".join(written.split("\n")[-4:]).strip(" |")
            raise OdometryError(f"{' '.join(arguments)}: exit code {code}: {words}")


@cache
def _say_that_it_holds(node: str) -> None:
    _log.info("%s holds what is set; a node that reads it only at its start does not tell", node)


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
