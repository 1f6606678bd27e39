"""Trajectories, and their files in the TUM, KITTI and EuRoC formats.

All readers raise a TrajectoryError that names the file, and the line where one is wrong.
"""

import logging
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune._system.files import write_text
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses

_log = logging.getLogger(__name__)


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

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Since the first pose, of shape (n,)."""
        return np.asarray((self.stamps - self.stamps[0]) * 1e-9)

    @property
    def sparse(self) -> str:
        """Where many poses are further apart than `max_gap`: how many, and what to set."""
        seconds = np.diff(self.stamps) * 1e-9
        long = seconds[seconds > self.max_gap]
        if len(long) <= 0.1 * len(seconds):
            return ""
        what = f"{len(long)} of {len(seconds)} gaps of the reference are longer than max_gap"
        enough = np.ceil(2.0 * np.median(long)) / 2.0
        help_ = f"scans in them get no label, set `max_gap: {enough:g}` or more"
        return f"{what} = {self.max_gap:g} s: {help_}"

    def at(self, stamps: NDArray[np.int64], max_gap: float | None = None) -> Poses:
        """Poses of shape (m, 4, 4) at m stamps: linear in translation, spherical in rotation.

        They are NaN outside the trajectory, and between poses further apart than `max_gap` seconds,
        by default its own.
        """
        T = np.full((len(stamps), 4, 4), np.nan)
        if not len(self) or not len(stamps):
            return T
        gap = round((self.max_gap if max_gap is None else max_gap) * 1e9)
        after = np.searchsorted(self.stamps, stamps, side="left")
        inside = (stamps >= self.stamps[0]) & (stamps <= self.stamps[-1])
        after = np.clip(after, 0, len(self) - 1)
        exact = inside & (self.stamps[after] == stamps)
        T[exact] = self.T_world_sensor[after[exact]]
        between = inside & ~exact
        between[between] = (self.stamps[after[between]] - self.stamps[after[between] - 1]) <= gap
        if between.any():
            from scipy.spatial.transform import Rotation, Slerp

            # Stamps are exact integers; only differences, which fit a double, become floats.
            seconds = self.seconds
            query = (stamps[between] - self.stamps[0]) * 1e-9
            T[between] = np.eye(4)
            rotations = Rotation.from_matrix(self.T_world_sensor[:, :3, :3])
            T[between, :3, :3] = Slerp(seconds, rotations)(query).as_matrix()
            left = after[between] - 1
            share = ((query - seconds[left]) / (seconds[left + 1] - seconds[left]))[:, None]
            positions = self.T_world_sensor[:, :3, 3]
            T[between, :3, 3] = (1.0 - share) * positions[left] + share * positions[left + 1]
        return T


Row = tuple[int, list[str]]
"""Number of a line, and its fields."""
_NUMBER = re.compile(r"[-+.]*\d")
_DECIMAL = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")


_TO_TUM = "write a line `timestamp x y z qx qy qz qw` for each pose"
_ECHO = "`rostopic echo -p TOPIC` or `ros2 topic echo --csv TOPIC`"
_FOREIGN = {  # what other files begin with, what they are, and what to do
    r"(VERTEX|EDGE|FIX)\w*[ :]": f"a pose graph (g2o), whose poses have no stamps; {_TO_TUM}",
    r"(---\s+)?(header|pose|position|transforms):\s": f"messages as YAML; print them by {_ECHO}",
    r"<|[\[{]\s*[\[{\"]|\$G": f"XML, JSON or NMEA; {_TO_TUM}",
}


def _lines(path: Path) -> Iterator[tuple[int, str, list[str]]]:
    """Number, text and fields of lines that are not empty; a comment has no fields."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise TrajectoryError(f"{path}: there is no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"{path}: cannot be read as text in UTF-8 ({error})") from error
    for begin, what in _FOREIGN.items():
        if re.match(begin, text.lstrip()):
            raise TrajectoryError(f"{path}: holds {what}")
    for number, line in enumerate(text.splitlines(), start=1):
        if line := line.strip().rstrip(",; "):
            fields = re.split(r"\s*;\s*" if ";" in line else r"\s+", line)
            commas = [field for field in fields if "," in field]
            # Where something else parts so many fields, commas are decimal.
            if commas and len(fields) >= 7 and all(map(_DECIMAL.fullmatch, commas)):
                _assume(path, "its numbers have decimal commas")
                fields = [field.replace(",", ".") for field in fields]
            elif re.search("[,;]", line):
                fields = re.split(r"\s*[,;]\s*|\s+", line)
            yield number, line, [] if line[0] == "#" else fields


