"""The configuration of a study: the settings that both stages share."""

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from adaptune._system.strict import StrictModel
from adaptune.errors import Finding, nearest
from adaptune.odometry.base import Description
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.remote import Limits
from adaptune.recording.config import Fractions, SequenceConfig, Transform, part_name, read_part
from adaptune.ros.steering import SetCommand
from adaptune.simulation.course import Course
from adaptune.space import ParameterSpace


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
    parameters: dict[str, dict[str, Any]] | None = None

    @model_validator(mode="before")
    @classmethod
    def _name_alone(cls, data: Any) -> Any:
        return {"name": data} if isinstance(data, str) else data

    @cached_property
    def declared(self) -> tuple[Any, Description]:
        """The checked settings, and the odometry's description with them; else an OdometryError."""
        from adaptune.odometry.registry import declare

        return declare(self.name, self.settings).sound(self.name)

    @cached_property
    def space(self) -> ParameterSpace:
        """The parameters that are tuned: those that are named here, by default all."""
        own = self.declared[1].space
        if self.parameters is None:
            return own or ParameterSpace({})
        each = self.parameters.items()
        return ParameterSpace.load({name: whole_definition(own, name, d) for name, d in each})


def whole_definition(
    space: ParameterSpace | None, name: str, given: Mapping[str, Any]
) -> dict[str, Any]:
    """Definition of a parameter: the study's values, and the odometry's own for the rest."""
    own = {} if space is None else space.parameters[name].model_dump()
    other = given.get("type", own.get("type")) != own.get("type")
    return dict(given) if other else own | dict(given)


def _known_descriptor(name: str) -> str:
    from adaptune.model.descriptor import DescriptorError, check_descriptor

    try:
        check_descriptor(name)
    except DescriptorError as error:
        raise ValueError(str(error)) from error
    return name


def _listed(given: Any) -> Any:
    return (given,) if isinstance(given, str) else given


def _once(names: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(names)) < len(names):
        raise ValueError("one of them is named twice")
    return names


Descriptors = Annotated[
    tuple[Annotated[str, AfterValidator(_known_descriptor)], ...],
    Field(min_length=1),
    BeforeValidator(_listed),
    AfterValidator(_once),
]
"""How scans are described."""


class SwitchingConfig(StrictModel):
    """How the odometry changes its parameters during a replay.

    `live`: it changes them between scans. `bank`: several instances run side by side, and their
    motions are averaged. `auto`: a bank, given more than one core and enough memory, else live if
    the odometry can. ``docs/adapting-live.md`` describes every key.
    """

    mechanism: Literal["auto", "live", "bank"] = "auto"
    size: int = Field(4, ge=2, le=6)  # members of a bank


class RealTimeConfig(StrictModel):
    """How to replay in real time."""

    rate: float = Field(1.0, gt=0, le=1e3)  # times as fast as it was recorded
    # Seconds from a scan's arrival to the selection that is made from it; a later one is dropped.
    deadline: float = Field(0.02, gt=0, le=60)
    # Scans that may wait for the odometry; the oldest ones are dropped. With 0 all wait.
    queue: int = Field(1, ge=0, le=10_000)


def _ros_name(name: str) -> str:
    if not re.fullmatch(r"[~/]?[A-Za-z]\w*(/[A-Za-z]\w*)*", name, re.ASCII) or len(name) > 255:
        raise ValueError("is no name in ROS: give letters, digits and _, with / between the parts")
    return name


RosName = Annotated[str, AfterValidator(_ros_name)]
"""A topic or a node of ROS."""


class SteerConfig(StrictModel):
    """Somebody else's odometry node, of which only the parameters are set."""

    node: RosName
    odometry: RosName  # topic of its poses, nav_msgs/Odometry
    extrinsic: Transform | None = None  # the LiDAR's pose in the frame whose poses it publishes
    command: SetCommand | None = None  # otherwise parameters are set through ROS
    patience: float = Field(0.3, gt=0, le=3600)  # seconds from a scan to its pose


