"""What makes instances of one odometry, or of several."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from adaptune.odometry import registry
from adaptune.odometry.base import Description, InProcess, OdometryInstance, OwnFile
from adaptune.odometry.content import Content, odometry_content
from adaptune.odometry.guarded import Guarded
from adaptune.odometry.remote import Isolated, Limits
from adaptune.space import ParameterSet, ParameterSpace, PooledSpace

if TYPE_CHECKING:
    from adaptune.odometry.program import ProgramInput


@dataclass(frozen=True)
class OdometryFactory:
    """Makes instances of one odometry, in any process: it pickles."""

    name: str  # the odometry, see `adaptune.odometry.registry.odometry_class`
    settings: Any  # its settings; a mapping is validated
    space: ParameterSpace  # the parameters that are tuned
    limits: Limits  # of odometries in processes of their own
    # gives the recording of a sequence, for programs that run whole recordings
    program_input: Callable[[str], "ProgramInput"] | None = None
    # Whether classes of the user may run in this process, if they are clean. Only processes that
    # the user can do without may allow it.
    user_code: bool = False
    description: Description = field(init=False)  # what a study must know of the odometry

    def __post_init__(self) -> None:
        settings, description = registry.declare(self.name, self.settings).sound(self.name)
        vars(self).update(settings=settings, description=description)

    @property
    def identity(self) -> dict[str, Any]:
        """Name and settings, by which a model knows the odometry that it was made for."""
        settings = self.settings.model_dump(mode="json") | dict.fromkeys(self.steering)
        return {"name": self.name, "settings": settings}

    @property
    def steering(self) -> dict[str, Any]:
        """Settings that only say how parameters change while it runs: trials do not need them."""
        given = {key: getattr(self.settings, key) for key in getattr(self.settings, "steering", ())}
        return {key: value for key, value in given.items() if value is not None}

    @property
    def content(self) -> Content:
        """What the poses depend on besides name, settings and parameters."""
        return odometry_content(self.name, self.settings, self.description.module)

    def changed(self, **changes: Any) -> "OdometryFactory":
        """The same with another `user_code` or `program_input`."""
        return replace(self, **changes)

    @property
    def isolated(self) -> bool:
        """Whether it runs in processes of their own, which have limits."""
        return not self.description.clean or registry.is_user_class(self.name)

    @property
    def one_by_one(self) -> bool:
        """Whether trials gain nothing from sharing a pass: what runs them shares nothing."""
        return self.description.whole or self.name in registry.CONTAINERS

    def alone(self, parameters: ParameterSet) -> tuple["OdometryFactory", ParameterSet]:
        """What makes the odometry that a set is for, and all parameters that it takes."""
        return self, self.space.complete(parameters)

    def own_file(self, parameters: ParameterSet) -> OwnFile | None:
        """All parameters as the odometry's own tool reads them; None if it has no such tool."""
        if registry.is_user_class(self.name):
            return None  # which is not imported here
        own_file: OwnFile | None = registry.odometry_class(self.name).own_file(
            parameters, self.settings
        )
        return own_file

    def __call__(
        self, parameters: ParameterSet | None = None, sequence: str | None = None
    ) -> OdometryInstance:
        """Make a new instance; programs that run whole recordings need the sequence's name."""
        given = self.space.complete(parameters or {})
        if self.name in registry.PROGRAMS:
            read = None
            if sequence is not None and self.program_input is not None:
                read = partial(self.program_input, sequence)
            program: Any = registry.odometry_class(self.name)
            instance: OdometryInstance = program.instance(given, self.settings, self.limits, read)
            return instance
        is_users = registry.is_user_class(self.name)
        if not self.description.clean or (is_users and not self.user_code):
            instance = Isolated(self.name, given, self.settings, self.limits)
        elif is_users:
            instance = Guarded(self.name, given, self.settings, self.limits.seconds)
        else:
            cls: Any = registry.odometry_class(self.name)
            return InProcess(cls(given, self.settings))
        instance.warm_up = self.description.warm_up
        return instance


@dataclass(frozen=True)
class OdometryPool:
    """Makes instances of several odometries, by sets of a `PooledSpace`; see `OdometryFactory`."""

    factories: Mapping[str, OdometryFactory]  # by label, what makes each odometry
    space: PooledSpace = field(init=False)

    def __post_init__(self) -> None:
        spaces = {label: factory.space for label, factory in self.factories.items()}
        object.__setattr__(self, "space", PooledSpace(spaces))

    @property
    def name(self) -> str:
        """All labels."""
        return ", ".join(self.factories)

    @cached_property
    def description(self) -> Description:
        """What a study must know of all together; no instance changes to another odometry."""
        every = [factory.description for factory in self.factories.values()]
        needs_imu, whole = any(d.needs_imu for d in every), any(d.whole for d in every)
        return Description(self.space, live=False, needs_imu=needs_imu, whole=whole)

    @property
    def identity(self) -> dict[str, Any]:
        """The labels, and by label name and settings, by which a model knows what it is of."""
        settings = {label: factory.identity for label, factory in self.factories.items()}
        return {"name": self.name, "settings": settings}

    @property
    def steering(self) -> dict[str, Any]:
        """See `OdometryFactory`; several do not change live."""
        return {}

    @property
    def isolated(self) -> bool:
        """Whether any of them runs in processes of its own, which have limits."""
        return any(factory.isolated for factory in self.factories.values())

    @property
    def one_by_one(self) -> bool:
        """See `OdometryFactory`."""
        return any(factory.one_by_one for factory in self.factories.values())

    @property
    def content(self) -> Content:
        """See `OdometryFactory`."""
        return {k: v for factory in self.factories.values() for k, v in factory.content.items()}

    def changed(self, **changes: Any) -> "OdometryPool":
        """See `OdometryFactory.changed`."""
        return OdometryPool({k: f.changed(**changes) for k, f in self.factories.items()})

    def alone(self, parameters: ParameterSet) -> tuple[OdometryFactory, ParameterSet]:
        """See `OdometryFactory.alone`."""
        label, own = self.space.split(parameters)
        return self.factories[label].alone(own)

    def __call__(
        self, parameters: ParameterSet | None = None, sequence: str | None = None
    ) -> OdometryInstance:
        """Make a new instance of the odometry that the set names, see `OdometryFactory`."""
        whole = self.space.baseline if parameters is None else parameters
        label, own = self.space.split(whole)
        return self.factories[label](own, sequence)


Factory = OdometryFactory | OdometryPool
"""What makes instances of one odometry, or of several."""
