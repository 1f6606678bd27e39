"""The odometries by name, imported when they are asked for."""

import inspect
import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, RootModel

from adaptune._system import processes
from adaptune._system.strict import Plugins, validated
from adaptune.errors import Finding, NotInstalledError, OdometryError, hidden
from adaptune.odometry import wire
from adaptune.odometry.base import Description, Odometry, ToolSettings
from adaptune.odometry.remote import SERVICE
from adaptune.odometry.template import Template
from adaptune.space import ParameterSet, ParameterSpace

ENTRY_POINTS = "adaptune.odometries"
"""Group in which other packages announce their odometries, each by its name."""

ODOMETRIES = {
    "ct_icp": "adaptune.odometry.evalio:CtIcp",
    "dlio": "adaptune.odometry.evalio:Dlio",
    "evalio_kiss_icp": "adaptune.odometry.evalio:KissIcp",
    "form": "adaptune.odometry.evalio:Form",
    "genz_icp": "adaptune.odometry.evalio:GenzIcp",
    "gicp": "adaptune.odometry.keyframe:KeyframeGicp",
    "kiss_icp": "adaptune.odometry.kiss_icp:Kiss",
    "lio_sam": "adaptune.odometry.evalio:LioSam",
    "loam": "adaptune.odometry.evalio:Loam",
    "mad_icp": "adaptune.odometry.evalio:MadIcp",
    "ndt": "adaptune.odometry.keyframe:KeyframeNdt",
    "rko_lio": "adaptune.odometry.rko_lio:RkoLio",
    "vgicp": "adaptune.odometry.keyframe:KeyframeVgicp",
}

PROGRAMS = {
    "command": "adaptune.odometry.program:Command",
    "docker_command": "adaptune.odometry.systems.programs:DockerCommand",
    "docker_process": "adaptune.odometry.systems.programs:DockerProcess",
    "process": "adaptune.odometry.remote:Process",
    "ros2": "adaptune.odometry.systems.ros2_system:Ros2",
    "rustle": "adaptune.odometry.systems.rustle:Rustle",
}
"""Programs of the user."""

ROS_SYSTEMS = ("ros2", "rustle")
CONTAINERS = ("docker_command", "docker_process", *ROS_SYSTEMS)
"""Those of them that run in containers, or may."""

PACKAGES = {"gicp": "small_gicp", "kiss_icp": "kiss-icp", "ndt": "open3d", "vgicp": "small_gicp"}
"""Packages that our odometries run on, where they are not named as the adapter's module is."""


ABSENT = set[str]()
"""Classes of users' that cannot be imported here, and of which only results are read."""


def is_user_class(name: str) -> bool:
    """Whether an odometry is a class that is not adaptune's: another package's, or the user's."""
    return name not in ODOMETRIES and name not in PROGRAMS


def classes() -> Plugins:
    """The classes of odometries."""
    return Plugins("odometry", ODOMETRIES | PROGRAMS, OdometryError, ENTRY_POINTS)


def odometry_class(name: str) -> type[Any]:
    """Class of an odometry, by its name as in a study; an `OdometryError` if there is none."""
    try:
        cls = classes().load(name)
    except OdometryError as error:
        if name in ODOMETRIES and isinstance(error.__cause__, ImportError):
            what = f"{name} cannot be imported ({error.__cause__})"
            help_ = hidden(error.__cause__) or f"run `pip install {PACKAGES.get(name, name)}`"
            raise NotInstalledError(f"{what}; {help_}") from error
        raise
    if name in PROGRAMS:
        return cls  # type: ignore[no-any-return]
    if not (isinstance(cls, type) and issubclass(cls, Odometry)):
        raise OdometryError(f"{name}: is not a class derived from adaptune.odometry.Odometry")
    for fault in _faults(cls):
        raise OdometryError(f"{name}: {fault}")
    return cls


def _faults(cls: type[Odometry]) -> Iterator[str]:
    """What keeps a class from being made, in the words of its author."""
    space: Any = getattr(cls, "space", None)
    if not isinstance(space, ParameterSpace):
        like = 'ParameterSpace({"x": Float(low=0.1, high=2.0, baseline=0.5)})'
        what = "missing" if space is None else f"a {type(space).__name__}"
        yield f"its `space` is {what}; write it as space = {like}"
    if lacking := sorted(cls.__abstractmethods__):
        yield f"the class lacks the method{'s' * (len(lacking) > 1)} {' and '.join(lacking)}"
    try:
        inspect.signature(cls).bind(None, None)
    except TypeError:
        yield (
            f"its __init__ takes {inspect.signature(cls)}; write __init__(self, parameters=None, "
            f"settings=None), and pass both on to super().__init__"
        )


