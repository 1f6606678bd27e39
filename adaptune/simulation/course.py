"""Configuration of a simulated recording."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from adaptune import geometry
from adaptune._system.strict import StrictModel
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.recording.config import Compensation, Part, SequenceConfig
from adaptune.recording.scan import ImuNoise
from adaptune.simulation.corridor import CORRIDOR
from adaptune.simulation.garden import GARDEN
from adaptune.simulation.open_ground import OPEN
from adaptune.simulation.street import STREET
from adaptune.simulation.tiles import Scene
from adaptune.simulation.underground import CAVE, MINE

SCENES: Mapping[str, Scene] = {
    "cave": CAVE,
    "open": OPEN,
    "street": STREET,
    "garden": GARDEN,
    "corridor": CORRIDOR,
    "mine": MINE,
}
"""The kinds of place a course can lead through, by name."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """A LiDAR."""

    # Radians above the sensor's horizon, by the ring number its driver gives: upwards on Velodynes,
    # downwards on Ousters; of shape (n_rings,).
    elevations: NDArray[np.float64]
    columns: int  # firings in a turn; all rings fire at once
    # Least and greatest range in metres. The greatest holds for a target that reflects a tenth of
    # the light or more and is met squarely.
    range: tuple[float, float]
    rate: float = 10.0  # turns in a second
    noise: float = 0.015  # standard deviation of a range in metres
    dropout: float = 0.005  # share of echoes lost for no reason


# Two blocks of 32 lasers: a third of a degree apart above, half a degree below.
_HDL64E = np.concatenate([2.0 - np.arange(32) / 3.0, -8.83 - 0.5 * np.arange(32)])[::-1]

SENSORS: Mapping[str, Sensor] = {
    "vlp16": Sensor(np.radians(np.arange(-15.0, 16.0, 2.0)), 1800, (0.5, 100.0)),
    # 900 columns, half of what it can do, keep a scan at 28,800 rays.
    "hdl32e": Sensor(np.radians(10.67 - (4.0 / 3.0) * np.arange(31, -1, -1)), 900, (1.0, 100.0)),
    "hdl64e": Sensor(np.radians(_HDL64E), 2083, (0.9, 120.0)),
    "os0-64": Sensor(np.radians(np.linspace(45.0, -45.0, 64)), 1024, (0.3, 50.0)),
    "os1-128": Sensor(np.radians(np.linspace(22.5, -22.5, 128)), 1024, (0.5, 120.0)),
}
"""LiDARs by name."""


@cache
def directions(name: str, columns: int) -> NDArray[np.float32]:
    """Unit vectors, (columns, n_rings, 3), along which a sensor looks during a turn, in its frame.

    x is ahead, y to the left, z up.
    """
    elevation = SENSORS[name].elevations
    # A Velodyne turns clockwise seen from above. The seam lies behind, away from what is ahead.
    azimuth = np.pi - 2.0 * np.pi * np.arange(columns) / columns
    level = np.cos(elevation)
    x, y = level * np.cos(azimuth)[:, None], level * np.sin(azimuth)[:, None]
    z = np.broadcast_to(np.sin(elevation), x.shape)
    looks = np.stack([x, y, z], axis=-1).astype(np.float32)
    looks.setflags(write=False)
    return looks


@dataclass(frozen=True)
class Motion:
    """A way of carrying a sensor."""

    speed: float  # usual speed in m/s
    acceleration: float  # greatest acceleration and braking in m/s^2
    turning: float  # greatest lateral acceleration in m/s^2: it goes slower through bends
    height: float  # metres of the sensor above the ground
    base: tuple[float, float]  # length and width in metres over which the ground carries it
    weave: float  # metres by which it strays from the road's middle, about
    # Standard deviation along x, y and z of the mount's shake on a paved road, in metres.
    shift: tuple[float, float, float]
    turn: tuple[float, float, float]  # standard deviation about x, y and z of the same, in radians
    band: tuple[float, float]  # least and greatest frequency of the shake in Hz


MOTIONS: Mapping[str, Motion] = {
    # Speed, acceleration, turning, height, base and weave; shift, turn and band of the shake.
    "robot": Motion(
        *(3.0, 0.8, 1.0, 0.9, (0.8, 0.6), 0.15),
        *((0.002, 0.003, 0.004), (0.0015, 0.0015, 0.001), (0.5, 3.5)),
    ),
    # As fast as a robot, and quick in bends: up to 50 degrees a second.
    "agile": Motion(
        *(3.0, 2.0, 4.0, 0.7, (0.6, 0.5), 0.15),
        *((0.002, 0.003, 0.004), (0.0015, 0.0015, 0.001), (0.5, 3.5)),
    ),
    "car": Motion(
        *(10.0, 2.0, 2.5, 1.75, (2.7, 1.6), 0.15),
        *((0.003, 0.006, 0.010), (0.0015, 0.0020, 0.0007), (0.6, 2.5)),
    ),
}
"""Ways of carrying a sensor, by name."""


LONGEST = 20_000.0  # metres; a longer course is most likely a mistake


class SimulationError(AdaptuneError):
    """A recording that cannot be made."""


def _known(kind: str, names: Collection[str]) -> AfterValidator:
    def check(name: str) -> str:
        if name not in names:
            raise ValueError(f"there is no {kind} {name!r}; choose from {', '.join(sorted(names))}")
        return name

    return AfterValidator(check)


class Course(StrictModel):
    """A simulated recording: its scenes in driving order, its sensor and its motion."""

    scenes: tuple[Annotated[str, _known("scene", SCENES)], ...] = Field(min_length=1)
    # Metres driven in every scene; twice as many where it is named twice.
    length: float = Field(60.0, ge=10.0, le=LONGEST)
    sensor: Annotated[str, _known("sensor", SENSORS)] = "hdl32e"
    motion: Annotated[str, _known("motion", MOTIONS)] = "robot"
    seed: int = Field(0, ge=0, lt=2**31)  # of the world, the drive and the noise
    rate: float | None = Field(None, gt=0.0, le=100.0)  # turns a second, in place of the sensor's
    columns: int | None = Field(None, ge=16, le=8192)  # firings a turn, in place of the sensor's
    stride: int = Field(1, ge=1, le=1000)  # keeps every stride-th scan
    # Seconds at rest before it drives off, which LiDAR-inertial systems need to begin.
    standstill: float = Field(0.0, ge=0.0, le=60.0)
    imu: Literal[200, 400] | None = None  # Hz of the inertial measurements, if there are any
    compensate: Compensation = None  # how motion within a scan is undone when it is read
    stamp: Literal["start", "end"] = "start"  # what headers mark of each scan
    # The course whose recording it is a part of; a study's `training` and `test` name such parts.
    of: Annotated[str, Field(pattern=r"^\w[\w.-]*$")] | None = None
    part: Part | None = None

    @model_validator(mode="after")
    def _rate_follows_motion(self) -> Self:
        motion, rate = MOTIONS[self.motion], self.turns
        # With fewer scans its shake is lost, or they lie two metres apart.
        least = max(2.0 * motion.band[1], motion.speed / 2.0)
        if rate < least:
            what = f"a {self.motion} moves too fast for {rate:g} scans a second"
            raise ValueError(f"{what}: it needs at least {least:g}")
        if self.length * len(self.scenes) > LONGEST:
            raise ValueError(f"a course is at most {LONGEST:g} m long")
        return self

    def recorded(self) -> dict[str, Any]:
        """What its recording depends on, as plain data, without how that is read."""
        about = self.model_dump(mode="json", exclude={"compensate", "of", "part"})
        return about | {"rate": self.turns, "columns": self.firings}

    @property
    def legs(self) -> list[tuple[str, float]]:
        """Name and metres of each scene in driving order."""
        return [(scene, self.length) for scene in self.scenes]

    @property
    def turns(self) -> float:
        """Scans a second."""
        return SENSORS[self.sensor].rate if self.rate is None else self.rate

    @property
    def firings(self) -> int:
        """Firings a turn."""
        return SENSORS[self.sensor].columns if self.columns is None else self.columns


POINTS, POSES, IMU = "/velodyne_points", "/gt_poses", "/imu/data"
"""Topics, named as BotanicGarden names them."""

T_IMU_LIDAR: Poses = np.array(
    [
        [0.9996789, 0.0252866, 0.0015042, 0.058487],
        [-0.0252723, 0.9996494, -0.0078025, 0.008404],
        [-0.0017010, 0.0077630, 0.9999700, 0.168916],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Pose of the LiDAR in the IMU's frame, as on BotanicGarden's robot."""

IMU_NOISE = ImuNoise(5.2e-5, 5.9e-4, 2.0e-6, 3.0e-5)  # noise of an Xsens MTi-680G


def as_sequence(course: Course, path: Path) -> SequenceConfig:
    """Configuration of the sequence in the bag that was recorded of a course."""
    extrinsic = geometry.invert(T_IMU_LIDAR).tolist()
    imu: Any = {"topic": IMU, "extrinsic": extrinsic, "noise": IMU_NOISE._asdict()}
    return SequenceConfig(
        bag=str(path),
        points=POINTS,
        reference=POSES,
        imu=None if course.imu is None else imu,
        part=course.part,
        compensate=course.compensate,
    )
