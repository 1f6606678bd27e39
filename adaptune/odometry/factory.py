"""Make an odometry from its name, wherever it runs."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from adaptune.odometry.base import Description, OdometryInstance
from adaptune.odometry.content import Content, odometry_content
from adaptune.odometry.declaration import declare
from adaptune.odometry.guarded import Guarded
from adaptune.odometry.in_process import InProcess
from adaptune.odometry.isolation import Isolated, Limits
from adaptune.odometry.program_input import ProgramInput
from adaptune.odometry.registry import CONTAINERS, PROGRAMS, is_user_class, odometry_class, versions
from adaptune.space import ParameterSet, ParameterSpace


@dataclass(frozen=True)
class OdometryFactory:
    """Makes instances of one odometry, in any process: it pickles.

    Attributes
    ----------
    name : str
        The odometry, see `adaptune.odometry.registry.odometry_class`.
    settings : BaseModel
        Its settings; a mapping is validated.
    space : ParameterSpace
        The parameters that are tuned.
    limits : Limits
        Limits of odometries in processes of their own.
    program_input : callable, optional
        Gives the recording of a sequence, for programs that run whole recordings.
    user_code : bool
        Whether classes of the user may run in this process, if they are clean. Only processes that
        the user can do without may allow it.
    description : Description
        What a study must know of the odometry.
    module : str
        Module in which its class is written.
    """

    name: str
    settings: Any
    space: ParameterSpace
    limits: Limits
    program_input: Callable[[str], ProgramInput] | None = None
    user_code: bool = False
    description: Description = field(init=False)
    module: str = field(init=False)
    _clean: bool = field(init=False)

    def __post_init__(self) -> None:
        declared = declare(self.name, self.settings)
        settings, description = declared.sound(self.name)
        for name, value in (
            ("settings", settings),
            ("description", description),
            ("_clean", declared.clean),
            ("module", declared.module),
        ):
            object.__setattr__(self, name, value)

    @property
    def identity(self) -> dict[str, Any]:
        """Name and settings, by which a model knows the odometry that it was made for."""
        return {"name": self.name, "settings": self.settings.model_dump(mode="json")}

    @property
    def content(self) -> Content:
        """What the poses depend on besides name, settings and parameters."""
        return odometry_content(self.name, self.settings, self.module)

    @property
    def has_user_class(self) -> bool:
        """Whether it is a class of the user."""
        return is_user_class(self.name)

    def allowing(self, user_code: bool) -> "OdometryFactory":
        """The same where classes of the user may, or may not, run in this process."""
        return replace(self, user_code=user_code)

    def reading(self, program_input: Callable[[str], ProgramInput]) -> "OdometryFactory":
        """The same with another source of whole recordings, if it reads any."""
        return self if self.program_input is None else replace(self, program_input=program_input)

    @property
    def apart(self) -> bool:
        """Whether it runs in processes of their own, which have limits."""
        return self.name in PROGRAMS or not self._clean or is_user_class(self.name)

    @property
    def one_by_one(self) -> bool:
        """Whether trials gain nothing from sharing a pass: what runs them shares nothing."""
        return self.description.whole or self.name in CONTAINERS

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the packages that the poses depend on."""
        return versions(self.name)

    def alone(self, parameters: ParameterSet) -> tuple["OdometryFactory", ParameterSet]:
        """What makes the odometry that a set is for, and all parameters that it takes."""
        return self, self.space.complete(parameters)

    def __call__(
        self,
        parameters: ParameterSet | None = None,
        sequence: str | None = None,
        isolated: bool = False,
    ) -> OdometryInstance:
        """Make a new instance.

        Parameters
        ----------
        parameters
            Parameters not given keep their baseline.
        sequence
            Name of the sequence on which the instance will run; programs that run whole recordings
            need it.
        isolated
            Run in a process of its own even if the odometry is clean, to measure its memory.
        """
        given = self.space.complete(parameters or {})
        if self.name in PROGRAMS:
            read = None
            if sequence is not None and self.program_input is not None:
                read = partial(self.program_input, sequence)
            program: Any = odometry_class(self.name)
            made: OdometryInstance = program.instance(given, self.settings, self.limits, read)
            return made
        if isolated or not self._clean or (is_user_class(self.name) and not self.user_code):
            return Isolated(self.name, given, self.settings, self.limits)
        if is_user_class(self.name):
            return Guarded(self.name, given, self.settings, self.limits.seconds)
        cls: Any = odometry_class(self.name)
        return InProcess(cls(given, self.settings))
