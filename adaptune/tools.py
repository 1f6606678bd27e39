"""Commands that need no study: recordings, the cache, odometries for other programs, models."""

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from adaptune.errors import AdaptuneError
from adaptune.terminal import console, progress, say


def inspect(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="A bag, a folder, or a file of poses.", show_default=False
        ),
    ],
    png: Annotated[
        Path | None, typer.Option(help="Draw the first scan to this PNG or SVG.", dir_okay=False)
    ] = None,
    deep: Annotated[bool, typer.Option("--deep", help="Read all messages, not a sample.")] = False,
) -> None:
    """Show what is in a recording, what each stage lacks, and how to name it in a study."""
    from adaptune.inspect import inspect as inspect_file
    from adaptune.rendering import draw_inspection, render_inspection

    if deep:
        with progress() as show:
            found = inspect_file(file, deep, show)
    else:
        found = inspect_file(file)
    console.print(render_inspection(found))
    if png is not None:
        draw_inspection(found, png)
        say(f"First scan: {png}")


class CacheAction(StrEnum):
    """What to do with the cache."""

    LIST = "list"
    CLEAR = "clear"


def cache(
    action: Annotated[CacheAction, typer.Argument(help="List or clear it.")] = CacheAction.LIST,
) -> None:
    """List or clear the decoded recordings on disk.

    adaptune decodes a bag once, and then maps it into memory. `ADAPTUNE_CACHE` names another
    folder; `ADAPTUNE_CACHE_GB` limits its size (50), and 0 turns it off.
    """
    from adaptune.rendering import render_cache
    from adaptune.sequence.cache import clear_cache

    if action is CacheAction.CLEAR:
        say(f"Freed {clear_cache() / 1e9:.2f} GB.")
    else:
        console.print(render_cache())


def serve(
    odometry: Annotated[
        str | None,
        typer.Argument(help="The only odometry to serve.", show_default="as each hello asks"),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(help="Serve every connection to tcp://HOST:PORT or unix:PATH instead."),
    ] = None,
) -> None:
    """Serve an odometry to another program, over standard input and output.

    The odometry's own output goes to standard error; an odometry in a process of its own reports it
    with its faults. `docs/your-odometry.md` describes the messages.
    """
    from adaptune.odometry import serving

    if listen is not None:
        if odometry is None:
            raise AdaptuneError("--listen serves one odometry: give its name")
        serving.listen(listen, odometry, lambda at: say(f"{odometry} at {at}"))
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as writer:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        serving.serve(sys.stdin.buffer, writer, odometry)


def show(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="An error model.", show_default=False)
    ],
) -> None:
    """Describe an error model: its sets, sequences, provenance, and validation."""
    from adaptune.model import ErrorModel
    from adaptune.model.show import render

    console.print(render(ErrorModel.load(file), file), highlight=False)
