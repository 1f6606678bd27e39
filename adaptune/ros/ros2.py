"""What ROS 2 is told and asked, whatever carries its messages: names, types, parameters."""

import os
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from adaptune.errors import import_extra
from adaptune.recording import clouds
from adaptune.ros.link import LinkError

if TYPE_CHECKING:
    from adaptune.ros.dds import DdsLink

RECEIVE_BUFFER = 1 << 22  # bytes of a receive buffer that hold some clouds
BUFFER_CURE = f"sudo sysctl -w net.core.rmem_default={RECEIVE_BUFFER}"
"""What lets nodes on Fast DDS have it."""
_MAX_DOMAIN = 232
_DEFINITIONS = {
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
PLACES = {
    "SetParameters": "set_parameters",
    "GetParameters": "get_parameters",
    "ListParameters": "list_parameters",
}
"""Where a node serves them, below its name."""
FIELDS = {bool: "bool_value", int: "integer_value", float: "double_value", str: "string_value"}
"""Where a parameter's value is, in the order of rcl_interfaces/msg/ParameterType, from 1 on."""
_ARRAY_TYPES = {"byte": np.uint8, "bool": np.bool_, "integer": np.int64, "double": np.float64}
"""The arrays that a parameter's value has besides, which stay empty."""


class Service(NamedTuple):
    """The names of a service's messages in the store."""

    request: str
    response: str


def local_ros2() -> "DdsLink":
    """A node in the ROS 2 of the environment, over DDS; a `LinkError` if that is not allowed."""
    (dds,) = import_extra("ros2", "adaptune.ros.dds")
    link: DdsLink = dds.DdsLink()
    link.topics()  # so that others are known
    return link


def ros_domain() -> int:
    """The ROS domain of the environment (``ROS_DOMAIN_ID``), or 0."""
    domain = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not domain.isdecimal() or not 0 <= int(domain) <= _MAX_DOMAIN:
        raise LinkError(f"ROS_DOMAIN_ID is {domain}; it is a number from 0 to {_MAX_DOMAIN}")
    return int(domain)


def message_types() -> Typestore:
    """The messages of ROS 2 Jazzy, and those of Livox LiDARs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in clouds.DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def register_service(store: Typestore, name: str) -> Service:
    """Register the messages of a service."""
    names: list[str] = []
    for part, text in zip(("Request", "Response"), _DEFINITIONS[name], strict=True):
        types = get_types_from_msg(text, f"rcl_interfaces/srv/{name}_{part}")
        store.register(types)
        names += types
    return Service(*names)


def parameter_message(store: Typestore, name: str, value: Any) -> Any:
    """A message with a parameter, whose type is that of the value."""
    plain = value.item() if hasattr(value, "item") else value  # numpy's, too
    if type(plain) not in FIELDS:
        raise LinkError(f"{name} = {value!r} is not a boolean, a number or a text")
    fields: dict[str, Any] = {field: kind() for kind, field in FIELDS.items()}
    fields |= {f"{name}_array_value": np.empty(0, kind) for name, kind in _ARRAY_TYPES.items()}
    fields["string_array_value"] = []
    fields |= {"type": 1 + list(FIELDS).index(type(plain)), FIELDS[type(plain)]: plain}
    held = store.types["rcl_interfaces/msg/ParameterValue"](**fields)
    return store.types["rcl_interfaces/msg/Parameter"](name=name, value=held)


def full(name: str) -> str:
    """A name of a topic or node with its leading slash."""
    return f"/{name.strip('/')}"
