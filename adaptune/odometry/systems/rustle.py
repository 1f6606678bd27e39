"""ROS 1 systems in Docker images that have RUSTLE's layout (Tavares, University of Coimbra, 2026).

Such an image has a package with ``rustle.launch``, which loads ``/rustle/config/params.yaml``; a
login shell finds it. A container holds a roscore, the system's nodes, and adaptune's node.
"""

import re
import shlex
import shutil
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, model_validator

from adaptune._system import processes
from adaptune.errors import OdometryError, warn_once
from adaptune.odometry.base import Description, OdometryInstance, OwnFile, Usage
from adaptune.odometry.program import ProgramInput
from adaptune.odometry.remote import Limits
from adaptune.odometry.systems.engine import Container, Mount, image_digest
from adaptune.odometry.systems.lockstep import Lockstep
from adaptune.odometry.systems.played_bag import PlayedBag
from adaptune.odometry.systems.ros_system import RosSettings, RosSystem, filled, image_user
from adaptune.odometry.template import Template, check_names
from adaptune.ros import ros1_node
from adaptune.ros.relay import Ros1
from adaptune.ros.steering import Run, SetCommand, equal_values
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
_ROS1_SETUP = "command -v roslaunch >/dev/null || . /opt/ros/*/setup.bash; "
_FIND_PACKAGE = (
    'for package in {packages}; do rospack find "$package" >/dev/null 2>&1 && {then}; done; '
)
_MASTER = (
    _ROS1_SETUP + "for python in python3 python; do "
    f'"$python" {_PROGRAMS}/ros1_node.py {_FOLDER}/link {{use_sim_time}}; '
    "code=$?; [ $code = 9 ] || [ $code = 127 ] || exit $code; "
    "done; echo 'no Python of the image imports rospy: is it a ROS 1 image?' >&2; exit 127"
)
_LOG_NOISE = re.compile(
    rb"(\x1b\[\d*m)*(=*|/|  \S+ \(\S+/\S+\)|NODES|auto-starting new master|ROS_MASTER_URI=.*|"
    rb"process\[\S+\]: started with pid \[\d+\]|roscore/master is not yet running.*|"
    rb"master has started.*|.*rustle\.launch http\S*|log file: .*|Initiating shutdown!|"
    rb"\[\S+\] killing on exit| \* /\S+: .*|PARAMETERS|SUMMARY|started roslaunch server .*|"
    rb"\.\.\. logging to .*|Checking log directory .*|Press Ctrl-C .*|Done checking log .*|"
    rb"all processes on machine have died.*|(\.\.\. )?shutting down .*|done)(\x1b\[\d*m)*"
)
"""Lines that roslaunch writes at its begin and at its end, before and after those of the nodes."""
_LAUNCH = (
    _ROS1_SETUP
    + f"exec > {_FOLDER}/roslaunch.log 2>&1; "
    + _FIND_PACKAGE.replace("{then}", 'exec roslaunch --wait "$package" {launch}')
    + "echo 'there is no package {packages}'; exit 1"
)
_ROS1_PROBE = (
    _ROS1_SETUP
    + "command -v roslaunch >/dev/null || exit 1; "
    + _FIND_PACKAGE.replace("{then}", "exit 0")
    + "exit 1"
)
_PLAYER = "player=$(ls /opt/ros/*/lib/rosbag/play /usr/lib/rosbag/play 2>/dev/null | head -n 1); "
"""What `rosbag play` runs; Python takes half a second to find it."""
_UNTIL_NOTED = 0.5  # seconds in which the engine notes that a container has ended
_TICK = 0.01  # seconds


