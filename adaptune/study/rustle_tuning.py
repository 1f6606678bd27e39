"""Searches for parameters in RUSTLE's tunings, as settings of the offline stage."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from adaptune.odometry.base import OdometryError
from adaptune.odometry.template import Template
from adaptune.plain_words import Key
from adaptune.study.rustle_files import Annealing, Number, RustleFile, Tuning

MOST_POINTS = 10**6
"""Trials of a random search over a grid, and points on an axis."""
_ALPHA = 0.95
"""What RUSTLE's exponential cooling multiplies the temperature by."""

Search = tuple[dict[str, Any], dict[str, Any]]
"""The parameters, and the settings of the search."""


def search_of(file: RustleFile, tuning: Tuning, template: Template, notes: list[str]) -> Search:
    """Make the parameters and the search of a tuning.

    Parameters
    ----------
    file, tuning
        The tuning, and the file that holds it.
    template
        The system's parameter file, which has the types and the defaults.
    notes
        Receives what has no counterpart.

    Raises
    ------
    RustleError
        It names the file, the line and the key.
    """
    if tuning.tuning_algo == "simulated_annealing":
        return _annealing(file, tuning, template, notes)
    return _grid(file, tuning, template, notes)


def range_of(low: Number, high: Number, baseline: Number) -> dict[str, Any]:
    """A parameter of a study; it is a whole number if all three are."""
    whole = all(isinstance(value, int) for value in (low, high, baseline))
    ends = {"low": low, "high": high, "baseline": baseline}
    if whole:
        return {"type": "integer", **ends}
    return {"type": "float", **{key: float(value) for key, value in ends.items()}}


def _default(file: RustleFile, key: Key, template: Template) -> Any:
    """What a parameter is in the parameter file."""
    try:
        return template.value(str(key[-1]))
    except OdometryError as error:
        raise file.error(key, str(error)) from error


def _grid(file: RustleFile, tuning: Tuning, template: Template, notes: list[str]) -> Search:
    if not tuning.parameters:
        raise file.error(("parameters",), "give the parameters, each [first, step, number]")
    parameters: dict[str, Any] = {}
    axes: dict[str, Any] = {}
    size = 1
    for name, given in tuning.parameters.items():
        key = ("parameters", name)
        default = _default(file, key, template)
        if not isinstance(given, list):
            notes.append(f"{name} is fixed at {given!r}: write that into {template.path}.")
            continue
        if isinstance(default, str | bool):
            parameters[name], axes[name] = _categories(file, key, given, default), given
            size *= len(given)
        else:
            parameters[name] = _axis(file, key, given, default)
            axes[name] = given
            size *= given[2]
    if not parameters:
        raise file.error(("parameters",), "all of them are fixed; give one [first, step, number]")
    offline: dict[str, Any] = {"sampler": "grid", "sampler_settings": {"grid": axes}}
    if tuning.tuning_algo == "random_search":
        offline["sampler"] = "random"
        if tuning.time_limit is None:
            offline["trials"] = min(size + 1, MOST_POINTS)
    stopping = tuning.early_stopping
    if stopping is not None and tuning.time_limit is None:
        offline["stagnation"] = stopping.tolerance
        notes.append(
            "early_stopping.delta has no counterpart: any better trial counts as a new best."
        )
    elif stopping is not None:
        notes.append("early_stopping has no effect in RUSTLE beside a time_limit, nor here.")
    return parameters, offline


def _categories(
    file: RustleFile, key: Key, given: list[Any], default: str | bool
) -> dict[str, Any]:
    if not given or any(type(value) is not type(default) for value in given):
        raise file.error(key, f"give a list of values like {default!r}")
    choices = given if default in given else [default, *given]
    if len(choices) < 2:
        raise file.error(key, "has one value; leave it out")
    return {"type": "categorical", "choices": choices, "baseline": default}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _axis(file: RustleFile, key: Key, given: list[Any], default: Any) -> dict[str, Any]:
    """A range that holds the grid's points and the default."""
    if not _is_number(default):
        raise file.error(key, f"is {default!r} in the parameter file, which cannot be tuned")
    form = "give [first, step, number]"
    if len(given) != 3 or not all(map(_is_number, given)) or not isinstance(given[2], int):
        raise file.error(key, f"{form}, not {given!r}")
    first, step, number = given
    if not 1 <= number <= MOST_POINTS or (step == 0 and number > 1):
        raise file.error(key, f"{form}, the number from 1 on and the step not 0")
    last = first + step * (number - 1)
    low, high = min(first, last, default), max(first, last, default)
    return range_of(low, high if high > low else low + (abs(step) or 1), default)


