"""Odometries in programs that read a recording and a parameter file and write a trajectory."""

import json
import os
import shutil
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from adaptune._system import processes
from adaptune._system.files import locked, replacing_folder, temporary_folder
from adaptune.errors import OdometryError, UnavailableError, nearest
from adaptune.geometry import Poses, invert, nearest_rotation, rotation_angle, to_pose
from adaptune.metrics import window_ends
from adaptune.odometry.base import BaseSettings, Description, OwnFile, Registration, Usage
from adaptune.odometry.faults import Faulting, pose_fault
from adaptune.odometry.own_frame import duration_of
from adaptune.odometry.remote import Arguments, Limits
from adaptune.odometry.template import Template, check_names, placeholders, replace
from adaptune.recording.config import SequenceConfig, Transform, resolve
from adaptune.recording.export import IMU, POINTS, Layout, export
from adaptune.recording.scan import Recording, Scan
from adaptune.ros.link import LinkError
from adaptune.space import ParameterSet, Selection
from adaptune.trajectory import Trajectory, TrajectoryError, read_kitti, read_tum

_COVERAGE = 0.9  # least share of the scans for which there must be poses


class ProgramInput(NamedTuple):
    """A recording as a program reads it, the topics in it, and what is known of its n scans."""

    path: Path
    points: str
    imu: str  # empty if there is none
    stamps: NDArray[np.int64]  # nanoseconds, of shape (n,)
    T_ref_sensor: Poses | None  # of shape (n, 4, 4), NaN where there is no reference
    logs: Path | None = None  # folder for what a program leaves behind, one folder a parameter set
    span: int = 0  # nanoseconds from a scan's stamp to its last point


def program_input(
    sequence: Recording,
    config: SequenceConfig,
    about: Any,
    folder: Path,
    layout: Layout | Literal["either"],
) -> ProgramInput:
    """Find or write the recording of a sequence for a program that reads `layout`, or either bag.

    `about` is all that the sequence depends on, as plain data: a recording with another is
    replaced. What is written is kept in `folder`; processes wait for each other.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    own = _own_bag(config, layout)
    name = "input" if layout in ("ros2", "kitti") else "input.bag"
    with (folder.parent / f".{folder.name}.lock").open("w") as lock:
        locked(lock)
        if _about(folder) != about:
            taken: list[tuple[int, int]] = []
            with replacing_folder(folder) as temporary:
                temporary.mkdir()
                scans = _note_stamps(sequence, taken)
                if own is None:
                    export(scans, sequence.imu(), temporary / name, layout)
                deque(scans, 0)
                np.save(temporary / "stamps.npy", np.array(taken, np.int64).reshape(-1, 2).T)
                (temporary / "about.json").write_text(json.dumps(about), encoding="utf-8")
        at, spans = np.load(folder / "stamps.npy")
    span = int(np.median(spans)) if len(spans) else 0
    reference = sequence.reference()
    T_ref_sensor = None if reference is None else reference.at(at)
    if own is None:
        imu = "" if sequence.imu() is None else IMU
        return ProgramInput(folder / name, POINTS, imu, at, T_ref_sensor, span=span)
    source: Any = getattr(sequence, "source", None)
    imu = "" if config.imu is None else config.imu.topic or ""
    return ProgramInput(own, config.points or source.points, imu, at, T_ref_sensor, span=span)


def _note_stamps(sequence: Recording, taken: list[tuple[int, int]]) -> Iterator[Scan]:
    for scan in sequence:
        taken.append((scan.stamp, duration_of(scan)))
        yield scan


def _own_bag(config: SequenceConfig, layout: str) -> Path | None:
    """The sequence's bag, if it is a single one, used as it is, and of the right kind."""
    if not isinstance(config.bag, str) or layout == "kitti":
        return None
    plain = SequenceConfig(bag=config.bag)
    changes = ("start", "stop", "stride", "part", "compensate")
    if any(getattr(config, key) != getattr(plain, key) for key in changes):
        return None
    path = Path(config.bag)
    is_ros1, is_ros2 = path.is_file() and path.suffix == ".bag", (path / "metadata.yaml").exists()
    right = {"bag": is_ros1, "ros2": is_ros2}.get(layout, is_ros1 or is_ros2)
    return path if right else None


