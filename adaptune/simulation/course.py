"""Configuration of a simulated recording."""

from collections.abc import Collection
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from adaptune.errors import AdaptuneError
from adaptune.sequence.part import Part
from adaptune.simulation.motions import MOTIONS
from adaptune.simulation.scenes import SCENES
from adaptune.simulation.sensors import SENSORS
from adaptune.simulation.weather import WEATHERS
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
