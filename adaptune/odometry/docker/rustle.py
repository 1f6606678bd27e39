"""ROS 1 systems in Docker images that have RUSTLE's layout (Tavares, University of Coimbra, 2026).

Such an image has a package with ``rustle.launch``, which loads ``/rustle/config/params.yaml``; a
login shell finds it.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, model_validator

from adaptune.errors import OdometryError
from adaptune.odometry.base import Description, OdometryInstance, OwnFile
from adaptune.odometry.docker.engine import image_digest
from adaptune.odometry.docker.lockstep import Lockstep
from adaptune.odometry.docker.played_bag import PlayedBag
from adaptune.odometry.docker.ros_container import Ros1System
from adaptune.odometry.docker.ros_system import RosSettings, RosSystem, filled
from adaptune.odometry.program import ProgramInput
from adaptune.odometry.remote import Limits
from adaptune.odometry.template import Template, check_names
from adaptune.ros.steering import SetCommand
from adaptune.space import ParameterSet


class RustleSettings(RosSettings):
    """An image in RUSTLE's layout.

    ``docs/docker.md`` describes the settings and their defaults.
    """

    system: ClassVar[type[RosSystem]] = Ros1System

    package: str | None = Field(None, pattern=r"^[\w-]+$")
    arguments: tuple[Annotated[str, Field(pattern=r"^[\w:=./-]+$")], ...] = ()
    use_sim_time: bool | None = None
    set_parameter: SetCommand | None = None

    @model_validator(mode="after")
    def _check_node(self) -> Self:
        if self.set_parameter is not None and self.node is None:
            raise ValueError("set_parameter: name the node, too (node)")
        return self

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages in which the launch file may be."""
        return ("rustle-ros", "rustle") if self.package is None else (self.package,)


class Rustle:
    """A ROS 1 system, run on a bag that is played, or scan by scan."""

    settings_type: type[RosSettings] = RustleSettings

    @staticmethod
    def describe(settings: Any) -> Description:
        """The study defines the parameters."""
        whole = settings.play == "bag"
        needs_imu = not whole and settings.imu is not None
        return Description(None, settings.node is not None, needs_imu, whole=whole)

    @staticmethod
    def check(settings: Any, parameters: ParameterSet) -> None:
        """Raise an `OdometryError` if the image is not here, or a parameter is not in its file."""
        template = Template(Path(settings.template))
        if template.path.suffix not in (".yaml", ".yml"):
            ros = f"ROS {settings.system.ros}"
            raise OdometryError(f"template: {template.path} is not YAML, as {ros} reads it")
        check_names(parameters, template, ())
        if settings.system.ros == 1:
            template.warn_of_texts()
        if settings.image is not None:
            image_digest(settings.image)

    @staticmethod
    def own_file(parameters: ParameterSet, settings: Any) -> OwnFile:
        """The parameter file that the system reads."""
        template, text = filled(settings, parameters)
        use, node = f"in the place of {template.path.name}", settings.node or ""
        name = node.strip("/").replace("/", "_") or template.path.stem
        # That of a system in RUSTLE's layout is known as that.
        return OwnFile(template.path.suffix, text, use, name * (settings.system.ros == 2))

    @staticmethod
    def instance(
        parameters: ParameterSet,
        settings: Any,
        limits: Limits,
        read: Callable[[], ProgramInput] | None,
    ) -> OdometryInstance:
        """Make an instance, as all programs of the user are made."""
        if settings.play == "bag":
            return PlayedBag(parameters, settings, limits, read)
        return Lockstep(parameters, settings, limits)