def _about(folder: Path) -> Any:
    try:
        return json.loads((folder / "about.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def check_frame(T_own_sensor: Poses, T_ref_sensor: Poses | None) -> None:
    """Refuse poses that move as the reference does, but along other axes.

    The rotation that aligns displacements over a metre with those of the reference (Kabsch, Acta
    Cryst. 1976) must not remove most of their difference.
    """
    if T_ref_sensor is None:
        return
    ends = window_ends(T_ref_sensor, 1.0)
    starts = np.flatnonzero(ends >= 0)
    T_own, T_true = (invert(T[starts]) @ T[ends[starts]] for T in (T_own_sensor, T_ref_sensor))
    known = np.isfinite(T_own).all(axis=(1, 2))
    own, true = T_own[known, :3, 3], T_true[known, :3, 3]
    if len(own) < 10:
        return
    T_true_own = np.eye(4)
    T_true_own[:3, :3] = R_true_own = nearest_rotation(own, true)
    before = np.linalg.norm(own - true, axis=1).mean()
    after = np.linalg.norm(own @ R_true_own.T - true, axis=1).mean()
    if before > 0.3 and after < 0.2 * before:
        angle = np.degrees(rotation_angle(T_true_own))
        raise OdometryError(
            f"the program's poses are those of another frame: turned by {angle:.0f} degrees, they "
            f"are the reference's; give the LiDAR's pose in it (odometry.settings.extrinsic)"
        )


class WholeSettings(BaseSettings):
    """What all odometries that run whole recordings may set."""

    extrinsic: Transform | None = None  # the LiDAR's pose in the frame whose poses are written
    pose_time: Literal["stamp", "end"] = "stamp"  # the moment of a scan that its pose is of


class WholeRun(Faulting):
    """An odometry that runs once on a whole recording, and its trajectory.

    It cannot restart on the way: where `start` places it elsewhere, its motions go on from there.
    Of the limits, the time is for all scans together. `read` gives the recording at the first
    start; None if scans are only prepared.
    """

    _words = ""  # the last lines that the program wrote
    _unanswered: NDArray[np.bool_] | slice = slice(0)  # scans that got no pose of their own
    _help = ""  # what to do about them

    def __init__(
        self,
        parameters: ParameterSet,
        settings: Any,
        limits: Limits,
        read: Callable[[], ProgramInput] | None = None,
    ):
        super().__init__(getattr(settings, "image", None) or settings.command[0], parameters)
        self.settings, self._limits, self._read_input = settings, limits, read
        self._T_own_sensor: dict[int, Poses] | None = None
        self._T_begin = self._T_odom_own = np.eye(4)
        self._begun = False
        self._usage, self._lacking = Usage(0.0, None), 0

    @staticmethod
    def describe(settings: Any) -> Description:  # noqa: ARG004
        """The study defines the parameters, and nothing can change on the way."""
        return Description(space=None, live=False, whole=True)

    @classmethod
    def instance(cls, *given: Any) -> Self:
        """Make an instance, as all programs of the user are made."""
        return cls(*given)

    @property
    def begun(self) -> bool:
        return self._begun or bool(self.faults)

    @property
    def usage(self) -> Usage:
        """What the program has used, with all processes that it has started."""
        return self._usage._replace(lacking=self._lacking)

    @property
    def too_long(self) -> OdometryError:
        """What is raised where the program runs too long."""
        limit = f"isolation.seconds = {self._limits.seconds:g}"
        return OdometryError(f"it took longer than {limit} for each scan")

    @abstractmethod
    def trajectory(self, given: ProgramInput, folder: Path) -> Trajectory:
        """Run the program, in an empty folder that is removed afterwards.

        Sets `_usage` and `_words`. A `TrajectoryError` or an `OdometryError` is a fault.
        """

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
        self._T_begin = T_odom_sensor
        self._place(self._own(prepared))
        self._last_motion.start(T_odom_sensor, T_previous_current)

    def _place(self, T_own_sensor: Poses) -> None:
        """Begin with a pose of its own."""
        self._T_odom_own = self._T_begin @ invert(T_own_sensor)
        self._begun = self._begun or bool(np.isfinite(T_own_sensor).all())

    def _collect(self) -> Registration:
        if not self.begun:
            self._place(self._own(self._submitted))
        T_odom_sensor = self._T_odom_own @ self._own(self._submitted)
        return Registration(T_odom_sensor, bool(np.isfinite(T_odom_sensor).all()))

    def apply(self, selection: Selection) -> None:  # noqa: ARG002
        raise OdometryError(
            "a program that runs whole recordings cannot change its parameters: give it one set"
        )

    def _own(self, stamp: NDArray[np.int64]) -> Poses:
        assert self._T_own_sensor is not None
        return self._T_own_sensor.get(int(stamp), np.full((4, 4), np.nan))

    def _run(self, given: ProgramInput) -> Poses:
        """Poses at the scans' stamps, of shape (n, 4, 4), NaN where the program wrote none."""
        T_own_sensor, failure = np.full((len(given.stamps), 4, 4), np.nan), None
        with temporary_folder() as folder:
            try:
                trajectory = self.trajectory(given, folder)
                if self.settings.pose_time == "end":
                    later, T = trajectory.stamps + given.span, trajectory.T_world_sensor
                    trajectory = Trajectory(later, T)
                if self.settings.extrinsic is not None:
                    T = trajectory.T_world_sensor @ to_pose(self.settings.extrinsic)
                    trajectory = Trajectory(trajectory.stamps, T)
                T_own_sensor = poses_at(trajectory, given.stamps)
                beside = np.searchsorted(trajectory.stamps, given.stamps) - [[1], [0]]
                nearest = trajectory.stamps[beside.clip(0, len(trajectory) - 1)] - given.stamps
                spacing = np.ptp(given.stamps) / len(given.stamps)
                self._lacking = int((np.abs(nearest).min(axis=0) > 0.6 * spacing).sum())
                known = np.isfinite(T_own_sensor[:, 0, 0])
                if known.mean() < _COVERAGE:
                    # All who count the scans without a pose are to count the same.
                    T_own_sensor[self._unanswered], known[self._unanswered] = np.nan, False
                    when = when_known(known, given.stamps) + self._help
                    failure = f"it gave poses for {known.sum()} of {len(known)} scans; {when}"
            except UnavailableError:
                raise
            except (TrajectoryError, OdometryError, LinkError) as error:
                failure = str(error)
        if failure is not None:
            self.note_fault(processes.quoting(failure, self._words))
        try:
            check_frame(T_own_sensor, given.T_ref_sensor)
        except OdometryError as error:
            what = f"{self.name}, with {self.parameters}: {error}"
            raise OdometryError(processes.quoting(what, self._words)) from error
        return T_own_sensor


def when_known(known: NDArray[np.bool_], stamps: NDArray[np.int64]) -> str:
    """When the first and the last pose come: late, early, or some between are missing."""
    if not known.any():
        return "none at all"
    (first, last), end = 1e-9 * (stamps[known][[0, -1]] - stamps[0]), 1e-9 * np.ptp(stamps)
    return f"the first pose at {first:.1f} s, the last at {last:.1f} s of {end:.1f} s"


def poses_at(trajectory: Trajectory, stamps: NDArray[np.int64]) -> Poses:
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
            f"{1e-9 * stamps[0]:.3f} s to {1e-9 * stamps[-1]:.3f} s: the program must stamp poses "
            f"as the scans are"
        )
    return T


def _inside(output: str) -> str:
    path = Path(output)
    if path.is_absolute() or ".." in path.parts or not path.name:
        raise ValueError("give a path in the program's working folder, without `..`")
    return output


class FileSettings(WholeSettings):
    """The files of a program that reads a recording; ``docs/programs.md`` describes them."""

    template: Annotated[str, AfterValidator(resolve)] | None = None
    output: Annotated[str, AfterValidator(_inside)] = "trajectory.tum"  # or a pattern
    format: Literal["tum", "kitti", "evalio"] = "tum"
    input: Layout = "bag"


class CommandSettings(FileSettings):
    """A program with its arguments, and its files; results of another `version` do not count."""

    command: Arguments
    version: str | None = None


class FileRun(WholeRun):
    """A program that is told by arguments, and by a file, where it reads and writes."""

    @staticmethod
    def own_file(parameters: ParameterSet, settings: Any) -> OwnFile | None:
        """The template with the parameters, if there is a template."""
        if settings.template is None:
            return None
        template = Template(Path(settings.template))
        # Arguments may hold parameters, too.
        values = {**parameters, "parameters": "FILE"}
        command = " ".join(replace(argument, values) for argument in settings.command)
        use = command or f"in the place of {template.path.name}"
        return OwnFile(template.path.suffix, template.fill(parameters), use)

    def filled_template(self, folder: Path) -> Path | None:
        """A copy of the template with the parameters, if there is a template."""
        if (own := self.own_file(self.parameters, self.settings)) is None:
            return None
        file = folder / Path(self.settings.template).name
        file.write_text(own.text, encoding="utf-8", errors="surrogateescape")
        return file

    def arguments(self, given: ProgramInput, **paths: str | Path) -> list[str]:
        """The command with the paths, topics and parameters that it names."""
        values = {"points": given.points, "imu": given.imu, **self.parameters, **paths}
        return [replace(argument, values) for argument in self.settings.command]

    @property
    def names_output(self) -> bool:
        """Whether the command says where to write; if so, the folder is there for it."""
        return any("output" in placeholders(argument) for argument in self.settings.command)


class Command(FileRun):
    """A program that runs once on a whole recording, and its trajectory; see `WholeRun`."""

    settings_type = CommandSettings

    @staticmethod
    def check(settings: CommandSettings, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if there is no such program, or no way for a parameter to it."""
        program = settings.command[0]
        if shutil.which(program) is None:
            raise OdometryError(f"command: there is no program {program!r}")
        check_arguments(settings.command, settings.template, parameters)

    def trajectory(self, given: ProgramInput, folder: Path) -> Trajectory:
        here = folder / "run"
        output = here / self.settings.output
        here.mkdir()
        if self.names_output:
            output.parent.mkdir(parents=True, exist_ok=True)
        paths = {"input": given.path.resolve(), "output": output}
        if (file := self.filled_template(folder)) is not None:
            paths["parameters"] = file
        command = self.arguments(given, **paths)
        self._execute(command, here, len(given.stamps))
        return read_output(find_output(here, self.settings.output), self.settings, given.stamps)

    def _execute(self, command: list[str], folder: Path, n: int) -> None:
        """Run the program; an `OdometryError` says how it ended if not well."""
        begin = time.perf_counter()
        with closing(processes.Program(command, self._limits.memory, cwd=folder)) as program:
            ended = in_time = program.wait(self._limits.seconds * n)
            if ended is None:
                ended = program.end()
            self._words = program.last_lines()
        if ended is not None:
            seconds = (time.perf_counter() - begin) / n
            self._usage = Usage(ended.cpu, ended.memory, seconds, other_cpu=ended.cpu)
        if in_time is None:
            raise self.too_long
        if in_time.code:
            raise OdometryError(processes.how_it_ended(in_time.code))


def find_output(folder: Path, output: str) -> Path:
    """The one file in a folder that a path or a pattern fits; else an `OdometryError`."""
    root = folder.resolve()
    files = _files_in(root, root.glob(output))
    if len(files) == 1:
        return files[0]
    what = f"{len(files)} files fit {output}" if files else f"it left no {output}"
    if left := files or _files_in(root, root.rglob("*")):
        names = ", ".join(str(path.relative_to(root)) for path in left[:5])
        what += f"; there are {names}; let odometry.settings.output fit just one file"
    raise OdometryError(what)


def _files_in(root: Path, paths: Iterable[Path]) -> list[Path]:
    real = {path.resolve() for path in paths if os.path.isfile(path)}  # noqa: PTH113
    return sorted(path for path in real if path.is_relative_to(root))


def read_output(path: Path, settings: FileSettings, stamps: NDArray[np.int64]) -> Trajectory:
    """Read the trajectory that a program left, for n stamps of scans; else there is an error."""
    try:
        if settings.format == "kitti":
            poses = read_kitti(path)
            if len(poses) > len(stamps):
                counted = f"{len(poses)} poses without stamps for {len(stamps)} scans"
                raise OdometryError(f"{path.name} has {counted}")
            trajectory = Trajectory(stamps[: len(poses)], poses)
        else:
            trajectory = read_tum(path)
    except TrajectoryError as error:
        raise TrajectoryError(str(error).replace(str(path), path.name)) from error
    for number, T in enumerate(trajectory.T_world_sensor):
        if what := pose_fault(T):
            raise OdometryError(f"{path.name}, pose {number + 1}: {what}")
    return trajectory


def check_arguments(command: Sequence[str], template: str | None, parameters: ParameterSet) -> None:
    """Raise an `OdometryError` if there is no way for a parameter to a program."""
    known = ["input", "output", "parameters", "points", "imu", *parameters]
    for argument in command:
        for name in placeholders(argument):
            if name not in known:
                raise OdometryError(f"command: {{{name}}} is nothing; {nearest(name, known)}")
    check_names(parameters, None if template is None else Template(Path(template)), command)
