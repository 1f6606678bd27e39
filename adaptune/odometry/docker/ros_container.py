"""A ROS 1 system in a container: a roscore, the system's nodes, and adaptune's node beside them."""

import logging
import re
import shlex
import shutil
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from adaptune import processes
from adaptune.errors import OdometryError
from adaptune.odometry.base import Usage
from adaptune.odometry.docker.engine import Container, Mount
from adaptune.odometry.docker.folders import remove_shared
from adaptune.odometry.docker.ros_parameters import server_keys, warn_of_unread
from adaptune.odometry.docker.ros_system import RosSystem, image_user
from adaptune.odometry.template import Template
from adaptune.ros import ros1_node
from adaptune.ros.ros1 import Ros1
from adaptune.ros.steering import Run
from adaptune.space import ParameterSet

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
_UNTIL_NOTED = 0.5
"""Seconds in which the engine notes that a container has ended."""
_TICK = 0.01
"""Seconds."""

_log = logging.getLogger(__name__)


class Ros1System(RosSystem):
    """A container with a roscore, and the nodes that a launch file starts.

    There is an `OdometryError` if there is no such image, or it holds no ROS 1.
    """

    link: Ros1
    _log_name, _noise = "roslaunch.log", _NOISE
    _written = b""

    def _begin(self) -> None:
        settings, self._play = self._settings, ""
        script = _PROBE.format(packages=" ".join(settings.packages))
        user = self._user = image_user(settings, script, *settings.packages)
        shutil.copy(ros1_node.__file__, self._given)
        for file in self._given.iterdir():
            file.chmod(0o644)
        self._given.chmod(0o755)
        mounts = [
            Mount(self.folder, _FOLDER, writable=True),
            Mount(self._given, _PROGRAMS),
            Mount(self._parameters, "/rustle/config/params.yaml"),
        ]
        if self._recording is not None:
            # As RUSTLE mounts the folder of a data set.
            source = self._recording.path.resolve()
            self._bag = f"/rustle/dataset/{source.name}"
            mounts.append(Mount(source, self._bag))
        self._environment = dict(_ENVIRONMENT)
        if user.partition(":")[0] not in ("0", "root"):
            self._environment["HOME"] = _FOLDER
        sim = {None: "''", True: "true", False: "false"}[settings.use_sim_time]
        self._container = Container(
            settings,
            self._memory,
            ["/bin/bash", "-l", "-c", _MASTER.format(use_sim_time=sim)],
            mounts,
            user=user,
            environment=self._environment,
            bare=True,
        )
        launch = " ".join(("rustle.launch", *settings.arguments))
        command = _LAUNCH.format(packages=" ".join(settings.packages), launch=launch)
        try:
            self._launch = self._container.run(command, self._environment)
        except OdometryError as error:  # also an engine's, of a container that has ended
            time.sleep(_UNTIL_NOTED)
            raise self._lacking() or error from error

    def _linked(self, connection: socket.socket) -> Ros1:
        running = lambda: self._container.ended() is None  # noqa: E731
        return Ros1(connection, running, self._container.close)

    def _lacking(self) -> OdometryError | None:
        """How the container ended; None while it runs."""
        if (code := self._container.ended()) is None:
            return None
        words = self._container.last_lines()
        return OdometryError(f"no roscore: {processes.how_it_ended(code)}: {words}")

    def state(self) -> dict[str, Any]:
        found: dict[str, Any] = self.link.ask("state", topics=self._topics)
        nodes = found["nodes"].values()
        self.usage = Usage(sum(cpu for cpu, _ in nodes), sum(memory for _, memory in nodes))
        if found["dead"]:
            raise OdometryError(f"node {found['dead'][0]} died")
        if (code := self._container.finished(self._launch)) is not None:
            raise OdometryError(f"roslaunch ended with code {code}")
        return found

    def check(self, template: Template, parameters: ParameterSet) -> None:
        self._keys = server_keys(template, parameters, self.link.ask("parameters"))

    def warn_of_unread(self) -> None:
        warn_of_unread(self.link, self._settings.image, self._keys)

    def whole_name(self, template: Template, name: str) -> str:
        return "/".join(template.path_of(name))

    def play(self, rate: float, renamed: Mapping[str, str]) -> None:
        names = " ".join(f"{old}:={new}" for old, new in renamed.items())
        self._play = self._container.run(
            f"{_SETUP}{_PLAYER}exec ${{player:-rosbag play}} --quiet --clock --delay 0.3 "
            f"-r {rate:g} {shlex.quote(self._bag)} {names} > {_FOLDER}/rosbag.log 2>&1",
            self._environment,
        )

    def played(self) -> bool:
        code = self._container.finished(self._play)
        if code:
            words = self._last_lines("rosbag.log")
            raise OdometryError(f"rosbag play ended with code {code}: {words}")
        return code is not None

    def _command(self) -> tuple[Sequence[str] | None, Run | None]:
        return self._settings.set_parameter, self.run

    def run(self, command: list[str]) -> tuple[int, str]:
        """Run a command of the image; its exit code and the last lines that it wrote."""
        run = self._container.run(f"{shlex.join(command)} > {_FOLDER}/run.log 2>&1")
        end = time.monotonic() + self._settings.ready
        while (code := self._container.finished(run)) is None:
            if time.monotonic() > end:
                raise OdometryError(f"{command[0]} did not end in {self._settings.ready:g} s")
            time.sleep(_TICK)
        return code, self._last_lines("run.log")

    def keep(self, folder: Path) -> None:
        super().keep(folder)
        (folder / "roscore.log").write_bytes(self._written)

    def stop(self) -> None:
        if self._container is not None:
            self._written = self._written or self._container.log()
        super().stop()

    def close(self) -> None:
        super().close()
        remove_shared(self.folder, self._settings.image, self._user)
