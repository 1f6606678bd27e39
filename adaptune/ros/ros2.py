"""A robot whose ROS 2 runs on Zenoh (rmw_zenoh), reached without an installation of ROS 2."""

import contextlib
import itertools
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from adaptune.errors import NotInstalledError, import_extra
from adaptune.recording import clouds
from adaptune.ros.link import LinkError, take_all

_CONNECT, _ANSWER = 2.0, 2.0
"""Seconds in which a router, and a service, must answer."""
_PAUSE = 0.05
"""Seconds between calls of a service that is not there, or not yet."""
_WAITING = 10_000
"""Messages of a topic that may wait to be taken; with more, all else waits, too."""
_NODE = "adaptune"

_DEFINITIONS = {
    "SetParameters": (
        "rcl_interfaces/Parameter[] parameters",
        "rcl_interfaces/SetParametersResult[] results",
    ),
    "GetParameters": ("string[] names", "rcl_interfaces/ParameterValue[] values"),
}
"""Requests and responses of services, which are not among the types of rosbags."""
_USED = ("Parameter", "ParameterValue", "SetParametersResult")
"""The messages that these services use."""
_FIELDS = {bool: "bool_value", int: "integer_value", float: "double_value", str: "string_value"}
"""Where a parameter's value is, in the order of rcl_interfaces/msg/ParameterType, from 1 on."""
_ARRAYS = {"byte": np.uint8, "bool": np.bool_, "integer": np.int64, "double": np.float64}
"""The arrays that a parameter's value has besides, which stay empty."""


class _Service(NamedTuple):
    """A type of service, and the names of its messages in the store."""

    kind: str
    type_hash: str
    request: str
    response: str


