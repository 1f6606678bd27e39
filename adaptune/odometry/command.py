"""Odometries that are programs: a recording and a parameter file in, a trajectory out."""

import contextlib
import fcntl
import json
import logging
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from adaptune.files import replacing_folder
from adaptune.geometry import Poses, invert, rotation_angle
from adaptune.metrics import window_ends
from adaptune.odometry.base import BaseSettings, Description, OdometryError, Registration
from adaptune.odometry.isolation import (
    ONE_THREAD,
    Arguments,
    Limits,
    bounded,
    last_lines,
    nonsense,
    verdict,
)
from adaptune.odometry.template import Template, check_names, placeholders, replace
from adaptune.sequence import Scan, Sequence, SequenceConfig
from adaptune.sequence.config import Transform, resolve, to_pose
from adaptune.sequence.export import IMU, POINTS, Layout, export
from adaptune.space import ParameterSet, nearest
from adaptune.trajectory import Trajectory, TrajectoryError, read_kitti, read_tum

_log = logging.getLogger(__name__)

_COVERAGE = 0.9
"""Share of the scans for which a whole trajectory has poses."""

_PLACEHOLDERS = ("input", "output", "parameters", "points", "imu")


class Settings(BaseSettings):
    """A program and its files.

    Attributes
    ----------
    command : list of str
        The program and its arguments. In these ``{input}`` is the recording, ``{parameters}`` the
        file made of the template, ``{output}`` where the trajectory shall be, ``{points}`` and
        ``{imu}`` are topics, ``{study}`` is the folder of the study's file, and the name of any
        parameter its value.
    template : str, optional
        A parameter file: YAML, JSON or TOML, also as ROS 1 and ROS 2 have it.
    output : str
        The trajectory, in the empty folder in which the program is run.
    format : {"tum", "kitti", "evalio"}
        Of the trajectory.
    input : {"bag", "ros2", "kitti"}
        What the program reads.
    extrinsic : Transform, optional
        The LiDAR's pose in the frame that the program's poses are of.
    """

    command: Arguments
    template: Annotated[str, AfterValidator(resolve)] | None = None
    output: str = "trajectory.tum"
    format: Literal["tum", "kitti", "evalio"] = "tum"
    input: Layout = "bag"
    extrinsic: Transform | None = None


class Material(NamedTuple):
    """What a program is given of a sequence, and what its trajectory is read by.

    Attributes
    ----------
    path : Path
        The recording.
    points : str
        Topic of the clouds in it.
    imu : str
        Topic of the IMU; empty where there is none.
    stamps : ndarray of shape (n,)
        Nanoseconds, of the scans.
    T_ref_sensor : ndarray of shape (n, 4, 4), optional
        Reference poses, NaN where there is none.
    """

    path: Path
    points: str
    imu: str
    stamps: NDArray[np.int64]
    T_ref_sensor: Poses | None


def material(
    sequence: Sequence, config: SequenceConfig, about: Any, folder: Path, layout: Layout
) -> Material:
    """A recording for a program: the sequence's own bag where that is just what is wanted.

    Parameters
    ----------
    sequence
        What `config` describes.
    config
        The sequence's description.
    about
        All that the sequence depends on, as plain data; what was written for another is replaced.
    folder
        Where to keep what has to be written; processes wait for each other.
    layout
        What the program reads.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    own = _own_bag(config, layout)
    name = {"bag": "input.bag", "ros2": "input", "kitti": "input"}[layout]
    with (folder.parent / f".{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if _about(folder) != about:
            stamps: list[int] = []
            with replacing_folder(folder) as beside:
                beside.mkdir()
                if own is None:
                    export(_noted(sequence, stamps), sequence.imu(), beside / name, layout)
                else:
                    stamps += [scan.stamp for scan in sequence]
                np.save(beside / "stamps.npy", np.array(stamps, np.int64))
                (beside / "about.json").write_text(json.dumps(about), encoding="utf-8")
        at = np.load(folder / "stamps.npy")
    reference = sequence.reference()
    T_ref_sensor = None if reference is None else reference.at(at)
    if own is None:
        imu = "" if sequence.imu() is None else IMU
        return Material(folder / name, POINTS, imu, at, T_ref_sensor)
    source: Any = getattr(sequence, "source", None)
    imu = "" if config.imu is None else config.imu.topic or ""
    return Material(own, config.points or source.points, imu, at, T_ref_sensor)


def _noted(sequence: Sequence, stamps: list[int]) -> Iterator[Scan]:
    for scan in sequence:
        stamps.append(scan.stamp)
        yield scan


def _own_bag(config: SequenceConfig, layout: Layout) -> Path | None:
    """The sequence's bag, if it is one, whole and of the right kind."""
    if not isinstance(config.bag, str) or layout == "kitti":
        return None
    plain = SequenceConfig(bag=config.bag)
    for key in ("start", "stop", "stride", "views", "compensate"):
        if getattr(config, key) != getattr(plain, key):
            return None
    path = Path(config.bag)
    right = path.is_file() and path.suffix == ".bag"
    if layout == "ros2":
        right = (path / "metadata.yaml").exists()
    return path if right else None