@cache
def _assume(path: Path, what: str) -> None:
    _log.info("%s: %s", path, what)


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


_COLUMNS = ("timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")
# What a header may call them, in lower case and without units; an axis follows the last two.
_NAMES = {
    "nanoseconds": r"(.*[._ /])?n(ano)?sec\w*",
    "timestamp": r"t|.*(time|stamp).*|(.*[._ /])?sec\w*",
    "q": r"(.*[._ /])?(q|quat|orient|rot)(.*[._ /])?[xyzw]",
    "": r"(t_?|(.*[._ /])?(p|pos|trans|loc)(.*[._ /])?)?[xyz]",
}
_OTHERS = re.compile(r"(?<![a-z])(vel|rate|acc|std|sigma|cov|var|err|q?dot)")  # no poses


def _named(path: Path, header: str) -> dict[str, list[int]]:
    """Where a header has each of `_COLUMNS`, as far as it names them; the likeliest one first."""
    header = re.sub(r"\[.*?\]|\(.*?\)|[#%\"]", "", header).lower().strip()
    names = re.split(r"\s*[,;]\s*" if re.search("[,;]", header) else r"\s+", header)
    found: dict[str, list[int]] = {}
    stems: dict[str, dict[str, dict[str, list[int]]]] = {"": {}, "q": {}}
    for i, name in enumerate(names):
        kind = next((k for k, known in _NAMES.items() if re.fullmatch(known, name)), None)
        if kind in stems:
            stems[kind].setdefault(name[:-1], {}).setdefault(kind + name[-1], [i])
        elif kind is not None:
            found.setdefault(kind, []).append(i)
    # Of several, a whole position and a whole turn, of one body.
    whole = [
        [stem for stem, axes in of.items() if len(axes) == 3 + len(kind)] or [*of, ""][:1]
        for kind, of in stems.items()
    ]

    def unlikely(pair: tuple[str, ...]) -> tuple[bool, int]:
        common = os.path.commonprefix(pair)  # noqa: RUF071 (names, not paths)
        return any(map(_OTHERS.search, pair)), len("".join(pair)) - 2 * len(common)

    pairs = sorted(product(*whole), key=unlikely)
    for of, stem in zip(stems.values(), pairs[0], strict=True):
        found |= of.get(stem, {})
    if len(pairs) > 1:
        _assume(path, f"of its poses, those in {' and '.join(f'{s}x' for s in pairs[0])} are used")
    # A message's own stamp comes before the time at which it was recorded.
    for times in (found.get("timestamp", []), found.get("nanoseconds", [])):
        times.sort(key=lambda i: ("header" not in names[i], "stamp" not in names[i], len(names[i])))
    return found


