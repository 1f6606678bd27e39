"""The command to run next, which every command names at its end."""

import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from adaptune.terminal import say


def say_next(why: str, *words: object, first: str = "") -> None:
    """Print a command, ready to copy, what it is for, and what to do first."""
    say(f"Next: {first}{shlex.join([_program(), *map(str, words)])}    # {why}")


def say_next_of_study(
    why: str,
    command: str,
    study: Path,
    override: Sequence[str],
    folder: Path | None,
    first: str = "",
) -> None:
    """Name a command on the same study, with the same options."""
    of_folder = [] if folder is None else ["--folder", folder]
    options = [word for text in override for word in ("-o", text)]
    say_next(why, command, study, *of_folder, *options, first=first)


def say_next_online(
    test: Sequence[str], study: Path, override: Sequence[str], folder: Path | None
) -> None:
    """Name the replay of the test sequences, if there are any."""
    first = "" if test else f"name sequences for the `test` of {study}; then "
    why = "replay the test sequences in every mode"
    say_next_of_study(why, "online", study, override, folder, first)


def say_next_of_trained(
    enough: bool,
    test: Sequence[str],
    study: Path,
    override: Sequence[str],
    folder: Path | None,
) -> None:
    """Name what follows training: nothing can be left out of a single stretch."""
    if enough:
        say_next_of_study("what does adapting gain elsewhere?", "validate", study, override, folder)
    else:
        say_next_online(test, study, override, folder)


def _program() -> str:
    """The command line as the user can call it."""
    called = Path(sys.argv[0])
    typed = called.name == "adaptune" and shutil.which("adaptune") is None
    return str(called) if typed else "adaptune"
