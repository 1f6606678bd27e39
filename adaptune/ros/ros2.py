"""What all links to ROS 2 share: names, types of messages, and parameters of other nodes."""

import contextlib
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from adaptune.errors import import_extra, nearest
from adaptune.recording import clouds
from adaptune.ros.link import LinkError, RosLink

NODE = "adaptune"
ANSWER = 2.0
"""Seconds in which a service must answer."""
_PAUSE = 0.02
"""Seconds between calls of a service that is not there, or not yet."""
_MAX_DOMAIN = 232

DEFINITIONS = {
    "SetParameters": (
        "rcl_interfaces/Parameter[] parameters",
        "rcl_interfaces/SetParametersResult[] results",
    ),
    "GetParameters": ("string[] names", "rcl_interfaces/ParameterValue[] values"),
    "ListParameters": (
        "string[] prefixes\nuint64 depth",
        "rcl_interfaces/ListParametersResult result",
    ),
}
"""Requests and responses of services, which are not among the types of rosbags."""
_FIELDS = {bool: "bool_value", int: "integer_value", float: "double_value", str: "string_value"}
"""Where a parameter's value is, in the order of rcl_interfaces/msg/ParameterType, from 1 on."""
_ARRAYS = {"byte": np.uint8, "bool": np.bool_, "integer": np.int64, "double": np.float64}
"""The arrays that a parameter's value has besides, which stay empty."""


class Service(NamedTuple):
    """A service by its name in rcl_interfaces, and the names of its messages in the store."""

    name: str
    request: str
    response: str

    @property
    def kind(self) -> str:
        return f"rcl_interfaces/srv/{self.name}"


class Ros2Link(RosLink, ABC):
    """A `RosLink` to ROS 2, whatever carries its messages.

    `domain` is the ROS domain; where none is given, that of the environment.
    """

    is2 = True
    _discovery = 0.0
    """Seconds in which other nodes are found."""

    def __init__(self, domain: int | None = None):
        self.domain = ros_domain() if domain is None else _checked(domain, "the ROS domain")
        self.store = message_types()
        self._services = {name: _service(self.store, name) for name in DEFINITIONS}
        self._calling = threading.Lock()
        self._joined = time.monotonic()
        self._closed = False
        self._threads: list[threading.Thread] = []

    @property
    def alive(self) -> bool:
        """See `RosLink.alive`; whoever has gone may come back."""
        return not self._closed

    def close(self) -> None:
        """Leave; messages that wait to be taken are dropped."""
        self._closed = True
        self._leave()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(ANSWER)
        self._threads = []

    @abstractmethod
    def _leave(self) -> None:
        """End what receives messages."""

    def _reading(self, kind: str, take: Callable[[Any], None]) -> Callable[[bytes], None]:
        """Take messages of a type by their bytes; arrays are views of them."""
        return lambda data: take(self.store.deserialize_cdr(memoryview(data), kind))

    def why_unheard(self, topic: str) -> str:  # noqa: ARG002
        return ""

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """See `RosLink.set_parameters`; what the node does not tell is as given.

        If it refuses a value, it may hold the other values then.
        """
        node = full(node)
        given = [_parameter(self.store, name, value) for name, value in values.items()]
        results = self._call(node, "SetParameters", len(given), parameters=given).results
        if refused := [
            f"{name} = {value!r} ({result.reason or 'without a reason'})"
            for (name, value), result in zip(values.items(), results, strict=False)
            if not result.successful
        ]:
            raise LinkError(f"{node} refuses {', '.join(refused)}{self._lacking(node, values)}")
        return dict(values) | self._held(node, list(values))

    def parameters(self, node: str) -> Mapping[str, Any]:
        """The parameters that a node declares, and what it holds; arrays and empty ones left out.

        There is a LinkError if the node is not there or does not answer.
        """
        return self._held(full(node), self._declared(full(node)))

    def _declared(self, node: str) -> list[str]:
        names = self._call(node, "ListParameters", None, prefixes=[], depth=0).result.names
        return sorted(names)

    def _held(self, node: str, names: list[str]) -> dict[str, Any]:
        told = self._call(node, "GetParameters", len(names), names=names).values
        fields = dict(enumerate(_FIELDS.values(), 1))
        held = zip(names, told, strict=False)  # none, where a node does not tell
        return {n: getattr(value, fields[value.type]) for n, value in held if value.type in fields}

    def _lacking(self, node: str, names: Iterable[str]) -> str:
        """In words, which parameters a node does not declare, as far as it tells."""
        with contextlib.suppress(LinkError):
            declared = self._declared(node)
            if lacking := [name for name in names if declared and name not in declared]:
                return f"; it declares no {lacking[0]}: {nearest(lacking[0], declared)}"
        return ""

    def _call(self, node: str, name: str, n: int | None, **fields: Any) -> Any:
        """Call a service of a node, as soon as there is such a one; `n` values are expected.

        Who calls may get the answer to another caller, which has as many values only by chance.
        """
        service = self._services[name]
        place = f"{node}/{name.removesuffix('Parameters').lower()}_parameters"
        request = self.store.types[service.request](**fields)
        raw = bytes(self.store.serialize_cdr(request, service.request))
        response = None
        with self._calling:
            end = max(time.monotonic(), self._joined + self._discovery) + ANSWER
            while (left := end - time.monotonic()) > 0:
                for reply in self._ask(place, service, raw, left):
                    with contextlib.suppress(Exception):  # it answers another request
                        response = self.store.deserialize_cdr(reply, service.response)
                        if n is None or len(next(iter(vars(response).values()))) == n:
                            return response
                time.sleep(_PAUSE)
        if response is not None:
            return response
        services = self._places()
        raise LinkError(
            f"{node} does not answer: {place} in ROS domain {self.domain}; the services there are "
            f"{', '.join(services) or 'none'}"
        )

    @abstractmethod
    def _ask(self, place: str, service: Service, request: bytes, seconds: float) -> Iterable[Any]:
        """Send a request; the replies' bytes, which end at once if nobody is there."""

    @abstractmethod
    def _places(self) -> list[str]:
        """The services that there are, sorted."""


