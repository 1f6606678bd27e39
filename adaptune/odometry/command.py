"""Odometries in programs that read a recording and a parameter file and write a trajectory."""

import os
import shutil
import subprocess
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from adaptune import hosting
from adaptune.odometry.base import Description, OdometryError, Usage
from adaptune.odometry.isolation import Arguments, pose_fault
from adaptune.odometry.program_input import ProgramInput
from adaptune.odometry.template import Template, check_names, placeholders, replace
from adaptune.odometry.whole_run import WholeRun, WholeSettings
from adaptune.sequence.config import resolve
from adaptune.sequence.export import Layout
from adaptune.space import ParameterSet, nearest
from adaptune.trajectory import Trajectory, TrajectoryError, read_kitti, read_tum

_PLACEHOLDERS = ("input", "output", "parameters", "points", "imu")


class FileSettings(WholeSettings):
    """The files of a program that reads a recording.

    Attributes
    ----------
    template : str, optional
        A parameter file: YAML, JSON or TOML, also in the layouts of ROS 1 and ROS 2.
    output : str
        Name of the trajectory that it leaves.
    format : {"tum", "kitti", "evalio"}
        Format of the trajectory.
    input : {"bag", "ros2", "kitti"}
        What the program reads.
    """

    template: Annotated[str, AfterValidator(resolve)] | None = None
    output: str = "trajectory.tum"
    format: Literal["tum", "kitti", "evalio"] = "tum"
    input: Layout = "bag"


class CommandSettings(FileSettings):
    """A program and its files.

    Attributes
    ----------
    command : list of str
        The program and its arguments. In these ``{input}`` is the recording, ``{parameters}`` the
        file made from the template, ``{output}`` the path of the trajectory, ``{points}`` and
        ``{imu}`` are topics, ``{study}`` is the folder of the study's file, and the name of any
        parameter stands for its value.
    version : str, optional
        Version of the program. Change it where its file stays the same and the program does not, as
        with a shared library: results of the version before do not count any more.
    """

    command: Arguments
    version: str | None = None


class Command(WholeRun):
    """A program that runs once on a whole recording, and its trajectory; see `WholeRun`."""

    settings_type = CommandSettings

    @staticmethod
    def describe(settings: CommandSettings) -> Description:  # noqa: ARG004
        """The study defines the parameters, and nothing can change on the way."""
        return Description(space=None, live=False, whole=True)

    @staticmethod
    def check(settings: CommandSettings, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if there is no such program, or no way for a parameter to it."""
        program = settings.command[0]
        if shutil.which(program) is None:
            raise OdometryError(f"command: there is no program {program!r}")
        check_arguments(settings.command, settings.template, parameters)

    @property
    def called(self) -> str:
        return str(self.settings.command[0])

    def trajectory(self, given: ProgramInput, folder: Path) -> Trajectory:
        here = folder / "run"
        here.mkdir()
        output = here / self.settings.output
        output.parent.mkdir(parents=True, exist_ok=True)
        command = self._command(given, output, folder)
        failure = self._execute(command, here, folder / "output", len(given.stamps))
        if failure is not None:
            raise OdometryError(failure)
        return read_output(here, self.settings, given.stamps)

    def _command(self, given: ProgramInput, output: Path, folder: Path) -> list[str]:
        values: dict[str, Any] = {"input": given.path.resolve(), "output": output}
        values |= {"points": given.points, "imu": given.imu}
        if self.settings.template is not None:
            template = Template(Path(self.settings.template))
            values["parameters"] = folder / template.path.name
            values["parameters"].write_text(template.fill(self.parameters), encoding="utf-8")
        values |= self.parameters
        return [replace(argument, values) for argument in self.settings.command]

    def _execute(self, command: list[str], folder: Path, log: Path, n: int) -> str | None:
        """Run the program; how it ended if not well."""
        begin = time.perf_counter()
        with log.open("wb") as file:
            program = hosting.Program(
                command,
                self._limits.memory,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
            )
            with closing(program):
                ended = in_time = program.wait(self._limits.seconds * n)
                if ended is None:
                    ended = program.end()
        with log.open("rb") as written:
            self._words = hosting.last_lines(written)
        if ended is not None:
            self._usage = Usage(ended.cpu, ended.memory, (time.perf_counter() - begin) / n)
        if in_time is None:
            return f"it took longer than isolation.seconds = {self._limits.seconds:g} for each scan"
        return hosting.verdict(in_time.code) if in_time.code else None


def read_output(folder: Path, settings: FileSettings, stamps: NDArray[np.int64]) -> Trajectory:
    """Read the trajectory that a program left in a folder; `stamps` of shape (n,) are the scans'.

    Raises
    ------
    OdometryError, TrajectoryError
        If there is none, or it holds something else.
    """
    path = folder / settings.output
    if not path.exists():
        raise OdometryError(f"it left no {settings.output}")
    try:
        if settings.format == "kitti":
            poses = read_kitti(path)
            if len(poses) > len(stamps):
                counted = f"{len(poses)} poses without stamps for {len(stamps)} scans"
                raise OdometryError(f"{settings.output} has {counted}")
            trajectory = Trajectory(stamps[: len(poses)], poses)
        else:
            trajectory = read_tum(path)
    except TrajectoryError as error:
        raise TrajectoryError(str(error).replace(f"{folder}{os.sep}", "")) from error
    for number, T in enumerate(trajectory.T_world_sensor):
        if what := pose_fault(T):
            raise OdometryError(f"{settings.output}, pose {number + 1}: {what}")
    return trajectory


def check_arguments(command: Sequence[str], template: str | None, parameters: ParameterSet) -> None:
    """Raise an `OdometryError` if there is no way for a parameter to a program."""
    known = [*_PLACEHOLDERS, *parameters]
    for argument in command:
        for name in placeholders(argument):
            if name not in known:
                raise OdometryError(f"command: {{{name}}} is nothing; {nearest(name, known)}")
    check_names(parameters, None if template is None else Template(Path(template)), command)
