"""Make an odometry from its name, wherever it runs."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

from adaptune.odometry.base import Description, OdometryInstance
from adaptune.odometry.command import Command
from adaptune.odometry.in_process import InProcess
from adaptune.odometry.isolation import Isolated, Limits
from adaptune.odometry.process import Process
from adaptune.odometry.program_input import ProgramInput
from adaptune.odometry.registry import AnyOdometry, odometry_class, versions
from adaptune.space import ParameterSet, ParameterSpace


@dataclass(frozen=True)
class OdometryFactory:
    """Makes instances of one odometry, in any process: it pickles.

    Attributes
    ----------
    name : str
        The odometry, see `adaptune.odometry.registry.odometry_class`.
    settings : BaseSettings
        Its settings; a mapping is validated.
    space : ParameterSpace
        The parameters that are tuned.
    limits : Limits
        Limits of odometries in processes of their own.
    program_input : callable, optional
        Gives the recording of a sequence, for programs that run whole recordings.
    """

    name: str
    settings: Any
    space: ParameterSpace
    limits: Limits
    program_input: Callable[[str], ProgramInput] | None = None

    def __post_init__(self) -> None:
        settings = self.odometry_class.settings_type.model_validate(self.settings)
        object.__setattr__(self, "settings", settings)

    @cached_property
    def odometry_class(self) -> AnyOdometry:
        """Class of the odometry."""
        return odometry_class(self.name)

    @cached_property
    def description(self) -> Description:
        """What a study must know of the odometry."""
        return self.odometry_class.describe(self.settings)

    @property
    def identity(self) -> dict[str, Any]:
        """Name and settings, by which a model knows the odometry that it was made for."""
        return {"name": self.name, "settings": self.settings.model_dump(mode="json")}

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the packages that the poses depend on."""
        return versions(self.odometry_class)

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
        cls, given = self.odometry_class, self.space.baseline | (parameters or {})
        if issubclass(cls, Command):
            read = None
            if sequence is not None and self.program_input is not None:
                read = partial(self.program_input, sequence)
            return cls(given, self.settings, self.limits, read)
        if issubclass(cls, Process):
            return cls(given, self.settings, self.limits)
        if cls.clean and not isolated:
            return InProcess(cls(given, self.settings))
        return Isolated(self.name, given, self.settings, self.limits)
