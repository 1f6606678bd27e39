"""A ROS 1 node that passes messages on, run by the Python of a ROS installation.

It imports nothing of adaptune's, is written for Python 2.7 (ROS Melodic) and 3, and speaks the
format of `adaptune.odometry.wire` on a socket. In a container, it is the roscore, too.
"""

import json
import os
import socket
import struct
import sys
import threading
import uuid

try:
    from typing import Any
    from xmlrpc.client import ServerProxy
except ImportError:
    from xmlrpclib import ServerProxy  # type: ignore[no-redef]

_LENGTH = struct.Struct("<I")
_NODE_TIMEOUT = 2.0  # in which another node must answer
_BUFFER = 1 << 24  # bytes
_OWN_NODES = (
    "/adaptune",
    "/rosout",
    "/play_",
    "/record_",
)  # nodes that are no odometry, by their begin


class Stream(object):
    """Messages on a socket; any thread may send."""

    def __init__(self, connection):  # type: (socket.socket) -> None
        self._socket = connection
        self._reader = self._socket.makefile("rb")
        self._lock = threading.Lock()

    def send(self, header, data=b""):  # type: (dict[str, Any], bytes) -> None
        """Send a message with the bytes of one array."""
        header = dict(header, arrays=[["data", "|u1", [len(data)]]])
        encoded = json.dumps(header).encode()
        with self._lock:
            try:
                self._socket.sendall(_LENGTH.pack(len(encoded)) + encoded)
                if data:
                    self._socket.sendall(data)
            except (OSError, socket.error):
                pass  # the other side has gone, and this process ends soon

    def receive(self):  # type: () -> tuple[dict[str, Any], bytes] | None
        """Wait for a message; None where the other side has gone."""
        try:
            first = self._reader.read(_LENGTH.size)
            if len(first) < _LENGTH.size:
                return None
            header = json.loads(self._reader.read(_LENGTH.unpack(first)[0]).decode())
            size = sum(shape[0] for _, _, shape in header["arrays"])
            return header, self._reader.read(size)
        except (OSError, socket.error):
            return None


def _message_class(rospy, header):  # type: (Any, dict[str, Any]) -> Any
    """What rospy publishes: bytes that were serialised elsewhere."""
    names = {"_md5sum": header["md5"], "_type": header["kind"], "_full_text": header["text"]}

    class Serialised(rospy.AnyMsg):  # type: ignore[misc]
        _slot_types = ()

        def serialize(self, buff):  # type: (Any) -> None
            buff.write(self._buff)

    for name, value in names.items():
        setattr(Serialised, str(name), str(value))
    return Serialised


def _used(pid):  # type: (int) -> tuple[float, float]
    """Seconds of CPU time and peak megabytes of a process; an OSError if it has ended."""
    with open("/proc/%d/stat" % pid) as file:
        fields = file.read().rpartition(")")[2].split()
    if fields[0] == "Z":
        raise OSError("it has ended")
    cpu = (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))
    with open("/proc/%d/status" % pid) as file:
        peak = [line.split()[1] for line in file if line.startswith("VmHWM")]
    return cpu, 1024e-6 * int(peak[0]) if peak else 0.0


