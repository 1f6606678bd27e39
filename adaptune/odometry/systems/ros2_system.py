"""A ROS 2 system in a container, or on this machine, and adaptune's node in its network."""

import contextlib
import fcntl
import logging
import re
import socket
import subprocess
import sys
import tempfile
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, field_validator
from rosbags.highlevel import AnyReader
from rosbags.typesys.store import Typestore

from adaptune._system import processes
from adaptune.errors import OdometryError, import_extra, in_a_line, nearest
from adaptune.geometry import to_pose, to_quaternions
from adaptune.odometry.base import Usage
from adaptune.odometry.systems.engine import Container, Mount, own_container
from adaptune.odometry.systems.ros_system import RosSettings, RosSystem, SimClock, image_user
from adaptune.odometry.systems.rustle import Rustle
from adaptune.odometry.template import Template, placeholders, replace
from adaptune.recording.clouds import LIVOX_TYPES
from adaptune.recording.config import Transform
from adaptune.recording.pose_messages import POSES, TRANSFORMS
from adaptune.ros.link import LinkError
from adaptune.ros.relay import Ros2Relay
from adaptune.ros.steering import equal_values
from adaptune.space import ParameterSet

_FOLDER, _PARAMETERS = "/adaptune", "/adaptune-parameters/params.yaml"
_MODULE = "adaptune.ros.ros2_node"
_FIND_NODES = """\
command -v ros2 >/dev/null || for file in /opt/ros/*/setup.bash; do
    [ ! -r "$file" ] || . "$file"
done
"""
_SETUP = """\
for file in ./install/setup.bash /*/install/setup.bash /root/*/install/setup.bash \
        /home/*/*/install/setup.bash; do
    [ ! -r "$file" ] || . "$file"
done
"""
"""As a workspace is sourced, wherever the image has one."""
_RUN = 'exec > "$ADAPTUNE_LOG" 2>&1; exec "$@"'
_PROBE = r"""
command -v "$1" >/dev/null || exit 1
case "$1 $3" in ros2\ */*) [ -r "$3" ]; exit;; esac
[ "$1" != ros2 ] || for prefix in ${AMENT_PREFIX_PATH//:/ }; do
    [ ! -e "$prefix/share/$3/package.xml" ] || exit 0
done
[ "$1" != ros2 ]
"""
DIED = re.compile(
    rb"\[ERROR\] \[([\w./-]+?)(?:-\d+)?\]: process has died \[pid \d+, exit code (-?\d+)"
)
"""What `ros2 launch` writes, which may go on."""
NOISE = re.compile(
    rb"\[INFO\] \[(launch|[\w.-]+)\]: (All log files|Default logging|process started).*"
)
_BETWEEN_LOOKS, _BETWEEN_STATES = 0.3, 0.05  # seconds
_NOT_FOUND = 127  # a shell's exit code
_UNDECLARED = 3.0  # seconds in which a node that subscribes declares its parameters
_MATCHED = 3.0  # seconds in which nodes find what is published
_LEAD = 300_000_000  # nanoseconds between the begin of the clock and of the recording
_DOMAINS = range(60, 101)
"""Of systems on this machine; ports of higher ones are given to other programs."""
_PORT, _PORTS = 7400, 250  # the first port of the first domain, and how many each has

_log = logging.getLogger(__name__)


