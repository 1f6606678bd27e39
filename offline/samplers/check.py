"""Mistakes in a sampler's settings that only the sampler and the parameters show."""

from collections.abc import Iterable, Mapping
from typing import Any

from adaptune import hosting
from adaptune.space import (
    Categorical,
    Float,
    Integer,
    ParameterSpace,
    describe,
    nearest,
)
from adaptune.study.mistakes import Mistake
from offline.samplers.grid import check_grid
from offline.samplers.settings import (
    SERVICE,
    SETTINGS,
    AnnealingSettings,
    RandomSettings,
    SamplerError,
    Step,
    is_user_sampler,
    optuna_class,
    optuna_sampler,
)

_ELSEWHERE = {"seed": "seed", "n_startup_trials": "initial", "constraints_func": "limits"}
"""Settings of Optuna's samplers that adaptune sets, and from which key."""
_BOX = ("low", "high")
_MOST = 100_000
"""Candidates, or members of a population: more of them take hours, or all memory."""


def check_class(name: str) -> None:
    """Refuse a name that leads to no Optuna sampler; the user's are imported elsewhere.

    Raises
    ------
    SamplerError
    """
    if not is_user_sampler(name):
        optuna_class(name)
        return
    try:
        hosting.server(SERVICE, name)
    except hosting.HostError as error:
        raise SamplerError(str(error)) from error


def check_sampler(
    name: str, settings: Mapping[str, Any], space: ParameterSpace | None, budgeted: bool
) -> Iterable[Mistake]:
    """Find mistakes in a sampler's settings, where `space` is None without the parameters.

    Yields
    ------
    Mistake
        Its key begins below the settings.
    """
    if name == "tpe" and not settings:
        return  # a look at Optuna would take long
    if name not in SETTINGS:
        yield from _check_optuna(name, settings, space)
    elif space is None:
        return
    elif name == "annealing":
        given = AnnealingSettings.model_validate(settings)
        for parameter, value in (given.start or {}).items():
            yield from _check_start(parameter, value, given.steps.get(parameter, Step()), space)
        for parameter, step in given.steps.items():
            yield from _check_step(parameter, step, space)
    elif name in ("grid", "random"):
        axes = RandomSettings.model_validate(settings).grid
        if axes is not None:
            yield from check_grid(axes, space, bounded=budgeted or name == "random")


def _check_optuna(
    name: str, settings: Mapping[str, Any], space: ParameterSpace | None
) -> Iterable[Mistake]:
    if taken := next((key for key in _ELSEWHERE if key in settings), None):
        yield Mistake((taken,), f"is set by offline.{_ELSEWHERE[taken]}")
        return
    for key, value in settings.items():
        if isinstance(value, int) and abs(value) > _MOST:
            yield Mistake((key,), f"give a number of at most {_MOST:,}, not {value}")
            return
    try:
        make = _make_elsewhere if is_user_sampler(name) else optuna_sampler
        make(name, settings, 0)
    except SamplerError as error:
        key, _, rest = str(error).partition(": ")
        yield Mistake((key,), rest) if key in settings else Mistake((), str(error))
    parameters = () if space is None else space.parameters.values()
    if name == "cmaes" and parameters and all(isinstance(p, Categorical) for p in parameters):
        yield Mistake((), "cmaes searches among numbers, and all parameters are categories")


def _check_step(name: str, step: Step, space: ParameterSpace) -> Iterable[Mistake]:
    key = ("steps", name)
    parameter = space.parameters.get(name)
    if parameter is None:
        yield Mistake(key, f"no parameter {name!r} is tuned: {nearest(name, space.names)}")
        return
    allowed = _allowed(parameter)
    given = step.model_dump(exclude_none=True)
    for setting in given:
        if setting not in allowed:
            kind = "log " * getattr(parameter, "log", False) + parameter.type
            message = f"steps of a {kind} are set by {_listed(allowed)}"
            yield Mistake((*key, setting), message)
    if not isinstance(parameter, Categorical):
        low, high = box = _box(parameter, step)
        if not (low < high and all(map(parameter.contains, box))):
            message = f"the walk's low and high must lie in {describe(parameter)}, low below high"
            yield Mistake(key, message)
    still = {k: v for k, v in given.items() if k in allowed and k not in _BOX}
    if still and not any(still.values()) and (allowed[0] != "mu" or "sigma" in still):
        named = " and ".join(f"{k} {v:g}" for k, v in still.items())
        yield Mistake(key, f"never moves with {named}")


def _check_start(name: str, value: float, step: Step, space: ParameterSpace) -> Iterable[Mistake]:
    key = ("start", name)
    parameter = space.parameters.get(name)
    if parameter is None:
        yield Mistake(key, f"no parameter {name!r} is tuned: {nearest(name, space.names)}")
    elif isinstance(parameter, Categorical):
        yield Mistake(key, "is a category, which starts at the baseline; leave it out")
    else:
        low, high = _box(parameter, step)
        if not (parameter.contains(value) and low <= value <= high):
            what = "a whole number" if isinstance(parameter, Integer) else "a number"
            yield Mistake(key, f"give {what} from {low:g} to {high:g}, not {value!r}")


def _box(parameter: Float | Integer, step: Step) -> tuple[float, float]:
    """Bounds of the walk."""
    low, high = step.low, step.high
    return parameter.low if low is None else low, parameter.high if high is None else high


def _allowed(parameter: Float | Integer | Categorical) -> tuple[str, ...]:
    if isinstance(parameter, Categorical):
        return ("change",)
    linear = isinstance(parameter, Integer) and not parameter.log
    return (*(("delta_max",) if linear else ("mu", "sigma")), *_BOX)


def _make_elsewhere(name: str, settings: Mapping[str, Any], seed: int) -> None:
    """Try whether a sampler of the user takes its settings.

    Raises
    ------
    SamplerError
    """
    seconds = hosting.IMPORT_SECONDS
    bounds = hosting.Bounds(seconds, late=f"it took longer than {seconds:g} s to begin")
    process = hosting.Hosted(SERVICE, name, "make", bounds)
    try:
        process.ask({"settings": dict(settings), "seed": seed})
    except hosting.HostError as error:
        raise SamplerError(str(error)) from error
    finally:
        process.close()


def _listed(words: tuple[str, ...]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
