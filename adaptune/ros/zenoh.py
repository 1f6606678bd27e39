"""A robot whose ROS 2 runs on Zenoh (rmw_zenoh), reached without an installation of ROS 2."""

import contextlib
import itertools
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from types import ModuleType
from typing import Any

from adaptune.errors import import_extra
from adaptune.ros.link import LinkError, take_all
from adaptune.ros.ros2 import ANSWER, DEFINITIONS, NODE, Ros2Link, Service, full

_CONNECT = 2.0
"""Seconds in which a router must answer."""
_WAITING = 10_000
"""Messages of a topic that may wait to be taken; with more, all else waits, too."""
_USED = ("ListParametersResult", "Parameter", "ParameterValue", "SetParametersResult")
"""The messages that services of parameters use."""


class ZenohLink(Ros2Link):
    """A `RosLink` to a robot whose ROS 2 runs on rmw_zenoh.

    It is a client of the robot's router. A router passes messages on to its clients, which may be
    on any machine; the nodes on the robot reach each other without it. There is a `LinkError` if
    no router answers.

    The robot's Zenoh router is named as ``host:port``, or as Zenoh writes it (``tls/host:port``).
    """

    def __init__(self, router: str, domain: int | None = None):
        super().__init__(domain)
        self._zenoh, self._keys, self._entity, self._qos, self._attachment, self._utils = (
            _packages()
        )
        place = router if "/" in router else f"tcp/{router}"
        self._session = _session(self._zenoh, place)
        self._node = self._entity.NodeEntity(
            self.domain, str(self._session.zid()), node_id=0, node_name=NODE
        )
        self._numbers = itertools.count(1)
        token = self._keys.node_liveliness_keyexpr(self._node)
        self._kept: list[Any] = [self._session.liveliness().declare_token(token)]

    def subscribe(
        self, topic: str, kind: str, take: Callable[[Any], None], raw: bool = False
    ) -> None:
        """See `RosLink.subscribe`; an error in `take` is logged, and the next message is taken.

        There is a `LinkError` if the topic is published with another type than this as known here.
        """
        # What would never bring a message: its place depends on the type's hash.
        known = kind, self._hash(topic, kind)
        there = [token[1:] for token in self._tokens("PUBLISHER") if token[0] == full(topic)]
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
        samples = (sample.payload.to_bytes() for sample in subscriber if not self._closed)
        self._threads.append(take_all(topic, samples, take if raw else self._reading(kind, take)))

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

    def _ask(self, place: str, service: Service, request: bytes, seconds: float) -> Iterator[Any]:
        definitions = DEFINITIONS[service.name]
        texts = {f"rcl_interfaces/msg/{name}": "" for name in _USED}
        for name in texts:
            text, _ = self.store.generate_msgdef(name, ros_version=2)
            texts[name] = text.partition("=" * 80)[0]
        type_hash = self._utils.compute_service_type_hash(service.kind, *definitions, texts)
        key = self._keys.topic_keyexpr(self.domain, place, self._dds(service.kind), type_hash)
        with self._naming(key):
            replies = self._session.get(
                key,
                payload=request,
                encoding="application/cdr",
                attachment=self._attachments()(),
                target=self._zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=self._zenoh.ConsolidationMode.NONE,
                timeout=seconds,
            )
        return (reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None)

    def _places(self) -> list[str]:
        return sorted({name for name, *_ in self._tokens("SERVICE")})

    def topics(self) -> Mapping[str, str]:
        return {name: kind for name, kind, _ in self._tokens("PUBLISHER")}

    def _tokens(self, kind: str) -> list[tuple[str, str, str]]:
        """Names, types and their hashes of what there is: nodes keep a token for each of theirs."""
        utils, space = self._utils, self._keys.ADMIN_SPACE
        kind = self._entity.EntityKind[kind].value
        pattern = f"{space}/{self.domain}/*/*/*/{kind}/**"
        with self._naming(pattern):
            replies = self._session.liveliness().get(pattern, timeout=ANSWER)
        keys = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]
        # These follow the enclave, the namespace and the node's name.
        return sorted(
            (utils.demangle_name(key[9]), utils.dds_to_ros_type(key[10]), key[11])
            for key in keys
            if len(key) > 11
        )

    def _leave(self) -> None:
        self._session.close()
        self._kept = []

    def _key(self, topic: str, kind: str) -> str:
        """Where a topic's messages pass."""
        dds, type_hash = self._dds(kind), self._hash(topic, kind)
        return str(self._keys.topic_keyexpr(self.domain, full(topic), dds, type_hash))

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
                name=full(topic),
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
    return import_extra("ros2", "zenoh", *(f"zenoh_ros2_sdk.{name}" for name in names))


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
