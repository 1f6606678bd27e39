"""Errors that a user is meant to read."""

import difflib
import errno
import logging
import os
import sys
import traceback
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from importlib.machinery import PathFinder
from typing import Any, NamedTuple


class AdaptuneError(Exception):
    """A mistake in the input, with a sentence that says what to do.

    The command line prints the sentence and exits with `exit_code`. Modules derive their own class
    from it, and chain the cause.
    """

    exit_code = 2


class OdometryError(AdaptuneError):
    """An odometry that cannot do what is asked of it."""


class UnavailableError(OdometryError):
    """What runs an odometry is gone, whatever its parameters: a trial says nothing then."""


class NotInstalledError(OdometryError):
    """An odometry whose package is not installed."""


Key = tuple[str | int, ...]
"""Path of a key in a study; of the whole study it is empty."""


class Finding(NamedTuple):
    """One thing that is wrong with what a user gave: a recording, a reference, a setting."""

    where: Key  # a topic, a file, or the path of a key; empty where the text says it
    what: str  # is wrong, and what follows from it
    mend: str = ""  # the setting, or the act, that mends it
    seconds: tuple[float, float] | None = None  # from when to when, since the first scan
    of: str = ""  # `points`, `reference` or `imu`, where one of these inputs is affected
    lacks: str = ""  # what is missing because of it: the stages that need it cannot run

    def __str__(self) -> str:
        when = "" if self.seconds is None else "from {:.1f} to {:.1f} s".format(*self.seconds)
        what = ", ".join(filter(None, (self.what, when)))
        said = "; ".join(filter(None, (what, self.mend)))
        return ": ".join(filter(None, (".".join(map(str, self.where)), said)))

    def below(self, key: Key) -> "Finding":
        """The same as seen from outside the section at `key`."""
        return self._replace(where=key + self.where)


OUT_OF_MEMORY = "out of memory; end other programs, or lower offline.workers"


class MachineError(AdaptuneError):
    """What a machine lacks, whatever the data and the odometry are."""


def blame_machine(what: str, error: BaseException) -> None:
    """Raise a MachineError where an error, or what led to it, says what the machine lacks."""
    if said := lacking(error):
        raise MachineError(f"{what}: {said}") from error


def lacking(error: BaseException | None) -> str:
    """What the machine lacks, where the system says so in what led to an error; else nothing.

    A MemoryError says nothing: damaged data may ask for any size.
    """
    while error is not None:
        if isinstance(error, OSError) and error.errno in _LACKING:
            return _LACKING[error.errno]
        error = error.__cause__ or error.__context__
    return ""


_LACKING = {
    **dict.fromkeys((errno.EMFILE, errno.ENFILE), "too many open files; raise `ulimit -n`"),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "the disk is full; make room"),
    errno.ENOMEM: OUT_OF_MEMORY,
}


def in_a_line(error: BaseException) -> str:
    """An exception in a line, with the place where it was raised; ours are told as they are."""
    if isinstance(error, AdaptuneError):
        return str(error)
    what = "".join(traceback.format_exception_only(error)).strip()
    raised = traceback.extract_tb(error.__traceback__)
    return f"{what} ({raised[-1].filename}, line {raised[-1].lineno})" if raised else what


@cache
def warn_once(what: str) -> None:
    """Log a warning, the first time that it is given."""
    logging.getLogger(__name__).warning("%s", what)


def nearest(name: str, names: Iterable[str]) -> str:
    """The nearest valid name as half a sentence, or all valid names."""
    names = sorted(names)
    close = difflib.get_close_matches(name, names, n=1)
    if close:
        return f"did you mean {close[0]!r}?"
    return f"there is {', '.join(map(repr, names))}" if names else "there is none"


def hidden(error: BaseException) -> str:
    """Which package PYTHONPATH hides, where that may have led to an ImportError; else nothing."""
    theirs = [*filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    ours = [folder for folder in sys.path if folder not in theirs]
    frames = (at.f_globals.get("__name__") for at, _ in traceback.walk_tb(error.__traceback__))
    for name in (getattr(error, "name", None), *frames):
        package = str(name).partition(".")[0]
        specs = [PathFinder.find_spec(package, path) for path in (theirs, ours)]
        if specs[0] and specs[1]:
            where = specs[0].origin
            return f"{package} comes from PYTHONPATH ({where}), before the installed one; unset it"
    return ""


@cache
def import_extra(extra: str, *modules: str) -> tuple[Any, ...]:
    """Import modules of a package that one of adaptune's extras installs; an error without it."""
    try:
        return tuple(map(import_module, modules))
    except ImportError as error:
        help_ = hidden(error) or f"run `pip install 'adaptune[{extra}]'`"
        raise NotInstalledError(f"{extra} cannot be imported ({error}); {help_}") from error
