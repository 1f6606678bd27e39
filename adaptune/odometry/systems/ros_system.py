"""A ROS system under adaptune's eyes: its nodes, and adaptune's node beside them."""

import contextlib
import logging
import os
import re
import shutil
import socket
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator
from rosbags.serde import SerdeError

from adaptune._system import processes
from adaptune.errors import OdometryError
from adaptune.geometry import Poses, invert, to_pose, to_quaternions
from adaptune.odometry.base import Usage
from adaptune.odometry.program import ProgramInput, WholeSettings
from adaptune.odometry.systems import engine
from adaptune.odometry.template import Template
from adaptune.recording.config import resolve
from adaptune.recording.pose_messages import POSES, TRANSFORMS, Pose, message_stamp
from adaptune.ros.link import LinkError
from adaptune.ros.relay import Relay
from adaptune.ros.steering import Run, Steering
from adaptune.space import ParameterSet

QUIET = {"/clock", "/rosout", "/rosout_agg", "/parameter_events"}  # topics of every node
CLOCK_TYPE = "rosgraph_msgs/msg/Clock"
_NODE_POLL = 0.05
_TAIL_BYTES = 1 << 16  # bytes of a log in which its last lines are
_TICK = 0.01  # seconds
_FLOOD = 2000  # messages of a second that are too many
_log = logging.getLogger(__name__)

START_TIMEOUT = 30.0  # seconds in which adaptune's node must be there
LONG = 5.0  # seconds without a node that subscribes to the clouds, after which that is told


def _topic(name: str) -> str:
    if not re.fullmatch(r"/[A-Za-z][\w/]*", name):
        raise ValueError(f"{name!r} is no name in ROS; it begins with a slash, as /Odometry")
    return name


Topic = Annotated[str, AfterValidator(_topic)]


class RosSettings(engine.ContainerSettings, WholeSettings):
    """What ROS systems may set; ``docs/docker.md`` describes it and its defaults."""

    steering: ClassVar[tuple[str, ...]] = ("node",)
    """Settings that only say how parameters change while it runs."""

    template: Annotated[str, AfterValidator(resolve)]
    odometry: Topic
    frame: str = "lidar"
    points: Topic | None = None
    imu: Topic | None = None
    play: Literal["bag", "lockstep"] = "bag"
    rate: float = Field(1.0, ge=0, le=100)
    ready: float = Field(60.0, gt=0, le=3600)
    patience: float = Field(2.0, gt=0, le=3600)
    node: Topic | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.play == "bag" and not self.rate:
            raise ValueError("rate: 0 is for play: lockstep; a bag plays at 1, or at another rate")
        if self.node is not None and self.play == "bag":
            raise ValueError("node: parameters change only with play: lockstep")
        return self


