"""What every command shares: where it prints, its progress, and its exit after an error."""

import logging
import os
import shlex
import shutil
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from adaptune.errors import AdaptuneError
from adaptune.progress import Progress

if TYPE_CHECKING:
    from rich.progress import TaskID

    from offline.config import OfflineStudy


# Text of files is printed as it is: no markup, no emoji.
_literal: Any = {"markup": False, "emoji": False, "highlight": False}
# In a pipe, tables and logs are not wrapped, unless COLUMNS gives a width.
_wide = None if "COLUMNS" in os.environ else 200
console = Console(width=None if sys.stdout.isatty() else _wide, **_literal)
errors = Console(stderr=True, width=None if sys.stderr.isatty() else _wide, **_literal)


class Commands(TyperGroup):
    """Exits with code 2 after an error that the user can correct, and with 130 after Ctrl-C."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        try:
            return super().invoke(ctx)
        except (AdaptuneError, OSError) as error:
            if isinstance(error, BrokenPipeError):
                raise  # nobody reads the output any more
            errors.print(f"error: {error}", style="red", soft_wrap=True)
            raise typer.Exit(2) from error
        except KeyboardInterrupt as error:
            errors.print("interrupted; run the same command again to resume", style="yellow")
            raise typer.Exit(130) from error


def say(text: str) -> None:
    """Print plain text, on one line however narrow the terminal is."""
    console.print(text, soft_wrap=True)


def begin_work() -> None:
    """From here on, let Ctrl-C raise an exception, so that what is begun is put in order."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


LOG_EVERY = 5.0
"""Seconds between two lines about progress in a log."""

MOST_FINISHED = 8
"""Bars that stay on the screen when they are full."""


@contextmanager
def progress(above: Any = None) -> Iterator[Progress]:
    """Show a bar for each thing that is done; without a terminal, write a line now and then.

    In a terminal, `above` stands over the bars: something that rich can render, again and again.
    """
    begin_work()
    if not errors.is_terminal:
        yield _logger()
        return
    from rich import progress as columns
    from rich.console import Group
    from rich.live import Live

    bars = columns.Progress(
        columns.TextColumn("{task.description}", markup=False),
        columns.BarColumn(),
        columns.MofNCompleteColumn(),
        columns.TimeElapsedColumn(),
        columns.TextColumn("{task.fields[remark]}", markup=False),
        console=errors,
    )
    tasks: dict[str, TaskID] = {}
    pace, full = _Pace(), _Full()
    shown = bars if above is None else Live(Group(above, bars), console=errors)
    with shown:

        def show(what: str, done: float, total: int, remark: str = "", /) -> None:
            if full.again(what, done, total):
                return
            if what not in tasks:
                over = [task.id for task in bars.tasks if task.finished]
                for finished in over[:-MOST_FINISHED]:
                    bars.update(finished, visible=False)
                tasks[what] = bars.add_task(what, total=total, remark="")
            words = ", ".join(filter(None, (pace.left(what, done, total), remark)))
            bars.update(tasks[what], completed=done, total=max(total, done), remark=words)

        yield show


def _logger() -> Progress:
    log = logging.getLogger("adaptune")
    last = time.monotonic()
    pace, full = _Pace(), _Full()

    def show(what: str, done: float, total: int, remark: str = "", /) -> None:
        nonlocal last
        if full.again(what, done, total):
            return
        now = time.monotonic()
        left = pace.left(what, done, total, now)
        if now - last > LOG_EVERY:
            last = now
            words = (f"{what}: {int(done)} of {total}", left, remark)
            log.info("%s", ", ".join(filter(None, words)))

    return show


class _Pace:
    """How long each thing will take, by how long it took in the newer half of the time so far.

    What a study that is resumed has done already comes in the first moment, and says nothing.
    """

    def __init__(self) -> None:
        self._begun: dict[str, float] = {}
        self._past: dict[str, deque[tuple[float, float]]] = {}  # when, and how much was done

    def left(self, what: str, done: float, total: int, now: float | None = None) -> str:
        """In words; empty before a first piece is done, and in the first seconds."""
        now = time.monotonic() if now is None else now
        past = self._past.setdefault(what, deque())
        if not past or done < past[0][1] or done == past[-1][1] == past[0][1]:
            self._begun[what] = now
            past.clear()
        elapsed = now - self._begun[what]
        if not past or now - past[-1][0] > 0.01 * elapsed:
            past.append((now, done))
        while len(past) > 1 and past[1][0] <= now - 0.5 * elapsed:
            past.popleft()
        seconds, gained = now - past[0][0], done - past[0][1]
        if gained < 1.0 or elapsed < LOG_EVERY or done >= total:
            return ""
        return _time_left((total - done) * seconds / gained)


class _Full:
    """What was done completely: several workers may read the same, one after the other."""

    def __init__(self) -> None:
        self._totals: dict[str, int] = {}

    def again(self, what: str, done: float, total: int) -> bool:
        """Whether it is done once more."""
        if done >= total:
            self._totals[what] = total
        return done < total == self._totals.get(what)


def _time_left(seconds: float) -> str:
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds > 2.0 * length:
            return f"about {seconds / length:.0f} {unit} left"
    return f"about {seconds:.0f} s left"


# The command to run next, which every command names at its end.


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


# Arguments that all commands on a study share.


StudyFile = Annotated[
    Path,
    typer.Argument(metavar="STUDY", help="The study's YAML, or its folder.", show_default=False),
]


def _complete_override(incomplete: str) -> list[str]:
    """Keys and values for `-o`, when the shell asks."""
    from adaptune.study.config import complete
    from offline.config import NAMES, OfflineStudyConfig

    return complete(OfflineStudyConfig, incomplete, {"offline.sampler": NAMES})


Override = Annotated[
    list[str],
    typer.Option(
        "-o",
        "--override",
        metavar="KEY=VALUE",
        help="Replace a value of the YAML, as in `-o offline.trials=128`. May be repeated.",
        show_default=False,
        autocompletion=_complete_override,
    ),
]
Folder = Annotated[
    Path | None,
    typer.Option(
        help="The study's folder.", show_default="the YAML's name, under runs/", file_okay=False
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Run the trials on a Dask cluster, as tcp://scheduler:8786.",
        show_default="processes of this machine",
    ),
]


def load(path: Path, overrides: list[str], folder: Path | None) -> "OfflineStudy":
    """Load the study of a YAML file, or of the folder of a study that has begun."""
    from offline.config import load_study

    if not path.exists():
        what = "give the YAML of a study, or the folder of one that has begun"
        raise AdaptuneError(f"{path}: there is no such file or folder; {what}")
    if path.is_dir():
        if not (path / "study.yaml").exists():
            raise AdaptuneError(f"{path}: is no study's folder: there is no study.yaml in it")
        path, folder = path / "study.yaml", folder or path
    return load_study(path, overrides, folder)
