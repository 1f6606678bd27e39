"""The configuration of a study with the settings of the offline stage."""

import inspect
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from adaptune._system.strict import ConfigurationError, Plugins, StrictModel, validated
from adaptune.errors import AdaptuneError, Finding, nearest
from adaptune.odometry.registry import PROGRAMS
from adaptune.space import (
    Categorical,
    Float,
    Integer,
    Parameter,
    ParameterSet,
    ParameterSpace,
    Value,
    describe,
)
from adaptune.study.config import StudyConfig
from adaptune.study.portfolios import portfolio_sets
from adaptune.study.study import CONFIGURATION, Study

OPTUNA = {"tpe": "optuna.samplers:TPESampler"}
"""Optuna's samplers that have a name; their settings are the keywords of the class."""
NAMES = ("annealing", "grid", "random", *OPTUNA)


class SamplerError(AdaptuneError):
    """A sampler that cannot be used."""


class Step(StrictModel):
    """How far a step of annealing moves a parameter; see ``docs/reference-study.md``."""

    mu: float | None = None
    sigma: float | None = Field(None, ge=0)
    delta_max: int | None = Field(None, ge=0, le=2**53)
    change: float | None = Field(None, ge=0, le=1)
    # Bounds of the walk, within the parameter's range.
    low: int | float | None = None
    high: int | float | None = None


class AnnealingSettings(StrictModel):
    """Settings of simulated annealing, named as in RUSTLE; see ``docs/reference-study.md``."""

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

    def mistakes(self, space: ParameterSpace) -> Iterable[Finding]:
        """Find what does not fit the tuned parameters."""
        start = self.start or {}
        yield from _untuned("start", start, space)
        yield from _untuned("steps", self.steps, space)
        for key, parameter in space.parameters.items():
            if key in start:
                yield from _check_start(key, parameter, start[key], self.steps.get(key))
            if key in self.steps:
                yield from _check_step(key, parameter, self.steps[key])


MOST_VALUES = 100_000
"""Of one parameter in a grid."""


class Span(StrictModel):
    """`count` values from `low` to `high`, evenly in ratio where the parameter's scale is log."""

    low: float
    high: float
    count: int = Field(ge=1, le=MOST_VALUES)


class GridSettings(StrictModel):
    """Settings of `grid`."""

    # For every number ``[first, step, count]`` or a `Span`; for categories the choices to try, by
    # default all.
    grid: dict[str, Span | tuple[Value, ...]] | None = None

    def mistakes(self, space: ParameterSpace) -> Iterable[Finding]:
        """Find what does not fit the tuned parameters."""
        return check_grid(self.grid or {}, space)


class RandomSettings(GridSettings):
    """Settings of `random`, which draws the points of a grid, if any, without repetition."""

    def mistakes(self, space: ParameterSpace) -> Iterable[Finding]:
        """See `GridSettings`."""
        return () if self.grid is None else super().mistakes(space)


def optuna_class(name: str) -> type[Any]:
    """Class of an Optuna sampler; a SamplerError names the nearest one, or the mistake."""
    if name not in OPTUNA and ":" not in name:
        raise SamplerError(
            f"there is no sampler {name!r}: {nearest(name, NAMES)} (another Optuna sampler is "
            f"package.module:Class)"
        )
    from optuna.samplers import BaseSampler

    classes = Plugins("sampler", OPTUNA, SamplerError)
    return classes.derived(name, BaseSampler, "optuna.samplers.BaseSampler")


def optuna_sampler(name: str, settings: Mapping[str, Any], seed: int) -> Any:
    """Make an Optuna sampler; there is a SamplerError if it does not take these settings."""
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


SETTINGS: dict[str, type[AnnealingSettings | GridSettings]] = {
    "annealing": AnnealingSettings,
    "grid": GridSettings,
    "random": RandomSettings,
}
"""Settings of adaptune's own samplers."""


class Grid:
    """All combinations of the axes' values, in row-major order: the last axis changes fastest."""

    def __init__(self, axes: Mapping[str, Sequence[Value]]):
        self.axes = dict(axes)
        self._shape = tuple(map(len, self.axes.values()))
        self.size = math.prod(self._shape)  # number of points

    def __getitem__(self, index: int) -> ParameterSet:
        at = map(int, np.unravel_index(index, self._shape))
        return {name: axis[i] for (name, axis), i in zip(self.axes.items(), at, strict=True)}

    def index(self, parameters: ParameterSet) -> int | None:
        """Index of a point, up to rounding; None if it is not on the grid."""
        at = [
            next((i for i, value in enumerate(axis) if _alike(value, parameters[name])), -1)
            for name, axis in self.axes.items()
        ]
        return None if -1 in at else int(np.ravel_multi_index(at, self._shape))

    @classmethod
    def of(cls, space: ParameterSpace) -> "Grid | None":
        """All sets of a space; None if there are infinitely many."""
        axes: dict[str, Sequence[Value]] = {}
        for name, p in space.parameters.items():
            if isinstance(p, Float):
                return None
            if isinstance(p, Categorical):
                axes[name] = p.choices
            else:
                axes[name] = range(int(p.low), int(p.high) + 1)
        return cls(axes)


