"""The samplers by name, and the settings of each."""

import inspect
import warnings
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

from pydantic import BaseModel, Field

from adaptune import hosting, plugins
from adaptune.errors import AdaptuneError
from adaptune.space import Value, nearest
from adaptune.strict import StrictModel

OPTUNA = {
    "cmaes": "optuna.samplers:CmaEsSampler",
    "gp": "optuna.samplers:GPSampler",
    "nsga2": "optuna.samplers:NSGAIISampler",
    "qmc": "optuna.samplers:QMCSampler",
    "tpe": "optuna.samplers:TPESampler",
}
"""Optuna's samplers; their settings are the keywords of the class."""
NAMES = ("annealing", "grid", "random", "sobol", *OPTUNA)
SINGLE = ("annealing", "cmaes")
"""Samplers that minimise one objective only."""
FORGETFUL = ("tpe", "gp")
"""Samplers that keep no notes: they continue from any list of trials."""
NEEDS = {"cmaes": "cmaes", "gp": "torch"}
"""Packages that a sampler needs; adaptune's extra has the sampler's name."""
SERVICE = hosting.Service("offline.samplers.hosted")
"""What a server does with a sampler of the user."""


def is_user_sampler(name: str) -> bool:
    """Whether a sampler is a class that is neither adaptune's nor Optuna's."""
    return ":" in name and name.partition(":")[0].partition(".")[0] != "optuna"


class SamplerError(AdaptuneError):
    """A sampler that cannot be used."""


class Step(StrictModel):
    """How far a step of annealing moves a parameter.

    ``docs/reference-offline.md`` describes the settings and their defaults.
    """

    mu: float | None = None
    sigma: float | None = Field(None, ge=0)
    delta_max: int | None = Field(None, ge=0, le=2**53)
    change: float | None = Field(None, ge=0, le=1)
    # Bounds of the walk, within the parameter's range.
    low: int | float | None = None
    high: int | float | None = None


class AnnealingSettings(StrictModel):
    """Settings of simulated annealing, with the names they have in RUSTLE.

    ``docs/reference-offline.md`` describes them.
    """

    initial_temperature: float = Field(0.1, gt=0)
    alpha: float = Field(0.9, gt=0, le=1)
    energy_scale: float | None = Field(None, gt=0)
    reanneal_fixed: int | None = Field(None, ge=1, le=10**9)
    reanneal_accepted: int | None = Field(None, ge=1, le=10**9)
    reanneal_best: int | None = Field(None, ge=1, le=10**9)
    stall_accepted: int | None = Field(None, ge=1, le=10**9)
    stall_best: int | None = Field(None, ge=1, le=10**9)
    chains: int = Field(2, ge=1, le=1000)
    # Where the chains begin, instead of at the best of the initial points.
    start: dict[str, int | float] | None = None
    steps: dict[str, Step] = Field(default_factory=dict)


class Span(StrictModel):
    """`count` values from `low` to `high`, evenly in ratio where the parameter's scale is log."""

    low: float
    high: float
    count: int = Field(ge=1, le=10**6)


class GridSettings(StrictModel):
    """Settings of `grid`."""

    # For every number ``[first, step, count]`` or a `Span`; for categories the choices to try, by
    # default all.
    grid: dict[str, Span | tuple[Value, ...]]


class RandomSettings(StrictModel):
    """Settings of `random`: with a grid, it draws the grid's points without repetition."""

    grid: dict[str, Span | tuple[Value, ...]] | None = None


def optuna_class(name: str) -> type[Any]:
    """Class of an Optuna sampler.

    Raises
    ------
    SamplerError
        It names the nearest sampler, or what to install.
    """
    if name in NEEDS and find_spec(NEEDS[name]) is None:
        raise SamplerError(
            f"{name} needs the package {NEEDS[name]}: pip install 'adaptune[{name}]'"
        )
    if name not in OPTUNA and ":" not in name:
        raise SamplerError(
            f"there is no sampler {name!r}: {nearest(name, NAMES)} (another Optuna sampler is "
            f"package.module:Class)"
        )
    from optuna.samplers import BaseSampler

    try:
        path = plugins.path_of(name, "sampler", OPTUNA, "", "Class")
        found = plugins.load(name, path, "class")
    except plugins.PluginError as error:
        raise SamplerError(str(error)) from error
    if not (isinstance(found, type) and issubclass(found, BaseSampler)):
        raise SamplerError(f"{name}: is not a class derived from optuna.samplers.BaseSampler")
    return found


def optuna_sampler(name: str, settings: Mapping[str, Any], seed: int) -> Any:
    """Make an Optuna sampler.

    Raises
    ------
    SamplerError
        If it does not take these settings.
    """
    cls = optuna_class(name)
    keywords = inspect.signature(cls).parameters
    if not any(k.kind is inspect.Parameter.VAR_KEYWORD for k in keywords.values()):
        for key in settings:
            if key not in keywords:
                raise SamplerError(f"{key}: {name} has no such setting; {nearest(key, keywords)}")
    seeded = {"seed": seed} if "seed" in keywords else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about what is experimental, or deprecated
        try:
            return cls(**seeded, **settings)
        except Exception as error:
            raise SamplerError(f"{name} does not take its settings: {error}") from error


SETTINGS: dict[str, type[BaseModel]] = {
    "annealing": AnnealingSettings,
    "grid": GridSettings,
    "random": RandomSettings,
    "sobol": type("SobolSettings", (StrictModel,), {"__doc__": "`sobol` has no settings."}),
}
"""Settings of adaptune's own samplers."""
