"""Odometries in programs that read a recording and a parameter file and write a trajectory."""

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from logging import getLogger
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from adaptune import hosting
from adaptune.geometry import Poses, invert
from adaptune.odometry.base import (
    BaseSettings,
    Description,
    LastMotion,
    Motions,
    OdometryError,
    OdometryInstance,
    Registration,
    Usage,
)
from adaptune.odometry.frame_check import check_frame
from adaptune.odometry.isolation import Arguments, Limits, pose_fault
from adaptune.odometry.program_input import ProgramInput
from adaptune.odometry.template import Template, check_names, placeholders, replace
from adaptune.selection import Selection
from adaptune.sequence.config import Transform, resolve, to_pose
from adaptune.sequence.export import Layout
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet, nearest
from adaptune.trajectory import Trajectory, TrajectoryError, read_kitti, read_tum

_log = getLogger(__name__)

_COVERAGE = 0.9
"""Least share of the scans for which a program must write poses."""

_PLACEHOLDERS = ("input", "output", "parameters", "points", "imu")


class CommandSettings(BaseSettings):
    """A program and its files.

    Attributes
    ----------
    command : list of str
        The program and its arguments. In these ``{input}`` is the recording, ``{parameters}`` the
        file made from the template, ``{output}`` the path of the trajectory, ``{points}`` and
        ``{imu}`` are topics, ``{study}`` is the folder of the study's file, and the name of any
        parameter stands for its value.
    template : str, optional
        A parameter file: YAML, JSON or TOML, also in the layouts of ROS 1 and ROS 2.
    output : str
        Name of the trajectory, in the empty folder in which the program runs.
    format : {"tum", "kitti", "evalio"}
        Format of the trajectory.
    input : {"bag", "ros2", "kitti"}
        What the program reads.
    extrinsic : Transform, optional
        The LiDAR's pose in the frame whose poses the program writes.
    version : str, optional
        Version of the program. Change it where its file stays the same and the program does not, as
        with a container or a shared library: results of the version before do not count any more.
    """

    command: Arguments
    template: Annotated[str, AfterValidator(resolve)] | None = None
    output: str = "trajectory.tum"
    format: Literal["tum", "kitti", "evalio"] = "tum"
    input: Layout = "bag"
    extrinsic: Transform | None = None
    version: str | None = None


