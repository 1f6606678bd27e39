"""What every command prints on, and how it exits after an error."""

import os
import sys
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from adaptune.errors import AdaptuneError

if TYPE_CHECKING:
    from adaptune.progress import Show

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


def progress() -> "AbstractContextManager[Show]":
    """Show the progress of a command, see `adaptune.progress`."""
    from adaptune.progress import show_progress

    return show_progress(errors)