def _about(folder: Path) -> Any:
    try:
        return json.loads((folder / "about.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


class Command:
    """A program that is run once on a whole recording, and its trajectory.

    It cannot begin anew on the way: where `start` places it elsewhere, the motions that it has
    found go on from there.

    Parameters
    ----------
    parameters
        A value for every parameter.
    settings
        The program and its files.
    limits
        What it may take: memory, and of time as much as for all scans together.
    material
        Gives the recording when it is wanted; none where scans are only prepared.
    strict
        Whether a run that fails is an error, not a fault.

    Attributes
    ----------
    faults : list of str
        What went wrong, with the last lines that the program wrote. Poses that are not known are
        NaN.
    """

    settings_type = Settings

    def __init__(
        self,
        parameters: ParameterSet,
        settings: Settings,
        limits: Limits,
        material: Callable[[], Material] | None = None,
        strict: bool = False,
    ):
        self.parameters = dict(parameters)
        self.settings = settings
        self.faults: list[str] = []
        self._limits, self._material, self._strict = limits, material, strict
        self._T_own_sensor: dict[int, Poses] | None = None
        self._T_odom_own = np.eye(4)

    @staticmethod
    def describe(settings: Settings) -> Description:  # noqa: ARG004
        """Parameters are the study's to define, and nothing can be changed on the way."""
        return Description(space=None, live=False, whole=True)

    @staticmethod
    def check(settings: Settings, parameters: ParameterSet) -> None:
        """Make sure that the program is there, and that every parameter reaches it.

        Raises
        ------
        OdometryError
        """
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
        """See `Odometry.prepare`; all that is wanted of a scan is its stamp."""
        return np.array(scan.stamp, np.int64)

    def start(
        self,
        prepared: NDArray[np.int64],
        T_odom_sensor: Poses,
        T_previous_current: Poses | None = None,  # noqa: ARG002
    ) -> None:
        """See `Odometry.start`; the program is run when this is called first.

        Raises
        ------
        OdometryError
            If the program cannot be run, or its poses are another frame's.
        """
        if self._T_own_sensor is None:
            if self._material is None:
                raise OdometryError("a program is run on a recording, not on single scans")
            given = self._material()
            poses = self._run(given)
            self._T_own_sensor = dict(zip(given.stamps.tolist(), poses, strict=True))
        self._T_odom_own = T_odom_sensor @ invert(self._own(prepared))

    def register(self, prepared: NDArray[np.int64]) -> Registration:
        """See `Odometry.register`."""
        T_odom_sensor = self._T_odom_own @ self._own(prepared)
        return Registration(T_odom_sensor, bool(np.isfinite(T_odom_sensor).all()))

    def configure(self, parameters: ParameterSet) -> None:  # noqa: ARG002
        """Refuse.

        Raises
        ------
        OdometryError
        """
        raise OdometryError("a program that runs whole recordings cannot change its parameters")

    def _own(self, stamp: NDArray[np.int64]) -> Poses:
        assert self._T_own_sensor is not None
        return self._T_own_sensor.get(int(stamp), np.full((4, 4), np.nan))

    def _run(self, given: Material) -> Poses:
        """Poses at the scans' stamps, of shape (n, 4, 4), NaN where the program tells none."""
        T_own_sensor = np.full((len(given.stamps), 4, 4), np.nan)
        with tempfile.TemporaryDirectory(prefix="adaptune-") as name:
            folder = Path(name) / "run"
            folder.mkdir()
            output = folder / self.settings.output
            output.parent.mkdir(parents=True, exist_ok=True)
            command = self._command(given, output, Path(name))
            log = Path(name) / "output"
            failure = self._execute(command, folder, log, len(given.stamps))
            if failure is None:
                try:
                    T_own_sensor = self._read(output, given.stamps)
                except (TrajectoryError, OdometryError) as error:
                    failure = str(error).replace(f"{folder}{os.sep}", "")
            with log.open("rb") as written:
                words = last_lines(written)
        known = np.isfinite(T_own_sensor[:, 0, 0])
        if failure is None and known.mean() < _COVERAGE:
            failure = (
                f"{self.settings.output} has poses for {known.sum()} of {len(known)} scans, the "
                f"last at {_seconds(given.stamps, known)}"
            )
        if failure is not None:
            self._fault(failure, words)
        try:
            _check_frame(T_own_sensor, given.T_ref_sensor)
        except OdometryError as error:
            raise OdometryError(self._told(str(error), words)) from error
        return T_own_sensor

    def _command(self, given: Material, output: Path, folder: Path) -> list[str]:
        values: dict[str, Any] = {
            "input": given.path.resolve(),
            "output": output,
            "points": given.points,
            "imu": given.imu,
        }
        if self.settings.template is not None:
            template = Template(Path(self.settings.template))
            values["parameters"] = folder / template.path.name
            values["parameters"].write_text(template.fill(self.parameters), encoding="utf-8")
        values |= self.parameters
        return [replace(argument, values) for argument in self.settings.command]

    def _execute(self, command: list[str], folder: Path, log: Path, n: int) -> str | None:
        """Run the program, and tell how it ended if not well."""
        seconds = self._limits.seconds * n
        with log.open("wb") as file:
            process = subprocess.Popen(
                # Should this process be killed, the time on the core is bounded still.
                bounded(command, self._limits.memory, f"-t {round(seconds) + 1}"),
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=os.environ | ONE_THREAD,
                start_new_session=True,
            )
            with _ending(process):
                try:
                    code = process.wait(seconds)
                except subprocess.TimeoutExpired:
                    return f"it took longer than isolation.seconds = {seconds / n:g} for each scan"
        if code == 0:
            return None
        if code == -signal.SIGXCPU:
            return f"it took longer than isolation.seconds = {seconds / n:g} for each scan"
        return verdict(code)

    def _read(self, path: Path, stamps: NDArray[np.int64]) -> Poses:
        if not path.exists():
            raise OdometryError(f"it left no {self.settings.output}")
        if self.settings.format == "kitti":
            poses = read_kitti(path)
            if len(poses) > len(stamps):
                raise OdometryError(
                    f"{self.settings.output} has {len(poses)} poses without stamps for "
                    f"{len(stamps)} scans"
                )
            stamps_own = stamps[: len(poses)]
        else:
            trajectory = read_tum(path)
            poses, stamps_own = trajectory.T_world_sensor, trajectory.stamps
        for number, T in enumerate(poses):
            if what := nonsense(T):
                raise OdometryError(f"{self.settings.output}, pose {number + 1}: {what}")
        if self.settings.extrinsic is not None:
            poses = poses @ to_pose(self.settings.extrinsic)
        return _at(Trajectory(stamps_own, poses), stamps)

    def _told(self, what: str, words: str) -> str:
        """What went wrong, of which program, and the last lines that it wrote."""
        told = f"{self.settings.command[0]}, with {self.parameters}: {what}"
        return f"{told}: {words}" if words else told

    def _fault(self, what: str, words: str) -> None:
        if self._strict:
            raise OdometryError(self._told(what, words))
        what = f"{what}: {words}" if words else what
        self.faults.append(what)
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


def _seconds(stamps: NDArray[np.int64], known: NDArray[np.bool_]) -> str:
    last = stamps[np.flatnonzero(known)[-1]]
    return f"{1e-9 * (last - stamps[0]):.1f} s of {1e-9 * (stamps[-1] - stamps[0]):.1f} s"


def _check_frame(T_own_sensor: Poses, T_ref_sensor: Poses | None) -> None:
    """Refuse poses whose motion is the reference's, seen from other axes.

    Displacements over a metre are compared before and after the rotation that brings them nearest
    to each other (Kabsch, Acta Cryst. 1976).

    Raises
    ------
    OdometryError
    """
    if T_ref_sensor is None:
        return
    ends = window_ends(T_ref_sensor, 1.0)
    starts = np.flatnonzero((ends >= 0) & np.isfinite(T_own_sensor[:, 0, 0]))
    starts = starts[np.isfinite(T_own_sensor[ends[starts], 0, 0])]
    if len(starts) < 10:
        return
    own, truth = (
        (invert(T[starts]) @ T[ends[starts]])[:, :3, 3] for T in (T_own_sensor, T_ref_sensor)
    )
    U, _, Vt = np.linalg.svd(truth.T @ own)
    T_truth_own = np.eye(4)
    T_truth_own[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    before = np.linalg.norm(own - truth, axis=1).mean()
    after = np.linalg.norm(own @ T_truth_own[:3, :3].T - truth, axis=1).mean()
    if before > 0.3 and after < 0.2 * before:
        angle = np.degrees(rotation_angle(T_truth_own))
        raise OdometryError(
            f"the program's poses are those of another frame: turned by {angle:.0f} degrees, they "
            f"are the reference's; give the LiDAR's pose in it (odometry.settings.extrinsic)"
        )


@contextmanager
def _ending(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """End a program and its children with the block, or when this process is told to end."""

    def end() -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def told(number: int, _: object) -> None:
        end()
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)

    before = None
    with contextlib.suppress(ValueError):  # only the main thread may
        before = signal.signal(signal.SIGTERM, told)
    try:
        yield
    finally:
        end()
        if before is not None:
            signal.signal(signal.SIGTERM, before)
