"""Recordings with one file for each scan.

All functions raise a SequenceError that names the file or folder that is missing or unfit.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from adaptune import files as open3d
from adaptune import geometry
from adaptune.errors import NotInstalledError
from adaptune.geometry import Poses
from adaptune.recording.clouds import PointCloudError, from_fields
from adaptune.recording.scan import AUTO, Frame, Imu, Scan, SequenceError, Timing
from adaptune.trajectory import Trajectory, read_kitti

SUFFIXES = (".bin", ".npy", ".pcd", ".ply")
ELEVATION = 0.205
"""Degrees by which KITTI's LiDAR reports its rays too low."""


@dataclass(frozen=True, eq=False)
class FileSource:
    """Scans in files of their own."""

    name: str  # the folder
    scans: Sequence[Path]
    stamps: NDArray[np.int64]  # nanoseconds of each file, of shape (n,)
    timing: Timing = AUTO  # what the stamps mean
    # Reads the LiDAR's poses stored with the files.
    own_poses: Callable[[], Trajectory] | None = None
    elevation: float = 0.0  # degrees by which every ray is to be turned up
    stamp_files: Sequence[Path] = ()  # hold the stamps, where the files' names do not
    pose_files: Sequence[Path] = ()  # hold the poses

    random_access: ClassVar[bool] = True
    begins: ClassVar[Mapping[str, int]] = {}

    def about(self) -> dict[str, Any]:
        """Its name."""
        return {"name": self.name}

    @property
    def n_messages(self) -> int:
        """Number of files."""
        return len(self.scans)

    @property
    def files(self) -> list[Path]:
        """Scans and stamps."""
        return [*self.scans, *self.stamp_files]

    def frames(self) -> Iterator[Frame]:
        """All scans in the order of the files' names."""
        for path, stamp in zip(self.scans, self.stamps.tolist(), strict=True):
            yield Frame(stamp, stamp, partial(self._load, path, stamp))

    def between(self, begin: int, stop: int) -> list[Frame]:
        """Scans with stamps from `begin` to before `stop`."""
        return [frame for frame in self.frames() if begin <= frame.stamp < stop]

    def _load(self, path: Path, stamp: int) -> Scan:
        scan = read_scan(path, stamp, self.timing)
        if not self.elevation:
            return scan
        return replace(scan, points=turn_up(scan.points, self.elevation))

    def span(self) -> tuple[int, int] | None:
        """First and last stamp."""
        return (int(self.stamps[0]), int(self.stamps[-1])) if len(self.stamps) else None

    def poses(self, *_: str | None) -> Trajectory | None:
        """The LiDAR's poses stored with the files; a TrajectoryError if they cannot be read."""
        return None if self.own_poses is None else self.own_poses()

    def imu(self, *_: str | None) -> Imu | None:
        """Folders hold none."""


def read_scan(path: Path, stamp: int, timing: Timing = AUTO) -> Scan:
    """Read one file: ``.bin`` as KITTI writes them, ``.npy``, ``.pcd`` or ``.ply``."""
    try:
        return from_fields(_fields(path), stamp, timing)
    except FileNotFoundError as error:
        raise SequenceError(f"{path}: there is no such file") from error
    except NotInstalledError as error:
        raise SequenceError(f"{path}: {error}") from error
    except (KeyError, PointCloudError, *open3d.DAMAGED_NPZ) as error:
        raise SequenceError(f"{path}: cannot be read as a scan ({error})") from error