class Ros1System(RosSystem):
    """A container with a roscore, and the nodes that a launch file starts."""

    link: Ros1
    _log_name, _noise = "roslaunch.log", _LOG_NOISE
    _written = b""

    def _begin(self) -> None:
        settings, self._play = self._settings, ""
        script = _ROS1_PROBE.format(packages=" ".join(settings.packages))
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

    def state(self, fresh: bool = False) -> dict[str, Any]:  # noqa: ARG002
        state: dict[str, Any] = self.link.ask("state", topics=self._topics)
        nodes = state["nodes"].values()
        self.usage = Usage(sum(cpu for cpu, _ in nodes), sum(memory for _, memory in nodes))
        if state["dead"]:
            self.died = f"node {state['dead'][0]} died"
            raise OdometryError(self.died)
        if (code := self._container.finished(self._launch)) is not None:
            raise OdometryError(f"roslaunch ended with code {code}")
        return state

    def check(self, template: Template, parameters: ParameterSet) -> None:
        self.link.keys = server_keys(template, parameters, self.link.ask("parameters"))

    def warn_of_unread(self) -> None:
        warn_of_unread(self.link, self._settings.image, self.link.keys)

    def whole_name(self, template: Template, name: str) -> str:
        return "/".join(template.path_of(name))

    def play(self, rate: float, renamed: Mapping[str, str]) -> None:
        names = " ".join(f"{old}:={new}" for old, new in renamed.items())
        self._play = self._container.run(
            f"{_ROS1_SETUP}{_PLAYER}exec ${{player:-rosbag play}} --quiet --clock --delay 0.3 "
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
        whole = "/".join(template.path_of(name))
        keys[whole] = [key for key in every if key.endswith(f"/{whole}")]
        if not keys[whole]:
            raise OdometryError(
                f"the parameter server holds no {whole}: the launch file does not load "
                f"/rustle/config/params.yaml"
            )
        for key in keys[whole]:
            if not equal_values(value, every[key]):
                raise OdometryError(
                    f"{key} is {every[key]!r} on the parameter server, not {value!r}: the launch "
                    f"file, or the node, has changed it: is it in the node's range?"
                )
    return keys


def warn_of_unread(link: Ros1, image: str, keys: Mapping[str, Sequence[str]]) -> None:
    """Log, once for an image, which parameters no node has ever asked for."""
    asked = {
        key.rstrip("/")
        for caller, their_keys in link.ask("asked").items()
        if not caller.startswith(("/roslaunch", "/rosparam", "/adaptune"))
        for key in their_keys
    }
    for name, places in keys.items():
        # A node may ask for all that is below a name.
        above = {place[:i] for place in places for i, c in enumerate(place) if c == "/"}
        if not asked & (above | set(places)):
            warn_once(
                f"{image}: no node has read the parameter {name}, so its value changes nothing; is "
                f"its name in the template right?"
            )


def _flat(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(data, dict):
        for name, value in data.items():
            yield from _flat(value, f"{key}/{name}")
    else:
        yield key, data


class RustleSettings(RosSettings):
    """An image in RUSTLE's layout; ``docs/docker.md`` describes the settings and their defaults."""

    system: ClassVar[type[RosSystem]] = Ros1System
    steering: ClassVar[tuple[str, ...]] = ("node", "set_parameter")

    package: str | None = Field(None, pattern=r"^[\w-]+$")
    arguments: tuple[Annotated[str, Field(pattern=r"^[\w:=./-]+$")], ...] = ()
    use_sim_time: bool | None = None
    set_parameter: SetCommand | None = None

    @model_validator(mode="after")
    def _check_node(self) -> Self:
        if self.set_parameter is not None and self.node is None:
            raise ValueError("set_parameter: name the node, too (node)")
        return self

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages in which the launch file may be."""
        return ("rustle-ros", "rustle") if self.package is None else (self.package,)


class Rustle:
    """A ROS 1 system, run on a bag that is played, or scan by scan."""

    settings_type: type[RosSettings] = RustleSettings

    @staticmethod
    def describe(settings: Any) -> Description:
        """The study defines the parameters."""
        whole = settings.play == "bag"
        needs_imu = not whole and settings.imu is not None
        return Description(None, settings.node is not None, needs_imu, whole=whole)

    @staticmethod
    def check(settings: Any, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if the image is not here, or a parameter is not in its file."""
        template = Template(Path(settings.template))
        if template.path.suffix not in (".yaml", ".yml"):
            ros = f"ROS {settings.system.ros}"
            raise OdometryError(f"template: {template.path} is not YAML, as {ros} reads it")
        check_names(parameters, template, ())
        if settings.system.ros == 1:
            template.warn_of_texts()
        if settings.image is not None:
            image_digest(settings.image)

    @staticmethod
    def own_file(parameters: ParameterSet, settings: Any) -> OwnFile:
        """The parameter file that the system reads."""
        template, text = filled(settings, parameters)
        use, name = f"in the place of {template.path.name}", ""
        if settings.system.ros == 2:  # that of a system in RUSTLE's layout is known as that
            name = (settings.node or "").strip("/").replace("/", "_") or template.path.stem
        return OwnFile(template.path.suffix, text, use, name)

    @staticmethod
    def instance(
        parameters: ParameterSet,
        settings: Any,
        limits: Limits,
        read: Callable[[], ProgramInput] | None,
    ) -> OdometryInstance:
        """Make an instance, as all programs of the user are made."""
        if settings.play == "bag":
            return PlayedBag(parameters, settings, limits, read)
        return Lockstep(parameters, settings, limits)