class RosSystem(ABC):
    """The nodes of a system, and a node of adaptune's, which `link` reaches.

    There is an `OdometryError` if it does not begin. The settings are `RosSettings`, the memory in
    gigabytes, the parameters the text of a file. The caller removes the folder, which is empty.
    A recording is given if it is to be played.
    """

    ros: ClassVar[Literal[1, 2]] = 1
    link: Relay
    _log_name: ClassVar[str]
    """Of the log of the nodes."""
    _noise: ClassVar[re.Pattern[bytes]]
    """Lines of it that say nothing."""
    _container: Any = None
    _user: str  # in a container
    _told = False
    died = ""  # which of its nodes died, in words

    def __init__(
        self,
        settings: Any,
        memory: float,
        parameters: str,
        folder: Path,
        recording: ProgramInput | None = None,
    ):
        self._settings, self._topics = settings, [settings.odometry]
        self.usage, self._memory, self._recording = Usage(0.0, 0.0), memory, recording
        self._clock: SimClock | None = None
        self.folder, self._given = engine.make_shared(folder / "shared"), folder / "given"
        self._given.mkdir()
        self._parameters = self._given / "params.yaml"
        self._parameters.write_text(parameters, encoding="utf-8", errors="surrogateescape")
        with contextlib.ExitStack() as undo:
            with socket.socket(socket.AF_UNIX) as server:
                with processes.socket_name(self.folder / "link") as name:
                    server.bind(name)
                (self.folder / "link").chmod(0o777)
                server.listen()
                undo.callback(self.stop)
                self._begin()
                connection = self._accept(server)
            self.link, self._begun = self._linked(connection), time.monotonic()
            undo.pop_all()

    @abstractmethod
    def _begin(self) -> None:
        """Begin the system, and adaptune's node, which connects to the socket ``link``."""

    @abstractmethod
    def _linked(self, connection: socket.socket) -> Relay:
        """The link, by the connection of adaptune's node."""

    @abstractmethod
    def _lacking(self) -> OdometryError | None:
        """Why there is no node of adaptune's, and will be none; None while it may come."""

    @abstractmethod
    def state(self, fresh: bool = False) -> dict[str, Any]:
        """What adaptune's node sees; an `OdometryError` where the system, or a node, has ended.

        What the system has used may be from a little before, unless it is to be `fresh`.
        """

    @abstractmethod
    def check(self, template: Template, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if the nodes hold other parameters."""

    def warn_of_unread(self) -> None:  # noqa: B027
        """Log which of the parameters that were checked no node has read, where that is known."""

    def cloud_type(self, topic: str) -> str:  # noqa: ARG002
        """The type of the messages with points that the system hears."""
        return "sensor_msgs/msg/PointCloud2"

    @staticmethod
    def laid_out(template: Template, text: str) -> str:  # noqa: ARG004
        """A parameter file's text as the nodes read it."""
        return text

    @abstractmethod
    def whole_name(self, template: Template, name: str) -> str:
        """The name that a parameter has in this ROS."""

    @abstractmethod
    def play(self, rate: float, renamed: Mapping[str, str]) -> None:
        """Begin to play the recording, with some topics renamed."""

    @abstractmethod
    def played(self) -> bool:
        """Whether it has been played to its end; an error if that went wrong."""

    def stop(self) -> None:
        """End the system."""
        if self._clock is not None:
            self._clock.close()
            self._clock = None
        if self._container is not None:
            self._container.close()

    def _accept(self, server: socket.socket) -> socket.socket:
        server.settimeout(_NODE_POLL)
        begin = time.monotonic()
        while time.monotonic() - begin < START_TIMEOUT:
            with contextlib.suppress(TimeoutError):
                return server.accept()[0]
            if (failure := self._lacking()) is not None:
                raise failure
        raise OdometryError(f"adaptune's node did not begin in {START_TIMEOUT:g} s: {self.words()}")

    def wait(self, topic: str, sent: Sequence[str] = ()) -> None:
        """Wait until a node subscribes to the clouds' topic, and hears what adaptune sends."""
        self._topics.append(topic)
        before: AbstractSet[str] = set()
        late = False
        while not late:
            late = time.monotonic() - self._begun > self._settings.ready
            state = self.state()
            heard = state["subscribed"].keys() - {"/clock"}
            self._tell(topic, heard)
            # A node subscribes to one after the other.
            if heard != before:
                before = heard
            elif topic in heard and all(state["sending"].get(t, 0) for t in sent if t in heard):
                self._container.hold_to_cores()
                return
            time.sleep(_NODE_POLL)
        if topic in before and (why := self.link.why_unheard(topic)):
            raise OdometryError(why)
        raise OdometryError(
            f"no node subscribed to the clouds' topic {topic} in {self._settings.ready:g} s "
            f"({_heard(before)}); name the topic that the system hears as "
            f"odometry.settings.points, or change it in the template"
        )

    def _tell(self, topic: str, heard: AbstractSet[str]) -> None:
        """Log, once, what is waited for: nodes may take long, as while they load a map."""
        if not self._told and topic not in heard and time.monotonic() - self._begun > LONG:
            self._told = True
            what = "%s: waits up to %g s for a node to subscribe to the clouds' topic %s (%s)"
            name = self._settings.image or self._settings.command[0]
            _log.info(what, name, self._settings.ready, topic, _heard(heard))

    def reader(self) -> "PoseReader":
        """What reads the system's poses."""
        given = self._settings
        fixed = getattr(given, "transforms", None)
        return PoseReader(self.link, given.odometry, given.frame, fixed)

    def run_clock(self, stamp: int, rate: float = 1.0) -> "SimClock":
        """Publish a clock from now on, until this is closed."""
        if self._clock is None:
            self._clock = SimClock(self.link, stamp, rate)
        return self._clock

    def steering(self) -> Steering | None:
        """What sets parameters of the settings' node while it runs, if that is named."""
        if (node := self._settings.node) is None:
            return None
        return Steering(node, partial(self.link.set_parameters, node), *self._command())

    def _command(self) -> tuple[Sequence[str] | None, Run | None]:
        """What sets a parameter in place of ROS, and what runs it, if anything."""
        return None, None

    def words(self) -> str:
        """The last lines that the system wrote."""
        with contextlib.suppress(OdometryError):
            self._container.ended()
        if self._container.out_of_memory:
            return "out of isolation.memory"
        return self._last_lines(self._log_name)

    def _last_lines(self, name: str) -> str:
        tail = self._tail(name).splitlines()
        lines = [line for line in tail if not self._noise.fullmatch(line)]
        return processes.plain_lines(re.sub(rb"={10,}", b"", b"\n".join(lines)))

    def _tail(self, name: str) -> bytes:
        with engine.opened(self.folder / name, self.folder) as file:
            if file is None:
                return b""
            file.seek(max(file.seek(0, os.SEEK_END) - _TAIL_BYTES, 0))
            return file.read()

    def keep(self, folder: Path) -> None:
        """Copy what was written, and what was given, to a folder."""
        shutil.copy(self._parameters, folder)
        for name in (self._log_name, "rosbag.log"):
            engine.copy_regular(self.folder / name, self.folder, folder / name)
        logs = self.folder / "ros" / "log"
        for path in engine.regular_files(logs):
            engine.copy_regular(path, self.folder, folder / "ros" / path.relative_to(logs))

    def close(self) -> None:
        """End the system, and remove what it has written in a container."""
        self.stop()
        self.link.close()
        if (image := self._settings.image) is not None:
            engine.remove_shared(self.folder, image, self._user)


def _heard(topics: AbstractSet[str]) -> str:
    return f"topics with subscribers: {', '.join(sorted(topics - QUIET)) or 'none'}"


class PoseReader:
    """Hears a topic, and reads its poses.

    Of transforms, the poses are those of the sensor's `frame`, by way of all frames between, or
    those of the only frame that moves. `fixed` holds frames that do not move, each with its parent
    and its pose in that; those on ``/tf_static`` are heard, too.
    """

    def __init__(
        self,
        link: Relay,
        topic: str,
        frame: str = "lidar",
        fixed: Mapping[str, tuple[str, Any]] | None = None,
    ):
        self.fault = ""  # what goes wrong with the messages
        self.lacking = ""  # why transforms hold no pose
        self.about = ""  # of which frame the poses are, and in which other one
        self._link, self.topic, self._frame = link, topic, frame
        self._fixed = {child: (into, to_pose(T)) for child, (into, T) in (fixed or {}).items()}
        self._moving: dict[str, tuple[str, Poses]] = {}
        self._n, self._first = 0, np.inf

    def hear(self, take: Callable[[str, bytes], None]) -> None:
        """Have messages taken, unless they are too many."""

        def count(kind: str, data: bytes) -> None:
            now = time.monotonic()
            self._n, self._first = self._n + 1, min(self._first, now)
            if self._n > _FLOOD * max(1.0, now - self._first):
                self.fault = f"it publishes more than {_FLOOD} messages a second on {self.topic}"
            take(kind, data)

        self._link.record(self.topic, count)
        if self.topic.endswith("/tf"):
            self._link.record(f"{self.topic}_static", self._fix)

    def read(self, kind: str, data: bytes) -> list[Pose]:
        """The poses in a message; none if it is of another type."""
        if kind not in POSES:
            return []
        try:
            message = self._link.decode(data, kind)
            if kind in TRANSFORMS:
                return self._sensor(self._frames(message, self._moving))
            if child := getattr(message, "child_frame_id", ""):
                self.about = f"{child} in {message.header.frame_id}"
            return POSES[kind](message)
        except (SerdeError, struct.error, ValueError, IndexError) as error:
            raise OdometryError(f"it publishes a {kind} that cannot be read ({error})") from error

    def _fix(self, kind: str, data: bytes) -> None:
        if kind in TRANSFORMS:
            self._frames(self._link.decode(data, kind), self._fixed)

    @staticmethod
    def _frames(message: Any, known: dict[str, tuple[str, Poses]]) -> dict[str, int]:
        """Note a message's frames; the stamp of each."""
        stamps = {}
        for stamped in message.transforms:
            p, q = stamped.transform.translation, stamped.transform.rotation
            child, parent = stamped.child_frame_id.lstrip("/"), stamped.header.frame_id.lstrip("/")
            known[child] = parent, matrix(p, q)
            stamps[child] = message_stamp(stamped)
        return stamps

    def _sensor(self, stamps: Mapping[str, int]) -> list[Pose]:
        """The sensor's pose, if the frame that carries it has moved now."""
        frame, known = self._frame, {**self._fixed, **self._moving}
        if frame not in {*known, *(parent for parent, _ in known.values())}:
            if len(self._moving) != 1:
                self.lacking = (
                    f"{self.topic} moves {', '.join(sorted(self._moving))}, and does not say where "
                    f"{frame} is; name the sensor's frame as odometry.settings.frame"
                )
                return []
            (frame,) = self._moving
        (*path, into), T = self._upwards(frame)
        carriers = [passed for passed in path if passed in self._moving]
        if not carriers and (below := self._moving_below(into)):
            # The sensor is above its odometry's frame.
            leaf, *others = below
            if others:
                self.lacking = (
                    f"{self.topic} moves {', '.join(sorted(below))} below {into}, so nobody knows "
                    f"in which of them {frame} moves; let the system publish {frame} below the "
                    f"frame of its odometry (as KISS-ICP's invert_odom_tf: false)"
                )
                return []
            (*path, _), T_into_leaf = self._upwards(leaf)
            carriers = [passed for passed in reversed(path) if passed in self._moving]
            into, T = leaf, invert(T_into_leaf) @ T
        upside_down = " (the tree is inverted)" * (into in self._moving)
        self.about = f"{frame} in {into}{upside_down}"
        self.lacking = "" if carriers else f"nothing on {self.topic} moves {frame}"
        if not carriers or carriers[0] not in stamps:
            return []
        types, q = self._link.store.types, np.full(4, np.nan)
        if np.isfinite(T).all():
            (q,) = to_quaternions(T[None])
        position = types["geometry_msgs/msg/Vector3"](*T[:3, 3].tolist())
        rotation = types["geometry_msgs/msg/Quaternion"](*q.tolist())
        return [(stamps[carriers[0]], into, position, rotation)]

    def _upwards(self, frame: str) -> tuple[list[str], Poses]:
        """A frame and those above it, and its pose in the last of them."""
        path, T = [frame], np.eye(4)
        while path[-1] in self._moving or path[-1] in self._fixed:
            parent, T_parent_frame = self._moving.get(path[-1]) or self._fixed[path[-1]]
            path, T = [*path, parent], T_parent_frame @ T
            if parent in path[:-1]:  # a circle
                break
        return path, T

    def _moving_below(self, top: str) -> list[str]:
        """The frames that move below another one, without those that others move with."""
        parents = {parent for parent, _ in self._moving.values()}
        return [f for f in self._moving if f not in parents and self._upwards(f)[0][-1] == top]


def matrix(p: Any, q: Any) -> Poses:
    """A pose of shape (4, 4) from a position and a quaternion, NaN where they are none."""
    try:
        return to_pose((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    except ValueError:
        return np.full((4, 4), np.nan)


class SimClock:
    """Publishes ``/clock`` from a stamp in nanoseconds on, `rate` times as fast as time passes."""

    def __init__(self, link: Relay, stamp: int, rate: float):
        self._types, self._publish = link.store.types, link.advertise("/clock", CLOCK_TYPE)
        self._rate, self._lock = rate, threading.Lock()
        self._begin, self._stamp = time.monotonic(), stamp
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._tick, daemon=True)
        self._thread.start()

    @property
    def now(self) -> int:
        """Its time, in nanoseconds."""
        return self._stamp + int(1e9 * self._rate * (time.monotonic() - self._begin))

    def reach(self, stamp: int) -> None:
        """Go to a time at once; it never goes back."""
        with self._lock:
            if stamp > self.now:
                self._begin, self._stamp = time.monotonic(), stamp
            self._send()

    def close(self) -> None:
        """Stop."""
        self._ended.set()
        self._thread.join()

    def _tick(self) -> None:
        with contextlib.suppress(LinkError):
            while not self._ended.wait(_TICK):
                with self._lock:
                    self._send()

    def _send(self) -> None:
        seconds, nanoseconds = divmod(self.now, 10**9)
        time_ = self._types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        self._publish(self._types[CLOCK_TYPE](clock=time_))


def filled(settings: Any, parameters: ParameterSet) -> tuple[Template, str]:
    """The template, and its text with the parameters."""
    template = Template(Path(settings.template))
    return template, settings.system.laid_out(template, template.fill(parameters))


def image_user(settings: Any, script: str, *words: str) -> str:
    """User who runs ROS in an image: root only where a script succeeds for nobody else."""
    user = engine.default_user(settings)
    if settings.user is not None:
        return user
    return _probed(engine.image_digest(settings.image), user, script, words)


@cache
def _probed(image: str, user: str, script: str, words: tuple[str, ...]) -> str:
    command = ["/bin/bash", "-l", "-c", script, "bash", *words]
    settings, home = engine.ContainerSettings(image=image), {"HOME": "/"}
    container = engine.Container(settings, 1.0, command, user=user, environment=home, bare=True)
    with contextlib.closing(container):
        code = container.wait(START_TIMEOUT)
    if code != 0:
        _log.info("only root finds %s in the image, so root runs it", " ".join(words))
        return "0"
    return user