def ros2_link(router: str | None = None) -> Ros2Link:
    """A node in the ROS 2 of the environment: over DDS, or Zenoh where its router is named.

    There is a `LinkError` if the extra ``ros2`` is not installed, or the robot is out of reach.
    """
    (module,) = import_extra("ros2", f"adaptune.ros.{'zenoh' if router else 'dds'}")
    link: Ros2Link = module.ZenohLink(router) if router else module.DdsLink()
    link.topics()  # so that others are known
    return link


def ros_domain() -> int:
    """The ROS domain of the environment (``ROS_DOMAIN_ID``), or 0."""
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    return _checked(int(text) if text.isdecimal() else text, "ROS_DOMAIN_ID")


def _checked(domain: int | str, name: str) -> int:
    if not isinstance(domain, int) or not 0 <= domain <= _MAX_DOMAIN:
        raise LinkError(f"{name} is {domain}; it is a number from 0 to {_MAX_DOMAIN}")
    return domain


def message_types() -> Typestore:
    """The messages of ROS 2 Jazzy, and those of Livox LiDARs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in clouds.DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def _service(store: Typestore, name: str) -> Service:
    """Register the messages of a service."""
    names: list[str] = []
    for part, text in zip(("Request", "Response"), DEFINITIONS[name], strict=True):
        types = get_types_from_msg(text, f"rcl_interfaces/srv/{name}_{part}")
        store.register(types)
        names += types
    return Service(name, *names)


def _parameter(store: Typestore, name: str, value: Any) -> Any:
    """A message with a parameter, whose type is that of the value."""
    plain = value.item() if hasattr(value, "item") else value  # numpy's, too
    if type(plain) not in _FIELDS:
        raise LinkError(f"{name} = {value!r} is not a boolean, a number or a text")
    fields: dict[str, Any] = {field: of() for of, field in _FIELDS.items()}
    fields |= {f"{name}_array_value": np.empty(0, of) for name, of in _ARRAYS.items()}
    fields["string_array_value"] = []
    fields |= {"type": 1 + list(_FIELDS).index(type(plain)), _FIELDS[type(plain)]: plain}
    held = store.types["rcl_interfaces/msg/ParameterValue"](**fields)
    return store.types["rcl_interfaces/msg/Parameter"](name=name, value=held)


def full(name: str) -> str:
    """A name of a topic or node with its leading slash."""
    return f"/{name.strip('/')}"