class Ros2System(RosSystem):
    """A ROS 2 system as it is started by hand, in an image or on this machine.

    Adaptune's node shares the container's network; here, a domain keeps it apart from others.
    """

    ros = 2
    link: Ros2Relay
    _log_name, _noise, _inside = "output.log", NOISE, _FOLDER
    _node: Any = None
    _player: "_Player | None" = None
    _looked = -float("inf")

    def _begin(self) -> None:
        self._dead: dict[bytes, bytes] = {}  # exit codes by nodes
        settings = self._settings
        common = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "PYTHONUNBUFFERED": "1"}
        if settings.image is None:
            self._inside = str(self.folder)
            domain, self._domain = _free_domain()
            common["ROS_DOMAIN_ID"] = str(domain)
            node = [sys.executable, "-m", _MODULE, f"{self.folder}/link"]
            self._node = processes.Program(node, 1.0, environment=common)
            parameters = str(self._parameters)
        else:
            common["ROS_DOMAIN_ID"] = "0"
            user = self._user = image_user(
                settings, _FIND_NODES + _SETUP + _PROBE, *settings.command[:3]
            )
            self._node = own_container(["-m", _MODULE, f"{self.folder}/link"], self.folder, common)
            self._parameters.chmod(0o644)
            self._given.chmod(0o755)
            parameters = _PARAMETERS
        logs = f"{self._inside}/ros"
        environment = common | {
            "ADAPTUNE_LOG": f"{self._inside}/{self._log_name}",
            "ROS_HOME": logs,
            "ROS_LOG_DIR": f"{logs}/log",
        }
        values = {"points": settings.points, "imu": settings.imu, "parameters": parameters}
        command = [replace(argument, values) for argument in settings.command]
        setup = _FIND_NODES if settings.image is None else _FIND_NODES + _SETUP
        shell = ["/bin/bash", "-l", "-c", setup + _RUN, "bash", *command]
        if settings.image is None:
            self._container = processes.Program(shell, self._memory, environment=environment)
            return
        if user.partition(":")[0] not in ("0", "root"):
            environment["HOME"] = _FOLDER
        mounts = [
            Mount(self.folder, _FOLDER, writable=True),
            Mount(self._given, str(Path(_PARAMETERS).parent)),
        ]
        self._container = Container(
            settings,
            self._memory,
            shell,
            mounts,
            user=user,
            environment=environment,
            network_of=self._node,
        )

    def _linked(self, connection: socket.socket) -> Ros2Relay:
        link = Ros2Relay(connection, lambda: self._node.ended() is None, self._node.close)
        if transforms := self._settings.transforms:
            types = link.store.types
            stamped = [_stamped(types, child, *given) for child, given in transforms.items()]
            link.advertise("/tf_static", TRANSFORMS[0])(types[TRANSFORMS[0]](stamped))
        return link

    def _lacking(self) -> OdometryError | None:
        if self._node.ended() is not None:
            return OdometryError(f"adaptune's node ended: {self._node.last_lines()}")
        ended = self._ended()
        return None if ended is None else OdometryError(processes.quoting(ended, self.words()))

    def _ended(self) -> str | None:
        """How the system ended; None while it runs."""
        if (code := self._container.ended()) is None:
            return None
        program = self._settings.command[0]
        if code == _NOT_FOUND and f"exec: {program}: not found" in self.words():
            return f"a login shell of the image finds no {program!r}: is it a ROS 2 image?"
        return f"{' '.join(self._settings.command[:4])}: {processes.how_it_ended(code)}"

    def state(self, fresh: bool = False) -> dict[str, Any]:
        now = time.monotonic()
        if fresh or now - self._looked > _BETWEEN_LOOKS:
            self._looked = now
            used = self._container.used()
            cpu, memory = max(used.cpu, self.usage.cpu), max(used.memory, self.usage.memory or 0.0)
            self.usage = Usage(cpu, memory)
            self._dead |= dict(DIED.findall(self._tail(self._log_name)))
        if self._dead:
            how = [(name, processes.how_it_ended(int(code))) for name, code in self._dead.items()]
            self.died = "; ".join(f"node {name.decode()} died: {ended}" for name, ended in how)
            raise OdometryError(self.died)
        if (ended := self._ended()) is not None:
            raise OdometryError(ended)
        topic = self._settings.odometry
        state: dict[str, Any] = self.link.ask("state", topics=self._topics[1:], own=[topic])
        kinds = state["published"].get(topic) or [TRANSFORMS[0]]
        if kinds[0] not in POSES:
            raise OdometryError(
                f"{topic} is {kinds[0]}; odometry.settings.odometry must name poses"
            )
        if len(senders := state["senders"][topic]) > 1 and kinds[0] not in TRANSFORMS:
            names = " and ".join(senders)
            raise OdometryError(f"{topic} is published by two ({names}), whose poses would mix")
        return state

    def cloud_type(self, topic: str) -> str:
        while time.monotonic() - self._begun < self._settings.ready:
            heard = self.state()["subscribed"]
            if kinds := heard.get(topic):
                livox = [kind for kind in kinds if kind in LIVOX_TYPES]
                return str(livox[0]) if livox else super().cloud_type(topic)
            self._tell(topic, heard.keys())
            time.sleep(_BETWEEN_STATES)
        return super().cloud_type(topic)  # what waits for it says what is wrong

    @staticmethod
    def laid_out(template: Template, text: str) -> str:
        if template.ros2:
            return text
        text = re.sub(r"(?m)^(---|%).*$", "", text)
        return "/**:\n  ros__parameters:\n" + textwrap.indent(text, "    ")

    def whole_name(self, template: Template, name: str) -> str:
        return template.ros2_name(name)

    def check(self, template: Template, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if no node declares a parameter, or one holds another value."""
        wanted = {self.whole_name(template, name): value for name, value in parameters.items()}
        end = time.monotonic() + _UNDECLARED
        while True:
            nodes: dict[str, Any] = {}
            with contextlib.suppress(LinkError):  # nodes that are busy do not answer
                nodes = self.link.ask("parameters")
            held = [(n, k, v) for n, all_ in nodes.items() for k, v in all_.items() if k in wanted]
            lacking = wanted.keys() - {name for _, name, _ in held}
            if not lacking or time.monotonic() > end:
                break
            time.sleep(0.1)
        if lacking and nodes:
            name, declared = min(lacking), sorted({k for all_ in nodes.values() for k in all_})
            raise OdometryError(
                f"no node declares the parameter {name}, so its value changes nothing; "
                f"{nearest(name, declared)}"
            )
        if lacking:
            what = "%s: no node tells its parameters, so nobody knows whether %s has any effect"
            _log.warning(what, self._settings.image or self._settings.command[0], min(lacking))
        for node, name, value in held:
            if not equal_values(wanted[name], value):
                raise OdometryError(
                    f"{node} holds {name} = {value!r}, not {wanted[name]!r}: does it read the file "
                    f"{{parameters}}, and has the launch file another value?"
                )

    def play(self, rate: float, renamed: Mapping[str, str]) -> None:
        assert self._recording is not None
        clock = self.run_clock(int(self._recording.stamps[0]) - _LEAD, rate)
        heard = self.state()["subscribed"]
        publish, store = {}, self.link.store
        with AnyReader([self._recording.path]) as reader:
            for connection in reader.connections:
                topic, kind = connection.topic, connection.msgtype
                kinds = heard.get(renamed.get(topic, topic), ())
                # The two drivers of Livox have the same messages.
                kind = next((k for k in kinds if {k, kind} <= set(LIVOX_TYPES)), kind)
                if kind in kinds and kind in store.types:
                    sent = renamed.get(topic, topic)
                    publish[topic] = kind, self.link.advertise_bytes(sent, kind)
        end = time.monotonic() + _MATCHED
        while not all(self.state()["sending"].values()) and time.monotonic() < end:
            time.sleep(_BETWEEN_STATES)
        self._player = _Player(self._recording.path, rate, clock, store, publish)

    def played(self) -> bool:
        assert self._player is not None
        if (error := self._player.error) is not None:
            raise OdometryError(f"the recording cannot be played: {in_a_line(error)}")
        return not self._player.is_alive()

    def stop(self) -> None:
        if self._player is not None:
            self._player.ended.set()
            self._player.join()
            self._player = None
        super().stop()
        if self._node is not None:
            self._node.close()

    def close(self) -> None:
        super().close()
        if self._settings.image is None:
            self._domain.close()


def _stamped(types: Mapping[str, Any], child: str, parent: str, given: Any) -> Any:
    """A frame's pose in another one, as a message."""
    T = to_pose(given)
    return types["geometry_msgs/msg/TransformStamped"](
        types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), parent),
        child,
        types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](*T[:3, 3].tolist()),
            types["geometry_msgs/msg/Quaternion"](*to_quaternions(T[None])[0].tolist()),
        ),
    )


