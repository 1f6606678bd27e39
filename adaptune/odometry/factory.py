"""The one place that makes an odometry from its name."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

from adaptune.odometry.base import Box, Description
from adaptune.odometry.command import Command, Material
from adaptune.odometry.isolation import Isolated, Limits
from adaptune.odometry.process import Process
from adaptune.odometry.registry import box_class
from adaptune.space import ParameterSet, ParameterSpace


@dataclass(frozen=True)
class OdometryFactory:
    """Makes instances of an odometry.

    Attributes
    ----------
    name : str
    settings : BaseSettings
    space : ParameterSpace
        The parameters that are tuned.
    limits : Limits
        Limits of an odometry in a process of its own.
    material : callable, optional
        Returns a sequence as a program reads it.
    strict_sequences : tuple of str
        Sequences on which a program must not fail with the baseline.
    """

    name: str
    settings: Any
    space: ParameterSpace
    limits: Limits
    material: Callable[[str], Material] | None = None
    strict_sequences: tuple[str, ...] = ()

    @cached_property
    def odometry_class(self) -> Any:
        """Class of the odometry."""
        programs: dict[str, Any] = {"command": Command, "process": Process}
        return programs.get(self.name) or box_class(self.name)

    @cached_property
    def description(self) -> Description:
        """What a study must know of the odometry."""
        described: Description = self.odometry_class.describe(self.settings)
        return described

    @property
    def identity(self) -> dict[str, Any]:
        """Name and settings of the odometry, as a model keeps them."""
        return {"name": self.name, "settings": self.settings.model_dump(mode="json")}

    def __call__(
        self,
        parameters: ParameterSet | None = None,
        sequence: str | None = None,
        isolated: bool = False,
    ) -> Box:
        """Make a new instance, in a process of its own if it is not clean or `isolated` asks."""
        given = self.space.baseline | (parameters or {})
        if issubclass(self.odometry_class, Command):
            strict = sequence in self.strict_sequences and given == self.space.baseline
            material = None
            if self.material is not None and sequence is not None:
                material = partial(self.material, sequence)
            return Command(given, self.settings, self.limits, material, strict)
        if issubclass(self.odometry_class, Process):
            return Process(given, self.settings, self.limits)
        if self.odometry_class.clean and not isolated:
            made: Box = self.odometry_class(given, self.settings)
            return made
        return Isolated(self.name, given, self.settings, self.limits)