class Command(OdometryInstance):
    """A program that runs once on a whole recording, and its trajectory.

    It cannot restart on the way: where `start` places it elsewhere, its motions go on from there.

    Parameters
    ----------
    parameters
        A value for every parameter.
    settings
        The program and its files.
    limits
        What it may use: memory, and time for all scans together.
    read
        Gives the recording at the first start; None if scans are only prepared.
    strict
        Whether a run that fails is an error, not a fault, which quotes the program's last lines.
    """

    faults: Sequence[str] = ()
    settings_type = CommandSettings

    def __init__(
        self,
        parameters: ParameterSet,
        settings: CommandSettings,
        limits: Limits,
        read: Callable[[], ProgramInput] | None = None,
        strict: bool = False,
    ):
        self.parameters, self.settings = dict(parameters), settings
        self._limits, self._read_input, self._strict = limits, read, strict
        self._T_own_sensor: dict[int, Poses] | None = None
        self._T_odom_own = np.eye(4)
        self._usage = Usage(0.0, None)
        self._last_motion = LastMotion()

    @property
    def usage(self) -> Usage:
        """What the program has used, with all processes that it has started."""
        return self._usage

    @property
    def motions(self) -> Motions:
        return self._last_motion.motions

    @staticmethod
    def describe(settings: CommandSettings) -> Description:  # noqa: ARG004
        """The study defines the parameters, and nothing can change on the way."""
        return Description(space=None, live=False, whole=True)

    @staticmethod
    def check(settings: CommandSettings, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if there is no such program, or no way for a parameter to it."""
        program, *arguments = settings.command
        if shutil.which(program) is None:
            raise OdometryError(f"command: there is no program {program!r}")
        known = [*_PLACEHOLDERS, *parameters]
        for argument in settings.command:
            for name in placeholders(argument):
                if name not in known:
                    raise OdometryError(f"command: {{{name}}} is nothing; {nearest(name, known)}")
        template = None if settings.template is None else Template(Path(settings.template))
        check_names(parameters, template, arguments)

    def prepare(self, scan: Scan) -> NDArray[np.int64]:
        return np.array(scan.stamp, np.int64)  # nothing else is needed

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        if self._T_own_sensor is None:
            if self._read_input is None:
                raise OdometryError("a program runs on a recording, not on single scans")
            given = self._read_input()
            poses = self._run(given)
            self._T_own_sensor = dict(zip(given.stamps.tolist(), poses, strict=True))
        self._T_odom_own = T_odom_sensor @ invert(self._own(prepared))
        self._last_motion.start(T_odom_sensor, T_previous_current)

    def submit(self, prepared: NDArray[np.int64]) -> None:
        self._submitted = prepared

    def collect(self) -> Registration:
        T_odom_sensor = self._T_odom_own @ self._own(self._submitted)
        self._last_motion.move(T_odom_sensor)
        return Registration(T_odom_sensor, bool(np.isfinite(T_odom_sensor).all()))

    def apply(self, selection: Selection) -> None:  # noqa: ARG002
        raise OdometryError(
            "a program that runs whole recordings cannot change its parameters: give it one set"
        )

    def close(self) -> None:
        pass  # the program has ended

    def _own(self, stamp: NDArray[np.int64]) -> Poses:
        assert self._T_own_sensor is not None
        return self._T_own_sensor.get(int(stamp), np.full((4, 4), np.nan))

    def _run(self, given: ProgramInput) -> Poses:
        """Poses at the scans' stamps, of shape (n, 4, 4), NaN where the program wrote none."""
        T_own_sensor = np.full((len(given.stamps), 4, 4), np.nan)
        with tempfile.TemporaryDirectory(prefix="adaptune-") as name:
            folder = Path(name) / "run"
            folder.mkdir()
            output = folder / self.settings.output
            output.parent.mkdir(parents=True, exist_ok=True)
            command, log = self._command(given, output, Path(name)), Path(name) / "output"
            failure = self._execute(command, folder, log, len(given.stamps))
            if failure is None:
                try:
                    T_own_sensor = self._read(output, given.stamps)
                except (TrajectoryError, OdometryError) as error:
                    failure = str(error).replace(f"{folder}{os.sep}", "")
            with log.open("rb") as written:
                words = hosting.last_lines(written)
        known = np.isfinite(T_own_sensor[:, 0, 0])
        if failure is None and known.mean() < _COVERAGE:
            seconds = 1e-9 * (given.stamps - given.stamps[0])
            failure = (
                f"{self.settings.output} has poses for {known.sum()} of {len(known)} scans, the "
                f"last at {seconds[known][-1]:.1f} s of {seconds[-1]:.1f} s"
            )
        if failure is not None:
            self._fault(failure, words)
        try:
            check_frame(T_own_sensor, given.T_ref_sensor)
        except OdometryError as error:
            raise OdometryError(self._message(str(error), words)) from error
        return T_own_sensor

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
        if ended is not None:
            self._usage = Usage(ended.cpu, ended.memory, (time.perf_counter() - begin) / n)
        if in_time is None:
            return f"it took longer than isolation.seconds = {self._limits.seconds:g} for each scan"
        return hosting.verdict(in_time.code) if in_time.code else None

    def _read(self, path: Path, stamps: NDArray[np.int64]) -> Poses:
        if not path.exists():
            raise OdometryError(f"it left no {self.settings.output}")
        if self.settings.format == "kitti":
            poses = read_kitti(path)
            if len(poses) > len(stamps):
                counted = f"{len(poses)} poses without stamps for {len(stamps)} scans"
                raise OdometryError(f"{self.settings.output} has {counted}")
            stamps_own = stamps[: len(poses)]
        else:
            trajectory = read_tum(path)
            poses, stamps_own = trajectory.T_world_sensor, trajectory.stamps
        for number, T in enumerate(poses):
            if what := pose_fault(T):
                raise OdometryError(f"{self.settings.output}, pose {number + 1}: {what}")
        if self.settings.extrinsic is not None:
            poses = poses @ to_pose(self.settings.extrinsic)
        return _at(Trajectory(stamps_own, poses), stamps)

    def _message(self, what: str, words: str) -> str:
        """What went wrong, with which program, and the last lines that it wrote."""
        message = f"{self.settings.command[0]}, with {self.parameters}: {what}"
        return f"{message}: {words}" if words else message

    def _fault(self, what: str, words: str) -> None:
        if self._strict:
            raise OdometryError(self._message(what, words))
        what = f"{what}: {words}" if words else what
        self.faults = [*self.faults, what]
        _log.warning("%s with %s: %s", self.settings.command[0], self.parameters, what)


def _at(trajectory: Trajectory, stamps: NDArray[np.int64]) -> Poses:
    """Poses at the scans' stamps.

    Programs stamp a scan at its start or at its end: the scan before the first pose and the one
    after the last get the motion next to them.
    """
    spacing = np.diff(stamps)
    gap = max(1.0, 3e-9 * float(np.median(spacing))) if len(spacing) else 1.0
    T = trajectory.at(stamps, gap)
    known = np.flatnonzero(np.isfinite(T[:, 0, 0]))
    if len(known) > 1:
        first, last = known[[0, -1]]
        if first == 1 and np.isfinite(T[2]).all():
            T[0] = T[1] @ invert(T[2]) @ T[1]
        if last == len(T) - 2 and np.isfinite(T[-3]).all():
            T[-1] = T[-2] @ invert(T[-3]) @ T[-2]
    elif not len(known):
        begin, end = (1e-9 * trajectory.stamps[[0, -1]]).tolist()
        raise OdometryError(
            f"its poses are of {begin:.3f} s to {end:.3f} s, the scans of "
            f"{1e-9 * stamps[0]:.3f} s to {1e-9 * stamps[-1]:.3f} s"
        )
    return T
