"""How parameter sets are searched for: the samplers by name, and what may be set of each."""

import inspect
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from adaptune.errors import AdaptuneError
from adaptune.space import (
    Categorical,
    Float,
    Integer,
    ParameterSet,
    ParameterSpace,
    Value,
    describe,
    nearest,
)

OPTUNA = {
    "cmaes": "optuna.samplers:CmaEsSampler",
    "gp": "optuna.samplers:GPSampler",
    "nsga2": "optuna.samplers:NSGAIISampler",
    "qmc": "optuna.samplers:QMCSampler",
    "tpe": "optuna.samplers:TPESampler",
}
"""Samplers of Optuna's; their settings are the keywords of the class."""
NAMES = ("annealing", "grid", "random", "sobol", *OPTUNA)
SINGLE = ("annealing", "cmaes")
"""Those that minimise one objective and no more."""
NEEDS = {"cmaes": "cmaes", "gp": "torch"}
"""What else must be installed; the extra is named as the sampler."""
TRIALS = 64
"""Where there is no other budget."""
MAX_GRID = 10_000
"""Points of a grid that is walked to its end without being asked to stop before."""

Problem = tuple[tuple[str, ...], str]
"""The keys of a mistake, and what it is."""


class SamplerError(AdaptuneError):
    """A sampler that cannot be used."""


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Step(_Settings):
    """How far annealing moves a parameter at once.

    Attributes
    ----------
    mu, sigma : float, optional
        Of real numbers, and of whole ones in log scale: mean and standard deviation of a normal
        distribution, in the parameter's unit or, in log scale, of its natural logarithm; 0 and a
        twentieth of the range when left out.
    delta_max : int, optional
        Of other whole numbers: the longest step at temperature 1, which the temperature multiplies;
        half of the range when left out. One step is always possible.
    change : float, optional
        Of categories: the probability that another one is taken; 0.3 when left out.
    """

    mu: float | None = Field(None, allow_inf_nan=False)
    sigma: float | None = Field(None, ge=0, allow_inf_nan=False)
    delta_max: int | None = Field(None, ge=0)
    change: float | None = Field(None, ge=0, le=1)


class AnnealingSettings(_Settings):
    """Settings of simulated annealing, with the names they have in RUSTLE.

    Attributes
    ----------
    initial_temperature, alpha : float
        A chain begins at the initial temperature, which `alpha` multiplies after every step.
    energy_scale : float, optional
        What differences of the error are divided by before they are compared with the temperature;
        the error of the first trial when left out. 1 is the thesis's rule.
    reanneal_fixed, reanneal_accepted, reanneal_best : int, optional
        Return to the initial temperature after this many steps, after this many in a row of which
        none was accepted, or none was the chain's best.
    stall_accepted, stall_best : int, optional
        Stop when every chain has made this many steps in a row of which none was accepted, or none
        was its best.
    chains : int
        They take turns: trial n is of chain n modulo `chains`.
    steps : dict
        By name of the parameter.
    """

    initial_temperature: float = Field(0.1, gt=0, allow_inf_nan=False)
    alpha: float = Field(0.9, gt=0, le=1)
    energy_scale: float | None = Field(None, gt=0, allow_inf_nan=False)
    reanneal_fixed: int | None = Field(None, ge=1)
    reanneal_accepted: int | None = Field(None, ge=1)
    reanneal_best: int | None = Field(None, ge=1)
    stall_accepted: int | None = Field(None, ge=1)
    stall_best: int | None = Field(None, ge=1)
    chains: int = Field(2, ge=1)
    steps: dict[str, Step] = {}


class Span(_Settings):
    """`count` values from `low` to `high`, evenly in ratio where the parameter's scale is log."""

    low: float = Field(allow_inf_nan=False)
    high: float = Field(allow_inf_nan=False)
    count: int = Field(ge=1)


class GridSettings(_Settings):
    """Settings of `grid`.

    Attributes
    ----------
    grid : dict
        For every number ``[first, step, count]`` or a `Span`; for categories those to try, all of
        them when left out.
    """

    grid: dict[str, Span | tuple[Value, ...]]


class RandomSettings(_Settings):
    """Settings of `random`: with a grid, its points are drawn without repetition."""

    grid: dict[str, Span | tuple[Value, ...]] | None = None


@dataclass(frozen=True)
class Axis:
    """Values of one parameter, computed when asked for.

    Attributes
    ----------
    parameter
        What they are of.
    count : int
    first, step : float
        Of numbers; in log scale if `log`.
    log : bool
    choices : tuple
        Of categories.
    """

    parameter: Float | Integer | Categorical
    count: int
    first: float = 0.0
    step: float = 0.0
    log: bool = False
    choices: tuple[Value, ...] = ()

    def __getitem__(self, i: int) -> Value:
        if self.choices:
            return self.choices[i]
        value = self.first + i * self.step
        value = math.exp(value) if self.log else value
        if isinstance(self.parameter, Integer):
            return round(value)
        assert isinstance(self.parameter, Float)
        for bound in (self.parameter.low, self.parameter.high):
            if math.isclose(value, bound, abs_tol=1e-12):
                return bound  # which rounding may have missed
        return value

    def index(self, value: Value) -> int | None:
        """Which of them it is, but for rounding."""
        if self.choices:
            alike = (i for i, c in enumerate(self.choices) if type(c) is type(value) and c == value)
            return next(alike, None)
        x = float(value)
        steps = ((math.log(x) if self.log else x) - self.first) / (self.step or 1.0)
        i = min(max(round(steps), 0), self.count - 1)
        return i if math.isclose(float(self[i]), x, rel_tol=1e-9, abs_tol=1e-12) else None


