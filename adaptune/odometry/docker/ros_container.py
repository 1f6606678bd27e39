"""A ROS 1 system in a container: a roscore, the system's nodes, and adaptune's node beside them."""

import contextlib
import logging
import os
import re
import shlex
import shutil
import socket
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import cache
from pathlib import Path
from typing import Any

from adaptune import processes
from adaptune.errors import OdometryError, UnavailableError
from adaptune.odometry.base import Usage
from adaptune.odometry.docker.engine import (
    Container,
    ContainerSettings,
    Mount,
    copy_regular,
    default_user,
    image_digest,
    make_shared,
    opened,
    regular_files,
    remove_shared,
)
from adaptune.odometry.program import Template
from adaptune.ros import ros1_node
from adaptune.ros.link import LinkError, equal_values
from adaptune.ros.ros1 import Ros1
from adaptune.space import ParameterSet

CLOCK = "rosgraph_msgs/msg/Clock"
_FOLDER, _PROGRAMS = "/adaptune", "/adaptune-programs"
_ENVIRONMENT = {
    "ROS_HOSTNAME": "localhost",
    "ROS_MASTER_URI": "http://localhost:11311",
    "ROS_HOME": f"{_FOLDER}/ros",
    "ROS_LOG_DIR": f"{_FOLDER}/ros/log",
    "PYTHONDONTWRITEBYTECODE": "1",
    "PYTHONUNBUFFERED": "1",
}
_SETUP = "command -v roslaunch >/dev/null || . /opt/ros/*/setup.bash; "
_FIND = 'for package in {packages}; do rospack find "$package" >/dev/null 2>&1 && {then}; done; '
_MASTER = (
    _SETUP + "for python in python3 python; do "
    f'"$python" {_PROGRAMS}/ros1_node.py {_FOLDER}/link {{use_sim_time}}; '
    "code=$?; [ $code = 9 ] || [ $code = 127 ] || exit $code; "
    "done; echo 'no Python of the image imports rospy: is it a ROS 1 image?' >&2; exit 127"
)
_NOISE = re.compile(
    rb"(\x1b\[\d*m)*(=*|/|  \S+ \(\S+/\S+\)|NODES|auto-starting new master|ROS_MASTER_URI=.*|"
    rb"process\[\S+\]: started with pid \[\d+\]|roscore/master is not yet running.*|"
    rb"master has started.*|.*rustle\.launch http\S*|log file: .*|Initiating shutdown!|"
    rb"\[\S+\] killing on exit| \* /\S+: .*|PARAMETERS|SUMMARY|started roslaunch server .*|"
    rb"\.\.\. logging to .*|Checking log directory .*|Press Ctrl-C .*|Done checking log .*|"
    rb"all processes on machine have died.*|(\.\.\. )?shutting down .*|done)(\x1b\[\d*m)*"
)
"""Lines that roslaunch writes at its begin and at its end, before and after those of the nodes."""
_LAUNCH = (
    _SETUP
    + f"exec > {_FOLDER}/roslaunch.log 2>&1; "
    + _FIND.replace("{then}", 'exec roslaunch --wait "$package" {launch}')
    + "echo 'there is no package {packages}'; exit 1"
)
_PROBE = (
    _SETUP
    + "command -v roslaunch >/dev/null || exit 1; "
    + _FIND.replace("{then}", "exit 0")
    + "exit 1"
)
_PLAYER = "player=$(ls /opt/ros/*/lib/rosbag/play /usr/lib/rosbag/play 2>/dev/null | head -n 1); "
"""What `rosbag play` runs; Python takes half a second to find it."""
_BETWEEN_LOOKS = 0.05
_TAIL = 1 << 14
"""Bytes of a log in which its last lines are."""
_UNTIL_NOTED = 0.5
"""Seconds in which the engine notes that a container has ended."""
_TICK = 0.01
"""Seconds."""
_START = 30.0
"""Seconds for a roscore."""

_log = logging.getLogger(__name__)