def _annealing(file: RustleFile, tuning: Tuning, template: Template, notes: list[str]) -> Search:
    given = tuning.tuning_settings
    if given is None:
        raise file.error(("tuning_settings",), "is missing")
    if not given.parameter_bounds:
        raise file.error(("tuning_settings", "parameter_bounds"), "names no parameter")
    walks = {
        name: _walk(file, ("tuning_settings", "parameter_bounds", name), bounds, given, template)
        for name, bounds in given.parameter_bounds.items()
    }
    notes += [
        f"The default of {name} lies outside of its bounds; the walk keeps to them."
        for name, walk in walks.items()
        if {"low", "high"} & set(walk.step)
    ]
    settings = _schedule(given, notes)
    settings["start"] = {name: walk.start for name, walk in walks.items()}
    settings["steps"] = {name: walk.step for name, walk in walks.items() if walk.step}
    offline: dict[str, Any] = {"sampler": "annealing", "sampler_settings": settings}
    offline |= {"initial": 1, "batch": 1, "seed": 0}
    if given.max_iterations is not None:
        offline["trials"] = given.max_iterations + 1  # and the baseline
    if tuning.early_stopping is not None:
        notes.append("early_stopping has no effect on annealing in RUSTLE, nor here.")
    notes.append("A step beyond a bound is reflected; RUSTLE cuts it off.")
    return {name: walk.parameter for name, walk in walks.items()}, offline


def _schedule(given: Annealing, notes: list[str]) -> dict[str, Any]:
    """Temperatures and triggers."""
    settings: dict[str, Any] = {"chains": 1, "energy_scale": 1.0}
    settings["initial_temperature"] = float(given.temperature.initial_value)
    settings["alpha"] = float(given.temperature.alpha or _ALPHA)
    if given.temperature.function in ("fast", "boltzman"):
        what = f"temperature.function {given.temperature.function} has no counterpart: adaptune"
        notes.append(f"{what} multiplies the temperature by alpha after every step.")
    heats, stalls = given.reanneal, given.halting_conditions
    counts = {
        "reanneal_fixed": heats.fixed,
        "reanneal_accepted": heats.accepted,
        "reanneal_best": heats.best,
        "stall_accepted": stalls.accepted,
        "stall_best": stalls.best,
    }
    return settings | {name: count for name, count in counts.items() if count}


class _Walk(NamedTuple):
    parameter: dict[str, Any]
    start: Number
    step: dict[str, Any]


def _walk(
    file: RustleFile, key: Key, bounds: Sequence[Number], given: Annealing, template: Template
) -> _Walk:
    default = _default(file, key, template)
    if not _is_number(default):
        raise file.error(key, f"is {default!r} in the parameter file, which cannot be tuned")
    first, low, high = bounds[:3]
    if not low <= first <= high or low == high:
        raise file.error(key, "give [first, low, high, ...], low below high and first in them")
    # A range must hold the default; the walk keeps RUSTLE's bounds.
    parameter = range_of(min(low, default), max(high, default), default)
    step = _step(file, key, bounds, parameter["type"], given)
    step |= {"low": low} if default < low else {}
    step |= {"high": high} if default > high else {}
    return _Walk(parameter, first, step)


def _step(
    file: RustleFile,
    key: Key,
    bounds: Sequence[Number],
    kind: str,
    given: Annealing,
) -> dict[str, Any]:
    """A step of its own, or the one of all parameters."""
    own, usual = bounds[3:], given.perturbation_functions
    if kind == "integer":
        if len(own) > 1 or any(not isinstance(value, int) for value in own):
            raise file.error(key, "a whole number has [first, low, high, longest step]")
        longest = own[0] if own else usual.integer_delta_max
        return {} if longest is None else {"delta_max": longest}
    if len(own) == 1 or any(value < 0 for value in own[1:]):
        raise file.error(key, "a real number has [first, low, high, mean, standard deviation]")
    mu, sigma = own or (usual.float_mean, usual.float_std_dev)
    step = {"mu": mu, "sigma": sigma}
    return {name: float(value) for name, value in step.items() if value is not None}
