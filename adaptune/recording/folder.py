"""Recordings with one file for each scan.

All functions raise a SequenceError that names the file or folder that is missing or unfit.
"""

import re
from calendar import timegm
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from functools import partial
from itertools import takewhile
from pathlib import Path
from time import strptime
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune._system import open3d
from adaptune._system.files import DAMAGED_NPZ, entries
from adaptune.errors import Finding, NotInstalledError
from adaptune.geometry import Poses
from adaptune.recording.clouds import FARTHEST, PointCloudError, from_fields
from adaptune.recording.scan import Frame, Imu, Scan, SequenceError
from adaptune.recording.timing import AUTO, SOONEST, Timing
from adaptune.trajectory import Trajectory, read_kitti

SUFFIXES = (".bin", ".npy", ".pcd", ".ply")
KITTI = ("x", "y", "z", "intensity")  # what KITTI's ``.bin`` files hold of each point
ELEVATION = 0.205  # degrees by which KITTI's LiDAR reports its rays too low


@dataclass(frozen=True, eq=False)
class FileSource:
    """Scans in files of their own."""

    name: str  # the folder
    scans: Sequence[Path]
    stamps: NDArray[np.int64]  # nanoseconds of each file, of shape (n,)
    timing: Timing = AUTO  # what the stamps mean
    own_poses: Callable[[], Trajectory] | None = None  # reads the LiDAR's poses
    elevation: float = 0.0  # degrees by which every ray is to be turned up
    stamp_files: Sequence[Path] = ()  # hold the stamps, where the files' names do not
    pose_files: Sequence[Path] = ()  # hold the poses
    stamped_by: str = "times.txt"  # what gives the scans' times
    columns: Sequence[str] = KITTI  # of a point in a ``.bin`` file
    findings: Sequence[Finding] = ()  # what is odd about the files

    begins: ClassVar[Mapping[str, int]] = {}
    skipped: ClassVar[float] = 0.0

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
        scan = read_scan(path, stamp, self.timing, self.columns)
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


def read_scan(
    path: Path, stamp: int, timing: Timing = AUTO, columns: Sequence[str] = KITTI
) -> Scan:
    """Read one file: ``.npy``, ``.pcd``, ``.ply``, or ``.bin`` with these columns of float32."""
    try:
        return from_fields(_fields(path, columns), stamp, timing)
    except FileNotFoundError as error:
        raise SequenceError(f"{path}: there is no such file") from error
    except NotInstalledError as error:
        raise SequenceError(f"{path}: {error}") from error
    except (KeyError, PointCloudError, *DAMAGED_NPZ) as error:
        raise SequenceError(f"{path}: cannot be read as a scan ({error})") from error