def _alike(one: Value, other: Value) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
    return type(one) is type(other) and one == other


def make_grid(space: ParameterSpace, grid: Mapping[str, Span | Sequence[Value]]) -> Grid:
    """Make a grid from its settings, which have no mistakes."""
    return Grid({name: _axis(p, grid.get(name)) for name, p in space.parameters.items()})


def _axis(parameter: Parameter, given: Span | Sequence[Value] | None) -> Sequence[Value]:
    """The values of a parameter; a ValueError says what is wrong with them."""
    if isinstance(parameter, Categorical):
        return _choices(parameter, parameter.choices if given is None else given)
    if given is None:
        raise ValueError("is missing; give [first, step, count] or {low, high, count}")
    numbers = _span(parameter, given) if isinstance(given, Span) else _steps(parameter, given)
    whole = isinstance(parameter, Integer)
    values: list[Value] = [round(x) if whole else _within(parameter, x) for x in numbers]
    for end in (values[0], values[-1]):
        if not parameter.contains(end):
            raise ValueError(f"{end:g} is outside {describe(parameter)}")
    return values


def _within(parameter: Float | Integer, x: float) -> float:
    """The bound of a range where rounding has missed it, or the number itself."""
    bounds = (parameter.low, parameter.high)
    return next((b for b in bounds if math.isclose(x, b, abs_tol=1e-12)), x)


def _choices(parameter: Categorical, given: Span | Sequence[Value]) -> Sequence[Value]:
    if isinstance(given, Span) or not given:
        raise ValueError("give a list of its choices")
    for choice in given:
        if not parameter.contains(choice):
            raise ValueError(f"{choice!r} is not one of {describe(parameter)}")
    if len(set(map(repr, given))) < len(given):
        raise ValueError("choices repeat themselves")
    return given


def _span(parameter: Float | Integer, given: Span) -> list[float]:
    low, high, count = given.low, given.high, given.count
    if low > high or (count > 1 and low == high):
        raise ValueError(f"low ({low:g}) must be less than high ({high:g})")
    if isinstance(parameter, Integer) and count > high - low + 1:
        raise ValueError(f"there are no {count} whole numbers from {low:g} to {high:g}")
    if parameter.log and low <= 0:
        raise ValueError(f"a log scale needs low ({low:g}) above 0")
    if parameter.log:
        low, high = math.log(low), math.log(high)
    step = (high - low) / max(count - 1, 1)
    numbers = [low + i * step for i in range(count)]
    return [math.exp(x) for x in numbers] if parameter.log else numbers


def _steps(parameter: Float | Integer, given: Sequence[Value]) -> list[float]:
    if len(given) != 3 or any(isinstance(v, bool | str) for v in given):
        raise ValueError("give [first, step, count], three numbers, or {low, high, count}")
    first, step, count = map(float, given)
    if not (1 <= count <= MOST_VALUES and count.is_integer()):
        raise ValueError(f"count, the last number, must be a whole one from 1 to {MOST_VALUES:,}")
    if step == 0 and count > 1:
        raise ValueError("a step of 0 gives the same value again and again")
    if isinstance(parameter, Integer) and not (first.is_integer() and step.is_integer()):
        raise ValueError("first and step must be whole numbers, as the parameter is")
    return [first + i * step for i in range(int(count))]


def _untuned(key: str, names: Iterable[str], space: ParameterSpace) -> Iterable[Finding]:
    for name in names:
        if name not in space.names:
            help_ = nearest(name, space.names)
            yield Finding((key, name), f"no parameter {name!r} is tuned: {help_}")


def check_grid(
    axes: Mapping[str, Span | Sequence[Value]], space: ParameterSpace
) -> Iterable[Finding]:
    """Find mistakes in a grid; their keys begin below the sampler's settings."""
    if untuned := list(_untuned("grid", axes, space)):
        yield from untuned
        return
    size = 1
    for name, parameter in space.parameters.items():
        try:
            size *= len(_axis(parameter, axes.get(name)))
        except ValueError as error:
            yield Finding(("grid", name), str(error))
    if size >= 2**63:  # `random` draws the numbers of points
        yield Finding(("grid",), "has more points than can be numbered; give a coarser one")