def turn_up(points: NDArray[np.float32], degrees: float) -> NDArray[np.float32]:
    """Turn every ray up by `degrees`, in the vertical plane in which it lies.

    The rays of KITTI's HDL-64E lie 0.205 too low (Deschaud, IMLS-SLAM, ICRA 2018; KISS-ICP corrects
    it likewise). `points` are of shape (n, 3).
    """
    sine, cosine = np.sin(np.deg2rad(degrees)), np.cos(np.deg2rad(degrees))
    distance = np.hypot(points[:, 0], points[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = cosine - sine * points[:, 2] / distance
    turned = np.empty_like(points)
    # Straight up there is no plane to turn in.
    turned[:, :2] = points[:, :2] * np.where(distance > 0, scale, 1.0)[:, None]
    turned[:, 2] = np.where(distance > 0, sine * distance + cosine * points[:, 2], points[:, 2])
    return turned


def _fields(path: Path) -> NDArray[Any] | dict[str, NDArray[Any]]:
    if path.suffix == ".bin":
        size = path.stat().st_size
        if size % 16:
            raise ValueError(f"{size} bytes are not a whole number of points of four float32")
        array: NDArray[Any] = np.fromfile(path, "<f4").reshape(-1, 4)
    elif path.suffix == ".npy":
        array = np.load(path, allow_pickle=False)
        if array.dtype.names is not None:
            if missing := [axis for axis in "xyz" if axis not in array.dtype.names]:
                there = ", ".join(array.dtype.names)
                raise KeyError(f"no field {', '.join(missing)}; there is {there}")
            return array.reshape(-1)
    else:
        return _open3d_fields(path)
    if array.ndim != 2 or array.shape[1] < 3:
        raise ValueError(f"an array of shape {array.shape} is not one of points")
    columns = {axis: array[:, i] for i, axis in enumerate("xyz")}
    return columns | {"intensity": array[:, 3]} if path.suffix == ".bin" else columns


def _open3d_fields(path: Path) -> dict[str, NDArray[Any]]:
    if path.suffix == ".pcd":
        with path.open("rb") as file:
            header = takewhile(lambda line: line[:4] != b"DATA", file)
            pose = next((line.split()[1:8] for line in header if line[:9] == b"VIEWPOINT"), [])
        if any(abs(float(number)) > 1e-6 for number in pose[:3] + pose[4:]):
            what = "VIEWPOINT is a pose, and its points may be in the sensor's frame or the world's"
            raise ValueError(f"{what}: give the sensor's, with VIEWPOINT 0 0 0 1 0 0 0")
    cloud = open3d.load().t.io.read_point_cloud(str(path))
    # Open3D returns an empty cloud for files that it cannot read.
    if "positions" not in cloud.point or not len(cloud.point.positions):
        raise ValueError("it is damaged or holds no point")
    fields = {name: tensor.numpy() for name, tensor in cloud.point.items()}
    columns = {name: v[:, 0] for name, v in fields.items() if v.ndim == 2 and v.shape[1] == 1}
    return columns | {axis: fields["positions"][:, i] for i, axis in enumerate("xyz")}


def scan_folder(folder: Path, timing: Timing = AUTO) -> FileSource:
    """Scans of a folder of ``.pcd``, ``.ply``, ``.npy`` or ``.bin`` files.

    Stamps are the lines of ``times.txt`` (seconds) where there is one; else the files' names
    where these are seconds with a fraction or nanoseconds since 1970; else one `period` a file.
    """
    if not folder.is_dir():
        raise SequenceError(f"{folder}: there is no such folder")
    for suffix in SUFFIXES:
        if files := sorted(folder.glob(f"*{suffix}"), key=_natural):
            break
    else:
        raise SequenceError(f"{folder}: holds no scan ({', '.join(SUFFIXES)}) and no bag")
    times = folder / "times.txt"
    if not times.exists():
        return FileSource(str(folder), files, _named_stamps(files, timing.period), timing)
    stamps = _seconds(times)
    if len(stamps) != len(files):
        raise SequenceError(f"{times}: {len(stamps)} times for {len(files)} scans; give one a scan")
    return FileSource(str(folder), files, stamps, timing, stamp_files=[times])


def _natural(path: Path) -> list[tuple[int, str]]:
    """Key by which scan_10 comes after scan_9."""
    return [(int(n or 0), text) for text, n in re.findall(r"(\D*)(\d*)", path.stem)]


def _named_stamps(files: Sequence[Path], period: float) -> NDArray[np.int64]:
    stems = [path.stem for path in files]
    if all(re.fullmatch(r"\d{17,19}", stem) for stem in stems):
        return np.array([int(stem) for stem in stems], np.int64)
    if all(re.fullmatch(r"\d{1,10}\.\d+", stem) for stem in stems):
        return np.array([int(Decimal(stem).scaleb(9)) for stem in stems], np.int64)
    return np.arange(len(files)) * round(period * 1e9)


def kitti(folder: Path, elevation: float | None = None) -> FileSource:
    """Scans of a sequence of the KITTI odometry benchmark.

    It holds ``velodyne/``, ``times.txt`` and ``calib.txt``; poses are in ``poses.txt``, or in
    ``poses/`` two folders up. Every ray is turned up by `elevation` degrees, 0.205 when left out.
    """
    if not folder.is_dir():
        raise SequenceError(f"{folder}: there is no such folder")
    files = sorted((folder / "velodyne").glob("*.bin"))
    if not files:
        raise SequenceError(f"{folder}: not a KITTI sequence; it has no velodyne/*.bin")
    stamps = _seconds(folder / "times.txt")
    if len(files) > len(stamps):
        raise SequenceError(f"{folder}: {len(stamps)} lines in times.txt for {len(files)} scans")
    candidates = (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt")
    found = next((path for path in candidates if path.exists()), None)

    def poses() -> Trajectory:
        assert found is not None
        T_world_camera = read_kitti(found)
        if len(T_world_camera) != len(stamps):
            raise SequenceError(f"{found}: {len(T_world_camera)} poses for {len(stamps)} stamps")
        T_camera_sensor = _matrix(folder / "calib.txt", "Tr")
        T = geometry.invert(T_camera_sensor) @ T_world_camera @ T_camera_sensor
        return Trajectory(stamps, T)

    # Files may be missing from the front or the middle: their numbers give the stamps.
    return FileSource(
        str(folder),
        files,
        _by_number(files, stamps),
        own_poses=poses if found else None,
        elevation=ELEVATION if elevation is None else elevation,
        stamp_files=[folder / "times.txt"],
        pose_files=[found, folder / "calib.txt"] if found else [],
    )


def _matrix(path: Path, key: str) -> Poses:
    """A 3x4 matrix of the line `key:` of a file, as a pose."""
    lines = (line.partition(":") for line in _text(path).splitlines())
    text = next((numbers for name, _, numbers in lines if name.strip() == key), "")
    try:
        numbers = np.array([float(field) for field in text.split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != 12:
        raise SequenceError(f"{path}: no line `{key}:` with 12 numbers")
    return np.vstack([numbers.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])


def _by_number(files: Sequence[Path], stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Stamp of each file by the number that its name is."""
    try:
        return np.asarray(stamps[[int(path.stem) for path in files]])
    except (ValueError, IndexError) as error:
        what = f"the files' numbers do not go with {len(stamps)} stamps"
        raise SequenceError(f"{files[0].parent}: {what}") from error


def _seconds(path: Path) -> NDArray[np.int64]:
    try:
        seconds = [Decimal(line) for line in _text(path).split()]
        return np.array([int(s.scaleb(9).to_integral_value()) for s in seconds], np.int64)
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise SequenceError(f"{path}: a line is not a time in seconds") from error


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise SequenceError(f"{path}: there is no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"{path}: cannot be read as text ({error})") from error
