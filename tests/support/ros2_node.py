"""A robot's node on DDS, which runs on, written without what adaptune has for it.

It publishes point clouds, says the odometry that it gets again on another topic, and has
parameters: it accepts all but `rings`. It ends when its input does.
"""

import contextlib
import fcntl
import itertools
import sys
import tempfile
import threading
import types
from pathlib import Path

import numpy as np
import rec
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

HZ = 50
POINTS = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
SET, GET = "rcl_interfaces/srv/SetParameters", "rcl_interfaces/srv/GetParameters"
LIST = "rcl_interfaces/srv/ListParameters"
REASON = "parameter 'rings' cannot be set because it is read-only"
SERVICES = {
    SET: ("rcl_interfaces/Parameter[] parameters", "rcl_interfaces/SetParametersResult[] results"),
    GET: ("string[] names", "rcl_interfaces/ParameterValue[] values"),
    LIST: ("string[] prefixes\nuint64 depth", "rcl_interfaces/ListParametersResult result"),
}
_held = []


def free_domain():
    """A ROS domain that no other test uses while this process runs."""
    for domain in itertools.count(1):
        file = (Path(tempfile.gettempdir()) / f"adaptune-test-domain-{domain}").open("a")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
        else:
            _held.append(file)
            return domain
    raise AssertionError


def cloud(store, n):
    """The cloud of a number: of as many bytes as a real one, more or less."""
    rows = np.random.default_rng(n).integers(0, 256, (30_000 + n % 7, 12), np.uint8)
    points = rows.view([(axis, "<f4") for axis in "xyz"])[:, 0]
    return rec.cloud(points, n * 10**9 + 999_999_999, store)


class Parameters:
    """Answers a node's services."""

    def __init__(self, node):
        self.store, self.type_named, self.held = node.store, node.type_named, {}

    def set(self, request):
        results = []
        for given in request.parameters:
            accepted = given.name != "rings"
            if accepted:
                self.held[given.name] = given.value
            result = self.store.types["rcl_interfaces/msg/SetParametersResult"]
            results.append(result(successful=accepted, reason="" if accepted else REASON))
        return self.type_named(f"{SET}_Response")(results=results)

    def get(self, request):
        values = [self.held[name] for name in request.names]
        return self.type_named(f"{GET}_Response")(values=values)

    def list(self, _):
        names = self.store.types["rcl_interfaces/msg/ListParametersResult"](list(self.held), [])
        return self.type_named(f"{LIST}_Response")(result=names)


class DdsNode:
    """A node on plain Cyclone DDS; with `bare`, its services have the layout of Fast DDS."""

    def __init__(self, domain, bare=False):
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant

        peers = '<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="lo'
        config = "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast></General>"
        config += f'{peers}calhost"/></Peers></Discovery></Domain></CycloneDDS>'
        # In a process that has joined the domain, that serves.
        with contextlib.suppress(DDSException):  # this process has joined it
            self.domain = Domain(domain, config)
        self.participant, self.bare = DomainParticipant(domain), bare
        self.store = get_typestore(Stores.ROS2_JAZZY)
        for kind, texts in SERVICES.items():
            for part, text in zip(("Request", "Response"), texts, strict=True):
                self.store.register(get_types_from_msg(text, f"{kind}_{part}"))

    def type_named(self, name):
        return self.store.types[name.replace("/srv/", "/srv/msg/")]

    def end(self, of, topic, kind, reliable=True, latched=False):
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        policy = Policy.Reliability
        qos = Qos(
            policy.Reliable(duration(seconds=1)) if reliable else policy.BestEffort,
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(10),
        )
        return of(self.participant, Topic(self.participant, topic, carrier(kind)), qos)

    def publisher(self, topic, kind, reliable=True):
        from cyclonedds.pub import DataWriter

        writer = self.end(DataWriter, f"rt{topic}", kind, reliable)
        serialise = self.store.serialize_cdr
        return lambda message: writer.write(writer.data_type(bytes(serialise(message, kind))))

    def subscribe(self, topic, kind, take, latched=False):
        from cyclonedds.sub import DataReader

        reader = self.end(DataReader, topic if latched else f"rt{topic}", kind, latched=latched)
        self._taking(reader, lambda data: take(self.store.deserialize_cdr(data, kind)))

    def watch(self, place, kind, take):
        """Have every request of a service taken as it comes."""
        from cyclonedds.sub import DataReader

        self._taking(self.end(DataReader, f"rq{place}Request", f"{kind}_Request"), take)

    def serve(self, place, kind, answer=None, before=None):
        """Answer a service's requests; `before` is an answer to somebody else."""
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader

        request, response = f"{kind}_Request", f"{kind}_Response"
        writer = self.end(DataWriter, f"rr{place}Reply", response)
        names = self.type_named(request).__msgtype__, self.type_named(response).__msgtype__
        head, serialise = 0 if self.bare else 16, self.store.serialize_cdr

        def reply(data):
            if before is not None:
                writer.write(writer.data_type(bytes(serialise(before, names[1]))))
            asked = self.store.deserialize_cdr(data[:4] + data[4 + head :], names[0])
            raw = bytes(serialise(answer(asked), names[1]))
            writer.write(writer.data_type(raw[:4] + data[4 : 4 + head] + raw[4:]))

        reader = self.end(DataReader, f"rq{place}Request", request)
        self._taking(reader, reply if answer else lambda _: None)

    def _taking(self, reader, take):
        def work():
            for sample in reader.take_iter():
                if sample.sample_info.valid_data:
                    take(sample.data)

        threading.Thread(target=work, daemon=True).start()


def carrier(kind):
    """A type of DDS whose messages are their bytes."""
    from cyclonedds.idl import IdlStruct

    def body(names):
        names["__init__"] = lambda self, data: setattr(self, "data", data)
        names["serialize"] = lambda self, **_: self.data
        names["deserialize"] = names["deserialize_key"] = classmethod(lambda cls, data: cls(data))

    package, space, name = kind.split("/")
    given = {"typename": f"{package}.{space}.dds_.{name}_"}
    return types.new_class(name, (IdlStruct,), given, body)


def main(domain):
    node = DdsNode(int(domain))
    parameters = Parameters(node)
    # As LiDARs do.
    points = node.publisher("/points", POINTS, reliable=False)
    node.subscribe("/odometry", ODOMETRY, node.publisher("/robot/echo", ODOMETRY))
    node.serve("/robot/slam/set_parameters", SET, parameters.set)
    node.serve("/robot/slam/get_parameters", GET, parameters.get)
    node.serve("/robot/slam/list_parameters", LIST, parameters.list)
    node.serve("/deaf/set_parameters", SET)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    n = 0
    while not ended.wait(1.0 / HZ):
        points(cloud(node.store, n))
        n += 1


if __name__ == "__main__":
    main(*sys.argv[1:])