class RosSystem:
    """A container with the nodes that a launch file starts.

    There is an `OdometryError` if there is no such image, or it holds no ROS 1. The settings are
    `RustleSettings`, the memory in gigabytes, the parameters the text of a file. The caller removes
    the folder, which is empty.
    """

    def __init__(
        self,
        settings: Any,
        memory: float,
        parameters: str,
        folder: Path,
        mounts: Sequence[Mount] = (),
    ):
        self._settings, self._topics = settings, [settings.odometry]
        self._user, self.usage = ros_user(settings), Usage(0.0, 0.0)
        self._clock: SimClock | None = None
        self._play: str | None = None
        self.folder, given = make_shared(folder / "shared"), folder / "given"
        given.mkdir()
        shutil.copy(ros1_node.__file__, given)
        self._parameters = given / "params.yaml"
        self._parameters.write_text(parameters, encoding="utf-8")
        for file in given.iterdir():
            file.chmod(0o644)
        given.chmod(0o755)
        mounts = [
            Mount(self.folder, _FOLDER, writable=True),
            Mount(given, _PROGRAMS),
            Mount(self._parameters, "/rustle/config/params.yaml"),
            *mounts,
        ]
        self._environment = dict(_ENVIRONMENT)
        if self._user.partition(":")[0] not in ("0", "root"):
            self._environment["HOME"] = _FOLDER
        with contextlib.ExitStack() as undo:
            with socket.socket(socket.AF_UNIX) as server:
                with processes.socket_name(self.folder / "link") as name:
                    server.bind(name)
                (self.folder / "link").chmod(0o777)
                server.listen()
                self._container = self._start(memory, mounts)
                undo.callback(self.stop)
                launch = " ".join(("rustle.launch", *settings.arguments))
                command = _LAUNCH.format(packages=" ".join(settings.packages), launch=launch)
                try:
                    self._launch = self._container.run(command, self._environment)
                except UnavailableError:
                    raise
                except OdometryError as error:
                    time.sleep(_UNTIL_NOTED)
                    raise self._no_roscore() or error from error
                connection = self._accept(server)
            running = lambda: self._container.ended() is None  # noqa: E731
            self.link = Ros1(connection, running, self._container.close)
            undo.pop_all()

    def _start(self, memory: float, mounts: Sequence[Mount]) -> Container:
        sim = {None: "''", True: "true", False: "false"}[self._settings.use_sim_time]
        return Container(
            self._settings,
            memory,
            ["/bin/bash", "-l", "-c", _MASTER.format(use_sim_time=sim)],
            mounts,
            user=self._user,
            environment=self._environment,
            bare=True,
            hurried=True,
        )

    def _accept(self, server: socket.socket) -> socket.socket:
        server.settimeout(_BETWEEN_LOOKS)
        begin = time.monotonic()
        while time.monotonic() - begin < _START:
            with contextlib.suppress(TimeoutError):
                return server.accept()[0]
            if (failure := self._no_roscore()) is not None:
                raise failure
        raise OdometryError(f"there was no roscore in {_START:g} s: {self._container.last_lines()}")

    def _no_roscore(self) -> OdometryError | None:
        """How the container ended; None while it runs."""
        if (code := self._container.ended()) is None:
            return None
        words = self._container.last_lines()
        return OdometryError(f"no roscore: {processes.how_it_ended(code)}: {words}")

    def state(self) -> dict[str, Any]:
        """What `ros1_node` sees; an `OdometryError` where the system has ended."""
        found: dict[str, Any] = self.link.ask("state", topics=self._topics)
        nodes = found["nodes"].values()
        self.usage = Usage(sum(cpu for cpu, _ in nodes), sum(memory for _, memory in nodes))
        if found["dead"]:
            raise OdometryError(f"node {found['dead'][0]} died")
        if (code := self._container.finished(self._launch)) is not None:
            raise OdometryError(f"roslaunch ended with code {code}")
        return found

    def wait(self, topic: str, sent: Sequence[str] = ()) -> None:
        """Wait until a node subscribes to the clouds' topic, and hears what adaptune sends.

        An `OdometryError` names the topics to which nodes subscribe if none does in time.
        """
        self._topics.append(topic)
        begin = time.monotonic()
        before: AbstractSet[str] = set()
        while time.monotonic() - begin < self._settings.ready:
            state = self.state()
            heard = state["subscribed"].keys() - {"/clock"}
            # A node subscribes to one after the other.
            if heard != before:
                before = heard
            elif topic in heard and all(state["sending"].get(t, 0) for t in sent if t in heard):
                self._container.hold_to_cores()
                return
            time.sleep(_BETWEEN_LOOKS)
        others = ", ".join(sorted(before)) or "none"
        raise OdometryError(
            f"no node subscribed to the clouds' topic {topic} in {self._settings.ready:g} s "
            f"(topics with subscribers: {others}); name the topic that the system hears as "
            f"odometry.settings.points, or change it in the template"
        )

    def play(self, bag: str, rate: float, renamed: Mapping[str, str]) -> None:
        """Begin to play a bag that is mounted in the container."""
        names = " ".join(f"{old}:={new}" for old, new in renamed.items())
        self._play = self._container.run(
            f"{_SETUP}{_PLAYER}exec ${{player:-rosbag play}} --quiet --clock --delay 0.3 "
            f"-r {rate:g} {shlex.quote(bag)} {names} > {_FOLDER}/rosbag.log 2>&1",
            self._environment,
        )

    def played(self) -> bool:
        """Whether the bag has been played to its end; an error if that went wrong."""
        code = self._container.finished(str(self._play))
        if code:
            words = self._last_lines("rosbag.log")
            raise OdometryError(f"rosbag play ended with code {code}: {words}")
        return code is not None

    def run_clock(self, stamp: int, rate: float = 1.0) -> "SimClock":
        """Publish a clock from now on, until this is closed."""
        if self._clock is None:
            self._clock = SimClock(self.link, stamp, rate)
        return self._clock

    def run(self, command: list[str]) -> tuple[int, str]:
        """Run a command of the image; its exit code and the last lines that it wrote."""
        run = self._container.run(f"{shlex.join(command)} > {_FOLDER}/run.log 2>&1")
        end = time.monotonic() + self._settings.ready
        while (code := self._container.finished(run)) is None:
            if time.monotonic() > end:
                raise OdometryError(f"{command[0]} did not end in {self._settings.ready:g} s")
            time.sleep(_TICK)
        return code, self._last_lines("run.log")

    def words(self) -> str:
        """The last lines that the system wrote."""
        with contextlib.suppress(OdometryError):
            self._container.ended()
        if self._container.out_of_memory:
            return "out of isolation.memory"
        return self._last_lines("roslaunch.log")

    def _last_lines(self, name: str) -> str:
        with opened(self.folder / name, self.folder) as file:
            if file is None:
                return ""
            file.seek(max(file.seek(0, os.SEEK_END) - _TAIL, 0))
            lines = [line for line in file.read().splitlines() if not _NOISE.fullmatch(line)]
            return processes.plain_lines(re.sub(rb"={10,}", b"", b"\n".join(lines)))

    def log(self) -> bytes:
        """What the roscore wrote."""
        return self._container.log()

    def keep(self, folder: Path) -> None:
        """Copy what was written, and what was given, to a folder."""
        shutil.copy(self._parameters, folder)
        for name in ("roslaunch.log", "rosbag.log"):
            copy_regular(self.folder / name, self.folder, folder / name)
        logs = self.folder / "ros" / "log"
        for path in regular_files(logs):
            copy_regular(path, self.folder, folder / "ros" / path.relative_to(logs))

    def stop(self) -> None:
        """Remove the container."""
        if self._clock is not None:
            self._clock.close()
            self._clock = None
        self._container.close()

    def close(self) -> None:
        """Remove the container, and what it has written."""
        self.stop()
        self.link.close()
        remove_shared(self.folder, self._settings.image, self._user)