class _Player(threading.Thread):
    """Publishes the messages of a recording that a system hears, each when it is due."""

    error: Exception | None = None

    def __init__(
        self,
        path: Path,
        rate: float,
        clock: SimClock,
        store: Typestore,
        publish: Mapping[str, tuple[str, Callable[[Any], None]]],
    ):
        super().__init__(daemon=True)
        self._path, self._rate, self._clock = path, rate, clock
        self._store, self._publish = store, publish
        self.ended = threading.Event()
        self.start()

    def run(self) -> None:
        try:
            with AnyReader([self._path]) as reader:
                self._play(reader)
        except LinkError:
            pass  # whoever asks for the system's state learns why
        except Exception as error:
            self.error = error

    def _play(self, reader: AnyReader) -> None:
        chosen = [c for c in reader.connections if c.topic in self._publish]
        begin, first = time.monotonic(), None
        for connection, stamp, raw in reader.messages(connections=chosen):
            first = stamp if first is None else first
            due = begin + 1e-9 * (stamp - first) / self._rate
            if self.ended.wait(max(0.0, due - time.monotonic())):
                return
            self._clock.reach(stamp)
            kind, publish = self._publish[connection.topic]
            publish(raw if reader.is2 else self._store.ros1_to_cdr(raw, kind))


