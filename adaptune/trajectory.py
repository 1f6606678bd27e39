"""Trajectories, and their files in the TUM, KITTI, EuRoC and OXTS formats.

All readers raise a TrajectoryError that names the file and the line that is not a pose, or whose
stamp does not come after the one before.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.errors import AdaptuneError
from adaptune.files import write_text
from adaptune.geometry import Poses


class TrajectoryError(AdaptuneError):
    """A trajectory file that cannot be read."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses over time.

    Attributes
    ----------
    stamps : ndarray of shape (n,)
        Strictly increasing integer nanoseconds.
    T_world_sensor : ndarray of shape (n, 4, 4)
        The pose at each stamp, in metres.
    max_gap : float
        Seconds. Between poses further apart the trajectory is unknown.
    """

    stamps: NDArray[np.int64]
    T_world_sensor: Poses
    max_gap: float = 1.0

    def __post_init__(self) -> None:
        if self.T_world_sensor.shape != (len(self.stamps), 4, 4):
            shape = self.T_world_sensor.shape
            raise ValueError(f"{len(self.stamps)} stamps do not go with poses of shape {shape}")
        if np.any(np.diff(self.stamps) <= 0):
            raise ValueError("stamps are not strictly increasing")

    def __len__(self) -> int:
        return len(self.stamps)

    def at(self, stamps: NDArray[np.int64], max_gap: float | None = None) -> Poses:
        """Interpolated poses of shape (m, 4, 4) at m stamps; NaN where there is no pose.

        `max_gap` is in seconds, in place of the trajectory's own.
        """
        gap = self.max_gap if max_gap is None else max_gap
        return geometry.interpolate(self.stamps, self.T_world_sensor, stamps, round(gap * 1e9))


Row = tuple[int, list[str]]
"""Number of a line, and its fields."""


def _lines(path: Path) -> Iterator[Row]:
    """Lines that are neither empty nor a comment."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise TrajectoryError(f"{path}: there is no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"{path}: cannot be read as text ({error})") from error
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if fields and not fields[0].startswith("#"):
            yield number, fields


def _rows(path: Path, columns: int, kind: str, or_more: bool = False) -> list[Row]:
    rows = []
    for number, fields in _lines(path):
        if len(fields) != columns and not (or_more and len(fields) > columns):
            what = f"a {kind} line has {columns} numbers, this has {len(fields)}"
            raise TrajectoryError(f"{path}, line {number}: {what}")
        rows.append((number, fields[:columns]))
    if not rows:
        raise TrajectoryError(f"{path}: holds no pose; give a file of TUM, KITTI or EuRoC")
    return rows


def _numbers(path: Path, rows: list[Row]) -> NDArray[np.float64]:
    values = np.empty((len(rows), len(rows[0][1])))
    for i, (number, fields) in enumerate(rows):
        try:
            values[i] = [float(field) for field in fields]
        except ValueError as error:
            raise TrajectoryError(f"{path}, line {number}: {error}") from error
        if not np.isfinite(values[i]).all():
            raise TrajectoryError(f"{path}, line {number}: a number is not finite; remove the line")
    return values


def _stamps(
    path: Path, rows: list[Row], parse: Callable[[str], int], unit: str
) -> NDArray[np.int64]:
    """Strictly increasing nanoseconds of the rows' first fields."""
    stamps = np.empty(len(rows), np.int64)
    for i, (number, fields) in enumerate(rows):
        try:
            stamps[i] = parse(fields[0])
        except (InvalidOperation, ValueError, OverflowError) as error:
            what = f"{fields[0]!r} is not a time in {unit}"
            raise TrajectoryError(f"{path}, line {number}: {what}") from error
        if i and stamps[i] <= stamps[i - 1]:
            what = "its stamp does not come after the line before"
            raise TrajectoryError(f"{path}, line {number}: {what}")
    return stamps


def _with_stamps(
    path: Path, rows: list[Row], parse: Callable[[str], int], unit: str, order: list[int]
) -> Trajectory:
    """Trajectory of rows of a stamp, a translation and a quaternion whose x y z w `order` finds."""
    values = _numbers(path, [(number, fields[1:]) for number, fields in rows])
    stamps, quaternions = _stamps(path, rows, parse, unit), values[:, order]
    norms = np.linalg.norm(quaternions, axis=1)
    worst = int(np.argmax(np.abs(norms - 1.0)))
    if abs(norms[worst] - 1.0) > 1e-2:
        what = f"its quaternion has length {norms[worst]:.3g}, not 1"
        raise TrajectoryError(f"{path}, line {rows[worst][0]}: {what}")
    return Trajectory(stamps, geometry.from_quaternions(values[:, :3], quaternions))