def _table(path: Path) -> tuple[dict[str, list[int]], list[Row]]:
    """Columns that a header, or a comment before the poses, names completely; and the rows."""
    named: dict[str, list[int]] = {}
    rows: list[Row] = []
    for number, line, fields in _lines(path):
        if fields and (rows or any(map(_NUMBER.match, fields))):
            rows.append((number, fields))
        elif not rows:
            found = _named(path, line)
            missing = ", ".join(name for name in _COLUMNS if name not in found)
            if fields and missing:
                what = f"line {number}: names no column {missing}"
                raise TrajectoryError(f"{path}, {what}; name all of {' '.join(_COLUMNS)}")
            named = named if missing else found
    if not rows:
        raise TrajectoryError(f"{path}: holds no pose; give a file of TUM, KITTI or EuRoC")
    first = rows[0][1]
    if not named and len(first) >= 10 and not any(map(_NUMBER.match, first[2:3])):
        _assume(path, "its columns are those of `ros2 topic echo --csv`")
        x = next((i for i, field in enumerate(first) if i > 2 and _NUMBER.match(field)), 3)
        columns = [0, *range(x, x + 7)]
        named = {"nanoseconds": [1]} | {n: [c] for n, c in zip(_COLUMNS, columns, strict=True)}
    return named, rows


def _stamps(path: Path, rows: list[Row], columns: Sequence[int]) -> tuple[NDArray[np.int64], bool]:
    """Nanoseconds of rows, and whether the file counts in them; a second column adds to seconds."""
    times: list[Any] = []
    for number, fields in rows:
        try:
            # A double holds seconds since 1970 to 0.2 microseconds only.
            times.append(sum(Decimal(fields[c]).scaleb(-9 * i) for i, c in enumerate(columns)))
            if abs(times[-1]) >= 9e18:
                raise OverflowError
        except (ArithmeticError, ValueError) as error:
            what = f"{fields[columns[0]]!r} is not a time"
            raise TrajectoryError(f"{path}, line {number}: {what}") from error
    numbers = np.array(times, float)
    # Since 1970 there are 1 to 9 times so many seconds, milliseconds or microseconds.
    since = ((0, 0.0, 9e9), (3, 1e12, 9e12), (6, 1e15, 9e15))
    size = np.abs(numbers).max()
    unit = next((unit for unit, least, most in since if least <= size < most), 9)
    if unit < 6 and all(fields[columns[0]].isdigit() for _, fields in rows):
        # No poses are 100 s apart: a clock that counts nanoseconds began with zero.
        unit = 9 if np.median(np.diff(numbers, append=numbers[-1])) > 1e5 else unit
    scaled = [int(time.scaleb(9 - unit).to_integral_value()) for time in times]
    return np.array(scaled, np.int64), unit == 9


@np.errstate(over="ignore", invalid="ignore")
def _is_matrix(fields: Sequence[str]) -> bool:
    """Whether fields are the rows of a 3x4 or 4x4 pose."""
    try:
        T = np.array(fields, float).reshape(-1, 4)
        turned = np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-2)
    except ValueError:
        return False
    return turned and len(T) in (3, 4) and bool((T[3:] == [0, 0, 0, 1]).all())


@np.errstate(over="ignore", invalid="ignore")
def _matrices(path: Path, rows: list[Row]) -> Poses:
    """Poses of lines that end with the 12 or 16 numbers of the rows of a matrix."""
    need = len(rows[0][1])
    for number, fields in rows:
        if len(fields) != need:
            what = f"a line of matrices has {need} numbers here, this has {len(fields)}"
            raise TrajectoryError(f"{path}, line {number}: {what}")
    values = _numbers(path, [(number, fields[need % 4 :]) for number, fields in rows])
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, : need // 4] = values.reshape(len(rows), -1, 4)
    R = T[:, :3, :3]
    wrong = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2)) > 1e-2
    wrong |= (T[:, 3] != (0.0, 0.0, 0.0, 1.0)).any(axis=1)
    if wrong.any():
        what = "its numbers are no rigid pose; write the rows of its matrix, one after the other"
        raise TrajectoryError(f"{path}, line {rows[int(np.argmax(wrong))][0]}: {what}")
    return T