def make_here(name: str, parameters: ParameterSet, settings: Any) -> tuple[Any, Description]:
    """Make an odometry in this process."""
    checked, described = declare_here(name, settings).sound(name)
    return odometry_class(name)(parameters, checked), described


class UserSettings(RootModel[dict[str, Any]]):
    """Checked settings of a class of the user, with nothing left to defaults."""

    model_config = ConfigDict(frozen=True)


@dataclass(frozen=True)
class Declaration:
    """An odometry with given settings."""

    settings: Any  # the checked settings; None if they have mistakes
    mistakes: list[Finding]
    # None if the odometry cannot be described without sound settings
    description: Description | None

    def sound(self, name: str) -> tuple[Any, Description]:
        """Settings and description; an `OdometryError` if the settings have mistakes."""
        if self.settings is None or self.description is None:
            said = "; ".join(map(str, self.mistakes))
            raise OdometryError(f"{name}: settings: {said}")
        return self.settings, self.description


def declare(name: str, settings: Any, folder: Path | None = None) -> Declaration:
    """Let an odometry check its settings, a mapping or a model, and describe itself.

    Relative paths in the settings begin at `folder`. There is an `OdometryError` if there is no
    such odometry, or it does not answer.
    """
    if not is_user_class(name):
        return declare_here(name, settings, folder)
    given = settings.model_dump(mode="json") if isinstance(settings, BaseModel) else settings
    if name in ABSENT:
        return Declaration(UserSettings(given), [], Description(None, live=False))
    answer = _ask(name, json.dumps(given, default=str), str(folder or ""))
    described = {key: answer[key] for key in Description._fields}
    complete = answer["settings"]
    return Declaration(
        None if complete is None else UserSettings(complete),
        [Finding(tuple(key), message) for key, message in answer["mistakes"]],
        Description(**described | {"space": ParameterSpace.load(answer["space"])}),
    )


def declare_here(name: str, settings: Any, folder: Path | None = None) -> Declaration:
    """Do `declare` in this process."""
    cls: Any = odometry_class(name)
    mistakes: list[Finding] = []
    context = None if folder is None else {"folder": folder}
    checked: Any = validated(cls.settings_type, settings, (), mistakes, context)
    if isinstance(checked, ToolSettings) and (template := checked.template):
        _check_whose(name, template, cls._under(template))
    describes = checked is not None or issubclass(cls, Odometry)
    return Declaration(checked, mistakes, cls.describe(checked) if describes else None)


def _check_whose(name: str, template: Template, under: str) -> None:
    """Refuse the parameter file of another odometry, which names more than what both have."""
    held = {path.rpartition(".")[2] for path in template.names if path.startswith(under)}
    there = dict[str, set[str]]()
    for other in ODOMETRIES:
        with suppress(OdometryError):  # one that is not installed
            there[other] = held.intersection(odometry_class(other).space.names)
    whose = max(there, key=lambda other: len(there[other]) * (there[other] > there[name]))
    if there[whose] > there[name]:
        what = f"{template.path}: holds {', '.join(sorted(there[whose] - there[name]))}"
        help_ = f"it is a file of {whose}; name that (--odometry {whose})"
        raise OdometryError(f"{what}, which {name} does not have: {help_}")


def forget_user_code() -> None:
    """Import it anew from here on: in one session, it may have been edited."""
    processes.forget_servers()
    _ask.cache_clear()


@cache
def _ask(name: str, settings: str, folder: str) -> dict[str, Any]:
    bounds = processes.Bounds(processes.IMPORT_SECONDS)
    process = processes.Conversation(processes.Forked(SERVICE, name, "describe", bounds))
    try:
        message = {"type": "describe", "settings": json.loads(settings), "folder": folder}
        return process.ask(message).header
    except processes.HostError as error:
        raise OdometryError(str(error)) from error
    finally:
        process.close()


# What runs in a process of its own for an odometry, see `adaptune._system.processes`.

load = odometry_class


def converse(name: str) -> processes.Answer:
    """Be an instance."""
    return wire.conversation(name, make_here)


def describe(name: str) -> processes.Answer:
    """Answer what `declare` asks."""

    def answer(message: processes.Message) -> dict[str, Any]:
        folder = message.header["folder"]
        declared = declare_here(name, message.header["settings"], Path(folder) if folder else None)
        description = declared.description
        assert description is not None  # it is a class
        return {
            **description._asdict(),
            **wire.about(description),
            "settings": declared.settings and declared.settings.model_dump(mode="json"),
            "mistakes": [[list(mistake.where), mistake.what] for mistake in declared.mistakes],
        }

    return answer
