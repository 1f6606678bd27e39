"""What becomes of a parameter set on its way into a ROS 1 system."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any

from adaptune.errors import OdometryError
from adaptune.odometry.template import Template
from adaptune.ros.ros1 import Ros1
from adaptune.ros.steering import equal_values
from adaptune.space import ParameterSet

_log = logging.getLogger(__name__)


def server_keys(
    template: Template, parameters: ParameterSet, held: Any
) -> Mapping[str, Sequence[str]]:
    """Keys of the parameter server that hold each parameter, by its whole name.

    `held` is all that the server holds. There is an `OdometryError` if it does not hold a
    parameter that was put into the template, or another value.
    """
    every = dict(_flat(held))
    keys = {}
    for name, value in parameters.items():
        whole = "/".join(template.path_of(name))
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
