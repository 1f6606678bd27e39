"""A study: a checked configuration, and what is made of it."""

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, Literal

from typing_extensions import TypeVar

from adaptune.cores import available
from adaptune.odometry.base import Description, WarmUp
from adaptune.odometry.declaration import declare
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.pool import Factory, OdometryPool
from adaptune.sequence.names import OF_VIEW
from adaptune.space import ParameterSpace
from adaptune.study.config import MOST_MEMBERS, OdometryConfig, StudyConfig
from adaptune.study.mistakes import ConfigurationError
from adaptune.study.run_folder import MODEL, check_folder, open_folder
from adaptune.study.sequences import StudySequences

C_co = TypeVar("C_co", bound=StudyConfig, covariant=True, default=StudyConfig)

_log = logging.getLogger(__name__)

Mechanism = Literal["live", "hand_over", "bank"]


@dataclass(frozen=True)
class Study(Generic[C_co]):
    """A checked configuration and its folder."""

    config: C_co
    folder: Path  # keeps trials, model, replays and comparison

    @property
    def name(self) -> str:
        """Name of the study: its folder's."""
        return self.folder.name

    @property
    def model_path(self) -> Path:
        """File of the error model."""
        return self.folder / MODEL

    @cached_property
    def sequences(self) -> StudySequences:
        """The sequences by name."""
        config = self.config
        described = [(one, describe_odometry(one)) for one in config.odometries.values()]
        # A program that runs whole recordings is the only odometry.
        whole = [odometry_settings(one) for one, about in described if about.whole]
        layouts = [getattr(settings, "input", "bag") for settings in whole]
        layout: Any = layouts[0] if layouts else "bag"
        of_study = (config.sequences, config.courses, config.views, self.folder)
        needs_imu = any(about.needs_imu for _, about in described)
        return StudySequences(*of_study, needs_imu, layout)

    @cached_property
    def odometry(self) -> Factory:
        """Makes instances of the odometry, or of any of several."""
        odometries = self.config.odometries
        factories = {label: self._factory(config) for label, config in odometries.items()}
        return OdometryPool(factories) if len(factories) > 1 else next(iter(factories.values()))

    def _factory(self, config: OdometryConfig) -> OdometryFactory:
        described = describe_odometry(config)
        return OdometryFactory(
            config.name,
            odometry_settings(config),
            tuned_space(config, described),
            self.config.isolation,
            self.sequences.program_input if described.whole else None,
        )

    @property
    def training(self) -> list[str]:
        """Names of the training sequences, each followed by its views."""
        suffixes = ("", *(f"{OF_VIEW}{view}" for view in self.config.views))
        return [name + suffix for name in self.config.training for suffix in suffixes]

    @property
    def rules(self) -> tuple[str, ...]:
        """Selection rules; none where the odometry runs whole recordings."""
        return () if self.odometry.description.whole else self.config.online.rules

    @property
    def window(self) -> int:
        """Number of selections over which descriptors are averaged."""
        return max(1, math.ceil(self.config.descriptor.window / self.config.online.period))

    @cached_property
    def mechanism(self) -> Mechanism:
        """How the odometry changes its parameters during a replay."""
        switching = self.config.online.switching
        if switching.mechanism != "auto":
            return switching.mechanism
        instances = switching.size if switching.sets is None else len(switching.sets)
        if switching.sets is None and self.config.online.budget is not None:
            instances = MOST_MEMBERS
        cores = available() if switching.cores is None else switching.cores
        enough = instances * self.config.isolation.memory <= switching.memory
        if cores > 1 and enough:
            return "bank"
        return "live" if self.odometry.description.live else "hand_over"

    @cached_property
    def warm_up(self) -> WarmUp:
        """Which scans a new instance sees before it takes over."""
        switching, usual = self.config.online.switching, self.odometry.description.warm_up
        given: dict[str, Any] = {
            "seconds": switching.warm_up,
            "full_rate": switching.full_rate,
            "stride": switching.stride,
        }
        return usual._replace(**{k: v for k, v in given.items() if v is not None})

    def switch_cost(self) -> float:
        """Share by which a switch raises the RTE, as `adaptune switching` measured it.

        Returns
        -------
        float
            0.0 if it was not measured, or with another odometry or warm-up.
        """
        path = self.folder / "switching.json"
        try:
            measured = json.loads(path.read_text(encoding="utf-8"))
            if "switch_cost" not in measured:
                raise ConfigurationError(
                    f"{path}: was written by an older adaptune; run `adaptune switching` again"
                )
            if measured["of"] != self.switching_identity():
                _log.warning(
                    "%s: was measured with another odometry, warm-up or recording; a switch counts "
                    "as free until you run `adaptune switching` again",
                    path,
                )
                return 0.0
            return max(0.0, float(measured["switch_cost"]))
        except FileNotFoundError:
            return 0.0
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigurationError(
                f"{path}: is damaged ({error}); remove it, or run `adaptune switching` again"
            ) from error

    def switching_identity(self) -> dict[str, Any]:
        """Everything that the switch cost depends on, as plain data."""
        return {
            "odometry": self.odometry.identity,
            "content": self.odometry.content,
            "sequences": {name: self._measured_on(name) for name in self.config.training},
            "mechanism": self.mechanism,
            "warm_up": self.warm_up._asdict(),
        }

    def _measured_on(self, name: str) -> dict[str, Any]:
        return self.sequences.identity(name) | self.sequences.reference(name)

    def check(self) -> None:
        """Refuse a folder that was begun with other settings of the offline stage.

        The budget, the number of workers, the sequences and the replays may change. What results
        depend on is compared by `adaptune.study.inputs`.

        Raises
        ------
        ConfigurationError
            It names the keys that differ.
        """
        check_folder(self.folder, self._resolved(), self.config.lasting)

    def open(self) -> None:
        """Make and lock the folder, and write the resolved configuration to it.

        Raises
        ------
        ConfigurationError
            If the folder cannot be made, another process works in it, or it was begun with another
            study.
        """
        self.check()
        open_folder(self.folder, self._resolved())

    def _resolved(self) -> dict[str, Any]:
        """The configuration with nothing left to defaults."""
        resolved = self.config.resolved()
        given = resolved["odometry"]
        entries = given if isinstance(given, list) else [given]
        for entry, config in zip(entries, self.config.odometries.values(), strict=True):
            made = self._factory(config)
            entry["settings"] = made.settings.model_dump(mode="json")
            entry["parameters"] = made.space.definition()
        return resolved


def odometry_settings(config: OdometryConfig) -> Any:
    """Settings of the odometry."""
    return declare(config.name, config.settings).sound(config.name)[0]


def describe_odometry(config: OdometryConfig) -> Description:
    """Description of the odometry with its settings."""
    return declare(config.name, config.settings).sound(config.name)[1]


def tuned_space(config: OdometryConfig, described: Description) -> ParameterSpace:
    """The parameters that are tuned: those that the study names, by default all."""
    own = described.space
    if config.parameters is None:
        return own or ParameterSpace({})
    definitions = config.parameters.items()
    return ParameterSpace.load({name: whole_definition(own, name, d) for name, d in definitions})


def whole_definition(
    space: ParameterSpace | None, name: str, given: Mapping[str, Any]
) -> dict[str, Any]:
    """Definition of a parameter: the study's values, and the odometry's own for the rest."""
    own = {} if space is None else space.parameters[name].model_dump()
    other = given.get("type", own.get("type")) != own.get("type")
    return dict(given) if other else own | dict(given)
