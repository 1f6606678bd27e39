"""Errors that a user is meant to read."""

import difflib
import traceback
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from typing import Any


class AdaptuneError(Exception):
    """A mistake in the input, with a sentence that says what to do.

    The command line prints the sentence and exits with code 2. Modules derive their own class
    from it, and chain the cause.
    """


class OdometryError(AdaptuneError):
    """An odometry that cannot do what is asked of it."""


class UnavailableError(OdometryError):
    """What runs an odometry is gone, whatever its parameters: a trial says nothing then."""


class NotInstalledError(OdometryError):
    """An odometry whose package is not installed."""


def in_a_line(error: BaseException) -> str:
    """An exception in a line, with the place where it was raised; ours are told as they are."""
    if isinstance(error, AdaptuneError):
        return str(error)
    what = "".join(traceback.format_exception_only(error)).strip()
    raised = traceback.extract_tb(error.__traceback__)
    return f"{what} ({raised[-1].filename}, line {raised[-1].lineno})" if raised else what


def nearest(name: str, names: Iterable[str]) -> str:
    """The nearest valid name as half a sentence, or all valid names."""
    names = sorted(names)
    close = difflib.get_close_matches(name, names, n=1)
    if close:
        return f"did you mean {close[0]!r}?"
    return f"there is {', '.join(map(repr, names))}" if names else "there is none"


@cache
def import_extra(extra: str, *modules: str) -> tuple[Any, ...]:
    """Import modules of a package that one of adaptune's extras installs; an error without it."""
    try:
        return tuple(map(import_module, modules))
    except ImportError as error:
        install = f"pip install 'adaptune[{extra}]'"
        what = f"{extra} cannot be imported ({error}); run `{install}`"
        raise NotInstalledError(what) from error


RENAMED: dict[str, str] = {}
"""Keys of a study's earlier versions, and their present names."""
_NO_HAND_OVER = "is gone with the hand-over, which gained nothing; leave it out"
DELETED = {
    "offline.search": "is gone: a search is always for single sets; leave it out",
    "online.also": "is gone: name these modes in online.modes, too",
    "online.repeats": "is gone: give `adaptune online` the option --repeats",
    "online.rules": "is gone: name these modes in online.modes",
    "online.dwell": "is gone: selections do not wait; leave it out",
    "online.pin": "is gone: fix a parameter by its range (odometry.parameters), or leave it out",
    "online.switching.beside": _NO_HAND_OVER,
    "online.switching.catch_up_scans": _NO_HAND_OVER,
    "online.switching.full_rate": _NO_HAND_OVER,
    "online.switching.stride": _NO_HAND_OVER,
    "online.switching.cores": "is gone: a bank shares all cores that adaptune may use",
    "online.switching.memory": "is gone: auto spends 16 GB; give mechanism: bank for more",
    "online.switching.warm_up": "is gone: the odometry says it; leave it out",
    "health.max_acceleration": "is gone: 30 m/s^2 is the bound; leave it out",
    "health.max_turn_rate": "is gone: 360 degrees a second are the bound; leave it out",
    "health.max_unregistered": "is gone: 10 scans in a row are the bound; leave it out",
    "offline.memory": "is gone: workers keep scans in a quarter of the machine's memory",
    "offline.preset": "is gone; for the paper's, give trials: 256, sets: own, runs: whole",
    "offline.target": "is gone; give trials, hours or stagnation",
    "offline.storage": "is gone: the trials are in a journal of Optuna's in the study's folder",
    "offline.max_frames": "is gone: the error model keeps all frames; leave it out",
}
"""Keys of earlier versions that are gone, and what became of them."""