def _free_domain() -> tuple[int, Any]:
    """A ROS domain in which nobody is on this machine, and an open file that holds it."""
    taken = {(port - _PORT) // _PORTS for port in _ports()}
    for number in _DOMAINS:
        path = Path(tempfile.gettempdir()) / f"adaptune-ros-domain-{number}.lock"
        with contextlib.suppress(OSError):
            file = path.open("a")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                file.close()
                continue
            if number not in taken:
                return number, file
            file.close()
    which = f"from {_DOMAINS[0]} to {_DOMAINS[-1]}"
    raise OdometryError(f"all ROS domains {which} are in use on this machine; end what runs there")


def _ports() -> Iterator[int]:
    """UDP ports that programs of this machine hold."""
    for name in ("udp", "udp6"):
        with contextlib.suppress(OSError):
            for line in Path("/proc/net", name).read_text().splitlines()[1:]:
                yield int(line.split()[1].rpartition(":")[2], 16)


class Ros2Settings(RosSettings):
    """A ROS 2 system as it is started by hand; without an image, that of this machine."""

    system: ClassVar[type[RosSystem]] = Ros2System
    input: ClassVar[str] = "either"

    image: str | None = Field(None, min_length=1)  # type: ignore[assignment]
    command: tuple[str, ...] = Field(min_length=1)
    # Poses of frames in others, by their names, as in imu_link: [lidar, [0, 0, 0.1, 0, 0, 0, 1]].
    transforms: dict[str, tuple[str, Transform]] = Field(default_factory=dict)
    play: Literal["bag", "lockstep"] = "lockstep"

    @field_validator("command")
    @classmethod
    def _names_file(cls, command: tuple[str, ...]) -> tuple[str, ...]:
        known = ("parameters", "points", "imu")
        names = [name for argument in command for name in placeholders(argument)]
        for name in names:
            if name not in known:
                raise ValueError(f"{{{name}}} is nothing; {nearest(name, known)}")
        if "parameters" not in names:
            raise ValueError(
                "no argument holds {parameters}, which stands for the parameter file; give it as "
                "the launch file takes it, as in params_file:={parameters}"
            )
        return command


class Ros2(Rustle):
    """A ROS 2 system, run on a recording that is played, or scan by scan."""

    settings_type = Ros2Settings

    @staticmethod
    def check(settings: Any, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if the system is not here, or a parameter is not in its file."""
        Rustle.check(settings, parameters)
        import_extra("ros2", "cyclonedds")
        if settings.image is not None:
            return
        program = settings.command[0]
        find = ["/bin/bash", "-l", "-c", _FIND_NODES + 'command -v "$1"', "bash", program]
        if subprocess.run(find, capture_output=True, check=False).returncode:
            raise OdometryError(
                f"command: a login shell of this machine finds no {program!r}; source your ROS 2 "
                f"in ~/.bash_profile, or name an image"
            )
