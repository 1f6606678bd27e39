"""A node in a process of its own, which passes messages on as bytes."""

import contextlib
import itertools
import logging
import os
import shutil
import socket
import struct
import subprocess
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from adaptune._system import processes
from adaptune.ros import ros1_node
from adaptune.ros.link import BusyError, LinkError, take_all, telling
from adaptune.ros.ros2 import BUFFER_CURE, RECEIVE_BUFFER, message_types

_NODE_START = 20.0  # seconds in which the node must be ready
_WAITING = 1000  # messages of a topic that may wait; more are dropped
_ANSWER_SECONDS = 5.0  # seconds in which it must answer; it waits less for others
_DEAF = 30.0  # seconds in which it must read what is sent

_log = logging.getLogger(__name__)


class Relay:
    """A node in a running ROS, see `adaptune.ros.link.RosLink`.

    A process of its own is the node, and messages pass through it as bytes. `running` says whether
    it runs, `end` waits for it or ends it. There is a `LinkError` if it does not start.
    """

    version: ClassVar[Literal[1, 2]]
    store: Typestore
    encode: Callable[[Any, str], Any]  # a message of a type as bytes
    decode: Callable[[bytes, str], Any]  # the message of a type in bytes
    keys: Mapping[str, Sequence[str]] = MappingProxyType({})  # of parameters, at another place

    def __init__(
        self, connection: socket.socket, running: Callable[[], bool], end: Callable[[], None]
    ):
        self._running, self._end, self.is2 = running, end, self.version == 2
        # For sending alone: a thread may wait for messages as long as it likes.
        limit = struct.pack("ll", int(_DEAF), int(_DEAF % 1 * 1e6))
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
        self._stream = processes.SocketStream(connection)
        self._sending = threading.Lock()
        self._numbers = itertools.count()
        self._answers: dict[int, SimpleQueue[dict[str, Any]]] = {}
        self._takes: dict[str, Callable[[str, bytes], None]] = {}
        self._waiting: list[SimpleQueue[bytes | None]] = []
        ready = processes.receive(self._stream) if self._stream.ready(_NODE_START) else None
        if ready is None or ready.header["type"] == "failed":
            self.close()
            what = "its node did not start" if ready is None else ready.header["message"]
            raise LinkError(f"ROS {self.version}: {what}")
        threading.Thread(target=self._receive, daemon=True).start()

    def subscribe(
        self, topic: str, kind: str, take: Callable[[Any], None], raw: bool = False
    ) -> None:
        received: SimpleQueue[bytes | None] = SimpleQueue()
        self._waiting.append(received)
        mistaken = set()

        def put(sent_kind: str, data: bytes) -> None:
            if sent_kind != kind and sent_kind not in mistaken:
                mistaken.add(sent_kind)
                _log.warning("%s is %s, not %s: its messages are ignored", topic, sent_kind, kind)
            elif sent_kind == kind and received.qsize() < _WAITING:
                received.put(data)

        messages = iter(received.get, None)
        take_all(topic, messages, lambda data: take(data if raw else self.decode(data, kind)))
        self.record(topic, put)

    def record(self, topic: str, take: Callable[[str, bytes], None]) -> None:
        """Have every message of a topic taken as it comes, as its type and its bytes."""
        self._takes[topic] = take
        self._send({"type": "subscribe", "topic": topic})

    def advertise(self, topic: str, kind: str) -> Callable[[Any], None]:
        publish = self.advertise_bytes(topic, kind)
        return lambda message: publish(self.encode(message, kind))

    def advertise_bytes(self, topic: str, kind: str) -> Callable[[Any], None]:
        """Announce a topic; what is returned publishes a message that is encoded."""
        names = self._names(kind) | {"kind": kind.replace("/msg/", "/")}
        self._send({"type": "advertise", "topic": topic, **names})
        header = {"type": "publish", "topic": topic}
        return lambda data: self._send(header, np.frombuffer(data, np.uint8))

    def _names(self, kind: str) -> dict[str, str]:  # noqa: ARG002
        """What the node must know of a type besides its name."""
        return {}

    def set_parameters(
        self,
        node: str,
        values: Mapping[str, Any],
        outdated: Callable[[], bool] = lambda: False,  # noqa: ARG002
    ) -> Mapping[str, Any]:
        """See `RosLink.set_parameters`.

        In ROS 1, they are set by dynamic_reconfigure where the node has it. The others are set at
        the parameter server: nobody tells what the node makes of them, so they are not returned.
        """
        asked = {"node": node, "values": dict(values), "keys": dict(self.keys)}
        try:
            held: dict[str, Any] = self.ask("set_parameters", **asked)
        except LinkError as error:
            raise type(error)(f"{node}: {error}") from error
        return held

    def topics(self) -> Mapping[str, str]:
        try:
            kinds: dict[str, str] = self.ask("topics")
        except LinkError as error:
            raise LinkError(f"ROS {self.version}: the node does not answer ({error})") from error
        return {topic: kind.replace("/", "/msg/") for topic, kind in kinds.items()}

    def why_unheard(self, topic: str) -> str:  # noqa: ARG002
        return ""

    def ask(self, kind: str, **given: Any) -> Any:
        """What the node answers, see `adaptune.ros.ros1_node`; a `LinkError` if it refuses."""
        number = next(self._numbers)
        waiting = self._answers[number] = SimpleQueue()
        try:
            self._send({**given, "type": kind, "number": number})
            answer = waiting.get(timeout=_ANSWER_SECONDS)
        except Empty as error:
            raise BusyError(f"no answer in {_ANSWER_SECONDS:g} s") from error
        finally:
            del self._answers[number]
        if "refused" in answer:
            raise LinkError(str(answer["refused"]))
        return answer["found"]

    @property
    def alive(self) -> bool:
        return self._running()

    def close(self) -> None:
        for received in self._waiting:
            received.put(None)
        # A thread reads; without it the node would not notice.
        self._stream.end()
        with contextlib.suppress(OSError):
            self._stream.close()
        self._end()

    def _send(self, header: dict[str, Any], data: Any = None) -> None:
        try:
            with self._sending:
                processes.send(self._stream, header, data=data)
        except BlockingIOError as error:
            raise LinkError(
                f"ROS {self.version}: adaptune's node has read nothing for {_DEAF:g} s"
            ) from error
        except (OSError, ValueError) as error:
            raise LinkError(f"ROS {self.version}: adaptune's node has ended") from error

    def _receive(self) -> None:
        """Pass on what the node sends, until it ends."""
        try:
            while (message := processes.receive(self._stream)) is not None:
                header = message.header
                if header["type"] == "answer":
                    if (waiting := self._answers.get(header["number"])) is not None:
                        waiting.put(header)
                    continue
                kind, data = header["kind"].replace("/", "/msg/"), message.arrays["data"].tobytes()
                with telling(header["topic"]):
                    self._takes[header["topic"]](kind, data)
        except (OSError, processes.WireError):
            pass  # it was closed


