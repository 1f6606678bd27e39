"""What becomes of a parameter set on its way into a ROS 1 system."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from adaptune.odometry.base import OdometryError
from adaptune.odometry.template import Template
from adaptune.ros.ros1 import Ros1
from adaptune.ros.steering import equal_values
from adaptune.space import ParameterSet

_log = logging.getLogger(__name__)


def server_keys(
    template: Template, parameters: ParameterSet, held: Any
) -> Mapping[str, Sequence[str]]:
    """Keys of the parameter server that hold each parameter, by its whole name.

    Parameters
    ----------
    template
        The system's parameter file.
    parameters
        What was put into it.
    held
        All that the parameter server holds.

    Raises
    ------
    OdometryError
        If it does not hold a parameter, or another value.
    """
    every = dict(_flat(held))
    keys = {}
    for name, value in parameters.items():
        whole = whole_name(template, name)
        keys[whole] = [key for key in every if key.endswith(f"/{whole}")]
        if not keys[whole]:
            raise OdometryError(
                f"the parameter server holds no {whole}: the launch file does not load "
                f"/rustle/config/params.yaml"
            )
        for key in keys[whole]:
            if not equal_values(value, every[key]):
                what = f"{key} is {every[key]!r} on the parameter server, not {value!r}"
                help_ = "the launch file, or the node, has changed it: is it in the node's range?"
                raise OdometryError(f"{what}: {help_}")
    return keys


def whole_name(template: Template, name: str) -> str:
    """All keys of a parameter, with slashes between them, as ROS has them."""
    return "/".join(template.path_of(name))


def warn_of_unread(link: Ros1, image: str, keys: Mapping[str, Sequence[str]]) -> None:
    """Log, once for an image, which parameters no node has ever asked for."""
    asked = {
        key.rstrip("/")
        for caller, those in link.ask("asked").items()
        if not caller.startswith(("/roslaunch", "/rosparam", "/adaptune"))
        for key in those
    }
    for name, places in keys.items():
        # A node may ask for all that is below a name.
        above = {place[:i] for place in places for i, c in enumerate(place) if c == "/"}
        if not asked & (above | set(places)):
            _warn(image, name)


@cache
def _warn(image: str, name: str) -> None:
    _log.warning(
        "%s: no node has read the parameter %s, so its value changes nothing; is its name in the "
        "template right?",
        image,
        name,
    )


def _flat(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(data, dict):
        for name, value in data.items():
            yield from _flat(value, f"{key}/{name}")
    else:
        yield key, data


def filled(settings: Any, parameters: ParameterSet) -> tuple[Template, str]:
    """The template, and its text with the parameters."""
    template = Template(Path(settings.template))
    return template, template.fill(parameters)