def turn_up(points: NDArray[np.float32], degrees: float) -> NDArray[np.float32]:
    """Turn the rays to points of shape (n, 3) up by `degrees`, each in its vertical plane.

    Those of KITTI's HDL-64E lie 0.205 too low (Deschaud, IMLS-SLAM, ICRA 2018).
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


def _fields(path: Path, names: Sequence[str]) -> NDArray[Any] | dict[str, NDArray[Any]]:
    if path.suffix == ".bin":
        size, width = path.stat().st_size, len(names)
        if size % (4 * width):
            what = f"{size} bytes are not a whole number of points of {width} float32"
            raise ValueError(f"{what} ({' '.join(names)})")
        array: NDArray[Any] = np.fromfile(path, "<f4").reshape(-1, width)
        return {name: array[:, i] for i, name in enumerate(names)}
    if path.suffix == ".npy":
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
    return {axis: array[:, i] for i, axis in enumerate("xyz")}


def _columns(files: Sequence[Path]) -> tuple[Sequence[str], list[Finding]]:
    """Columns of ``.bin`` files, by what they can be, and what is odd about them."""
    some = [np.fromfile(files[i], "<f4") for i in sorted({0, len(files) // 2, len(files) - 1})]
    mend = "if they are others, write .npy or .pcd files"
    for width in range(4, 9):
        whole = [v.reshape(-1, width) for v in some if len(v) and len(v) % width == 0]
        if not whole or len(whole) < len(some) or not _can_be_points(np.concatenate(whole)):
            continue
        names = [*KITTI, *(_name(column) for column in np.concatenate(whole).T[4:])]
        # A name that comes again is not known.
        names = [n if n and n not in names[:i] else f"unknown{i}" for i, n in enumerate(names)]
        what = f"the .bin files hold {width} numbers a point, read as {' '.join(names)}"
        return names, [Finding((), what, mend, of="points")] if width > 4 else []
    if sum(map(len, some)) % 4:
        return KITTI, []  # reading them says what is wrong
    what = "many numbers of the .bin files cannot be intensities: they are below zero"
    return KITTI, [Finding((), f"{what}; read as {' '.join(KITTI)}", mend, of="points")]


@np.errstate(over="ignore", invalid="ignore")
def _can_be_points(points: NDArray[np.float32]) -> bool:
    """Whether the first four columns are what they should be, but for marks of lost rays."""
    near = (np.abs(points[:, :3]) < FARTHEST).all(axis=1)
    return bool(np.mean(near & (points[:, 3] >= 0)) > 0.98)


@np.errstate(over="ignore", invalid="ignore")
def _name(column: NDArray[np.float32]) -> str:
    """What a column behind the intensities can be."""
    low, high = float(column.min()), float(column.max())
    if low >= 0 and high < 256 and not (column % 1).any():
        return "ring"
    return "time" if low > -1.0 and 1e-3 < high - low < 1.0 else ""


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

    They may be in ``data/`` below it, as KITTI's raw recordings are. Stamps are the lines of
    ``times.txt`` or ``timestamps.txt`` where there is one, there or above ``data/``; else the
    files' names where these are times; else one `period` a file.
    """
    if not folder.is_dir():
        raise SequenceError(f"{folder}: there is no such folder")
    places = [folder / below for below in ("", "data", "velodyne_points/data")]
    found = ((p, sorted(entries(p, s), key=_natural)) for p in places for s in SUFFIXES)
    place, files = next(((p, files) for p, files in found if files), (folder, []))
    if not files:
        raise SequenceError(f"{folder}: holds no scan ({', '.join(SUFFIXES)}) and no bag")
    columns, findings = _columns(files) if files[0].suffix == ".bin" else (KITTI, [])
    make = partial(FileSource, str(folder), timing=timing, columns=columns, findings=findings)
    around = [place, place.parent] if place.name == "data" else [place]
    listed = [p / name for p in around for name in ("times.txt", "timestamps.txt")]
    times = next((path for path in listed if path.exists()), None)
    if times is None:
        named, unit = _named_stamps(files)
        if named is not None:
            order = np.argsort(named, kind="stable")
            make = partial(make, scans=[files[i] for i in order])
            return make(stamps=named[order], stamped_by=f"the files' names ({unit})")
        assumed = f"one every {timing.period:g} s, as nothing gives their times"
        if unit:
            what = f"the names of the files look like times and are not read ({unit})"
            mend = "write a times.txt with the seconds of each scan, or set `period`"
            findings.append(Finding((), f"{what}; {assumed}", mend, of="points"))
        stamps = np.arange(len(files)) * round(timing.period * 1e9)
        return make(scans=files, stamps=stamps, stamped_by=assumed)
    stamps = _seconds(times)
    if len(stamps) > len(files) and all(path.stem.isdigit() for path in files):
        stamps = _by_number(files, stamps)  # files are missing
    if len(stamps) != len(files):
        raise SequenceError(f"{times}: {len(stamps)} times for {len(files)} scans; give one a scan")
    return make(scans=files, stamps=stamps, stamp_files=[times], stamped_by=times.name)


def _natural(path: Path) -> list[tuple[int, str]]:
    """Key by which scan_10 comes after scan_9."""
    return [(int(n or 0), text) for text, n in re.findall(r"(\D*)(\d*)", path.stem)]


# Times in the names of files: a date or a number, and what may come after it as a part of a second;
# the power of ten that makes the number nanoseconds. Short ones count from 1970.
_DATE = r"(?:^|\D)((?:19|20)\d\d(?:[-_.]?\d\d){2}[-_.T ]?\d\d(?:[-_.:hm]?\d\d){2})"
_STAMPED_NAMES = (
    (_DATE + r"([._,-]?(?:\d{3}){1,3}|\.\d+|)\D*$", None, "dates in UTC"),
    (r"^(\d{1,10})(\.\d+)$", 9, "seconds"),
    (r"(?:^|\D)([1-4]\d{9})([._-]\d{1,9})\D*$", 9, "seconds and their parts"),
    (r"(?:^|\D)(\d{17,19})()\D*$", 0, "nanoseconds"),
    (r"(?:^|\D)([1-4]\d{15})()\D*$", 3, "microseconds"),
    (r"(?:^|\D)([1-4]\d{12})()\D*$", 6, "milliseconds"),
    (r"(?:^|\D)([1-4]\d{9})()\D*$", 9, "seconds"),
)


