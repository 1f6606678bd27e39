"""Mistakes in the odometries of a study that only the odometries show."""

from collections.abc import Iterable, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

from adaptune.odometry.base import Description, NotInstalledError, OdometryError
from adaptune.odometry.declaration import declare
from adaptune.odometry.registry import PROGRAMS, is_user_class, odometry_class, where
from adaptune.plain_words import Key
from adaptune.pooled_space import ODOMETRY, PooledSpace
from adaptune.space import Categorical, Float, Integer, ParameterSpace, describe, nearest
from adaptune.study.config import OdometryConfig, StudyConfig
from adaptune.study.mistakes import Mistake, validated
from adaptune.study.study import describe_odometry, tuned_space, whole_definition

_KINDS: dict[str, type[Float | Integer | Categorical]] = {
    "float": Float,
    "integer": Integer,
    "categorical": Categorical,
}


def check_odometries(data: Any, mistakes: list[Mistake], folder: Path) -> None:
    """Check each odometry by itself; make paths in its settings absolute.

    Parameters
    ----------
    data
        What stands under `odometry`: one, or a list of several.
    mistakes
        Receives what is wrong.
    folder
        Where relative paths begin.
    """
    if isinstance(data, dict):
        _check_odometry(data, ("odometry",), mistakes, folder)
    elif isinstance(data, list):
        for i, one in enumerate(data):
            given = {"name": one} if isinstance(one, str) else one
            if isinstance(given, dict):
                _check_odometry(given, ("odometry", i), mistakes, folder)


def check_together(config: StudyConfig) -> tuple[list[Mistake], ParameterSpace | None]:
    """Find what does not fit the other odometries, or the rest of the study.

    Returns
    -------
    mistakes : list of Mistake
    space : ParameterSpace, optional
        The parameters that are tuned; None if an odometry cannot be described.
    """
    given = config.odometry
    entries: dict[Key, OdometryConfig] = (
        {("odometry",): given}
        if isinstance(given, OdometryConfig)
        else {("odometry", i): one for i, one in enumerate(given)}
    )
    try:
        described = {key: describe_odometry(one) for key, one in entries.items()}
        spaces = {key: tuned_space(one, described[key]) for key, one in entries.items()}
    except OdometryError:
        return [], None
    mistakes = list(_check_each_once(entries, spaces))
    if len(entries) > 1:
        for key, about in described.items():
            if about.whole:
                message = f"{entries[key].name} runs whole recordings, and must be the only one"
                mistakes.append(Mistake((*key, "name"), message))
    for key, about in described.items():
        if about.needs_imu:
            mistakes += _check_imu(config, entries[key].name)
    labelled = {one.label or one.name: spaces[key] for key, one in entries.items()}
    space = PooledSpace(labelled) if len(entries) > 1 else next(iter(spaces.values()))
    if not mistakes:
        mistakes += _check_switching(config, list(described.values()), space)
        mistakes += _check_pins(config.online.pin, space)
    return mistakes, space


def _check_each_once(
    entries: Mapping[Key, OdometryConfig], spaces: Mapping[Key, ParameterSpace]
) -> Iterable[Mistake]:
    """Find odometries that would run the same sets twice, and labels that are given twice."""
    for (first, one), (key, other) in combinations(entries.items(), 2):
        settings, others = (declare(o.name, o.settings).settings for o in (one, other))
        alike = one.name == other.name and settings == others
        if alike and _overlap(spaces[first], spaces[key]):
            yield Mistake(
                key,
                f"{other.name} is there already (odometry.{first[-1]}) with the same settings, and "
                f"their parameters overlap, so sets would run twice; leave one out, or give it "
                f"other settings or ranges",
            )
        elif (one.label or one.name) == (other.label or other.name):
            yield Mistake(
                (*key, "label"),
                f"{one.label or one.name!r} is what odometry.{first[-1]} is called; give one of "
                f"the two a label of its own",
            )


def _overlap(one: ParameterSpace, other: ParameterSpace) -> bool:
    """Whether two spaces of the same odometry have a set in common."""
    return all(
        _meet(p, other.parameters[name])
        for name, p in one.parameters.items()
        if name in other.parameters
    )


def _meet(one: Any, other: Any) -> bool:
    if isinstance(one, Categorical) and isinstance(other, Categorical):
        return any(one.contains(choice) for choice in other.choices)
    if isinstance(one, Categorical) or isinstance(other, Categorical):
        return True
    return bool(one.low <= other.high and other.low <= one.high)


