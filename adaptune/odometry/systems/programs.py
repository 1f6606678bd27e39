"""Programs in Docker images: those that read a whole recording, and those that receive scans."""

import contextlib
import socket
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from pydantic import Field

from adaptune._system import processes
from adaptune._system.files import make_temporary
from adaptune.errors import OdometryError
from adaptune.odometry.base import Description, Usage
from adaptune.odometry.program import (
    FileRun,
    FileSettings,
    ProgramInput,
    check_arguments,
    find_output,
    read_output,
)
from adaptune.odometry.remote import FIRST_ANSWER, Limits, UserProgram, described
from adaptune.odometry.systems import engine
from adaptune.odometry.template import replace
from adaptune.space import ParameterSet
from adaptune.trajectory import Trajectory

_OUTPUT = "/output"
_PROGRAM_POLL = 0.1  # seconds


class DockerCommandSettings(engine.ContainerSettings, FileSettings):
    """An image with a program, and its files."""

    command: tuple[str, ...] = ()  # by default the image's own


class DockerCommand(FileRun):
    """A program in a container, once on a whole recording.

    The recording is below ``/data``, the template's copy is ``/parameters`` with the template's
    suffix, and the trajectory is expected in ``/output``.
    """

    settings_type = DockerCommandSettings

    @staticmethod
    def check(settings: DockerCommandSettings, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if the image is not here, or a parameter has no way to it."""
        engine.image_digest(settings.image)
        check_arguments(settings.command, settings.template, parameters)

    def trajectory(self, given: ProgramInput, folder: Path) -> Trajectory:
        shared = engine.make_shared(folder / "shared")
        output = engine.make_shared(shared / "output")
        nested = output
        for part in Path(self.settings.output).parts[:-1] if self.names_output else ():
            nested = engine.make_shared(nested / part)
        source = given.path.resolve()
        inside = "/data" if source.is_dir() else f"/data/{source.name}"
        mounts = [engine.Mount(source, inside), engine.Mount(output, _OUTPUT, writable=True)]
        paths = {"input": inside, "output": f"{_OUTPUT}/{self.settings.output}"}
        if (file := self.filled_template(folder)) is not None:
            file.chmod(0o644)
            paths["parameters"] = f"/parameters{file.suffix}"
            mounts.append(engine.Mount(file, paths["parameters"]))
        container = engine.Container(
            self.settings,
            self._limits.memory,
            self.arguments(given, **paths),
            mounts,
            user=(user := engine.default_user(self.settings)),
            environment={"ADAPTUNE_POINTS": given.points, "ADAPTUNE_IMU": given.imu},
        )
        with closing(container):
            failure = self._watch(container, len(given.stamps))
            self._words = container.last_lines()
            with engine.kept_log(self, given.logs, failure) as kept:
                if kept is not None:
                    (kept / "output.log").write_bytes(container.log())
        try:
            if failure is not None:
                raise OdometryError(failure)
            written = find_output(output, self.settings.output)
            checked = folder / "checked" / written.name
            engine.copy_regular(written, output.resolve(), checked)
        finally:
            engine.remove_shared(shared, self.name, user)
        return read_output(checked, self.settings, given.stamps)

    def _watch(self, container: engine.Container, n: int) -> str | None:
        """Wait for the end; how it ended if not well."""
        begin, memory, cpu = time.perf_counter(), 0.0, 0.0
        while (code := container.ended()) is None:
            used = container.used()
            cpu, memory = max(cpu, used.cpu), max(memory, used.memory)
            seconds = time.perf_counter() - begin
            self._usage = Usage(cpu, memory, seconds / n, other_cpu=cpu)
            if seconds > self._limits.seconds * n:
                return str(self.too_long)
            time.sleep(_PROGRAM_POLL)
        if container.out_of_memory:
            return self._limits.bounds.full
        return processes.how_it_ended(code) if code else None


_FOLDER = "/adaptune"
_BETWEEN_SOCKET_LOOKS = 0.02  # seconds


class DockerProcessSettings(engine.ContainerSettings):
    """An image with a program that speaks `adaptune.odometry.wire`.

    It must listen at the Unix socket ``{socket}``, which the variable ADAPTUNE_SOCKET names, too.
    """

    command: tuple[str, ...] = ()  # by default the image's own
    settings: dict[str, Any] = Field(default_factory=dict)


class ContainerTransport(processes.Transport):
    """A program in a container, which listens at a socket that the container shares."""

    def __init__(self, settings: DockerProcessSettings, limits: Limits):
        self.name, self.bounds = settings.image, limits.bounds
        self._settings = settings
        self._container: engine.Container | None = None
        self._folder: Path | None = None

    def connect(self) -> processes.SocketStream:
        """Begin the container, and connect as soon as the program listens."""
        self._folder = folder = make_temporary()
        folder.chmod(0o777)  # for any user of the image
        inside = f"{_FOLDER}/odometry.sock"
        self._container = engine.Container(
            self._settings,
            self.bounds.memory,
            [replace(argument, {"socket": inside}) for argument in self._settings.command],
            [engine.Mount(folder, _FOLDER, writable=True)],
            user=engine.default_user(self._settings),
            environment={"ADAPTUNE_SOCKET": inside},
        )
        begin, what = time.monotonic(), "it does not listen at its socket"
        while time.monotonic() - begin < FIRST_ANSWER:
            connection = socket.socket(socket.AF_UNIX)
            with contextlib.suppress(OSError):
                with processes.socket_name(folder / "odometry.sock") as name:
                    connection.connect(name)
                connection.settimeout(max(self.bounds.seconds, FIRST_ANSWER))
                return processes.SocketStream(connection)
            connection.close()
            if (ended := self._ended(_BETWEEN_SOCKET_LOOKS)) is not None:
                what = f"{ended} before it listened at its socket"
                break
        what = processes.quoting(what, self._container.last_lines())
        self.close()
        raise OdometryError(f"{self.name}: {what}")

    def used(self) -> tuple[float, float] | None:
        """See `processes.Transport`."""
        return None if self._container is None else self._container.used()[1:]

    def why(self, what: str) -> str:
        if self._container is None:
            return what
        return processes.quoting(self._ended(0.5) or what, self._container.last_lines())

    def _ended(self, seconds: float) -> str | None:
        """How the program ended; None if it runs longer."""
        assert self._container is not None
        if (code := self._container.wait(seconds)) is None:
            return None
        return self.bounds.full if self._container.out_of_memory else processes.how_it_ended(code)

    def close(self) -> None:
        """Remove the container, and the folder of the socket."""
        if self._container is not None:
            self._container.close()
            self._container = None
        if self._folder is not None:
            engine.remove_shared(self._folder, self.name, engine.default_user(self._settings))
            self._folder = None


class DockerProcess(UserProgram):
    """An odometry in a container, which it keeps from start to start; a new one after a fault."""

    settings_type = DockerProcessSettings
    transport_type = ContainerTransport

    @classmethod
    def describe(cls, settings: DockerProcessSettings) -> Description:
        return described(cls, settings.model_dump_json(), engine.image_digest(settings.image))