def _named_stamps(files: Sequence[Path]) -> tuple[NDArray[np.int64] | None, str]:
    """Nanoseconds that the files' names are, and their unit, or a name that only looks like one."""
    stems = [re.sub(r"(\.(bin|npy|pcd|ply))+$", "", path.name) for path in files]
    for pattern, power, unit in _STAMPED_NAMES:
        found = [match.groups() for match in map(re.compile(pattern).search, stems) if match]
        if len(found) < len(stems):
            continue
        try:
            begin = np.array([_nanoseconds(whole, power) for whole, _ in found], np.int64)
        except (ValueError, OverflowError):
            continue  # no dates, or no times
        stamps = begin + _parts(begin, [rest for _, rest in found])
        # A number that counts may follow a date.
        if power is not None or np.ptp(stamps) >= SOONEST * (len(files) - 1):
            return stamps, unit
    numbers = [int(re.sub(r"\D", "", stem) or 0) for stem in stems]
    look = len(stems) > 1 and numbers[0] > 1e7 and np.median(np.diff(numbers)) > 1
    return None, files[0].name if look else ""


def _nanoseconds(text: str, power: int | None) -> int:
    if power is None:
        return timegm(strptime(re.sub(r"\D", "", text), "%Y%m%d%H%M%S")) * 10**9
    return int(text) * int(10**power)


def _parts(begin: NDArray[np.int64], rest: list[str]) -> NDArray[np.int64]:
    """Nanoseconds of the digits that follow the seconds that `begin`.

    Where their numbers differ, zeros may be lacking behind them, or before: scans come evenly.
    Unless that tells, `.5` is half a second, and `_5` is five nanoseconds.
    """
    parts, widths = [re.sub(r"\D", "", text) for text in rest], [0]
    most = max(map(len, parts))
    if min(map(len, parts)) < most and not any(re.match(r"0\d", part) for part in parts):
        widths = sorted([0, *(w for w in (9, 6, 3) if w >= most)], reverse=rest[0][0] != ".")
    digits = ([part.zfill(width).ljust(9, "0")[:9] for part in parts] for width in widths)
    read = [np.array(ones, np.int64) for ones in digits]
    steps = [np.log(np.maximum(np.diff(np.sort(begin + ones)), 1)) for ones in read]
    uneven = [np.abs(s - np.median(s)).sum() if len(s) else 0.0 for s in steps]
    best = int(np.argmin(uneven))
    return read[best if uneven[best] < 0.5 * uneven[0] else 0]


def kitti(folder: Path, elevation: float | None = None) -> FileSource:
    """Scans of a sequence of the KITTI odometry benchmark.

    It holds ``velodyne/``, ``times.txt`` and ``calib.txt``; poses are in ``poses.txt``, or in
    ``poses/`` two folders up. Every ray is turned up by `elevation` degrees, 0.205 when left out.
    """
    if not folder.is_dir():
        raise SequenceError(f"{folder}: there is no such folder")
    files = entries(folder / "velodyne", ".bin")
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
    """Nanoseconds of the lines of a file: seconds, smaller units since 1970, or dates."""
    try:
        lines = [line for line in _text(path).splitlines() if line.strip()]
        if lines and re.match(r"\d+-\d+-\d+[ T]\d+:", lines[0]):
            dates = np.array([line.strip().replace(" ", "T") for line in lines], "datetime64[ns]")
            return dates.astype(np.int64)
        times = [Decimal(text) for line in lines for text in line.split()]
        # Since 1970 there are 1e9 seconds and more.
        large = max(times, default=Decimal(0))
        power = next((p for p, most in ((9, 1e11), (6, 1e14), (3, 1e17)) if large < most), 0)
        return np.array([int(t.scaleb(power).to_integral_value()) for t in times], np.int64)
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise SequenceError(f"{path}: a line is not a time in seconds") from error


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise SequenceError(f"{path}: there is no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise SequenceError(f"{path}: cannot be read as text ({error})") from error
