"""Programs in Docker images that read a recording and leave a trajectory."""

import time
from contextlib import closing
from pathlib import Path
from typing import Any

from adaptune import hosting
from adaptune.odometry.base import Description, OdometryError, Usage
from adaptune.odometry.command import FileSettings, check_arguments, read_output
from adaptune.odometry.docker.engine import (
    Container,
    ContainerSettings,
    Mount,
    default_user,
    image_digest,
)
from adaptune.odometry.docker.shared_folder import copy_regular, make_shared, remove_shared
from adaptune.odometry.docker.trial_log import costs, kept_log
from adaptune.odometry.program_input import ProgramInput
from adaptune.odometry.template import Template, replace
from adaptune.odometry.whole_run import WholeRun
from adaptune.space import ParameterSet
from adaptune.trajectory import Trajectory

_OUTPUT = "/output"
_BETWEEN_LOOKS = 0.1
"""Seconds."""


class DockerCommandSettings(ContainerSettings, FileSettings):
    """An image with a program, and its files.

    Attributes
    ----------
    command : list of str
        The program and its arguments, see `CommandSettings`; by default the image's own.
    """

    command: tuple[str, ...] = ()


class DockerCommand(WholeRun):
    """A program in a container, once on a whole recording.

    The recording is below ``/data``, the template's copy is ``/parameters`` with the template's
    suffix, and the trajectory is expected in ``/output``.
    """

    settings_type = DockerCommandSettings

    @staticmethod
    def describe(settings: DockerCommandSettings) -> Description:  # noqa: ARG004
        """The study defines the parameters, and nothing can change on the way."""
        return Description(space=None, live=False, whole=True)

    @staticmethod
    def check(settings: DockerCommandSettings, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if the image is not here, or a parameter has no way to it."""
        image_digest(settings.image)
        check_arguments(settings.command, settings.template, parameters)

    @property
    def called(self) -> str:
        return str(self.settings.image)

    def trajectory(self, given: ProgramInput, folder: Path) -> Trajectory:
        shared = make_shared(folder / "shared")
        output = make_shared(shared / "output")
        nested = output
        for part in Path(self.settings.output).parts[:-1]:
            nested = make_shared(nested / part)
        source = given.path.resolve()
        inside = "/data" if source.is_dir() else f"/data/{source.name}"
        mounts = [Mount(source, inside), Mount(output, _OUTPUT, writable=True)]
        values: dict[str, Any] = {"input": inside, "output": f"{_OUTPUT}/{self.settings.output}"}
        values |= {"points": given.points, "imu": given.imu}
        if self.settings.template is not None:
            mounts.append(self._fill(folder))
            values["parameters"] = mounts[-1].target
        values |= self.parameters
        container = Container(
            self.settings,
            self._limits.memory,
            [replace(argument, values) for argument in self.settings.command],
            mounts,
            user=(user := default_user(self.settings)),
            environment={"ADAPTUNE_POINTS": given.points, "ADAPTUNE_IMU": given.imu},
        )
        with closing(container):
            failure = self._watch(container, len(given.stamps))
            self._words = container.last_lines()
            about = costs(self._usage, {}) | ({"fault": failure} if failure else {})
            with kept_log(given.logs, self.settings, self.parameters, about) as kept:
                if kept is not None:
                    (kept / "output.log").write_bytes(container.log())
        checked = folder / "checked"
        copy_regular(output / self.settings.output, output, checked / self.settings.output)
        remove_shared(shared, self.called, user)
        if failure is not None:
            raise OdometryError(failure)
        return read_output(checked, self.settings, given.stamps)

    def _fill(self, folder: Path) -> Mount:
        template = Template(Path(self.settings.template))
        file = folder / template.path.name
        file.write_text(template.fill(self.parameters), encoding="utf-8")
        file.chmod(0o644)
        return Mount(file, f"/parameters{template.path.suffix}")

    def _watch(self, container: Container, n: int) -> str | None:
        """Wait for the end; how it ended if not well."""
        begin, memory, cpu = time.perf_counter(), 0.0, 0.0
        while (code := container.ended()) is None:
            used = container.used()
            cpu, memory = max(cpu, used.cpu), max(memory, used.memory)
            seconds = time.perf_counter() - begin
            self._usage = Usage(cpu, memory, seconds / n)
            if seconds > self._limits.seconds * n:
                limit = f"isolation.seconds = {self._limits.seconds:g}"
                return f"it took longer than {limit} for each scan"
            time.sleep(_BETWEEN_LOOKS)
        if container.out_of_memory:
            return f"out of isolation.memory = {self._limits.memory:g} GB"
        return hosting.verdict(code) if code else None