def read_tum(path: Path) -> Trajectory:
    """Read ``timestamp tx ty tz qx qy qz qw`` lines, exact to the nanosecond."""

    def nanoseconds(text: str) -> int:
        # A double holds seconds since 1970 to 0.2 microseconds only.
        return int(Decimal(text).scaleb(9).to_integral_value())

    return _with_stamps(path, _rows(path, 8, "TUM"), nanoseconds, "seconds", [3, 4, 5, 6])


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write ``timestamp tx ty tz qx qy qz qw`` lines, stamps to the nanosecond."""
    write_text(path, "".join(tum_lines(trajectory.stamps, trajectory.T_world_sensor)))


def tum_lines(stamps: NDArray[np.int64], T_world_sensor: Poses) -> list[str]:
    """The lines of `write_tum`, for stamps of shape (n,) and poses of shape (n, 4, 4)."""
    quaternions = geometry.to_quaternions(T_world_sensor)
    values = np.hstack([T_world_sensor[:, :3, 3], quaternions])
    lines = []
    for stamp, row in zip(stamps.tolist(), values, strict=True):
        sign, (seconds, nanoseconds) = "-" if stamp < 0 else "", divmod(abs(stamp), 10**9)
        numbers = " ".join(f"{value:.9f}" for value in row)
        lines.append(f"{sign}{seconds}.{nanoseconds:09d} {numbers}\n")
    return lines


def read_kitti(path: Path) -> Poses:
    """Read poses, of shape (n, 4, 4), from lines of 12 numbers, the rows of a 3x4 matrix."""
    values = _numbers(path, _rows(path, 12, "KITTI"))
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T[:, :3] = values.reshape(-1, 3, 4)
    return T


def write_kitti(path: Path, T_world_sensor: Poses) -> None:
    """Write poses of shape (n, 4, 4) as 12 numbers a line, the rows of a 3x4 matrix."""
    rows = T_world_sensor[:, :3].reshape(-1, 12)
    write_text(path, "".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in rows))


def is_kitti(path: Path) -> bool:
    """Whether a file's first pose has 12 numbers, and no stamp."""
    return path.suffix != ".csv" and len(next(_lines(path), (0, []))[1]) == 12


def read_trajectory(path: Path) -> Trajectory:
    """Read poses with stamps: ``.csv`` as EuRoC writes them, all else as TUM."""
    return read_euroc(path) if path.suffix == ".csv" else read_tum(path)


def read_euroc(path: Path) -> Trajectory:
    """Read ``timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z, ...`` lines, nanoseconds and metres.

    Numbers after the pose (velocities, biases) are ignored.
    """
    rows = _rows(path, 8, "EuRoC", or_more=True)
    return _with_stamps(path, rows, int, "nanoseconds", [4, 5, 6, 3])


_EARTH_RADIUS = 6378137.0


def read_oxts(files: list[Path]) -> Poses:
    """Poses of a GPS/IMU from KITTI's OXTS files, one a file.

    Latitude, longitude, altitude (degrees, metres), roll, pitch and yaw (radians) are mapped by a
    Mercator projection true at the first file's latitude; the first position is the origin. Poses
    are of shape (n, 4, 4); x points east, y north and z up.
    """
    from scipy.spatial.transform import Rotation

    values = np.empty((len(files), 6))
    for i, path in enumerate(files):
        values[i] = _numbers(path, _rows(path, 6, "OXTS", or_more=True))[0]
    latitude, longitude, altitude = values[:, :3].T
    if np.any(np.abs(latitude) >= 90.0):
        raise TrajectoryError(f"{files[int(np.argmax(np.abs(latitude)))]}: no such latitude")
    scale = np.cos(np.deg2rad(latitude[0])) * _EARTH_RADIUS
    north = scale * np.log(np.tan(np.deg2rad(90.0 + latitude) / 2.0))
    position = np.column_stack([scale * np.deg2rad(longitude), north, altitude])
    T = np.tile(np.eye(4), (len(files), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("ZYX", values[:, [5, 4, 3]]).as_matrix()
    T[:, :3, 3] = position - position[0]
    return T