class _Node(object):
    def __init__(self, rospy, stream):  # type: (Any, Stream) -> None
        self._rospy, self._stream = rospy, stream
        self._subscribers = []  # type: list[Any]
        self._publishers = {}  # type: dict[str, tuple[Any, Any]]
        self._pids = {}  # type: dict[str, int]
        self._usage = {}  # type: dict[str, tuple[float, float]]
        self._watched = set()  # type: set[str]

    def subscribe(self, header, _):  # type: (dict[str, Any], bytes) -> None
        topic = header["topic"]

        def take(message):  # type: (Any) -> None
            # What this node was not asked for cannot be decoded there.
            head = {"kind": message._connection_header["type"], "topic": topic, "type": "message"}
            self._stream.send(head, message._buff)

        # With the usual buffer, a cloud would be read in many pieces.
        settings = {"queue_size": 1000, "buff_size": _BUFFER, "tcp_nodelay": True}
        self._subscribers.append(
            self._rospy.Subscriber(topic, self._rospy.AnyMsg, take, **settings)
        )

    def advertise(self, header, _):  # type: (dict[str, Any], bytes) -> None
        kind = _message_class(self._rospy, header)
        publisher = self._rospy.Publisher(header["topic"], kind, queue_size=1000, tcp_nodelay=True)
        self._publishers[header["topic"]] = kind, publisher

    def publish(self, header, data):  # type: (dict[str, Any], bytes) -> None
        kind, publisher = self._publishers[header["topic"]]
        message = kind()
        message._buff = data
        publisher.publish(message)

    def topics(self, _):  # type: (dict[str, Any]) -> dict[str, str]
        return dict(self._rospy.get_published_topics())

    def set_parameters(self, header):  # type: (dict[str, Any]) -> dict[str, Any]
        """Set them while the node runs, where it can, and else at the parameter server.

        Returns what the node then holds, of those that it can set.
        """
        import rosservice

        values, keys = header["values"], header["keys"]
        node = self._rospy.resolve_name(header["node"])
        if not self._master().lookupNode(node):
            raise LookupError("there is no node %s" % node)
        service = node + "/set_parameters"
        runs = service in rosservice.get_service_list(node=node)
        if runs and rosservice.get_service_type(service) == "dynamic_reconfigure/Reconfigure":
            held = self._reconfigured(node, values)
        else:
            held = {}
        for name, value in values.items():
            if name not in held:
                for key in keys.get(name, [node + "/" + name]):
                    self._rospy.set_param(key, value)
        return held

    def parameters(self, _):  # type: (dict[str, Any]) -> Any
        """All that the parameter server holds."""
        return self._rospy.get_param("/")

    def state(self, header):  # type: (dict[str, Any]) -> dict[str, Any]
        """Who subscribes to which topics, and what other nodes have used so far.

        A node that was seen at one of the `topics` and has ended is dead. Of the topics that this
        node sends, the number of subscribers that are connected.
        """
        published, subscribed, _ = self._master().getSystemState()
        listened = {}  # type: dict[str, list[str]]
        nodes = set()  # type: set[str]
        for topic, names in published + subscribed:
            others = [name for name in names if not name.startswith(_OWN_NODES)]
            nodes.update(others)
            if topic in header["topics"]:
                self._watched.update(others)
        for topic, names in subscribed:
            listened[topic] = [name for name in names if not name.startswith(_OWN_NODES)]
        dead = []
        for name in sorted(nodes | set(self._usage)):
            try:
                self._usage[name] = _used(self._pid(name))
            except Exception:
                dead.append(name)
        sending = {t: p.get_num_connections() for t, (_, p) in self._publishers.items()}
        return {
            "subscribed": {topic: names for topic, names in listened.items() if names},
            "nodes": self._usage,
            "dead": [name for name in dead if name in self._watched],
            "sending": sending,
        }

    def _pid(self, name):  # type: (str) -> int
        if name not in self._pids:
            slave = ServerProxy(self._master().lookupNode(name))
            answer = slave.getPid("/adaptune")  # type: Any
            self._pids[name] = int(answer[2])
        return self._pids[name]

    def _master(self):  # type: () -> Any
        import rosgraph

        return rosgraph.Master("/adaptune")

    def _reconfigured(self, node, values):  # type: (str, dict[str, Any]) -> dict[str, Any]
        from dynamic_reconfigure.client import Client

        client = Client(node, timeout=_NODE_TIMEOUT)
        try:
            known = client.get_configuration(timeout=_NODE_TIMEOUT) or {}
            own = {name: name.replace(".", "/").rpartition("/")[2] for name in values}
            # Two parameters may end alike.
            last = list(own.values())
            known = {name for name in known if last.count(name) == 1}
            mine = {own[name]: value for name, value in values.items() if own[name] in known}
            held = client.update_configuration(mine) if mine else {}
            return {name: held[own[name]] for name in values if own[name] in mine}
        finally:
            client.close()