class SimClock:
    """Publishes ``/clock``, and goes on by itself, so that nodes that sleep by it wake up.

    It begins at a stamp in nanoseconds; `rate` is seconds of it in a second.
    """

    def __init__(self, link: Ros1, stamp: int, rate: float):
        self._types, self._publish = link.store.types, link.advertise("/clock", CLOCK)
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
        self._publish(self._types[CLOCK](clock=time_))


def ros_user(settings: Any) -> str:
    """User who runs ROS in an image: root only where nobody else finds the packages."""
    user = default_user(settings)
    if settings.user is not None:
        return user
    return _probed(image_digest(settings.image), user, " ".join(settings.packages))


@cache
def _probed(image: str, user: str, packages: str) -> str:
    limits = ContainerSettings(image=image)
    command = ["/bin/bash", "-l", "-c", _PROBE.format(packages=packages)]
    container = Container(limits, 1.0, command, user=user, environment={"HOME": "/"}, bare=True)
    with contextlib.closing(container):
        code = container.wait(_START)
    if code != 0:
        _log.info("only root finds %s in the image, so root runs it", packages)
        return "0"
    return user


# What becomes of a parameter set on its way into a ROS 1 system.


def server_keys(
    template: Template, parameters: ParameterSet, held: Any
) -> Mapping[str, Sequence[str]]:
    """Keys of the parameter server that hold each parameter, by its whole name.

    `held` is all that the server holds. There is an `OdometryError` if it does not hold a
    parameter that was put into the template, or another value.
    """
    every = dict(_flat(held))
    keys = {}
    for name, value in parameters.items():
        whole = whole_name(template, name)
        keys[whole] = [key for key in every if key.endswith(f"/{whole}")]
        if not keys[whole]:
            raise OdometryError(
                f"the parameter server holds no {whole}: the launch file does not load "
                f"/rustle/config/params.yaml"
            )
        for key in keys[whole]:
            if not equal_values(value, every[key]):
                what = f"{key} is {every[key]!r} on the parameter server, not {value!r}"
                help_ = "the launch file, or the node, has changed it: is it in the node's range?"
                raise OdometryError(f"{what}: {help_}")
    return keys


def whole_name(template: Template, name: str) -> str:
    """All keys of a parameter, with slashes between them, as ROS has them."""
    return "/".join(template.path_of(name))


def warn_of_unread(link: Ros1, image: str, keys: Mapping[str, Sequence[str]]) -> None:
    """Log, once for an image, which parameters no node has ever asked for."""
    asked = {
        key.rstrip("/")
        for caller, those in link.ask("asked").items()
        if not caller.startswith(("/roslaunch", "/rosparam", "/adaptune"))
        for key in those
    }
    for name, places in keys.items():
        # A node may ask for all that is below a name.
        above = {place[:i] for place in places for i, c in enumerate(place) if c == "/"}
        if not asked & (above | set(places)):
            _warn(image, name)


@cache
def _warn(image: str, name: str) -> None:
    _log.warning(
        "%s: no node has read the parameter %s, so its value changes nothing; is its name in the "
        "template right?",
        image,
        name,
    )


def _flat(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(data, dict):
        for name, value in data.items():
            yield from _flat(value, f"{key}/{name}")
    else:
        yield key, data


def filled(settings: Any, parameters: ParameterSet) -> tuple[Template, str]:
    """The template, and its text with the parameters."""
    template = Template(Path(settings.template))
    return template, template.fill(parameters)
