"""Trajectories, and their files in the TUM and KITTI formats."""

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
    """

    stamps: NDArray[np.int64]
    T_world_sensor: Poses

    def __post_init__(self) -> None:
        if self.T_world_sensor.shape != (len(self.stamps), 4, 4):
            raise ValueError(
                f"{len(self.stamps)} stamps do not go with poses of shape "
                f"{self.T_world_sensor.shape}"
            )
        if np.any(np.diff(self.stamps) <= 0):
            raise ValueError("stamps are not strictly increasing")

    def __len__(self) -> int:
        return len(self.stamps)

    def at(self, stamps: NDArray[np.int64], max_gap: float = 1.0) -> Poses:
        """Interpolated poses.

        Parameters
        ----------
        stamps
            Nanoseconds, of shape (m,).
        max_gap
            Seconds; nothing is interpolated between poses further apart.

        Returns
        -------
        ndarray of shape (m, 4, 4)
            NaN where the trajectory says nothing.
        """
        return geometry.interpolate(self.stamps, self.T_world_sensor, stamps, round(max_gap * 1e9))


def _rows(path: Path, columns: int, kind: str) -> list[tuple[int, list[str]]]:
    """Split the lines that are neither empty nor a comment, with their numbers."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise TrajectoryError(f"{path}: there is no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"{path}: cannot be read as text ({error})") from error
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) != columns:
            raise TrajectoryError(
                f"{path}, line {number}: a {kind} line has {columns} numbers, this has "
                f"{len(fields)}"
            )
        rows.append((number, fields))
    if not rows:
        raise TrajectoryError(f"{path}: holds no pose")
    return rows


def _numbers(path: Path, rows: list[tuple[int, list[str]]]) -> NDArray[np.float64]:
    values = np.empty((len(rows), len(rows[0][1])))
    for i, (number, fields) in enumerate(rows):
        try:
            values[i] = [float(field) for field in fields]
        except ValueError as error:
            raise TrajectoryError(f"{path}, line {number}: {error}") from error
        if not np.isfinite(values[i]).all():
            raise TrajectoryError(f"{path}, line {number}: a number is not finite")
    return values


def read_tum(path: Path) -> Trajectory:
    """Read ``timestamp tx ty tz qx qy qz qw`` lines, exact to the nanosecond.

    Raises
    ------
    TrajectoryError
        Naming the file and the line that is not a pose, or does not come after the one before.
    """
    rows = _rows(path, 8, "TUM")
    values = _numbers(path, [(number, fields[1:]) for number, fields in rows])
    stamps = np.empty(len(rows), np.int64)
    for i, (number, fields) in enumerate(rows):
        # A double holds seconds since 1970 to 0.2 microseconds only.
        try:
            stamps[i] = int(Decimal(fields[0]).scaleb(9).to_integral_value())
        except (InvalidOperation, ValueError, OverflowError) as error:
            raise TrajectoryError(
                f"{path}, line {number}: {fields[0]!r} is not a time in seconds"
            ) from error
        if i and stamps[i] <= stamps[i - 1]:
            raise TrajectoryError(
                f"{path}, line {number}: its stamp does not come after the line before"
            )
    norms = np.linalg.norm(values[:, 3:], axis=1)
    if (worst := int(np.argmax(np.abs(norms - 1.0)))) >= 0 and abs(norms[worst] - 1.0) > 1e-2:
        raise TrajectoryError(
            f"{path}, line {rows[worst][0]}: its quaternion has length {norms[worst]:.3g}, not 1"
        )
    return Trajectory(stamps, geometry.from_quaternions(values[:, :3], values[:, 3:]))


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write ``timestamp tx ty tz qx qy qz qw`` lines, stamps to the nanosecond."""
    quaternions = geometry.to_quaternions(trajectory.T_world_sensor)
    lines = []
    for stamp, T, q in zip(
        trajectory.stamps.tolist(), trajectory.T_world_sensor, quaternions, strict=True
    ):
        sign, (seconds, nanoseconds) = "-" if stamp < 0 else "", divmod(abs(stamp), 10**9)
        numbers = " ".join(f"{value:.9f}" for value in (*T[:3, 3], *q))
        lines.append(f"{sign}{seconds}.{nanoseconds:09d} {numbers}\n")
    write_text(path, "".join(lines))


def read_kitti(path: Path) -> Poses:
    """Read poses of 12 numbers a line, the rows of a 3x4 matrix.

    Returns
    -------
    ndarray of shape (n, 4, 4)

    Raises
    ------
    TrajectoryError
        Naming the file and the line that is not a pose.
    """
    values = _numbers(path, _rows(path, 12, "KITTI"))
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T[:, :3] = values.reshape(-1, 3, 4)
    return T


def write_kitti(path: Path, T_world_sensor: Poses) -> None:
    """Write poses of shape (n, 4, 4) as 12 numbers a line, the rows of a 3x4 matrix."""
    rows = T_world_sensor[:, :3].reshape(-1, 12)
    write_text(path, "".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in rows))