class Ros1(Relay):
    """A node in a running ROS 1: the Python of any ROS will do."""

    version = 1

    def __init__(self, *given: Any):
        self.store = get_typestore(Stores.ROS1_NOETIC)
        text = "geometry_msgs/TransformStamped[] transforms\n"
        self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self.encode, self.decode = self.store.serialize_ros1, self.store.deserialize_ros1
        super().__init__(*given)

    def _names(self, kind: str) -> dict[str, str]:
        text, md5 = self.store.generate_msgdef(kind, ros_version=1)
        return {"text": text, "md5": md5}


def ros_python() -> str:
    """The first ``python3`` of the system's that imports ROS 1; a `LinkError` if none does."""
    pythons = [shutil.which("python3", path=folder) for folder in os.get_exec_path()]
    for python in dict.fromkeys([*filter(None, pythons), "/usr/bin/python3"]):
        # Not what lies in the working folder under a name of Python's.
        code = "import sys; sys.path[:] = filter(None, sys.path); import rospy"
        done = subprocess.run([python, "-c", code], capture_output=True, check=False)
        if done.returncode == 0:
            return python
    raise LinkError(
        "no python3 on PATH can import rospy: source the setup of your ROS 1 first (`source "
        "/opt/ros/noetic/setup.bash`), or install it (`apt-get install python3-rospy`)"
    )


def local_ros1() -> "Ros1":
    """A node in the ROS 1 of this machine, or of ROS_MASTER_URI; a `LinkError` if none answers."""
    here, there = socket.socketpair()
    command = [ros_python(), ros1_node.__file__, str(there.fileno())]
    # A session of its own: Ctrl-C ends adaptune, and that ends the node.
    process = subprocess.Popen(
        command, pass_fds=[there.fileno()], stdout=subprocess.DEVNULL, start_new_session=True
    )
    there.close()

    def end() -> None:
        try:
            # It takes leave of the roscore.
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    try:
        return Ros1(here, lambda: process.poll() is None, end)
    except LinkError as error:
        raise LinkError(f"{error}; start `roscore`, and source your ROS's setup") from error


class Ros2Relay(Relay):
    """A node in a running ROS 2, by the process that `main` is."""

    version = 2

    def __init__(self, *given: Any):
        self.store = message_types()
        self.encode = self.store.serialize_cdr
        self.decode = lambda data, kind: self.store.deserialize_cdr(memoryview(data), kind)
        super().__init__(*given)

    def why_unheard(self, topic: str) -> str:
        why = str(self.ask("state", topics=[topic], own=[])["unheard"][topic])
        # Who hears it is on this machine.
        return "" if BUFFER_CURE in why and receives_clouds() else why


def receives_clouds() -> bool:
    """Whether sockets of this machine hold some clouds, unless they ask for something else."""
    with contextlib.suppress(OSError, ValueError):
        return int(Path("/proc/sys/net/core/rmem_default").read_text()) >= RECEIVE_BUFFER
    return False