def distribution(parameter: Parameter) -> Any:
    """A parameter as Optuna describes it."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(parameter, Categorical):
        return CategoricalDistribution(parameter.choices)
    if isinstance(parameter, Integer):
        return IntDistribution(parameter.low, parameter.high, log=parameter.log)
    return FloatDistribution(parameter.low, parameter.high, log=parameter.log)


_NOT_SET = {
    "seed": "is set by offline.seed",
    "n_startup_trials": "is set by offline.initial",
    "constraints_func": "is a function, which a study cannot give; leave it out",
}
"""Settings of Optuna's samplers that a study does not have, and why."""


def _check_optuna(name: str, given: Mapping[str, Any]) -> Iterable[Finding]:
    """Find mistakes in the name of an Optuna sampler, and in its settings."""
    key = "sampler_settings"
    try:
        optuna_class(name)
    except SamplerError as error:
        yield Finding(("sampler",), str(error))
        return
    if taken := next((setting for setting in _NOT_SET if setting in given), None):
        yield Finding((key, taken), _NOT_SET[taken])
        return
    try:
        optuna_sampler(name, given, 0)
    except SamplerError as error:
        setting, _, rest = str(error).partition(": ")
        yield Finding((key, setting), rest) if setting in given else Finding((key,), str(error))


def _check_step(name: str, parameter: Parameter, step: Step) -> Iterable[Finding]:
    key, given = ("steps", name), step.model_dump(exclude_none=True)
    allowed: tuple[str, ...] = ("change",)
    if not isinstance(parameter, Categorical):
        linear = isinstance(parameter, Integer) and not parameter.log
        allowed = (*(("delta_max",) if linear else ("mu", "sigma")), "low", "high")
    for setting in given:
        if setting not in allowed:
            kind = "log " * getattr(parameter, "log", False) + parameter.type
            message = f"steps of a {kind} are set by {', '.join(allowed)} only"
            yield Finding((*key, setting), message)
    if not isinstance(parameter, Categorical):
        low, high = box = _box(parameter, step)
        if not (low < high and all(map(parameter.contains, box))):
            message = f"the walk's low and high must lie in {describe(parameter)}, low below high"
            yield Finding(key, message)


def _check_start(
    name: str, parameter: Parameter, value: float, step: Step | None
) -> Iterable[Finding]:
    if isinstance(parameter, Categorical):
        help_ = "is a category, which starts at the baseline; leave it out"
        yield Finding(("start", name), help_)
        return
    low, high = _box(parameter, step or Step())
    if not (parameter.contains(value) and low <= value <= high):
        what = "a whole number" if isinstance(parameter, Integer) else "a number"
        yield Finding(("start", name), f"give {what} from {low:g} to {high:g}, not {value!r}")


def _box(parameter: Float | Integer, step: Step) -> tuple[float, float]:
    """Bounds of the walk."""
    low, high = step.low, step.high
    return parameter.low if low is None else low, parameter.high if high is None else high


Metric = Literal["rte", "kitti", "rpe", "ape", "ms_per_scan", "cpu"]
"""What a trial can be judged by; ``docs/reference-study.md`` explains each."""
TIMED = ("ms_per_scan", "cpu")
"""Metrics that differ from run to run and from machine to machine."""
_Weighted = Annotated[dict[Metric, Annotated[float, Field(gt=0, le=1e9)]], Field(min_length=1)]


def _weighted(given: Any) -> Any:
    """Write a metric as a weighted sum."""
    return {given: 1.0} if isinstance(given, str) else given


def _portfolios(given: Any) -> Any:
    return {} if given == "none" else given


TRIALS, INITIAL = 64, 0.25
"""Trials of a search without a budget, and the share of all that are not proposed by results."""