class RosConfig(StrictModel):
    """How to drive on a robot with ROS; ``docs/reference-study.md`` describes every key."""

    points: RosName | None = None  # topic of the point clouds; that of `like` if left out
    like: str | None = None  # the sequence with the same sensor; by default the first of training
    frame: str = Field("odom", min_length=1)
    odometry: RosName = "adaptune/odometry"
    tf: bool = False
    steer: SteerConfig | None = None


ALSO = ("even", "standby", "untrained")
"""Modes that are replayed only on demand, to compare with; the others are selection rules."""


def _modes(given: Any) -> Any:
    from adaptune.model.registry import RULES

    return tuple(dict.fromkeys((*RULES, *ALSO))) if given == "all" else given


def _known_mode(name: str) -> str:
    from adaptune.model.registry import RULES, RuleError, rule_class

    try:
        if name not in (*RULES, *ALSO):
            rule_class(name, ALSO)
    except RuleError as error:
        raise ValueError(str(error)) from error
    return name


def read_budget(given: Any) -> float | str | None:
    """A budget in milliseconds, or as ``3x`` in times the baseline's; or a ValueError."""
    with suppress(ValueError, TypeError):
        times = isinstance(given, str) and given.endswith("x")
        number = float(given[:-1] if times else given)
        if not isinstance(given, bool) and 0.0 < number <= 1e6:
            return f"{number:g}x" if times else number
    if given is None:
        return None
    raise ValueError("give milliseconds of CPU time a scan, or times the baseline's, as 3x")


class OnlineConfig(StrictModel):
    """How to replay: seconds between selections, modes, switching, and what it may cost.

    `modes` are replayed besides baseline and fixed set; `all` of them is a choice, too. The budget
    is in milliseconds of CPU time a scan, all members and live evidence together, or as ``3x`` in
    times the baseline's.
    Without `real_time`, a replay is as fast as it goes and always the same.
    """

    period: float = Field(1.0, ge=0.01, le=3600)
    modes: Annotated[
        tuple[Annotated[str, AfterValidator(_known_mode)], ...],
        BeforeValidator(_modes),
        AfterValidator(_once),
    ] = ("adaptive", "paper")
    switching: SwitchingConfig = SwitchingConfig()
    budget: Annotated[
        Annotated[float, Field(gt=0, le=1e6)] | str | None, BeforeValidator(read_budget)
    ] = None
    real_time: RealTimeConfig | None = None
    ros: RosConfig = RosConfig()

    def milliseconds(self, baseline: float) -> float | None:
        """The budget of a scan, given what the baseline's scans take."""
        if isinstance(self.budget, str):
            return float(self.budget[:-1]) * baseline
        return self.budget

    @property
    def rules(self) -> tuple[str, ...]:
        """The modes that select parameters with the error model."""
        return tuple(mode for mode in self.modes if mode not in ALSO)

    @property
    def also(self) -> tuple[str, ...]:
        """The other modes."""
        return tuple(mode for mode in self.modes if mode in ALSO)


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
    descriptor: Descriptors = ("ndt",)
    online: OnlineConfig = OnlineConfig()

    @property
    def odometries(self) -> dict[str, OdometryConfig]:
        """The odometries by their labels."""
        given = (self.odometry,) if isinstance(self.odometry, OdometryConfig) else self.odometry
        return {one.label or one.name: one for one in given}

    def mistakes(self, space: ParameterSpace | None) -> "Iterable[Finding]":  # noqa: ARG002
        """Find what does not fit the tuned parameters; None where these have mistakes.

        A stage that adds settings of its own overrides it, `portfolios` and `resolved`.
        """
        return ()

    @property
    def search_inputs(self) -> dict[str, Any]:
        """What makes the trials of a study those that they are: another search has others."""
        return {}

    @property
    def portfolios(self) -> Mapping[str, str]:
        """Odometries whose portfolio is used, or files of portfolios, and the digest of each."""
        return {}

    def resolved(self) -> dict[str, Any]:
        """The configuration as plain data, with nothing left to defaults."""
        return self.model_dump(mode="json")


ROLES = ("training", "test")
_KINDS = ("sequences", "courses")
_WHOLE = (0.0, 1.0)


