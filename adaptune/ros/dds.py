"""A robot's ROS 2 over DDS, as it runs by default, reached without an installation of it."""

import contextlib
import itertools
import logging
import os
import random
import socket
import struct
import threading
import time
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from cyclonedds import builtin, core
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from adaptune.errors import nearest
from adaptune.recording.clouds import CLOUDS
from adaptune.ros import ros2
from adaptune.ros.link import BusyError, LinkError, take_all

_ANSWER = 2.0  # seconds in which a service must answer
_DISCOVERY = 1.5  # seconds in which other nodes are found
_AGAIN = 0.5
"""Seconds after which a service is called again: its answer may have had no way back yet."""
_DEPTH = 1000  # messages of a topic that may wait; then the oldest are dropped
_PAUSE = 0.02  # seconds between calls of a service that is not there, or not yet
_CYCLONE, _FAST_DDS = b"\x01\x10", b"\x01\x0f"
"""The vendors of DDS in ROS 2, as they begin the keys of their participants."""
_INFO = "rmw_dds_common/msg/ParticipantEntitiesInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_NEVER: Callable[[], bool] = lambda: False  # noqa: E731
_ANY_STATE = core.ViewState.Any | core.SampleState.Any
_DURABILITIES = tuple(
    getattr(Policy.Durability, name)
    for name in ("Volatile", "TransientLocal", "Transient", "Persistent")
)

_log = logging.getLogger(__name__)

_domains: dict[int, Domain] = {}
"""Those of this process, which joins each once: other threads would not survive its end."""
_joining = threading.Lock()


class Endpoint(NamedTuple):
    """What publishes a topic, or subscribes to it."""

    topic: str
    kind: str
    node: str
    vendor: bytes
    qos: Qos


