"""What an odometry says of itself. A class of the user is asked in a process of its own."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, RootModel

from adaptune import hosting
from adaptune.odometry.base import Description, Odometry, OdometryError, WarmUp
from adaptune.odometry.isolation import SERVICE
from adaptune.odometry.registry import is_user_class, odometry_class
from adaptune.space import ParameterSpace
from adaptune.study.mistakes import Mistake, validated


class UserSettings(RootModel[dict[str, Any]]):
    """Checked settings of a class of the user, with nothing left to defaults."""

    model_config = ConfigDict(frozen=True)


@dataclass(frozen=True)
class Declaration:
    """An odometry with given settings.

    Attributes
    ----------
    settings : BaseModel or None
        The checked settings; None if they have mistakes.
    mistakes : list of Mistake
        Mistakes in the settings.
    description : Description or None
        None if the odometry cannot be described without sound settings.
    clean : bool
        Whether instances in one process know nothing of each other, see `Odometry`.
    module : str
        Module in which its class is written.
    """

    settings: Any
    mistakes: list[Mistake]
    description: Description | None
    clean: bool
    module: str

    def sound(self, name: str) -> tuple[Any, Description]:
        """Settings and description.

        Raises
        ------
        OdometryError
            If the settings have mistakes.
        """
        if self.settings is None or self.description is None:
            said = "; ".join(f"{'.'.join(map(str, m.key))}: {m.message}" for m in self.mistakes)
            raise OdometryError(f"{name}: settings: {said}")
        return self.settings, self.description


def declare(name: str, settings: Any, folder: Path | None = None) -> Declaration:
    """Let an odometry check its settings and describe itself.

    Parameters
    ----------
    name
        The odometry, see `adaptune.odometry.registry.odometry_class`.
    settings
        A mapping, or a model.
    folder
        Where relative paths in the settings begin.

    Raises
    ------
    OdometryError
        If there is no such odometry, or it does not answer.
    """
    if not is_user_class(name):
        return declare_here(name, settings, folder)
    given = settings.model_dump(mode="json") if isinstance(settings, BaseModel) else settings
    answer = _ask(name, json.dumps(given, default=str), str(folder or ""))
    space, warm_up = ParameterSpace.load(answer["space"]), WarmUp(*answer["warm_up"])
    complete = answer["settings"]
    return Declaration(
        None if complete is None else UserSettings(complete),
        [Mistake(tuple(key), message) for key, message in answer["mistakes"]],
        Description(space, answer["live"], answer["needs_imu"], warm_up, answer["whole"]),
        answer["clean"],
        answer["module"],
    )


def declare_here(name: str, settings: Any, folder: Path | None = None) -> Declaration:
    """Do `declare` in this process."""
    cls: Any = odometry_class(name)
    mistakes: list[Mistake] = []
    context = None if folder is None else {"folder": folder}
    found: Any = validated(cls.settings_type, settings, (), mistakes, context)
    is_class = issubclass(cls, Odometry)
    described = cls.describe(found) if is_class or found is not None else None
    return Declaration(found, mistakes, described, is_class and cls.clean, cls.__module__)


@cache
def _ask(name: str, settings: str, folder: str) -> dict[str, Any]:
    process = hosting.Hosted(SERVICE, name, "describe", hosting.Bounds(hosting.IMPORT_SECONDS))
    try:
        message = {"type": "describe", "settings": json.loads(settings), "folder": folder}
        return process.ask(message).header
    except hosting.HostError as error:
        raise OdometryError(str(error)) from error
    finally:
        process.close()