class Ros2:
    """A `RosLink` to a robot whose ROS 2 runs on rmw_zenoh.

    It is a client of the robot's router. A router passes messages on to its clients, which may be
    on any machine; the nodes on the robot reach each other without it. There is a `LinkError` if
    the extra ``ros2`` is not installed, or no router answers.

    The robot's Zenoh router is named as ``host:port``, or as Zenoh writes it (``tls/host:port``).
    Where no ROS domain is given, it is that of the environment (``ROS_DOMAIN_ID``), or 0.
    """

    def __init__(self, router: str, domain: int | None = None):
        self._zenoh, self._keys, self._entity, self._qos, self._attachment, self._utils = (
            _packages()
        )
        try:
            self._domain = self._utils.resolve_domain_id(domain)
        except ValueError as error:
            raise LinkError(f"the ROS domain: {error}") from error
        self.store = message_types()
        self._services = {name: _service(self.store, self._utils, name) for name in _DEFINITIONS}
        place = router if "/" in router else f"tcp/{router}"
        self._session = _session(self._zenoh, place)
        self._node = self._entity.NodeEntity(
            self._domain, str(self._session.zid()), node_id=0, node_name=_NODE
        )
        self._numbers, self._closed = itertools.count(1), False
        token = self._keys.node_liveliness_keyexpr(self._node)
        self._kept: list[Any] = [self._session.liveliness().declare_token(token)]
        self._threads: list[threading.Thread] = []

    is2 = True

    def subscribe(
        self, topic: str, kind: str, take: Callable[[Any], None], raw: bool = False
    ) -> None:
        """See `RosLink.subscribe`; an error in `take` is logged, and the next message is taken.

        There is a `LinkError` if the topic is published with another type than this as known here.
        """
        # What would never bring a message: its place depends on the type's hash.
        known = kind, self._hash(topic, kind)
        there = [token[1:] for token in self._tokens("PUBLISHER") if token[0] == _full(topic)]
        if there and known not in there:
            raise LinkError(
                f"{topic} is published as {there[0][0]} with the type hash {there[0][1]}, not as "
                f"{kind} with {known[1]}; known are the types of ROS 2 Jazzy"
            )
        with self._naming(topic):
            channel = self._zenoh.handlers.FifoChannel(_WAITING)
            subscriber = self._session.declare_subscriber(self._key(topic, kind), channel)
            self._announce("SUBSCRIPTION", topic, kind)
        self._kept.append(subscriber)
        samples = (sample for sample in subscriber if not self._closed)
        payloads = (sample.payload for sample in samples)
        take_one = lambda p: take(p.to_bytes() if raw else self._message(p, kind))  # noqa: E731
        self._threads.append(take_all(topic, payloads, take_one))

    def _message(self, payload: Any, kind: str) -> Any:
        """A message; its arrays are views of the bytes that came."""
        return self.store.deserialize_cdr(memoryview(payload.to_bytes()), kind)

    def advertise(self, topic: str, kind: str) -> Callable[[Any], None]:
        with self._naming(topic):
            publisher = self._session.declare_publisher(
                self._key(topic, kind), encoding="application/cdr"
            )
            self._announce("PUBLISHER", topic, kind)
        self._kept.append(publisher)
        attached = self._attachments()

        def publish(message: Any) -> None:
            raw = self.store.serialize_cdr(message, kind)
            with self._naming(topic):
                publisher.put(bytes(raw), attachment=attached())

        return publish

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """See `RosLink.set_parameters`; what the node does not tell is as given.

        If it refuses a value, it may hold the other values then.
        """
        node = _full(node)
        given = [_parameter(self.store, name, value) for name, value in values.items()]
        results = self._call(node, "SetParameters", parameters=given).results
        if refused := [
            f"{name} = {value!r} ({result.reason or 'without a reason'})"
            for (name, value), result in zip(values.items(), results, strict=True)
            if not result.successful
        ]:
            raise LinkError(f"{node} refuses {', '.join(refused)}")
        told = self._call(node, "GetParameters", names=list(values)).values
        fields = dict(enumerate(_FIELDS.values(), 1))
        held = zip(values, told, strict=False)  # none, where a node does not tell
        return dict(values) | {
            name: getattr(value, fields[value.type]) for name, value in held if value.type in fields
        }

    def _call(self, node: str, name: str, **fields: Any) -> Any:
        """Call a service of a node, as soon as there is such a one."""
        service = self._services[name]
        place = f"{node}/{'set' if name == 'SetParameters' else 'get'}_parameters"
        request = self.store.types[service.request](**fields)
        key = self._keys.topic_keyexpr(
            self._domain, place, self._dds(service.kind), service.type_hash
        )
        raw = bytes(self.store.serialize_cdr(request, service.request))
        end = time.monotonic() + _ANSWER
        while (left := end - time.monotonic()) > 0:
            for reply in self._ask(key, raw, left):
                if reply.ok is not None:
                    return self._message(reply.ok.payload, service.response)
            time.sleep(_PAUSE)
        services = sorted({name for name, *_ in self._tokens("SERVICE")})
        raise LinkError(
            f"{node} does not answer: {place} in ROS domain {self._domain}; the services there are "
            f"{', '.join(services) or 'none'}"
        )

    def _ask(self, key: str, request: bytes, seconds: float) -> Any:
        """Send a request; the replies, which end at once if nobody is there."""
        with self._naming(key):
            return self._session.get(
                key,
                payload=request,
                encoding="application/cdr",
                attachment=self._attachments()(),
                target=self._zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=self._zenoh.ConsolidationMode.NONE,
                timeout=seconds,
            )

    def topics(self) -> Mapping[str, str]:
        return {name: kind for name, kind, _ in self._tokens("PUBLISHER")}

    def _tokens(self, kind: str) -> list[tuple[str, str, str]]:
        """Names, types and their hashes of what there is: nodes keep a token for each of theirs."""
        utils, space = self._utils, self._keys.ADMIN_SPACE
        kind = self._entity.EntityKind[kind].value
        pattern = f"{space}/{self._domain}/*/*/*/{kind}/**"
        with self._naming(pattern):
            replies = self._session.liveliness().get(pattern, timeout=_ANSWER)
        keys = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]
        # These follow the enclave, the namespace and the node's name.
        return sorted(
            (utils.demangle_name(key[9]), utils.dds_to_ros_type(key[10]), key[11])
            for key in keys
            if len(key) > 11
        )

    @property
    def alive(self) -> bool:
        """See `RosLink.alive`; where the router has gone, it may come back."""
        return not self._closed

    def close(self) -> None:
        """Leave; messages that wait to be taken are dropped."""
        self._closed = True
        self._session.close()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(_ANSWER)
        self._threads, self._kept = [], []

    def _key(self, topic: str, kind: str) -> str:
        """Where a topic's messages pass."""
        dds, type_hash = self._dds(kind), self._hash(topic, kind)
        return str(self._keys.topic_keyexpr(self._domain, _full(topic), dds, type_hash))

    def _dds(self, kind: str) -> str:
        return str(self._utils.ros2_to_dds_type(kind))

    def _hash(self, topic: str, kind: str) -> str:
        """What ROS 2 tells versions of a type apart by."""
        if kind not in self.store.types:
            raise LinkError(f"{topic}: the message type {kind} is not known")
        return self.store.hash_rihs01(kind)

    def _announce(self, entity: str, topic: str, kind: str) -> None:
        """Let the robot's nodes see that a topic is published, or subscribed to."""
        token = self._keys.endpoint_liveliness_keyexpr(
            self._entity.EndpointEntity(
                node=self._node,
                entity_id=next(self._numbers),
                kind=self._entity.EntityKind[entity],
                name=_full(topic),
                dds_type_name=self._dds(kind),
                type_hash=self.store.hash_rihs01(kind),
                qos=self._qos.DEFAULT_QOS_PROFILE.encode(),
            )
        )
        self._kept.append(self._session.liveliness().declare_token(token))

    def _attachments(self) -> Callable[[], bytes]:
        """What goes with each message or call of one sender: its number, its time, and whose."""
        sender, numbers = os.urandom(16), itertools.count(1)
        attachment = self._attachment.Attachment
        return lambda: bytes(attachment(next(numbers), time.time_ns(), sender).to_bytes())

    @contextlib.contextmanager
    def _naming(self, what: str) -> Iterator[None]:
        """Say what Zenoh cannot do, and why."""
        try:
            yield
        except self._zenoh.ZError as error:
            raise LinkError(f"{what}: {error}") from error