class DdsLink:
    """A `RosLink` to a robot whose ROS 2 runs on DDS.

    Other nodes are found as in ROS 2 (``ROS_AUTOMATIC_DISCOVERY_RANGE``, ``ROS_STATIC_PEERS``);
    ``CYCLONEDDS_URI`` has the last word. There is a `LinkError` if the network does not allow it.
    """

    is2 = True

    def __init__(self) -> None:
        self.domain = ros2.ros_domain()
        self.store = ros2.message_types()
        self._services = {name: ros2.register_service(self.store, name) for name in ros2.PLACES}
        self._calling, self._closed = threading.Lock(), False
        self._threads: list[threading.Thread] = []
        self._joined = time.monotonic()
        where = f"ROS domain {self.domain}: DDS does not start; see CYCLONEDDS_URI and the network"
        with self._naming(where), _joining:
            if self.domain not in _domains:
                _domains[self.domain] = Domain(self.domain, _configuration())
            me = DomainParticipant(self.domain, Qos(Policy.Userdata(b"enclave=/;")))
            self._participant, self._closing = me, core.GuardCondition(me)
            pair = builtin.BuiltinTopicDcpsPublication, builtin.BuiltinTopicDcpsSubscription
            readers = [builtin.BuiltinDataReader(me, topic) for topic in pair]
            self._found = [
                (r, core.ReadCondition(r, _ANY_STATE | core.InstanceState.Alive)) for r in readers
            ]
            self._kept: list[Any] = []
            self._writers: dict[str, DataWriter] = {}
            self._clients: dict[str, tuple[DataWriter, DataReader]] = {}
            self._answered: set[str] = set()  # services
            self._outdated: Callable[[], bool] = _NEVER  # of the newest parameters
            self._numbers, self._id = itertools.count(1), random.getrandbits(64)
            self._gids: dict[type, list[Any]] = {DataReader: [], DataWriter: []}
            self._nodes: dict[bytes, str] = {}
            self._announcing = threading.Lock()
            self._info = self._end(DataWriter, "ros_discovery_info", _INFO)
            self._infos = self._end(DataReader, "ros_discovery_info", _INFO)
            self._announce()

    def subscribe(
        self, topic: str, kind: str, take: Callable[[Any], None], raw: bool = False
    ) -> None:
        """See `RosLink.subscribe`; an error in `take` is logged, and the next message is taken.

        It is reliable where all who publish are. There is a `LinkError` if the topic is published
        with another type, as far as that is known by now.
        """
        there = self.endpoints(0, topic)
        if there and kind not in {e.kind for e in there}:
            raise LinkError(f"{topic} is published as {there[0].kind}, not as {kind}")
        if kind in CLOUDS and (size := _receive_buffer()) < ros2.RECEIVE_BUFFER:
            what = "%s: clouds may be lost, as this machine receives %d kB ahead; run `sudo sysctl "
            what += "-w net.core.rmem_max=%d` and start again"
            _log.warning(what, topic, size // 1000, ros2.RECEIVE_BUFFER)
        # Arrays are views of the bytes.
        read = lambda data: take(self.store.deserialize_cdr(memoryview(data), kind))  # noqa: E731
        messages = self._taken(topic, kind, self._topic_end(DataReader, topic, kind))
        self._threads.append(take_all(topic, messages, take if raw else read))

    def _taken(self, topic: str, kind: str, reader: DataReader) -> Iterator[bytes]:
        """The bytes of messages as they come, until the link is closed."""
        senders: list[int] = []
        mixed = kind == TRANSFORMS  # as is usual
        for reliable in (True, False):
            for sample in self._waited(reader):
                sender = sample.sample_info.publication_handle
                # A node that starts again is another one, and the first is not heard again.
                if sender in senders[:-1] and not mixed:
                    mixed = True
                    names = sorted({e.node for e in self.endpoints(0, topic)})
                    what = "%s is published by two (%s), whose messages mix; end one of them"
                    _log.warning(what, topic, " and ".join(names))
                if sender not in senders:
                    senders.append(sender)
                yield sample.data
            if reliable and not self._closed:
                # Who publishes is not reliable.
                self._kept.remove(reader)
                reader = self._topic_end(DataReader, topic, kind, reliable=False)

    def _waited(
        self, reader: DataReader, seconds: float = np.inf, over: Callable[[], bool] = _NEVER
    ) -> Iterator[Any]:
        """Samples as they come, until that takes too long, or somebody offers another QoS."""
        ready = core.WaitSet(self._participant)
        for condition in (
            reader,
            self._closing,
            core.ReadCondition(reader, _ANY_STATE | core.InstanceState.Any),
        ):
            ready.attach(condition)
        end, forever = time.monotonic() + seconds, seconds == np.inf
        limit = duration(weeks=9999) if forever else duration(seconds=_PAUSE)
        while (ready.wait(limit) or time.monotonic() < end) and not self._closed and not over():
            yield from (s for s in reader.take(N=_DEPTH) if s.sample_info.valid_data)
            if reader.get_requested_incompatible_qos_status().total_count:
                return

    def advertise(self, topic: str, kind: str, *, raw: bool = False) -> Callable[[Any], None]:
        """See `RosLink.advertise`; with `raw`, messages are given as bytes."""
        self._writers[topic] = self._topic_end(DataWriter, topic, kind)

        def publish(message: Any) -> None:
            data = message if raw else bytes(self.store.serialize_cdr(message, kind))
            with self._naming(topic):
                writer = self._writers[topic]
                writer.write(writer.data_type(data))

        return publish

    def hearers(self, topic: str) -> int:
        """How many subscribers hear what this link publishes on a topic."""
        with self._naming(topic):
            return len(self._writers[topic].get_matched_subscriptions())

    def topics(self) -> Mapping[str, str]:
        """See `RosLink.topics`; a link that is new waits until it can know."""
        time.sleep(max(0.0, self._joined + _DISCOVERY - time.monotonic()))
        return {e.topic: e.kind for e in self.endpoints(0)}

    @property
    def alive(self) -> bool:
        """See `RosLink.alive`; whoever has gone may come back."""
        return not self._closed

    def close(self) -> None:
        """Leave; messages that wait to be taken are dropped."""
        if self._closed:
            return
        self._closed = True
        self._closing.set(True)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(_ANSWER)
        with self._calling:
            # What nobody holds any more takes leave of the others.
            self._kept, self._found, self._threads = [], [], []
            self._writers, self._clients = {}, {}
            del self._participant, self._closing, self._info, self._infos

    def why_unheard(self, topic: str) -> str:
        topic = ros2.full(topic)
        offered, wanted = self.endpoints(0, topic, own=True), self.endpoints(1, topic)
        if not wanted:
            return f"nobody else subscribes to {topic}"
        for end in wanted:
            fitting = [e for e in offered if e.kind == end.kind]
            if offered and not fitting:
                return f"{end.node} subscribes to {topic} as {end.kind}, not {offered[0].kind}"
            lacks = [_lack(e.qos, end.qos) for e in fitting]
            if lacks and all(lacks):
                return f"{end.node} wants {topic} {lacks[0]}, and it is not published so"
        if fast := sorted({e.node for e in wanted if e.vendor == _FAST_DDS}):
            return (
                f"{' and '.join(fast)} runs on Fast DDS, which loses clouds that do not fit in the "
                f"receive buffer: run `{ros2.BUFFER_CURE}` on its machine, and start it again"
            )
        return ""

    def set_parameters(
        self, node: str, values: Mapping[str, Any], outdated: Callable[[], bool] = _NEVER
    ) -> Mapping[str, Any]:
        """See `RosLink.set_parameters`; after a refusal the node may hold the other values."""
        node, self._outdated = ros2.full(node), outdated
        given = [ros2.parameter_message(self.store, name, value) for name, value in values.items()]
        results = self._call(node, "SetParameters", len(given), parameters=given).results
        if refused := [
            f"{name} = {value!r} ({result.reason or 'without a reason'})"
            for (name, value), result in zip(values.items(), results, strict=False)
            if not result.successful
        ]:
            raise LinkError(f"{node} refuses {', '.join(refused)}{self._lacking(node, values)}")
        return dict(values) | self._held(node, list(values))

    def parameters(self, node: str) -> Mapping[str, Any]:
        """What a node declares and holds, arrays left out; a LinkError if it does not answer."""
        return self._held(ros2.full(node), self._declared(ros2.full(node)))

    def nodes(self) -> list[str]:
        """The nodes that serve their parameters."""
        last = "/list_parameters"
        return [place.removesuffix(last) for place in self._places() if place.endswith(last)]

    def meet(self) -> None:
        """Let nodes find who will ask for their parameters, which takes a while."""
        for node in self.nodes():
            for name, service in self._services.items():
                self._client(f"{node}/{ros2.PLACES[name]}", service)

    def _declared(self, node: str) -> list[str]:
        return sorted(self._call(node, "ListParameters", None, prefixes=[], depth=0).result.names)

    def _held(self, node: str, names: list[str]) -> dict[str, Any]:
        values = self._call(node, "GetParameters", len(names), names=names).values
        fields = dict(enumerate(ros2.FIELDS.values(), 1))
        held = zip(names, values, strict=False)  # none, where a node does not tell
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
        asked = self._services[name]
        place = f"{node}/{ros2.PLACES[name]}"
        request = self.store.types[asked.request](**fields)
        raw = bytes(self.store.serialize_cdr(request, asked.request))
        response = None
        with self._calling:
            end = max(time.monotonic(), self._joined + _DISCOVERY) + _ANSWER
            while (left := end - time.monotonic()) > 0 and not self._outdated():
                for reply in self._ask(place, asked, raw, left):
                    with contextlib.suppress(Exception):  # it answers another request
                        response = self.store.deserialize_cdr(reply, asked.response)
                        if n is None or len(next(iter(vars(response).values()))) == n:
                            return response
                time.sleep(_PAUSE)
        if response is not None:
            return response
        services, what = self._places(), f"{node} does not answer: {place} in ROS domain"
        if place in services:
            raise BusyError(f"{what} {self.domain}; it is there, but busy, and may take it later")
        there = f"the services there are {', '.join(services) or 'none'}"
        raise LinkError(f"{what} {self.domain}; {there}")

    def endpoints(
        self, which: int, topic: str | None = None, *, own: bool = False
    ) -> list[Endpoint]:
        """Who publishes topics (0), or subscribes to them (1), or to one; without this link."""
        there = self._others(which, own=own)
        if topic is not None:
            there = [e for e in there if e.topic_name == f"rt{ros2.full(topic)}"]
        self._learn_names()
        return [
            Endpoint(
                e.topic_name[2:],
                e.type_name.replace("::dds_::", "/").replace("::", "/").removesuffix("_"),
                self._nodes.get(e.key.bytes, "a node"),
                e.participant_key.bytes[:2],
                e.qos,
            )
            for e in there
            if e.topic_name.startswith("rt/")
        ]

    def _others(self, which: int, *, own: bool = False) -> list[Any]:
        """All writers (0) or readers (1) that are there now."""
        with self._naming("ROS 2"):
            (reader, alive), me = self._found[which], self._participant.guid
            ends = reader.read(N=10_000, condition=alive)
            return [e for e in ends if own or e.participant_key != me]

    def _learn_names(self) -> None:
        for sample in self._infos.take(N=_DEPTH):
            if sample.sample_info.valid_data:
                with contextlib.suppress(Exception):  # that of another ROS 2 is longer
                    info: Any = self.store.deserialize_cdr(sample.data, _INFO)
                    for node in info.node_entities_info_seq:
                        name = ros2.full(f"{node.node_namespace.rstrip('/')}/{node.node_name}")
                        for gid in (*node.reader_gid_seq, *node.writer_gid_seq):
                            self._nodes[bytes(gid.data)] = name

    def _ask(
        self, place: str, service: ros2.Service, request: bytes, seconds: float
    ) -> Iterator[Any]:
        with self._naming(place):
            writer, reader = self._client(place, service)
            servers = writer.get_matched_subscriptions()
            if not servers or not reader.get_matched_publications():
                return
            server = writer.get_matched_subscription_data(servers[0])
            # Cyclone begins with who asked and which request it was; others do not let us see it.
            cyclone = server is not None and server.participant_key.bytes[:2] == _CYCLONE
            head = struct.pack("<Qq", self._id, next(self._numbers)) if cyclone else b""
            reader.take(N=_DEPTH)
            writer.write(writer.data_type(request[:4] + head + request[4:]))
            # Who has answered once is busy, and needs no second request.
            seconds = seconds if place in self._answered else min(seconds, _AGAIN)
            for sample in self._waited(reader, seconds, self._outdated):
                self._answered.add(place)
                if sample.data[4 : 4 + len(head)] == head:
                    yield sample.data[:4] + sample.data[4 + len(head) :]

    def _client(self, place: str, service: ros2.Service) -> tuple[DataWriter, DataReader]:
        if place not in self._clients:
            asks = self._end(DataWriter, f"rq{place}Request", service.request)
            self._clients[place] = asks, self._end(DataReader, f"rr{place}Reply", service.response)
        return self._clients[place]

    def _places(self) -> list[str]:
        names = {e.topic_name for e in self._others(1)}
        return sorted(n[2:-7] for n in names if n.startswith("rq/"))

    def _topic_end(self, end_type: type, topic: str, kind: str, *, reliable: bool = True) -> Any:
        return self._end(end_type, f"rt{ros2.full(topic)}", kind, reliable=reliable)

    def _end(self, end_type: type, name: str, kind: str, *, reliable: bool = True) -> Any:
        """Make a reader or a writer of a topic, as DDS names it, and announce it."""
        if kind not in self.store.types:
            raise LinkError(f"{name[2:]}: the message type {kind} is not known")
        info, policy = name == "ros_discovery_info", Policy.Reliability
        qos = Qos(
            policy.Reliable(duration(seconds=_ANSWER)) if reliable else policy.BestEffort,
            # What is published once is for those who come later, too.
            _DURABILITIES[info or (name == "rt/tf_static" and reliable)],
            Policy.History.KeepLast(1 if info and end_type is DataWriter else _DEPTH),
            Policy.Userdata(f"typehash={self.store.hash_rihs01(kind)};".encode()),
        )
        with self._naming(name[2:]), self._announcing:
            end = end_type(self._participant, Topic(self._participant, name, _carrier(kind)), qos)
            self._kept.append(end)
            if end_type is DataReader:
                end.set_status_mask(core.DDSStatus.RequestedIncompatibleQos)
            if not info:
                self._gids[end_type].append(self._gid(end))
                self._announce()
        return end

    def _gid(self, entity: Any) -> Any:
        return self.store.types["rmw_dds_common/msg/Gid"](np.frombuffer(entity.guid.bytes, "u1"))

    def _announce(self) -> None:
        """Let tools of ROS 2 see this node and what it publishes and subscribes to."""
        node = self.store.types["rmw_dds_common/msg/NodeEntitiesInfo"](
            "/", "adaptune", self._gids[DataReader], self._gids[DataWriter]
        )
        info = self.store.types[_INFO](self._gid(self._participant), [node])
        self._info.write(self._info.data_type(bytes(self.store.serialize_cdr(info, _INFO))))

    @contextlib.contextmanager
    def _naming(self, what: str) -> Iterator[None]:
        """Say what DDS cannot do, and why."""
        if self._closed:
            raise LinkError(f"{what}: the link was closed")
        try:
            yield
        except (core.DDSException, UnicodeError) as error:
            raise LinkError(f"{what}: {error}") from error


@cache
def _carrier(kind: str) -> Any:
    """What DDS takes for a message of a type: its bytes."""

    def hold(self: Any, data: bytes) -> None:
        self.data = data

    methods = {
        "__init__": hold,
        "serialize": lambda self, **_: self.data,
        "deserialize": classmethod(lambda cls, data, **_: cls(data)),
        "deserialize_key": classmethod(lambda cls, data, **_: cls(data)),
    }
    # rosbags puts services among the messages.
    package, space, name = kind.replace("/srv/msg/", "/srv/").split("/")
    given = {"typename": f"{package}.{space}.dds_.{name}_"}
    return types.new_class(name, (IdlStruct,), given, lambda names: names.update(methods))


def _lack(offered: Qos, wanted: Qos) -> str:
    """In words, what a subscriber wants and a publisher does not offer; empty if they match."""
    reliable = Policy.Reliability.Reliable
    if isinstance(wanted[Policy.Reliability], reliable) and not isinstance(
        offered[Policy.Reliability], reliable
    ):
        return "reliable"
    durability = [_DURABILITIES.index(qos[Policy.Durability]) for qos in (offered, wanted)]
    if durability[0] < durability[1]:
        return "transient local, with what was published before it came"
    if offered[Policy.Deadline].deadline > wanted[Policy.Deadline].deadline:
        return "with a deadline"
    return ""


def _configuration() -> str:
    """What Cyclone DDS is told, by what ROS 2 is told of discovery."""
    name = "ROS_AUTOMATIC_DISCOVERY_RANGE"
    reach = os.environ.get(name, "").strip().upper() or "SUBNET"
    peers = ["localhost", *os.environ.get("ROS_STATIC_PEERS", "").replace(";", " ").split()]
    if os.environ.get("ROS_LOCALHOST_ONLY") == "1":
        reach, peers = "LOCALHOST", peers[:1]
    if reach not in ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT"):
        raise LinkError(f"{name} is {reach}; it is SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT")
    for peer in peers:
        try:
            socket.getaddrinfo(peer, None)
        except OSError as error:  # Cyclone DDS would end the process
            raise LinkError(f"ROS_STATIC_PEERS: {peer}: {error.strerror}") from error
    alone = f"<Tag>adaptune {os.getpid()}</Tag>" if reach == "OFF" else ""
    known = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in peers)
    parts = [f'<Internal><SocketReceiveBufferSize max="{ros2.RECEIVE_BUFFER} B"/></Internal>']
    if reach in ("LOCALHOST", "OFF"):
        # Cyclone DDS hears nobody on an interface that it does not use, and others greet on this.
        other = '<NetworkInterface autodetermine="true"/>' * (len(peers) > 1)
        faces = f'<Interfaces>{other}<NetworkInterface name="lo"/></Interfaces>'
        # Within a machine a datagram may be as large as it can; that saves both sides time.
        large = "<MaxMessageSize>65500 B</MaxMessageSize><FragmentSize>65000 B</FragmentSize>"
        large *= len(peers) == 1
        parts.append(f"<General><AllowMulticast>false</AllowMulticast>{faces}{large}</General>")
    if reach != "SYSTEM_DEFAULT":
        parts.append(
            "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
            "<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
            f"{alone}<Peers>{known}</Peers></Discovery>"
        )
    own = f"<CycloneDDS><Domain>{''.join(parts)}</Domain></CycloneDDS>"
    return ",".join(filter(None, (own, os.environ.get("CYCLONEDDS_URI"))))


def _receive_buffer() -> int:
    """Bytes that the kernel lets a socket receive ahead."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, ros2.RECEIVE_BUFFER)
        return probe.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
