"""What every command shares: where it prints, its progress, and its exit after an error."""

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from adaptune.errors import AdaptuneError

if TYPE_CHECKING:
    from rich.progress import TaskID

# A table in a pipe is not wrapped, unless COLUMNS gives a width.
console = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else 200)
errors = Console(stderr=True)


class Commands(TyperGroup):
    """Exits with code 2 after an error that the user can correct, and with 130 after Ctrl-C."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        try:
            return super().invoke(ctx)
        except (AdaptuneError, OSError) as error:
            if isinstance(error, BrokenPipeError):
                raise  # nobody reads the output any more
            errors.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
            raise typer.Exit(2) from error
        except KeyboardInterrupt as error:
            errors.print("interrupted; run the same command again to resume", style="yellow")
            raise typer.Exit(130) from error


def say(text: str) -> None:
    """Print plain text."""
    console.print(text, highlight=False)


LOG_EVERY = 5.0
"""Seconds between two lines of the log."""

Show = Callable[..., None]
"""Called with what is done, how much of it is done, how much there is, and a remark."""


@contextmanager
def progress() -> Iterator[Show]:
    """Show a bar for each thing that is done; without a terminal, write a line now and then."""
    if not errors.is_terminal:
        yield _logger()
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    bars = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[remark]}"),
        console=errors,
    )
    tasks: dict[str, TaskID] = {}
    with bars:

        def show(what: str, done: int, total: int, remark: str = "") -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total, remark="")
            bars.update(tasks[what], completed=done, total=total, remark=remark)

        yield show


def _logger() -> Show:
    log = logging.getLogger("adaptune")
    last = time.monotonic()

    def show(what: str, done: int, total: int, remark: str = "") -> None:
        nonlocal last
        if done >= total or time.monotonic() - last > LOG_EVERY:
            last = time.monotonic()
            log.info("%s: %d of %d%s", what, done, total, remark and f", {remark}")

    return show