class Grid:
    """All combinations of the axes' values, in row-major order: the last axis changes fastest.

    Parameters
    ----------
    axes
        By name.

    Attributes
    ----------
    size : int
        Number of points.
    """

    def __init__(self, axes: Mapping[str, Axis]):
        self.axes = dict(axes)
        self.size = math.prod(axis.count for axis in self.axes.values())

    def __getitem__(self, index: int) -> ParameterSet:
        values: ParameterSet = {}
        for name, axis in reversed(self.axes.items()):
            index, i = divmod(index, axis.count)
            values[name] = axis[i]
        return {name: values[name] for name in self.axes}

    def index(self, parameters: ParameterSet) -> int | None:
        """Index of a point; none if it is not of the grid."""
        index = 0
        for name, axis in self.axes.items():
            i = axis.index(parameters[name])
            if i is None:
                return None
            index = index * axis.count + i
        return index

    @classmethod
    def of(cls, space: ParameterSpace) -> "Grid | None":
        """All sets of a space; none if they are without number."""
        axes = {}
        for name, p in space.parameters.items():
            if isinstance(p, Float):
                return None
            axes[name] = (
                Axis(p, len(p.choices), choices=p.choices)
                if isinstance(p, Categorical)
                else Axis(p, int(p.high - p.low) + 1, p.low, 1.0)
            )
        return cls(axes)


def make_grid(space: ParameterSpace, grid: Mapping[str, Span | Sequence[Value]]) -> Grid:
    """Make a grid from its settings, which have no mistakes."""
    return Grid({name: _axis(p, grid.get(name)) for name, p in space.parameters.items()})


def _axis(parameter: Float | Integer | Categorical, given: Span | Sequence[Value] | None) -> Axis:
    if isinstance(parameter, Categorical):
        return _choices(parameter, parameter.choices if given is None else given)
    if given is None:
        raise ValueError("is missing; give [first, step, count] or {low, high, count}")
    axis = _span(parameter, given) if isinstance(given, Span) else _steps(parameter, given)
    for end in (axis[0], axis[axis.count - 1]):
        if not parameter.contains(end):
            raise ValueError(f"{end:g} is outside {describe(parameter)}")
    return axis


def _choices(parameter: Categorical, given: Span | Sequence[Value]) -> Axis:
    if isinstance(given, Span) or not given:
        raise ValueError("give a list of its choices")
    for choice in given:
        if not parameter.contains(choice):
            raise ValueError(f"{choice!r} is not one of {describe(parameter)}")
    if len(set(map(repr, given))) < len(given):
        raise ValueError("choices repeat themselves")
    return Axis(parameter, len(given), choices=tuple(given))


def _span(parameter: Float | Integer, given: Span) -> Axis:
    low, high, count = given.low, given.high, given.count
    if low > high or (count > 1 and low == high):
        raise ValueError(f"low ({low:g}) must be less than high ({high:g})")
    if isinstance(parameter, Integer) and count > high - low + 1:
        raise ValueError(f"there are no {count} whole numbers from {low:g} to {high:g}")
    if parameter.log:
        if low <= 0:
            raise ValueError(f"a log scale needs low ({low:g}) above 0")
        low, high = math.log(low), math.log(high)
    return Axis(parameter, count, low, (high - low) / max(count - 1, 1), parameter.log)


def _steps(parameter: Float | Integer, given: Sequence[Value]) -> Axis:
    if len(given) != 3 or any(isinstance(v, bool | str) for v in given):
        raise ValueError("give [first, step, count], three numbers, or {low, high, count}")
    first, step, count = map(float, given)
    if not (count >= 1 and count.is_integer()):
        raise ValueError("count, the last number, must be a whole one of at least 1")
    if step == 0 and count > 1:
        raise ValueError("a step of 0 gives the same value again and again")
    if isinstance(parameter, Integer) and not (first.is_integer() and step.is_integer()):
        raise ValueError("first and step must be whole numbers, as the parameter is")
    return Axis(parameter, int(count), first, step)