def _check_odometry(data: dict[str, Any], at: Key, mistakes: list[Mistake], folder: Path) -> None:
    """Check all that depends on the odometry; make paths in its settings absolute."""
    name = data.get("name")
    if not isinstance(name, str):
        return
    settings, key = data.get("settings") or {}, (*at, "settings")
    if not isinstance(settings, dict):
        return
    try:
        # A class of the user is imported in a process of its own.
        where(name) if is_user_class(name) else odometry_class(name)
    except OdometryError as error:
        mistakes.append(Mistake((*at, "name"), str(error)))
        return
    try:
        declared = declare(name, settings, folder)
        mistakes += (mistake.below(key) for mistake in declared.mistakes)
        if declared.settings is not None:
            data["settings"] = declared.settings.model_dump(mode="json", exclude_unset=True)
        if (described := declared.description) is None:
            return
        found: list[Mistake] = []
        _check_parameters(name, described.space, data.get("parameters"), found)
        mistakes += (mistake.below(at) for mistake in found)
        check = getattr(odometry_class(name), "check", None) if name in PROGRAMS else None
        if check is not None and isinstance(tuned := data.get("parameters"), dict):
            check(declared.settings, dict.fromkeys(tuned, 0))
    except NotInstalledError as error:
        mistakes.append(Mistake((*at, "name"), str(error)))
    except OdometryError as error:
        mistakes.append(Mistake((*at, "name") if is_user_class(name) else key, str(error)))


def _check_parameters(
    name: str, space: ParameterSpace | None, tuned: Any, mistakes: list[Mistake]
) -> None:
    if space is None and not tuned:
        message = f"define the parameters: a {name} does not know its own"
        mistakes.append(Mistake(("parameters",), message))
    for parameter, given in tuned.items() if isinstance(tuned, dict) else ():
        key = ("parameters", parameter)
        if space is not None and parameter not in space.names:
            mistakes.append(Mistake(key, _why_not_tuned(name, space, parameter)))
        elif isinstance(given, dict):
            whole = whole_definition(space, parameter, given)
            if str(whole.get("type")) not in _KINDS:
                mistakes.append(Mistake(key, f"give its type, one of {', '.join(_KINDS)}"))
            else:
                validated(_KINDS[whole["type"]], whole, key, mistakes)


def _why_not_tuned(name: str, space: ParameterSpace, parameter: Any) -> str:
    own: Any = None if is_user_class(name) or name in PROGRAMS else odometry_class(name)
    if own is not None and parameter in own.space.names:
        return f"{parameter} is fixed by settings; leave it out there to tune it"
    return f"{name} has no parameter {parameter!r}: {nearest(str(parameter), space.names)}"


def _check_imu(config: StudyConfig, odometry: str) -> Iterable[Mistake]:
    needs = f"{odometry} needs an IMU"
    for name, sequence in config.sequences.items():
        if sequence.imu is None:
            help_ = "name its topic and its place, imu: {topic: ..., extrinsic: ...}"
            yield Mistake(("sequences", name), f"{needs}; {help_}")
    for name, course in config.courses.items():
        if course.imu is None:
            yield Mistake(("courses", name), f"{needs}; simulate one, imu: 200")


def _check_set(at: Key, given: Mapping[str, Any], space: ParameterSpace) -> Iterable[Mistake]:
    """Find what is wrong with the names in a set that the study gives."""
    own = dict(given)
    if isinstance(space, PooledSpace):
        if ODOMETRY not in own:
            message = f"say which odometry it is for ({ODOMETRY}: {next(iter(space.spaces))})"
            yield Mistake(at, message)
            return
        if (label := own.pop(ODOMETRY)) not in space.spaces:
            message = f"there is no such odometry; {nearest(str(label), space.spaces)}"
            yield Mistake((*at, ODOMETRY), message)
            return
        space = space.spaces[label]
    for name in own:
        if name not in space.names:
            message = f"there is no such parameter; {nearest(name, space.names)}"
            yield Mistake((*at, name), message)


def _check_pins(pins: Mapping[str, Any], space: ParameterSpace) -> Iterable[Mistake]:
    """Find parameters that no odometry has, and values that none can have."""
    spaces = list(space.spaces.values()) if isinstance(space, PooledSpace) else [space]
    for name, value in pins.items():
        having = [one.parameters[name] for one in spaces if name in one.parameters]
        if not having:
            every = [known for one in spaces for known in one.names]
            message = f"there is no such parameter; {nearest(name, every)}"
            yield Mistake(("online", "pin", name), message)
        elif wrong := [one for one in having if not one.contains(value)]:
            message = f"{value!r} is outside {describe(wrong[0])}"
            yield Mistake(("online", "pin", name), message)


def _check_switching(
    config: StudyConfig, described: list[Description], space: ParameterSpace
) -> Iterable[Mistake]:
    online, key = config.online, ("online", "switching")
    for i, given in enumerate(online.switching.sets or ()):
        if isinstance(given, dict):
            yield from _check_set((*key, "sets", i), given, space)
    whole, names = any(one.whole for one in described), ", ".join(config.odometries)
    # A study's folder holds the defaults, too.
    if whole and online.rules and online.rules != type(online)().rules:
        message = f"{names} runs whole recordings and cannot adapt; leave this out"
        yield Mistake(("online", "rules"), message)
    live = len(described) == 1 and described[0].live
    if whole and online.switching.mechanism != "auto":
        message = f"{names} runs whole recordings and cannot change parameters; leave this out"
        yield Mistake((*key, "mechanism"), message)
    elif online.switching.mechanism == "live" and not live:
        message = f"{names} cannot change parameters between scans; choose auto, hand_over or bank"
        yield Mistake((*key, "mechanism"), message)
