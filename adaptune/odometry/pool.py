"""Several odometries in one study: a parameter set says which of them it is for."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from adaptune.odometry.base import Description, OdometryInstance, WarmUp
from adaptune.odometry.content import Content
from adaptune.odometry.factory import OdometryFactory
from adaptune.pooled_space import PooledSpace
from adaptune.space import ParameterSet


@dataclass(frozen=True)
class OdometryPool:
    """Makes instances of several odometries, in any process: it pickles.

    It offers what `OdometryFactory` does. Parameter sets are those of a `PooledSpace`.

    Attributes
    ----------
    factories : dict
        By label, what makes each odometry.
    """

    factories: Mapping[str, OdometryFactory]
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
        """What a study must know of all together.

        No instance changes from one odometry to another, so none is live. The longest warm-up is
        long enough for all.
        """
        every = [factory.description for factory in self.factories.values()]
        return Description(
            self.space,
            live=False,
            needs_imu=any(one.needs_imu for one in every),
            warm_up=WarmUp(
                max(one.warm_up.seconds for one in every),
                max(one.warm_up.full_rate for one in every),
                min(one.warm_up.stride for one in every),
            ),
            whole=any(one.whole for one in every),
        )

    @property
    def identity(self) -> dict[str, Any]:
        """The labels, and by label name and settings, by which a model knows what it is of."""
        settings = {label: factory.identity for label, factory in self.factories.items()}
        return {"name": self.name, "settings": settings}

    @property
    def user_code(self) -> bool:
        """See `OdometryFactory`."""
        return any(factory.user_code for factory in self.factories.values())

    @property
    def has_user_class(self) -> bool:
        """See `OdometryFactory`."""
        return any(factory.has_user_class for factory in self.factories.values())

    @property
    def apart(self) -> bool:
        """Whether any of them runs in processes of its own, which have limits."""
        return any(factory.apart for factory in self.factories.values())

    @property
    def one_by_one(self) -> bool:
        """See `OdometryFactory`."""
        return any(factory.one_by_one for factory in self.factories.values())

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the packages that the poses depend on."""
        every = (factory.versions for factory in self.factories.values())
        return {package: version for one in every for package, version in sorted(one.items())}

    @property
    def content(self) -> Content:
        """See `OdometryFactory`."""
        return {k: v for factory in self.factories.values() for k, v in factory.content.items()}

    def allowing(self, user_code: bool) -> "OdometryPool":
        """The same where classes of the user may, or may not, run in this process."""
        return OdometryPool({k: replace(f, user_code=user_code) for k, f in self.factories.items()})

    def reading(self, program_input: Any) -> "OdometryPool":
        """The same with another source of whole recordings."""
        given = {k: f.reading(program_input) for k, f in self.factories.items()}
        return OdometryPool(given)

    def alone(self, parameters: ParameterSet) -> tuple[OdometryFactory, ParameterSet]:
        """See `OdometryFactory.alone`."""
        label, own = self.space.split(parameters)
        return self.factories[label].alone(own)

    def __call__(
        self,
        parameters: ParameterSet | None = None,
        sequence: str | None = None,
        isolated: bool = False,
    ) -> OdometryInstance:
        """Make a new instance of the odometry that the set names, see `OdometryFactory`."""
        whole = self.space.baseline if parameters is None else parameters
        label, own = self.space.split(whole)
        return self.factories[label](own, sequence, isolated)


Factory = OdometryFactory | OdometryPool
"""What makes instances of one odometry, or of several."""
