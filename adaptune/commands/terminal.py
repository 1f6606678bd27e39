"""What every command shares: where it prints, its progress, and its exit after an error."""

import os
import shlex
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from typer.core import TyperGroup

from adaptune._system.progress import Progress, bars
from adaptune.errors import OUT_OF_MEMORY, AdaptuneError

if TYPE_CHECKING:
    from offline.config import OfflineStudy


# Text of files is printed as it is: no markup, no emoji.
_literal: Any = {"markup": False, "emoji": False, "highlight": False}
# In a pipe, tables are not wrapped, unless COLUMNS gives a width.
_wide = None if "COLUMNS" in os.environ else 200
console = Console(width=None if sys.stdout.isatty() else _wide, **_literal)
# Where it is stored, bars would fill it, whatever FORCE_COLOR says.
_live = sys.stderr.isatty()
errors = Console(stderr=True, force_terminal=_live, width=None if _live else _wide, **_literal)


class Commands(TyperGroup):
    """Exits with code 2 after an error that the user can correct, and with 130 after Ctrl-C."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        try:
            return super().invoke(ctx)
        except (AdaptuneError, OSError, MemoryError) as error:
            if isinstance(error, BrokenPipeError):
                raise  # nobody reads the output any more
            errors.print(f"error: {str(error) or OUT_OF_MEMORY}", style="red", soft_wrap=True)
            raise typer.Exit(getattr(error, "exit_code", 2)) from error
        except KeyboardInterrupt as error:
            errors.print(
                "interrupted; run the same command again: what is finished is kept", style="yellow"
            )
            raise typer.Exit(130) from error


def say(text: str) -> None:
    """Print plain text, on one line however narrow the terminal is."""
    console.print(text, soft_wrap=True)


def show_table(title: str, rows: Sequence[Mapping[str, Any]], caption: str = "") -> None:
    """Print a table, or several below each other where the terminal is narrow."""
    from adaptune.report.tables import Listing, tables_within

    console.print(*tables_within(Listing(title, rows, caption), console.width), sep="\n")


def show_front(study: "OfflineStudy", rows: Sequence[Mapping[str, Any]], *title: str) -> None:
    """The table of what may be driven, without the parameters, which are in files."""
    from adaptune.tuning.verdict import front_table

    title_, cells, caption = front_table(study, rows, *title)
    few = [{key: cell[key] for key in cell if key != "parameters"} for cell in cells]
    show_table(title_, few, caption)


def begin_work() -> None:
    """From here on, let Ctrl-C raise an exception, so that what is begun is put in order."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def progress() -> Iterator[Progress]:
    """Show a bar for each thing that is done; without a terminal, write a line now and then."""
    begin_work()
    with bars(errors) as show:
        yield show


def say_next(why: str, *words: object, first: str = "") -> None:
    """Print a command, ready to copy, what it is for, and what to do first."""
    say(f"Next: {first}{shlex.join(['adaptune', *map(str, words)])}    # {why}")


_study_words: list[object] = []
"""Words for the study that was loaded last."""


def say_next_of_study(why: str, command: str, first: str = "") -> None:
    """Name a command on the study that was loaded, with the same options."""
    say_next(why, command, *_study_words, first=first)


def say_next_of_trained(study: "OfflineStudy", validate: bool) -> None:
    """Name what follows training: to `validate` it, or to replay the test sequences, if any."""
    if validate:
        say_next_of_study("what does adapting gain elsewhere?", "validate")
        return
    first = f"name sequences for the `test` of {_study_words[0]}; then "
    why = "replay the test sequences in every mode"
    say_next_of_study(why, "online", "" if study.config.test else first)


StudyFile = Annotated[
    Path,
    typer.Argument(metavar="STUDY", help="The study's YAML, or its folder.", show_default=False),
]


Override = Annotated[
    list[str],
    typer.Option(
        "-o",
        "--override",
        metavar="KEY=VALUE",
        help="Replace a value of the YAML, as in `-o offline.trials=128`. May be repeated.",
        show_default=False,
    ),
]
Folder = Annotated[
    Path | None,
    typer.Option(
        help="The study's folder.", show_default="the YAML's name, under runs/", file_okay=False
    ),
]
As = Annotated[
    Literal["one", "several"] | None,
    typer.Option(
        "--as",
        help="Read the bags of a folder as parts of one recording, or as several.",
        show_default="as their times and names tell",
    ),
]
Given = Annotated[
    str | None,
    typer.Option(
        metavar="TOPIC|FILE",
        help="The reference, or `estimated` to compute one from the scans.",
        show_default="the recording's own, or estimated",
    ),
]
Points = Annotated[
    str | None, typer.Option(metavar="TOPIC", help="Topic of the scans, where there are several.")
]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Run the trials on a Dask cluster, as tcp://scheduler:8786.",
        show_default="processes of this machine",
    ),
]


def load(
    path: Path, overrides: list[str], folder: Path | None, *, runs: bool = False
) -> "OfflineStudy":
    """Load the study of a YAML file, or of the folder of a study that has begun.

    `say_next_of_study` names it then. Only a command that `runs` the odometry needs it installed.
    """
    from offline.config import load_study

    of_folder = [] if folder is None else ["--folder", folder]
    _study_words[:] = [path, *of_folder, *(word for text in overrides for word in ("-o", text))]
    return load_study(path, overrides, folder, needed=runs)
