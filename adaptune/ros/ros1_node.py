"""A ROS 1 node that passes messages on, run by the Python of a ROS installation.

It imports nothing of adaptune's, runs on Python 3.8 and newer, and speaks the format of
`adaptune.odometry.wire` on the socket whose number is its argument.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import sys
import threading
from typing import Any

_LENGTH = struct.Struct("<I")
_SECONDS = 2.0  # in which another node must answer
_BUFFER = 1 << 24  # bytes


class _Stream:
    """Messages on a socket; any thread may send."""

    def __init__(self, number: int):
        self._socket = socket.socket(fileno=number)
        self._reader = self._socket.makefile("rb")
        self._lock = threading.Lock()

    def send(self, header: dict[str, Any], data: bytes = b"") -> None:
        header = dict(header, arrays=[["data", "|u1", [len(data)]]])
        encoded = json.dumps(header).encode()
        # Where the other side has gone, this process ends soon.
        with self._lock, contextlib.suppress(OSError):
            self._socket.sendall(_LENGTH.pack(len(encoded)) + encoded)
            if data:
                self._socket.sendall(data)

    def receive(self) -> tuple[dict[str, Any], bytes] | None:
        first = self._reader.read(_LENGTH.size)
        if len(first) < _LENGTH.size:
            return None
        header = json.loads(self._reader.read(_LENGTH.unpack(first)[0]).decode())
        size = sum(shape[0] for _, _, shape in header["arrays"])
        return header, self._reader.read(size)


def _message_class(rospy: Any, header: dict[str, Any]) -> Any:
    """What rospy publishes: bytes that were serialised elsewhere."""
    names = {"_md5sum": header["md5"], "_type": header["kind"], "_full_text": header["text"]}

    class Serialised(rospy.AnyMsg):  # type: ignore[misc]
        _slot_types = ()

        def serialize(self, buff: Any) -> None:
            buff.write(self._buff)

    for name, value in names.items():
        setattr(Serialised, name, value)
    return Serialised


class _Node:
    def __init__(self, rospy: Any, stream: _Stream):
        self._rospy, self._stream = rospy, stream
        self._subscribers: list[Any] = []
        self._publishers: dict[str, tuple[Any, Any]] = {}

    def subscribe(self, header: dict[str, Any], _: bytes) -> None:
        topic = header["topic"]

        def take(message: Any) -> None:
            # What this node was not asked for cannot be decoded there.
            found = {"kind": message._connection_header["type"], "topic": topic, "type": "message"}
            self._stream.send(found, message._buff)

        # With the usual buffer, a cloud would be read in many pieces.
        settings = {"queue_size": 10, "buff_size": _BUFFER, "tcp_nodelay": True}
        self._subscribers.append(
            self._rospy.Subscriber(topic, self._rospy.AnyMsg, take, **settings)
        )

    def advertise(self, header: dict[str, Any], _: bytes) -> None:
        kind = _message_class(self._rospy, header)
        publisher = self._rospy.Publisher(header["topic"], kind, queue_size=10, tcp_nodelay=True)
        self._publishers[header["topic"]] = kind, publisher

    def publish(self, header: dict[str, Any], data: bytes) -> None:
        kind, publisher = self._publishers[header["topic"]]
        message = kind()
        message._buff = data
        publisher.publish(message)

    def topics(self, header: dict[str, Any], _: bytes) -> None:
        try:
            self._answer(header, {"found": dict(self._rospy.get_published_topics())})
        except Exception as error:
            self._answer(header, {"refused": str(error) or type(error).__name__})

    def set_parameters(self, header: dict[str, Any], _: bytes) -> None:
        try:
            self._answer(header, {"found": self._set(header["node"], header["values"])})
        except Exception as error:
            self._answer(header, {"refused": str(error) or type(error).__name__})

    def _set(self, node: str, values: dict[str, Any]) -> dict[str, Any]:
        """Set them while the node runs, where it can, and else at the parameter server.

        Returns what the node then holds, of those that it can set.
        """
        import rosgraph
        import rosservice

        node = self._rospy.resolve_name(node)
        if not rosgraph.Master("/adaptune").lookupNode(node):
            raise LookupError(f"there is no node {node}")
        service = node + "/set_parameters"
        runs = service in rosservice.get_service_list(node=node)
        if runs and rosservice.get_service_type(service) == "dynamic_reconfigure/Reconfigure":
            held = self._reconfigured(node, values)
        else:
            held = {}
        for name, value in values.items():
            if name not in held:
                self._rospy.set_param(node + "/" + name, value)
        return held

    def _reconfigured(self, node: str, values: dict[str, Any]) -> dict[str, Any]:
        from dynamic_reconfigure.client import Client

        client = Client(node, timeout=_SECONDS)
        try:
            known = client.get_configuration(timeout=_SECONDS) or {}
            mine = {name: value for name, value in values.items() if name in known}
            held = client.update_configuration(mine) if mine else {}
            return {name: held[name] for name in mine}
        finally:
            client.close()

    def _answer(self, header: dict[str, Any], found: dict[str, Any]) -> None:
        self._stream.send(dict(found, type="answer", number=header["number"]))


def main(number: int) -> None:
    """Pass messages on until the other side closes the socket."""
    stream = _Stream(number)
    try:
        import rosgraph
        import rospy
    except ImportError as error:
        stream.send({"type": "failed", "message": f"cannot import ROS ({error})"})
        return
    if not rosgraph.is_master_online():
        uri = os.environ.get("ROS_MASTER_URI", "which is not set")
        what = f"no roscore answers at ROS_MASTER_URI, {uri}"
        stream.send({"type": "failed", "message": what})
        return
    rospy.init_node("adaptune", anonymous=True, disable_signals=True)
    node = _Node(rospy, stream)
    stream.send({"type": "ready"})
    while True:
        received = stream.receive()
        if received is None:
            break
        header, data = received
        do = getattr(node, header["type"])
        if "number" in header:
            # Another node may take its time, and scans must not wait for it.
            threading.Thread(target=do, args=(header, data), daemon=True).start()
        else:
            do(header, data)
    rospy.signal_shutdown("adaptune has ended")


if __name__ == "__main__":
    main(int(sys.argv[1]))
