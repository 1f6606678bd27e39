"""The configuration of a study: the settings that both stages share."""

import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import AfterValidator, Field, field_validator, model_validator

from adaptune.odometry.health import HealthCheck
from adaptune.odometry.isolation import Limits
from adaptune.sequence.config import SequenceConfig, Transform, ViewConfig
from adaptune.simulation.course import Course
from adaptune.space import ParameterSpace, Value
from adaptune.strict import StrictModel

if TYPE_CHECKING:
    from adaptune.study.mistakes import Mistake


def _file_name(name: str) -> str:
    if not re.fullmatch(r"\w[\w.-]*", name) or len(name.encode()) > 100:
        raise ValueError(
            "becomes the name of a file: give letters, digits, _ . and - (not first), 100 at most"
        )
    return name


Name = Annotated[str, AfterValidator(_file_name)]
"""Becomes the name of a file."""


class OdometryConfig(StrictModel):
    """The odometry, its settings, and the ranges of the parameters that are tuned.

    Without `parameters`, all parameters are tuned in their usual ranges. Otherwise those that it
    does not name keep their baseline. A `command` defines its parameters here, with their `type`.
    """

    name: str
    # What the odometry is called in parameter sets and tables, if a study has several.
    label: Name | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    parameters: Annotated[dict[str, dict[str, Any]], Field(min_length=1)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _name_alone(cls, data: Any) -> Any:
        return {"name": data} if isinstance(data, str) else data


def _known_descriptor(name: str) -> str:
    from adaptune.descriptor import DescriptorError, check_descriptor

    try:
        check_descriptor(name)
    except DescriptorError as error:
        raise ValueError(str(error)) from error
    return name


class DescriptorConfig(StrictModel):
    """How scans are described.

    Descriptors are averaged over `window` seconds; with 0, only the newest scan counts.
    """

    names: Annotated[
        tuple[Annotated[str, AfterValidator(_known_descriptor)], ...], Field(min_length=1)
    ] = ("ndt",)
    window: float = Field(3.0, ge=0, le=3600)

    @field_validator("names")
    @classmethod
    def _once(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) < len(names):
            raise ValueError("a descriptor is named twice")
        return names

    @model_validator(mode="before")
    @classmethod
    def _names_alone(cls, data: Any) -> Any:
        if isinstance(data, str):
            return {"names": (data,)}
        return {"names": data} if isinstance(data, list) else data


def _catches_up(scans: int) -> int:
    if scans == 1:
        raise ValueError("with 1 a new instance never catches up; give 0, or 2 or more")
    return scans


MOST_MEMBERS = 6
"""Of a bank."""


class SwitchingConfig(StrictModel):
    """How the odometry changes its parameters during a replay.

    `live`: it changes them between scans. `hand_over`: a new instance takes over. `bank`: several
    instances run side by side, and their motions are averaged. `auto`: the first of bank (given
    more than one core, and enough memory), live and hand_over that is possible.
    ``docs/adapting-live.md`` describes every key.
    """

    mechanism: Literal["auto", "live", "hand_over", "bank"] = "auto"
    warm_up: float | None = Field(None, gt=0, le=3600)
    full_rate: float | None = Field(None, ge=0, le=3600)
    stride: int | None = Field(None, ge=1, le=10_000)
    catch_up_scans: Annotated[int, Field(ge=0, le=10_000), AfterValidator(_catches_up)] = 0
    size: int = Field(4, ge=2, le=MOST_MEMBERS)
    sets: Annotated[
        tuple[Annotated[int, Field(ge=0, le=10**9)] | dict[str, Value], ...] | None,
        Field(min_length=2, max_length=MOST_MEMBERS),
    ] = None
    cores: int | None = Field(None, ge=1, le=10_000)
    memory: float = Field(16.0, gt=0, le=1e6)


class RealTimeConfig(StrictModel):
    """How to replay in real time.

    Attributes
    ----------
    rate : float
        Times as fast as it was recorded.
    deadline : float
        Seconds from a scan's arrival to the selection that is made from it; a later one is dropped.
    queue : int
        Scans that may wait for the odometry; the oldest ones are dropped. With 0 all wait.
    """

    rate: float = Field(1.0, gt=0, le=1e3)
    deadline: float = Field(0.02, gt=0, le=60)
    queue: int = Field(1, ge=0, le=10_000)


def _ros_name(name: str) -> str:
    if not re.fullmatch(r"[~/]?[A-Za-z]\w*(/[A-Za-z]\w*)*", name, re.ASCII) or len(name) > 255:
        raise ValueError("is no name in ROS: give letters, digits and _, with / between the parts")
    return name


RosName = Annotated[str, AfterValidator(_ros_name)]
"""A topic or a node of ROS."""


class SteerConfig(StrictModel):
    """Somebody else's odometry node, of which only the parameters are set.

    Attributes
    ----------
    node : str
        Its name.
    odometry : str
        Topic of its poses, nav_msgs/Odometry.
    extrinsic : pose, optional
        The LiDAR's pose in the frame whose poses the node publishes.
    command : tuple of str, optional
        A program that sets a parameter, and its arguments, with ``{node}``, ``{name}`` and
        ``{value}``; otherwise they are set through ROS.
    """

    node: RosName
    odometry: RosName
    extrinsic: Transform | None = None
    command: Annotated[tuple[str, ...] | None, Field(min_length=1)] = None

    @field_validator("command")
    @classmethod
    def _sets(cls, command: tuple[str, ...] | None) -> tuple[str, ...] | None:
        words = " ".join(command or ("{name} {value}",))
        if lacking := [key for key in ("{name}", "{value}") if key not in words]:
            raise ValueError(f"names no {' and no '.join(lacking)} in its arguments")
        return command


class RosConfig(StrictModel):
    """How to drive on a robot with ROS.

    Attributes
    ----------
    points : str, optional
        Topic of the point clouds; that of `like` if left out.
    like : str, optional
        The sequence of the study with the same sensor: its `stamp`, `time_unit`, `period` and `imu`
        count. The first training sequence if left out.
    frame : str
        Name of the odometry's frame.
    odometry : str
        Topic to publish poses on.
    tf : bool
        Whether to publish the transform from `frame` to the sensor; not where that frame has
        another parent, such as the robot's base.
    steer : SteerConfig, optional
        Set the parameters of this node instead of running an odometry.
    router : str
        Address of Zenoh's router, in ROS 2.
    """

    points: RosName | None = None
    like: str | None = None
    frame: str = Field("odom", min_length=1)
    odometry: RosName = "adaptune/odometry"
    tf: bool = False
    steer: SteerConfig | None = None
    router: str = "127.0.0.1:7447"


Also = Literal["one_set", "bank", "bank_learned", "even", "random", "untrained"]
ALSO: tuple[Also, ...] = get_args(Also)
"""Modes that are replayed only on demand, to compare with."""


class OnlineConfig(StrictModel):
    """How to replay: seconds between selections, selection rules, switching, and what it may cost.

    `also` names modes that are replayed besides, or `all`. Each mode is replayed `repeats` times.
    A set stays for `dwell` seconds at least. Parameters of `pin` have these values in all sets.
    The budget is in milliseconds of CPU time a scan, all members and live evidence together.
    Without `real_time`, a replay is as fast as it goes and always the same.
    """

    period: float = Field(1.0, ge=0.01, le=3600)
    dwell: float = Field(0.0, ge=0, le=3600)
    pin: dict[str, Value] = Field(default_factory=dict)
    rules: tuple[Literal["paired", "paper"], ...] = ("paired", "paper")
    also: tuple[Also, ...] = ()
    repeats: int = Field(1, ge=1, le=20)
    switching: SwitchingConfig = SwitchingConfig()
    budget: float | None = Field(None, gt=0, le=1e6)
    real_time: RealTimeConfig | None = None
    ros: RosConfig = RosConfig()

    @field_validator("also", mode="before")
    @classmethod
    def _all(cls, also: Any) -> Any:
        return ALSO if also == "all" else also

    @field_validator("also")
    @classmethod
    def _once(cls, also: tuple[Also, ...]) -> tuple[Also, ...]:
        if len(set(also)) < len(also):
            raise ValueError("a mode is named twice")
        return also


class StudyConfig(StrictModel):
    """The YAML of a study without the settings that only one stage uses.

    ``docs/reference-study.md`` describes every key.
    """

    odometry: OdometryConfig | Annotated[tuple[OdometryConfig, ...], Field(min_length=1)]
    sequences: dict[Name, SequenceConfig] = Field(default_factory=dict)
    courses: dict[Name, Course] = Field(default_factory=dict)
    training: tuple[str, ...] = Field(min_length=1)
    test: tuple[str, ...] = ()
    sub_trajectory: float = Field(25.0, ge=0.01, le=1e6)
    lost_track: float = Field(3.0, gt=0, le=1e6)
    health: HealthCheck = HealthCheck()
    isolation: Limits = Limits()
    descriptor: DescriptorConfig = DescriptorConfig()
    online: OnlineConfig = OnlineConfig()

    @property
    def odometries(self) -> dict[str, OdometryConfig]:
        """The odometries by their labels."""
        given = (self.odometry,) if isinstance(self.odometry, OdometryConfig) else self.odometry
        return {one.label or one.name: one for one in given}

    # What a stage that adds settings of its own overrides.

    @property
    def views(self) -> Mapping[str, ViewConfig]:
        """Views of every training sequence that are trained on, too, by unique names."""
        return {}

    def mistakes(self, space: ParameterSpace | None) -> "Iterable[Mistake]":  # noqa: ARG002
        """Find what does not fit the tuned parameters; None where these have mistakes."""
        return ()

    def resolved(self) -> dict[str, Any]:
        """The configuration as plain data, with nothing left to defaults."""
        return self.model_dump(mode="json")

    @classmethod
    def lasting(cls, resolved: Mapping[str, Any]) -> dict[str, Any]:
        """The part of a resolved configuration that may not change when a study is resumed.

        Trials depend on it. What is compared elsewhere, see `adaptune.study.inputs`, and the test
        sequences may change.
        """
        return {key: resolved[key] for key in ("sub_trajectory", "lost_track")}