class OfflineConfig(StrictModel):
    """How to search for parameter sets; ``docs/reference-study.md`` describes every key."""

    sampler: str = "tpe"
    sampler_settings: dict[str, Any] = Field(default_factory=dict)
    trials: int | None = Field(None, ge=1, le=10**6)
    hours: float | None = Field(None, gt=0, le=1e5)
    stagnation: int | None = Field(None, ge=1, le=10**6)
    initial: int | None = Field(None, ge=1, le=10_000)
    batch: int = Field(8, ge=1, le=1000)
    seed: int = Field(0, ge=0, lt=2**32)
    workers: int | None = Field(None, ge=1, le=256)
    objective: Annotated[_Weighted, BeforeValidator(_weighted)] = Field({"rte": 1.0})
    # Segments of all training sequences together that are driven by every set, four of each at
    # least; where sequences are short, all of them are driven.
    segments: Annotated[int, Field(ge=1, le=10_000)] | Literal["all"] = 12
    repeats: int = Field(1, ge=1, le=100)
    baseline_runs: int | None = Field(None, ge=1, le=1000)
    # Portfolios that the search begins with, and the digest of each.
    portfolio: Annotated[dict[str, str], BeforeValidator(_portfolios)] = Field(default_factory=dict)

    @property
    def most_trials(self) -> int | None:
        """Number of trials after which the search stops; None if another budget stops it."""
        if self.trials or self.hours or self.stagnation or self.sampler == "grid":
            return self.trials
        return TRIALS

    @property
    def n_initial(self) -> int:
        """Trials with which a sampler that learns begins: a share of all, if not set."""
        share = round(INITIAL * (self.most_trials or TRIALS))
        return self.initial or max(self.batch, share)

    def mistakes(self, space: ParameterSpace | None) -> Iterable[Finding]:
        """Find mistakes in the sampler and its settings."""
        n = 1 if space is None else len(space.baselines)
        if n > 1 and (self.sampler not in ("tpe", "random") or "grid" in self.sampler_settings):
            message = "with several odometries, choose tpe or random, without a grid"
            yield Finding(("sampler",), message)
        if self.trials is not None and self.trials < n:
            message = f"{n} odometries need {n} trials at least, to try the parameters of each"
            yield Finding(("trials",), message)
        if self.sampler in SETTINGS:
            found: list[Finding] = []
            own = validated(SETTINGS[self.sampler], self.sampler_settings, (), found)
            if own is not None and space is not None:
                found += own.mistakes(space)
            yield from (mistake.below(("sampler_settings",)) for mistake in found)
        elif self.sampler != "tpe" or self.sampler_settings:  # to import Optuna takes long
            yield from _check_optuna(self.sampler, self.sampler_settings)


_SEARCH = (
    *("sampler", "sampler_settings", "initial", "batch", "seed"),
    *("objective", "segments", "repeats", "baseline_runs", "portfolio"),
)
"""Settings by which a search differs from another."""


class OfflineStudyConfig(StudyConfig):
    """The whole YAML of a study."""

    offline: OfflineConfig = OfflineConfig()

    @property
    def segments(self) -> int | None:
        """Segments of each training sequence that are driven; None for the whole of it.

        A program costs too much to start anew, and some metrics judge whole trajectories.
        """
        n, whole = self.offline.segments, {"kitti", "ape"} & set(self.offline.objective)
        if n == "all" or whole or any(one.name in PROGRAMS for one in self.odometries.values()):
            return None
        return max(4, math.ceil(n / len(self.training)))

    def mistakes(self, space: ParameterSpace | None) -> Iterable[Finding]:
        """See `StudyConfig.mistakes`."""
        yield from (mistake.below(("offline",)) for mistake in self.offline.mistakes(space))
        if space is not None:
            try:
                portfolio_sets(self, space)
            except AdaptuneError as error:
                yield Finding(("offline", "portfolio"), str(error))

    @property
    def portfolios(self) -> Mapping[str, str]:
        """See `StudyConfig.portfolios`; neither a grid nor random search begins with any."""
        return {} if self.offline.sampler in ("grid", "random") else self.offline.portfolio

    def resolved(self) -> dict[str, Any]:
        """See `StudyConfig.resolved`."""
        resolved, offline = super().resolved(), self.offline
        if settings := SETTINGS.get(offline.sampler):
            given = settings.model_validate(offline.sampler_settings)
            whole = given.model_dump(mode="json", exclude_none=True)
            resolved["offline"]["sampler_settings"] = whole
        return resolved

    @property
    def search_inputs(self) -> dict[str, Any]:
        """What makes the trials of a study those that they are: another search has others."""
        offline = self.resolved()["offline"] | {"segments": self.segments or "all"}
        return {key: value for key in _SEARCH if (value := offline.get(key))}


OfflineStudy = Study[OfflineStudyConfig]
"""A study with the settings of the offline stage."""


def load_study(
    study: Path | str | Mapping[str, Any],
    overrides: Sequence[str] = (),
    folder: Path | None = None,
    needed: bool = True,
) -> OfflineStudy:
    """Read and check a whole study, see `adaptune.study.loading.read_study`.

    It is a YAML file, its data, or the folder of a study that has begun. If nothing is to run, the
    odometry is not `needed`: what a folder holds is read without a class that is not here.
    """
    from adaptune.study.loading import read_study  # which opens recordings

    given = Path(study) if isinstance(study, str) else study
    if isinstance(given, Path) and not given.exists():
        help_ = "give the YAML of a study, or the folder of one that has begun"
        raise ConfigurationError(f"{given}: there is no such file or folder; {help_}")
    if isinstance(given, Path) and given.is_dir():
        if not (given / CONFIGURATION).exists():
            raise ConfigurationError(f"{given}: is no study's folder: there is no study.yaml in it")
        given, folder = given / CONFIGURATION, folder or given
    return read_study(given, OfflineStudyConfig, overrides, folder, needed)
