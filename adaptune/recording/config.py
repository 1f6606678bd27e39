"""Configuration of a sequence in a study."""

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from adaptune import geometry
from adaptune._system.files import entries, expand_user
from adaptune._system.strict import StrictModel
from adaptune.errors import AdaptuneError
from adaptune.recording.scan import USUAL, Imu, ImuNoise, SequenceError
from adaptune.recording.timing import Mark, Unit

Compensation = Literal["constant_velocity"] | None
"""How motion within a scan is undone; none if it is left as it is."""
Fractions = tuple[float, float]
"""Where a part of a sequence begins and ends, as fractions of its duration."""
REFERENCE_FILES = (".tum", ".txt", ".csv", ".g2o", ".yaml", ".yml", ".json")
ESTIMATED, NO_REFERENCE = "estimated", "none"
"""In place of a `reference`: it is estimated from the scans, or there is none."""
SOURCES = ("bag", "kitti", "folder")
_STANDARD_GRAVITY = 9.80665
_PERCENT = re.compile(r"\s*(\d+(?:\.\d+)?)\s*-\s*(\d+(?:\.\d+)?)\s*%\s*")


def read_part(given: Any) -> Fractions:
    """Read ``0-60%``, or two fractions; a ValueError says what is wrong."""
    begin, end = 1.0, 0.0
    if isinstance(given, str) and (match := _PERCENT.fullmatch(given)):
        begin, end = (float(percent) / 100.0 for percent in match.groups())
    elif isinstance(given, list | tuple) and [type(f) for f in given] in ([float] * 2, [int] * 2):
        begin, end = map(float, given)
    if not 0.0 <= begin < end <= 1.0:
        raise ValueError("give a part in percent of the duration, from 0 to 100, as in 0-60%")
    return begin, end


def part_name(name: str, part: Fractions) -> str:
    """Name of a part of a sequence, which may be the name of a file."""
    begin, end = (f"{100.0 * fraction:.10g}" for fraction in part)
    return f"{name}_{begin}-{end}"


Part = Annotated[Fractions, BeforeValidator(read_part)]


def expand(text: str) -> str:
    """Replace ``${VARIABLE}`` by its value; a ValueError names the variable that is not set."""
    if unset := [v for v in re.findall(r"\$\{(\w+)\}", text) if v not in os.environ]:
        raise ValueError(f"the environment variable {unset[0]} is not set")
    return os.path.expandvars(text)


def resolve(path: str, info: ValidationInfo) -> str:
    """Make a path absolute: `expand`, replace ~, start from the folder of the study's file."""
    folder = (info.context or {}).get("folder", Path())
    if not path.strip():
        raise ValueError("give a path, not an empty text")
    try:
        given = Path(folder, path)  # whatever signs its name holds, if it is there
        whole = (given if given.exists() else folder / expand_user(expand(path))).resolve()
        whole.exists()
    except AdaptuneError as error:
        raise ValueError(str(error)) from error
    except RuntimeError as error:
        raise ValueError(f"{path}: links lead in a circle; remove them") from error
    except OSError as error:
        raise ValueError(f"cannot be reached ({error.strerror}); give another path") from error
    return str(whole)


def _resolve_bags(given: Any, info: ValidationInfo) -> Any:
    if isinstance(given, str):
        return resolve(given, info)
    if given is None:
        return None
    if not isinstance(given, list | tuple) or not given or {type(path) for path in given} != {str}:
        raise ValueError("give the path of a bag, or a list of paths")
    return tuple(resolve(path, info) for path in given)


def _resolve_file(reference: str, info: ValidationInfo) -> str:
    return resolve(reference, info) if reference.endswith(REFERENCE_FILES) else reference


BAG_SUFFIXES = (".bag", ".mcap", ".db3")


def bag_paths(given: Sequence[str]) -> list[Path]:
    """Bags to open for paths, folders and patterns; a SequenceError names what holds no bag."""
    paths: list[Path] = []
    for text in given:
        path = Path(text)
        if path.is_dir():
            paths += _in_folder(path)
        elif path.exists():
            if path.suffix not in BAG_SUFFIXES:
                bags = "bags are .bag, .mcap and .db3 files and ROS 2 folders"
                raise SequenceError(f"{path}: not a bag; {bags}")
            paths.append(path)
        elif found := [p for p in sorted(path.parent.glob(path.name)) if p.name[0] != "."]:
            paths += bag_paths([str(match) for match in found])
        else:
            raise SequenceError(f"{path}: there is no such bag")
    if len({path.suffix == ".bag" for path in paths}) > 1:
        raise SequenceError(f"{paths[0]} and {paths[-1]} are of ROS 1 and ROS 2: they do not mix")
    return paths


def files_of(paths: Sequence[Path]) -> list[Path]:
    """The files of bags, of which some may be folders."""
    found = [entries(path) if path.is_dir() else [path] for path in paths]
    return [file for files in found for file in files if file.is_file()]


def _in_folder(folder: Path) -> list[Path]:
    if (folder / "metadata.yaml").exists():
        return [folder]
    # A recorder that was killed leaves its files without the metadata.
    for suffix in (".mcap", ".db3", ".bag"):
        if found := entries(folder, suffix):
            return found
    raise SequenceError(f"{folder}: neither a ROS 2 bag nor a folder with bags")