def _quaternions(
    path: Path, several: dict[str, list[int]], rows: list[Row], csv: bool
) -> tuple[NDArray[np.int64], Poses]:
    """Stamps and poses of lines with a position and a quaternion."""
    times, named = several.get("timestamp", [0]), {n: c[0] for n, c in several.items()}
    need = max([7, *times, *named.values()]) + 1
    for number, fields in rows:
        if len(fields) < need or not (named or csv or len(fields) == 8):
            what = f"a {'CSV' if csv else 'TUM'} line has {need} numbers, this has {len(fields)}"
            help_ = f"name other columns in the first line ({' '.join(_COLUMNS)})"
            raise TrajectoryError(f"{path}, line {number}: {what}; {help_}")
    # A stamp that never changes was never set.
    at = next((i for i in times if len({fields[i] for _, fields in rows}) > 1), times[0])
    if len(times) > 1:
        _assume(path, f"of its columns of times, the stamps are those of column {at + 1}")
    fractions = [i for i in several.get("nanoseconds", ()) if abs(i - at) == 1]
    stamps, nanoseconds = _stamps(path, rows, [at, *fractions[:1]])
    quaternion = (5, 6, 7, 4) if csv and nanoseconds else (4, 5, 6, 7)
    order = [named[name] for name in _COLUMNS[1:]] if named else [1, 2, 3, *quaternion]
    values = _numbers(path, [(n, [fields[column] for column in order]) for n, fields in rows])
    wrong = np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1.0) > 1e-2
    if wrong.any():
        i, columns = int(np.argmax(wrong)), ", ".join(str(column + 1) for column in order[3:])
        what = f"its quaternion has length {np.linalg.norm(values[i, 3:]):.3g}, not 1"
        raise TrajectoryError(f"{path}, line {rows[i][0]}: {what} (columns {columns})")
    return stamps, geometry.from_quaternions(values[:, :3], values[:, 3:])


def _read(path: Path, csv: bool) -> Trajectory:
    named, rows = _table(path)
    if not named and _is_matrix(rows[0][1][1:]):
        _assume(path, "its lines are a stamp and the rows of a matrix")
        stamps, T = _stamps(path, rows, [0])[0], _matrices(path, rows)
    else:
        stamps, T = _quaternions(path, named, rows, csv)
    ahead = np.diff(stamps, prepend=stamps[0] - 1)
    if (back := int(np.argmin(ahead))) and ahead[back] < 0:
        what = "its stamp does not come after the line before; sort the lines by time"
        raise TrajectoryError(f"{path}, line {rows[back][0]}: {what}")
    keep = ahead > 0
    if n := np.count_nonzero(~keep):
        what = f"{n} of {len(rows)} poses repeat the stamp before, first on line {rows[back][0]}"
        if n > 0.1 * len(rows):
            raise TrajectoryError(f"{path}: {what}; write stamps with all their digits")
        _log.warning("%s: %s; they are left out", path, what)
    return Trajectory(stamps[keep], T[keep])


def read_tum(path: Path) -> Trajectory:
    """Read ``timestamp tx ty tz qx qy qz qw`` lines, exact to the nanosecond."""
    return _read(path, csv=False)


def read_trajectory(path: Path) -> Trajectory:
    """Read poses with stamps: ``.csv`` in nanoseconds as EuRoC's, else TUM; or as a header says."""
    return _read(path, csv=path.suffix == ".csv")


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
    rows = _table(path)[1]
    if len(fields := rows[0][1]) not in (12, 16):
        what = f"a KITTI line has 12 numbers, this has {len(fields)}"
        raise TrajectoryError(f"{path}, line {rows[0][0]}: {what}")
    return _matrices(path, rows)


def is_kitti(path: Path) -> bool:
    """Whether a file's first pose is a matrix of 12 or 16 numbers, and has no stamp."""
    first: list[str] = next((fields for *_, fields in _lines(path) if fields), [])
    twelve = path.suffix != ".csv" and len(first) == 12 and bool(_NUMBER.match(first[0]))
    return twelve or _is_matrix(first)
