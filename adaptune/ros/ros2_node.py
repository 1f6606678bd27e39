"""A ROS 2 node in a process of its own, beside a system that no other network reaches."""

import contextlib
import socket
import sys
from collections.abc import Callable, Mapping
from typing import Any

from adaptune.ros.dds import TRANSFORMS, DdsLink
from adaptune.ros.link import LinkError
from adaptune.ros.ros1_node import Stream, serve
from adaptune.ros.ros2 import full

_COMMON_TOPICS = ("/parameter_events", "/rosout", "/clock")  # topics of every node


class _Node:
    def __init__(self, link: DdsLink, stream: Stream):
        self._link, self._stream = link, stream
        self._publish: dict[str, Callable[[bytes], None]] = {}
        self._awaited: list[str] = []

    def subscribe(self, header: Mapping[str, Any], _: bytes) -> None:
        """Subscribe as soon as somebody publishes, of whatever type."""
        topic = full(header["topic"])
        if topic.endswith("/tf_static"):  # this node may publish it
            self._record(topic, TRANSFORMS)
        else:
            self._awaited.append(topic)

    def advertise(self, header: Mapping[str, Any], _: bytes) -> None:
        kind = header["kind"].replace("/", "/msg/")
        self._publish[header["topic"]] = self._link.advertise(header["topic"], kind, raw=True)

    def publish(self, header: Mapping[str, Any], data: bytes) -> None:
        self._publish[header["topic"]](data)

    def state(self, header: Mapping[str, Any]) -> dict[str, Any]:
        """What is published and subscribed to; whom this node reaches, and why not others."""
        published = self._kinds(0)
        for topic in [topic for topic in self._awaited if topic in published]:
            self._awaited.remove(topic)
            self._record(topic, published[topic][0])
        self._link.meet()
        return {
            "published": published,
            "subscribed": {t: k for t, k in self._kinds(1).items() if t not in _COMMON_TOPICS},
            "sending": {topic: self._link.hearers(topic) for topic in self._publish},
            "senders": {t: [e.node for e in self._link.endpoints(0, t)] for t in header["own"]},
            "unheard": {topic: self._link.why_unheard(topic) for topic in header["topics"]},
        }

    def _kinds(self, which: int) -> dict[str, list[str]]:
        """The topics that others publish now (0), or subscribe to (1), with their types."""
        kinds: dict[str, set[str]] = {}
        for end in self._link.endpoints(which):
            kinds.setdefault(end.topic, set()).add(end.kind)
        return {topic: sorted(names) for topic, names in kinds.items()}

    def _record(self, topic: str, kind: str) -> None:
        head = {"type": "message", "topic": topic, "kind": kind.replace("/msg/", "/")}
        take = lambda data: self._stream.send(head, data)  # noqa: E731
        with contextlib.suppress(LinkError):  # of a type that nobody knows
            self._link.subscribe(topic, kind, take, raw=True)

    def topics(self, _: Mapping[str, Any]) -> dict[str, str]:
        return {t: kinds[0].replace("/msg/", "/") for t, kinds in self._kinds(0).items()}

    def set_parameters(self, header: Mapping[str, Any]) -> Mapping[str, Any]:
        return self._link.set_parameters(header["node"], header["values"])

    def parameters(self, _: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
        """What every node that serves its parameters holds."""
        held = {}
        for node in self._link.nodes():
            with contextlib.suppress(LinkError):
                held[node] = self._link.parameters(node)
        return held


_ASKED = ("state", "topics", "set_parameters", "parameters")


def main(path: str) -> None:
    """Be a node, and pass messages on through a socket, until its other side has gone."""
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(path)
    stream = Stream(connection)
    try:
        link = DdsLink()
    except LinkError as error:
        stream.send({"type": "failed", "message": str(error)})
        return
    node = _Node(link, stream)
    serve(stream, node, {kind: getattr(node, kind) for kind in _ASKED})
    link.close()


if __name__ == "__main__":
    main(sys.argv[1])