def _packages() -> tuple[Any, ...]:
    """What the extra installs: Zenoh, and how rmw_zenoh names and describes things."""
    # A module of the package wants git, to download messages; they are not downloaded here.
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
    names = ("keyexpr", "entity", "qos", "attachment", "utils")
    try:
        return import_extra("ros2", "zenoh", *(f"zenoh_ros2_sdk.{name}" for name in names))
    except NotInstalledError as error:
        raise LinkError(str(error)) from error


def message_types() -> Typestore:
    """The messages of ROS 2 Jazzy, and those of Livox LiDARs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in clouds.DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def _service(store: Typestore, utils: ModuleType, name: str) -> _Service:
    """Register the messages of a service."""
    kind, definitions = f"rcl_interfaces/srv/{name}", _DEFINITIONS[name]
    names = []
    for part, text in zip(("Request", "Response"), definitions, strict=True):
        types = get_types_from_msg(text, f"{kind}_{part}")
        store.register(types)
        names += list(types)
    used = {f"rcl_interfaces/msg/{message}" for message in _USED}
    texts = {m: store.generate_msgdef(m, ros_version=2)[0].partition("=" * 80)[0] for m in used}
    type_hash = utils.compute_service_type_hash(kind, *definitions, texts)
    return _Service(kind, type_hash, *names)


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


def _session(zenoh: ModuleType, router: str) -> Any:
    """A session as a client of a router."""
    config = zenoh.Config()
    given = {
        "mode": "client",
        "connect/endpoints": [router],
        "connect/timeout_ms": round(1e3 * _CONNECT),
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        # It leaves files in /dev/shm.
        "transport/shared_memory/enabled": False,
    }
    try:
        for name, value in given.items():
            config.insert_json5(name, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        # Where in Zenoh's own code that was, helps nobody.
        why = str(error).split(" at /")[0].rstrip("!. ")
        raise LinkError(
            f"no Zenoh router answers at {router}: run `ros2 run rmw_zenoh_cpp rmw_zenohd` on the "
            f"robot, which listens on port 7447, and check the address ({why})"
        ) from error


def _full(name: str) -> str:
    """A name of a topic or node with its leading slash."""
    return f"/{name.strip('/')}"