_ASKED = ("topics", "set_parameters", "parameters", "state")
"""What is answered; another node may take its time, and messages must not wait for it."""


def _answer(stream, header, answer):  # type: (Stream, dict[str, Any], Any) -> None
    try:
        reply = {"found": answer(header)}
    except Exception as error:
        reply = {"refused": str(error) or type(error).__name__}
    stream.send(dict(reply, type="answer", number=header["number"]))


def converse(stream, name, more=None):  # type: (Stream, str, dict[str, Any] | None) -> None
    """Be a node until the other side closes the socket; `more` answers other messages, by type."""
    import rospy

    rospy.init_node(name, anonymous=True, disable_signals=True)
    node = _Node(rospy, stream)
    serve(stream, node, dict(more or {}, **{kind: getattr(node, kind) for kind in _ASKED}))
    rospy.signal_shutdown("adaptune has ended")


def serve(stream, node, answers):  # type: (Stream, Any, dict[str, Any]) -> None
    """Have a node do what comes, or answer it, until the other side closes the socket."""
    stream.send({"type": "ready"})
    while True:
        received = stream.receive()
        if received is None:
            break
        header, data = received
        kind = header["type"]
        if kind in answers:
            thread = threading.Thread(target=_answer, args=(stream, header, answers[kind]))
            thread.daemon = True
            thread.start()
        else:
            getattr(node, kind)(header, data)


def _start_master(asked):  # type: (dict[str, set[str]]) -> None
    """Start a roscore that notes which node asks for which parameter."""
    import rosmaster.master
    import rosmaster.master_api as api

    plain_handler = api.ROSMasterHandler

    def noting(plain):  # type: (Any) -> Any
        def answer(self, caller, *given):  # type: (Any, str, *str) -> Any
            asked.setdefault(caller, set()).add(given[-1])  # the key
            return plain(self, caller, *given)

        return answer

    names = ("getParam", "hasParam", "searchParam", "subscribeParam")
    methods = {name: noting(getattr(plain_handler, name)) for name in names}
    api.ROSMasterHandler = type("Noting", (plain_handler,), methods)
    rosmaster.master.Master().start()


def contained(path, use_sim_time):  # type: (str, str) -> None
    """Start a roscore, connect to adaptune, and be a node; a path is that of a socket."""
    try:
        import rosgraph
        import rosmaster
        import rospy
    except ImportError:
        sys.exit(9)  # another Python may
    asked = {}  # type: dict[str, set[str]]
    _start_master(asked)
    master = rosgraph.Master("/adaptune")
    if use_sim_time:
        master.setParam("/use_sim_time", use_sim_time == "true")
    # roslaunch waits for it.
    master.setParam("/run_id", str(uuid.uuid1()))
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.connect(path)

    def found(_):  # type: (dict[str, Any]) -> dict[str, list[str]]
        return {caller: sorted(keys) for caller, keys in dict(asked).items()}

    converse(Stream(connection), "adaptune", {"asked": found})


def main(number):  # type: (int) -> None
    """Be a node in a running ROS; the number is that of a socket."""
    stream = Stream(socket.fromfd(number, socket.AF_UNIX, socket.SOCK_STREAM))
    os.close(number)
    try:
        import rosgraph
        import rospy
    except ImportError as error:
        stream.send({"type": "failed", "message": "cannot import ROS (%s)" % error})
        return
    if not rosgraph.is_master_online():
        uri = os.environ.get("ROS_MASTER_URI", "which is not set")
        what = "no roscore answers at ROS_MASTER_URI, %s" % uri
        stream.send({"type": "failed", "message": what})
        return
    converse(stream, "adaptune")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        contained(*sys.argv[1:])
    else:
        main(int(sys.argv[1]))
