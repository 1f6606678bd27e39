"""Configuration of a simulated recording."""

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from adaptune import geometry
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.recording.config import SequenceConfig
from adaptune.recording.scan import ImuNoise, Part
from adaptune.simulation.scenes import SCENES
from adaptune.simulation.sensors import MOTIONS, SENSORS, WEATHERS
from adaptune.strict import StrictModel

LONGEST = 20_000.0
"""Metres; a longer course is most likely a mistake."""


class SimulationError(AdaptuneError):
    """A recording that cannot be made."""


def _known(kind: str, names: Collection[str]) -> AfterValidator:
    def check(name: Any) -> Any:
        if isinstance(name, str) and name not in names:
            raise ValueError(f"there is no {kind} {name!r}; choose from {', '.join(sorted(names))}")
        return name

    return AfterValidator(check)


class SceneLeg(StrictModel):
    """One scene of a course."""

    scene: Annotated[str, _known("scene", SCENES)]
    # Metres driven in it; the course's `length` if not given.
    length: Annotated[float, Field(ge=10.0, le=LONGEST)] | None = None


class Course(StrictModel):
    """A simulated recording: its scenes, its sensor and its motion."""

    # Scenes in driving order, by name or with a length of their own.
    scenes: tuple[Annotated[str | SceneLeg, _known("scene", SCENES)], ...] = Field(min_length=1)
    # Metres driven in every scene that has no length of its own.
    length: float = Field(default=60.0, ge=10.0, le=LONGEST)
    sensor: Annotated[str, _known("sensor", SENSORS)] = "hdl32e"
    motion: Annotated[str, _known("motion", MOTIONS)] = "robot"
    # Another seed is another world, another drive and other noise.
    seed: int = Field(default=0, ge=0, lt=2**31)
    # Turns of the sensor in a second; the sensor's own if not given.
    rate: float | None = Field(default=None, gt=0.0, le=100.0)
    # Firings in a turn; the sensor's own if not given.
    columns: int | None = Field(default=None, ge=16, le=8192)
    # Hz of the inertial measurements; none are made if not given.
    imu: Literal[200, 400] | None = None
    moving_objects: bool = False  # whether cars and walkers move about
    weather: Annotated[str, _known("weather", WEATHERS)] = "clear"
    # Whether a recording's headers mark the start or the end of each scan.
    stamp: Literal["start", "end"] = "start"
    # The course whose recording it is a part of; a study's `training` and `test` name such parts.
    of: Annotated[str, Field(pattern=r"^\w[\w.-]*$")] | None = None
    part: Part | None = None

    @model_validator(mode="after")
    def _rate_follows_motion(self) -> Self:
        least, rate = MOTIONS[self.motion].least_rate, self.turns
        if rate < least:
            what = f"a {self.motion} moves too fast for {rate:g} scans a second"
            raise ValueError(f"{what}: it needs at least {least:g}")
        if sum(length for _, length in self.legs) > LONGEST:
            raise ValueError(f"a course is at most {LONGEST:g} m long")
        return self

    @property
    def legs(self) -> list[tuple[str, float]]:
        """Name and metres of each scene in driving order."""
        legs = [SceneLeg(scene=s) if isinstance(s, str) else s for s in self.scenes]
        return [(leg.scene, self.length if leg.length is None else leg.length) for leg in legs]

    @property
    def turns(self) -> float:
        """Scans a second."""
        return SENSORS[self.sensor].rate if self.rate is None else self.rate


# The sensors of a simulated recording: their topics, and the mounting of the IMU.


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

NOISE = ImuNoise(5.2e-5, 5.9e-4, 2.0e-6, 3.0e-5)
"""Noise of an Xsens MTi-680G."""


def as_sequence(course: Course, path: Path) -> SequenceConfig:
    """Configuration of the sequence in the bag that was recorded of a course."""
    extrinsic = geometry.invert(T_IMU_LIDAR).tolist()
    imu: Any = {"topic": IMU, "extrinsic": extrinsic, "noise": NOISE._asdict()}
    imu = None if course.imu is None else imu
    return SequenceConfig(bag=str(path), points=POINTS, reference=POSES, imu=imu, part=course.part)