class _Named(NamedTuple):
    """An entry of `training` or `test`."""

    name: str  # of the sequence that it becomes
    origin: str  # of the sequence that it is a part of, or the same
    part: Fractions

    def overlaps(self, other: "_Named") -> bool:
        shared = min(self.part[1], other.part[1]) - max(self.part[0], other.part[0])
        return self.origin == other.origin and shared > 0.0


def settle_roles(data: dict[str, Any]) -> tuple[dict[str, str], list[Finding]]:
    """Make every part that `training` and `test` name a sequence or course of its own.

    The study's data are changed in place: ``{hall: 0-60%}`` in a list becomes the name
    ``hall_0-60`` of a new entry. Returns of each new sequence the one that it is a part of, and the
    mistakes in the lists. Entries that are no names at all are left to the models.
    """
    mistakes: list[Finding] = []
    origins: dict[str, str] = {}
    if not all(isinstance(data.get(kind, {}), dict) for kind in _KINDS):
        return origins, mistakes  # the models find it
    found: dict[str, list[_Named]] = {role: [] for role in ROLES}
    for role in ROLES:
        if not isinstance(data.get(role), list):
            continue
        data[role] = list(data[role])
        for i, entry in enumerate(data[role]):
            if not isinstance(entry, str | dict):
                continue
            try:
                named = _read(data, entry, origins)
                _check(role, named, found)
            except ValueError as error:
                mistakes.append(Finding((role, i), str(error)))
                data[role][i] = str(next(iter(entry), "")) if isinstance(entry, dict) else entry
                continue
            found[role].append(named)
            data[role][i] = named.name
            if named.name != named.origin:
                origins[named.name] = named.origin
                _add_part(data, named)
    return origins, mistakes


def _read(data: dict[str, Any], entry: Any, origins: dict[str, str]) -> _Named:
    """The entry of a list; a ValueError says what is wrong with it."""
    known = {name: section for kind in _KINDS for name, section in data.get(kind, {}).items()}
    if isinstance(entry, dict) and len(entry) != 1:
        raise ValueError("each part is an entry of its own, as in [hall: 0-60%, town: 0-60%]")
    name = next(iter(entry)) if isinstance(entry, dict) else entry
    if name not in known or name in origins:
        whole = [str(other) for other in known if other not in origins]
        part_of = re.fullmatch(r"(.+)_([\d.]+-[\d.]+)", str(name))
        if isinstance(entry, str) and part_of and part_of[1] in whole:  # as messages call it
            return _read(data, {part_of[1]: f"{part_of[2]}%"}, origins)
        raise ValueError(f"there is no sequence {name!r}: {nearest(str(name), whole)}")
    if isinstance(entry, str):
        return _Named(name, name, _WHOLE)
    try:
        part = read_part(entry[name])
    except ValueError as error:
        raise ValueError(f"{entry[name]} of {name} is no part: {error}") from error
    named = _Named(part_name(name, part), name, part)
    if isinstance(known[name], dict) and known[name].get("part") is not None:
        raise ValueError(f"{name} is a part already; name it without one")
    if named.name in known and origins.get(named.name) != name:
        raise ValueError(f"there is another sequence {named.name}; rename that one")
    return named


def _check(role: str, named: _Named, found: dict[str, list[_Named]]) -> None:
    """A ValueError says that the same was named before."""
    if named in found[role]:
        raise ValueError(f"{named.name!r} is named twice")
    for other in filter(named.overlaps, found["training"]):
        if role == "training":
            raise ValueError(f"{named.name} overlaps {other.name}; name parts that share no scan")
        raise ValueError(
            f"{named.name} overlaps {other.name} of training, and proves nothing here; to split "
            f"it, write training: [{named.origin}: 0-60%], test: [{named.origin}: 60-100%]"
        )


def _add_part(data: dict[str, Any], named: _Named) -> None:
    for kind in _KINDS:
        section = data.get(kind, {})
        if isinstance(entry := section.get(named.origin), dict):
            origin = {"of": named.origin} if kind == "courses" else {}
            data[kind] = section | {named.name: entry | origin | {"part": list(named.part)}}