def _pose(given: Any) -> Any:
    geometry.to_pose(given)
    return given


_Numbers = tuple[float, ...]
Transform = Annotated[_Numbers | tuple[_Numbers, ...], BeforeValidator(_pose)]
"""A pose as seven numbers, or as the rows of a matrix."""
_Seconds = Annotated[float, Field(ge=0, le=1e9)]
_Noise = Annotated[float, Field(gt=0, le=1e6)]


class NoiseDensities(StrictModel):
    """See `ImuNoise`."""

    gyroscope: _Noise = USUAL.gyroscope
    accelerometer: _Noise = USUAL.accelerometer
    gyroscope_walk: _Noise = USUAL.gyroscope_walk
    accelerometer_walk: _Noise = USUAL.accelerometer_walk


class ImuConfig(StrictModel):
    """An IMU."""

    topic: str | None = None  # may be left out where there is only one
    extrinsic: Transform | None = None  # its pose in the LiDAR's frame
    unit: Literal["m/s2", "g"] = "m/s2"  # of its accelerometer
    noise: NoiseDensities = NoiseDensities()  # for odometries that weigh it against the LiDAR

    def in_si(self, imu: Imu) -> Imu:
        """Measurements in SI units, of an IMU in this place and with this noise."""
        # Livox IMUs measure acceleration in multiples of gravity.
        acceleration = imu.acceleration * (_STANDARD_GRAVITY if self.unit == "g" else 1.0)
        T = imu.T_sensor_imu if self.extrinsic is None else geometry.to_pose(self.extrinsic)
        noise = ImuNoise(**self.noise.model_dump())
        return replace(imu, acceleration=acceleration, T_sensor_imu=T, noise=noise)


class SequenceConfig(StrictModel):
    """A recording, from one of `bag`, `kitti` and `folder`, and what of it to use."""

    start: _Seconds = 0.0  # since the first scan
    stop: _Seconds | None = None
    # Bags that follow each other: files, ROS 2 folders, folders of bags, patterns.
    bag: Annotated[str | tuple[str, ...] | None, BeforeValidator(_resolve_bags)] = None
    kitti: Annotated[str, AfterValidator(resolve)] | None = None  # folder of an odometry sequence
    folder: Annotated[str, AfterValidator(resolve)] | None = None  # of files, one a scan
    points: str | None = None  # topic of the point clouds
    frame: str | None = None  # `frame_id` of the point clouds, where the topic has several
    stamp: Mark = "auto"  # what a stamp marks of its scan
    time_unit: Unit | None = None  # of the points' times
    # Seconds a scan takes; used if neither points nor files have times, or these are of a `turn`.
    period: float = Field(0.1, gt=0, le=60)
    stride: int = Field(1, ge=1, le=10_000)  # use every stride-th scan
    part: Part | None = None  # of the time from `start` to `stop`
    # Topic of the reference poses, or a file: TUM, KITTI (``.txt``, ``.tum``), EuRoC (``.csv``).
    # `estimated` from the scans, also where there are poses; `none`. Left out, the recording's own
    # poses, and where it has none, estimated.
    reference: Annotated[str, AfterValidator(_resolve_file)] | None = None
    child_frame: str | None = None  # of the transforms, where `reference` is a topic of them
    extrinsic: Transform | None = None  # the LiDAR's pose in the frame of the reference poses
    clock_offset: float = Field(0.0, ge=-3e9, le=3e9)  # seconds to add to the reference's stamps
    max_gap: float = Field(1.0, gt=0, le=1e9)  # seconds; between poses further apart it is unknown
    imu: ImuConfig | None = None
    # Degrees by which to turn up every ray of a `kitti` recording; 0.205 when left out.
    elevation: float | None = Field(None, ge=-5, le=5)
    compensate: Compensation = None  # undo the motion within scans
    cache: bool = True  # whether to keep decoded bags in the cache

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        given = [name for name in SOURCES if getattr(self, name) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"give one of {', '.join(SOURCES)}, not {found}")
        if self.stop is not None and self.stop <= self.start:
            raise ValueError(f"start ({self.start:g}) must be less than stop ({self.stop:g})")
        for key in ("points", "frame"):
            if getattr(self, key) is not None and given[0] != "bag":
                raise ValueError(f"`{key}` is for a bag; {given[0]} has none")
        if self.elevation is not None and given[0] != "kitti":
            raise ValueError(f"`elevation` is for kitti; {given[0]} has none")
        return self

    @property
    def poses_file(self) -> Path | None:
        """The file of its reference poses, if it names one."""
        named = self.reference or ""
        return Path(named) if named.endswith(REFERENCE_FILES) else None

    @property
    def poses_topic(self) -> str | None:
        """The topic of its reference poses, if it names one."""
        is_topic = self.poses_file is None and self.reference not in (ESTIMATED, NO_REFERENCE)
        return self.reference if is_topic else None

    def bags(self) -> list[Path]:
        """Bags to open; a SequenceError if there is no such bag."""
        return bag_paths((self.bag,) if isinstance(self.bag, str) else self.bag or ())
