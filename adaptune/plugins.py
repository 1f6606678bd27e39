"""Import an object by its name: a built-in one, one of another package, or ``module:attribute``."""

from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from adaptune.errors import AdaptuneError, nearest


class PluginError(AdaptuneError):
    """A name for which there is no object."""


def path_of(name: str, kind: str, ours: Mapping[str, str], group: str, sort: str) -> str:
    """Where an object is, as ``module:attribute``, without importing it.

    Parameters
    ----------
    name
        One of `ours`, one that an installed package announces in the entry-point group, or
        ``module:attribute``.
    kind
        Word for the object in messages, as "odometry".
    ours
        The built-in objects by name, as ``module:attribute``.
    group
        The entry-point group.
    sort
        Kind of Python object: ``Class``, or ``function``.
    """
    path = ours.get(name) or (name if ":" in name else None)
    if path is None:
        announced = {point.name: point.value for point in entry_points(group=group)}
        if name not in announced:
            help_ = f"{nearest(name, [*ours, *announced])} (a {sort.lower()} of your own is"
            raise PluginError(f"there is no {kind} {name!r}: {help_} module:{sort})")
        path = announced[name]
    module = path.partition(":")[0]
    if not all(map(str.isidentifier, module.split("."))):
        help_ = f"write it as Python imports it, as in my_package.my_module:{sort}"
        raise PluginError(f"{name}: {module!r} is not the name of a module; {help_}")
    return path


def load(name: str, path: str, sort: str) -> Any:
    """Import an object by its name from where it is, ``module:attribute``."""
    module, _, attribute = path.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except ImportError as error:
        help_ = "install it, or name its folder in PYTHONPATH"
        raise PluginError(f"{name}: cannot import {module} ({error}); {help_}") from error
    except AttributeError as error:
        raise PluginError(f"{name}: {module} has no {attribute or sort}") from error
