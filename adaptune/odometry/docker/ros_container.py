"""A ROS 1 system in a container: a roscore, the system's nodes, and adaptune's node beside them."""

import contextlib
import logging
import os
import re
import shlex
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import cache
from pathlib import Path
from typing import Any

from adaptune import hosting, ros
from adaptune.odometry.base import OdometryError, Usage
from adaptune.odometry.docker.engine import (
    Container,
    ContainerSettings,
    EngineError,
    Mount,
    default_user,
    image_digest,
)
from adaptune.ros.ros1 import Ros1
from adaptune.ros.ros_link import LinkError

CLOCK = "rosgraph_msgs/msg/Clock"
_FOLDER = "/adaptune"
_ENVIRONMENT = {
    "ROS_HOSTNAME": "localhost",
    "ROS_MASTER_URI": "http://localhost:11311",
    "ROS_HOME": f"{_FOLDER}/ros",
    "ROS_LOG_DIR": f"{_FOLDER}/ros/log",
    "PYTHONDONTWRITEBYTECODE": "1",
    "PYTHONUNBUFFERED": "1",
}
_FIND = 'for package in {packages}; do rospack find "$package" >/dev/null 2>&1 && {then}; done; '
_MASTER = (
    "command -v roslaunch >/dev/null || . /opt/ros/*/setup.bash; "
    "for python in python3 python; do "
    f'"$python" {_FOLDER}/ros1_container.py {_FOLDER}/link {{use_sim_time}}; '
    "code=$?; [ $code = 9 ] || [ $code = 127 ] || exit $code; "
    "done; echo 'no Python of the image imports rospy: is it a ROS 1 image?' >&2; exit 127"
)
_CLOSING = re.compile(
    rb"(\x1b\[\d*m)*(=*|log file: .*|Initiating shutdown!|\[\S+\] killing on exit|"
    rb"all processes on machine have died.*|(\.\.\. )?shutting down .*|done)(\x1b\[\d*m)*"
)
"""Lines that roslaunch writes at its end, after the last ones of the nodes."""
_LAUNCH = (
    "command -v roslaunch >/dev/null || . /opt/ros/*/setup.bash; "
    f"exec > {_FOLDER}/roslaunch.log 2>&1; "
    + _FIND.replace("{then}", 'exec roslaunch --wait "$package" {launch}')
    + "echo 'there is no package {packages}'; exit 1"
)
_PROBE = (
    "command -v roslaunch >/dev/null || . /opt/ros/*/setup.bash; "
    "command -v roslaunch >/dev/null || exit 1; " + _FIND.replace("{then}", "exit 0") + "exit 1"
)
_BETWEEN_LOOKS = 0.1
_OTHERS_ONLY = 10.0
"""Seconds in which nodes have subscribed to other topics only."""
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

    Parameters
    ----------
    settings
        A `RustleSettings`.
    memory
        Gigabytes.
    parameters
        Text of the parameter file.
    mounts
        More files and folders of the host.

    Raises
    ------
    OdometryError
        If there is no such image, or it holds no ROS 1.
    """

    def __init__(self, settings: Any, memory: float, parameters: str, mounts: Sequence[Mount] = ()):
        self._settings, self._topics = settings, [settings.odometry]
        self._folder = tempfile.TemporaryDirectory(prefix="adaptune-", ignore_cleanup_errors=True)
        self.folder = Path(self._folder.name)
        self.folder.chmod(0o777)  # for any user of the image
        self._clock: SimClock | None = None
        self._play: str | None = None
        for name in ("ros1_node.py", "ros1_container.py"):
            shutil.copy(Path(ros.__path__[0]) / name, self.folder)
        file = self.folder / "params.yaml"
        file.write_text(parameters, encoding="utf-8")
        file.chmod(0o644)
        with contextlib.ExitStack() as undo:
            undo.callback(self._folder.cleanup)
            user = ros_user(settings)
            self._environment = dict(_ENVIRONMENT)
            if user.partition(":")[0] not in ("0", "root"):
                self._environment["HOME"] = _FOLDER
            with socket.socket(socket.AF_UNIX) as server:
                server.bind(str(self.folder / "link"))
                (self.folder / "link").chmod(0o777)
                server.listen()
                sim = {None: "''", True: "true", False: "false"}[settings.use_sim_time]
                self._container = Container(
                    settings,
                    memory,
                    ["/bin/bash", "-l", "-c", _MASTER.format(use_sim_time=sim)],
                    [
                        Mount(self.folder, _FOLDER, writable=True),
                        Mount(file, "/rustle/config/params.yaml"),
                        *mounts,
                    ],
                    user=user,
                    environment=self._environment,
                    bare=True,
                )
                undo.callback(self._container.close)
                try:
                    self._launch = self._container.run(self._launched(), self._environment)
                except EngineError as error:
                    time.sleep(_UNTIL_NOTED)
                    raise self._no_roscore() or error from error
                connection = self._accept(server)
            self.link = Ros1(connection, self._running, self._container.close)
            undo.pop_all()

    def _launched(self) -> str:
        launch = " ".join(("rustle.launch", *self._settings.arguments))
        return _LAUNCH.format(packages=" ".join(self._settings.packages), launch=launch)

    def _running(self) -> bool:
        return self._container.ended() is None

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
        return OdometryError(f"no roscore: {hosting.verdict(code)}: {words}")

    def state(self) -> dict[str, Any]:
        """What adaptune's node sees, see `ros1_node`; an error where the system has ended.

        Raises
        ------
        OdometryError
            It names the node that has died.
        """
        found: dict[str, Any] = self.link.ask("state", topics=self._topics)
        if found["dead"]:
            raise OdometryError(f"node {found['dead'][0]} died")
        if (code := self._container.finished(self._launch)) is not None:
            raise OdometryError(f"roslaunch ended with code {code}")
        return found

    def wait(self, topic: str, connected: bool = False) -> None:
        """Wait until a node subscribes to a topic, and is connected if adaptune publishes it.

        Raises
        ------
        OdometryError
            If none does in time; it names the topics to which nodes subscribe.
        """
        self._topics.append(topic)
        begin = changed = time.monotonic()
        before: AbstractSet[str] = set()
        while (now := time.monotonic()) - begin < self._settings.ready:
            state = self.state()
            heard = state["subscribed"].keys() - {"/clock"}
            if heard != before:
                before, changed = heard, now
            elif topic in heard:
                # A node subscribes to one after the other.
                if not connected or state["sending"].get(topic, 0):
                    return
            elif heard and now - changed > _OTHERS_ONLY:
                break
            time.sleep(_BETWEEN_LOOKS)
        others = ", ".join(sorted(before)) or "none"
        raise OdometryError(
            f"no node subscribed to the clouds' topic {topic} in {now - begin:.0f} s (topics with "
            f"subscribers: {others}); name the topic that the system hears as "
            f"odometry.settings.points, or change it in the template"
        )

    def play(self, bag: str, rate: float, renamed: Mapping[str, str]) -> None:
        """Begin to play a bag that is mounted in the container."""
        names = " ".join(f"{old}:={new}" for old, new in renamed.items())
        self._play = self._container.run(
            f"exec rosbag play --quiet --clock -r {rate:g} '{bag}' {names} "
            f"> {_FOLDER}/rosbag.log 2>&1",
            self._environment,
        )

    def played(self) -> bool:
        """Whether the bag has been played to its end; an error if that went wrong."""
        code = self._container.finished(str(self._play))
        if code:
            words = _last_lines(self.folder / "rosbag.log")
            raise OdometryError(f"rosbag play ended with code {code}: {words}")
        return code is not None

    def run_clock(self, stamp: int, rate: float = 1.0) -> "SimClock":
        """Publish a clock from now on, until this is closed."""
        if self._clock is None:
            self._clock = SimClock(self.link, stamp, rate)
        return self._clock

    def run(self, command: list[str]) -> tuple[int, str]:
        """Run a command of the image; its exit code and what it wrote."""
        return self._container.call(["/bin/bash", "-l", "-c", shlex.join(command)])

    def used(self) -> Usage:
        """What the system's nodes have used; the memory is the sum of their peaks."""
        nodes = self.link.ask("state", topics=self._topics)["nodes"].values()
        return Usage(sum(cpu for cpu, _ in nodes), sum(memory for _, memory in nodes))

    def words(self) -> str:
        """The last lines that the system wrote."""
        if self._container.out_of_memory:
            return "it was out of isolation.memory"
        return _last_lines(self.folder / "roslaunch.log")

    def keep(self, folder: Path) -> None:
        """Copy what was written to a folder."""
        for file in ("params.yaml", "roslaunch.log", "rosbag.log"):
            with contextlib.suppress(OSError):
                shutil.copy(self.folder / file, folder)
        with contextlib.suppress(OSError, shutil.Error):
            shutil.copytree(self.folder / "ros" / "log", folder / "ros", dirs_exist_ok=True)
        (folder / "roscore.log").write_bytes(self._container.log())

    def close(self) -> None:
        """Remove the container."""
        if self._clock is not None:
            self._clock.close()
            self._clock = None
        self._container.close()
        self.link.close()
        self._folder.cleanup()


class SimClock:
    """Publishes ``/clock``, and goes on by itself, so that nodes that sleep by it wake up.

    Parameters
    ----------
    link
        A node in the system's ROS.
    stamp
        Nanoseconds at which it begins.
    rate
        Seconds of it in a second.
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


def _last_lines(path: Path) -> str:
    with contextlib.suppress(OSError), path.open("rb") as file:
        file.seek(max(file.seek(0, os.SEEK_END) - _TAIL, 0))
        lines = [line for line in file.read().splitlines() if not _CLOSING.fullmatch(line)]
        return hosting.plain_lines(re.sub(rb"={10,}", b"", b"\n".join(lines)))
    return ""


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
        while (code := container.ended()) is None:
            time.sleep(0.02)
    if code:
        _log.info("only root finds %s in the image, so root runs it", packages)
        return "0"
    return user