def optuna_class(name: str) -> type[Any]:
    """Class of an Optuna sampler.

    Parameters
    ----------
    name
        One of `OPTUNA`, or ``package.module:Class``.

    Raises
    ------
    SamplerError
        Naming the nearest sampler there is, or what to install.
    """
    if name in NEEDS and find_spec(NEEDS[name]) is None:
        raise SamplerError(
            f"{name} needs the package {NEEDS[name]}: pip install 'adaptune[{name}]'"
        )
    path = OPTUNA.get(name, name)
    if ":" not in path:
        raise SamplerError(
            f"there is no sampler {name!r}: {nearest(name, NAMES)} (another one of Optuna's kind "
            f"is package.module:Class)"
        )
    from optuna.samplers import BaseSampler

    module, _, attribute = path.partition(":")
    try:
        found = getattr(import_module(module), attribute)
    except (ImportError, ValueError) as error:
        raise SamplerError(
            f"{name}: cannot import {module} ({error}); install it, or name its folder in "
            f"PYTHONPATH"
        ) from error
    except AttributeError as error:
        raise SamplerError(f"{name}: {module} has no {attribute or 'class'}") from error
    if not (isinstance(found, type) and issubclass(found, BaseSampler)):
        raise SamplerError(f"{name}: is not a class derived from optuna.samplers.BaseSampler")
    return found


def optuna_sampler(name: str, settings: Mapping[str, Any], seed: int) -> Any:
    """Make an Optuna sampler.

    Parameters
    ----------
    name
        One of `OPTUNA`, or ``package.module:Class``.
    settings
        Keywords of the class.
    seed
        Passed on if the class takes one.

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
        warnings.simplefilter("ignore")  # of what is experimental, or about to be renamed
        try:
            return cls(**seeded, **settings)
        except Exception as error:
            raise SamplerError(f"{name} does not take its settings: {error}") from error


def check_sampler(
    name: str, settings: Mapping[str, Any], space: ParameterSpace, budgeted: bool
) -> Iterable[Problem]:
    """Find what only the sampler and the parameters can tell.

    Parameters
    ----------
    name
        Name of the sampler.
    settings
        Its settings, which `SETTINGS` has found in order where it is one of ours.
    space
        The parameters.
    budgeted
        Whether the search is told when to stop.

    Yields
    ------
    tuple
        The path to a mistake below the settings (empty: of the settings as a whole), and what it
        is.
    """
    if name == "annealing":
        yield from _check_steps(AnnealingSettings.model_validate(settings).steps, space)
    elif name in ("grid", "random"):
        axes = RandomSettings.model_validate(settings).grid
        if axes is not None:
            yield from _check_grid(name, axes, space, budgeted)
    elif name != "sobol":
        elsewhere = {"seed": "seed", "n_startup_trials": "initial", "constraints_func": "limits"}
        for key, told in elsewhere.items():
            if key in settings:
                yield (key,), f"is told by offline.{told}"
                return
        try:
            optuna_sampler(name, settings, 0)
        except SamplerError as error:
            key, _, rest = str(error).partition(": ")
            yield ((key,), rest) if key in settings else ((), str(error))
        numbers = [p for p in space.parameters.values() if not isinstance(p, Categorical)]
        if name == "cmaes" and not numbers:
            yield (), "cmaes searches among numbers, and all parameters are categories"


def _check_steps(steps: Mapping[str, Step], space: ParameterSpace) -> Iterable[Problem]:
    for name, step in steps.items():
        key = ("steps", name)
        parameter = space.parameters.get(name)
        if parameter is None:
            help_ = nearest(name, space.names)
            yield key, f"no parameter {name!r} is tuned: {help_}"
            continue
        allowed: tuple[str, ...] = ("mu", "sigma")
        if isinstance(parameter, Categorical):
            allowed = ("change",)
        elif isinstance(parameter, Integer) and not parameter.log:
            allowed = ("delta_max",)
        given = step.model_dump(exclude_none=True)
        for setting in given:
            if setting not in allowed:
                kind = "log " * getattr(parameter, "log", False) + parameter.type
                yield (*key, setting), f"steps of a {kind} are told by {' and '.join(allowed)}"
        still = {k: v for k, v in given.items() if k in allowed}
        if still and not any(still.values()) and (allowed[0] != "mu" or "sigma" in still):
            named = " and ".join(f"{k} {v:g}" for k, v in still.items())
            yield key, f"never moves with {named}"


def _check_grid(
    sampler: str,
    axes: Mapping[str, Span | Sequence[Value]],
    space: ParameterSpace,
    budgeted: bool,
) -> Iterable[Problem]:
    for name in axes:
        if name not in space.names:
            help_ = nearest(name, space.names)
            yield ("grid", name), f"no parameter {name!r} is tuned: {help_}"
            return
    made = {}
    for name, parameter in space.parameters.items():
        try:
            made[name] = _axis(parameter, axes.get(name))
        except ValueError as error:
            yield ("grid", name), str(error)
    if len(made) < len(space):
        return
    grid = Grid(made)
    if sampler == "grid" and not budgeted and grid.size > MAX_GRID:
        yield (
            ("grid",),
            f"has {grid.size:,} points, and nothing says when to stop; give offline.trials, hours, "
            f"stagnation or target, or a coarser grid (up to {MAX_GRID:,} points)",
        )
    elif grid.size >= 2**62:
        yield ("grid",), "has more points than can be numbered; give a coarser one"


SETTINGS: dict[str, type[BaseModel]] = {
    "annealing": AnnealingSettings,
    "grid": GridSettings,
    "random": RandomSettings,
    "sobol": type("SobolSettings", (_Settings,), {"__doc__": "There is nothing to set."}),
}
"""Of our own samplers."""
