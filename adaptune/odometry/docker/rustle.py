"""ROS 1 systems in Docker images that have RUSTLE's layout (Tavares, University of Coimbra, 2026).

Such an image has a package with ``rustle.launch``, which loads ``/rustle/config/params.yaml``; a
login shell finds it.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from adaptune.odometry.base import Description, OdometryError, OdometryInstance
from adaptune.odometry.docker.engine import ContainerSettings, image_digest
from adaptune.odometry.isolation import Limits
from adaptune.odometry.program_input import ProgramInput
from adaptune.odometry.template import Template, check_names
from adaptune.odometry.whole_run import WholeSettings
from adaptune.sequence.config import resolve
from adaptune.space import ParameterSet


def _topic(name: str) -> str:
    if not re.fullmatch(r"/[A-Za-z][\w/]*", name):
        raise ValueError(f"{name!r} is no name in ROS; it begins with a slash, as /Odometry")
    return name


Topic = Annotated[str, AfterValidator(_topic)]


class RustleSettings(ContainerSettings, WholeSettings):
    """An image in RUSTLE's layout.

    ``docs/docker.md`` describes the settings and their defaults.
    """

    template: Annotated[str, AfterValidator(resolve)]
    odometry: Topic
    points: Topic | None = None
    imu: Topic | None = None
    package: str | None = Field(None, pattern=r"^[\w-]+$")
    arguments: tuple[Annotated[str, Field(pattern=r"^[\w:=./-]+$")], ...] = ()
    play: Literal["bag", "lockstep"] = "bag"
    rate: float = Field(1.0, gt=0, le=100)
    use_sim_time: bool | None = None
    ready: float = Field(60.0, gt=0, le=3600)
    drain: float = Field(2.0, ge=0, le=3600)
    patience: float = Field(2.0, gt=0, le=3600)
    node: Topic | None = None
    set_parameter: tuple[str, ...] | None = Field(None, min_length=1)

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages in which the launch file may be."""
        return ("rustle-ros", "rustle") if self.package is None else (self.package,)

    @model_validator(mode="after")
    def _check(self) -> Self:
        words = " ".join(self.set_parameter or ("{name} {value}",))
        if lacking := [key for key in ("{name}", "{value}") if key not in words]:
            raise ValueError(f"set_parameter: names no {' and no '.join(lacking)} in its arguments")
        if self.set_parameter is not None and self.node is None:
            raise ValueError("set_parameter: name the node, too (node)")
        if self.node is not None and self.play == "bag":
            raise ValueError("node: parameters change only with play: lockstep")
        return self


class Rustle:
    """A ROS 1 system, run on a bag that is played, or scan by scan."""

    settings_type = RustleSettings

    @staticmethod
    def describe(settings: RustleSettings) -> Description:
        """The study defines the parameters."""
        whole = settings.play == "bag"
        needs_imu = not whole and settings.imu is not None
        return Description(None, settings.node is not None, needs_imu, whole=whole)

    @staticmethod
    def check(settings: RustleSettings, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if the image is not here, or a parameter is not in its file."""
        template = Template(Path(settings.template))
        if template.path.suffix not in (".yaml", ".yml"):
            raise OdometryError(f"template: {template.path} is not YAML, as ROS 1 reads it")
        check_names(parameters, template, ())
        image_digest(settings.image)

    @staticmethod
    def instance(
        parameters: ParameterSet,
        settings: RustleSettings,
        limits: Limits,
        read: Callable[[], ProgramInput] | None,
    ) -> OdometryInstance:
        """Make an instance, as all programs of the user are made."""
        if settings.play == "bag":
            from adaptune.odometry.docker.played_bag import PlayedBag

            return PlayedBag(parameters, settings, limits, read)
        from adaptune.odometry.docker.lockstep import Lockstep

        return Lockstep(parameters, settings, limits)
