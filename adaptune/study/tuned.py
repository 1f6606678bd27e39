"""The odometry of a study, and the parameters that are tuned."""

from collections.abc import Mapping
from typing import Any

from adaptune.odometry.base import Description
from adaptune.odometry.registry import odometry_class
from adaptune.space import ParameterSpace
from adaptune.study.config import OdometryConfig


def odometry_settings(config: OdometryConfig) -> Any:
    """Settings of the odometry."""
    return odometry_class(config.name).settings_type.model_validate(config.settings)


def describe_odometry(config: OdometryConfig) -> Description:
    """Description of the odometry with its settings."""
    return odometry_class(config.name).describe(odometry_settings(config))


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
    return ({} if space is None else space.parameters[name].model_dump()) | dict(given)
