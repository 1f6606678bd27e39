"""Commands that need no study: recordings, the cache, odometries for other programs, models."""

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adaptune.errors import AdaptuneError
from adaptune.next_command import say_next
from adaptune.terminal import begin_work, console, progress, say

if TYPE_CHECKING:
    from adaptune.inspect import Inspection
    from adaptune.trajectory import Trajectory


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

    begin_work()
    if deep:
        with progress() as show:
            found = inspect_file(file, deep, show)
    else:
        found = inspect_file(file)
    console.print(render_inspection(found))
    _begin_study(found)
    if png is not None:  # last: the lines of the study are to be copied in one piece
        draw_inspection(found, png)
        say(f"First scan: {png}")


LENGTHS = {25.0: 8, 10.0: 8, 5.0: 1.4, 2.0: 2}
"""Metres of a sub-trajectory, and how many of them the path of the test must hold: over short ones,
the noise of the reference counts too much."""
UNKNOWN = "5.0    # metres; 10.0 for a path of 200 m or more, 25.0 for one of 500 m or more"
"""What is proposed where the path is not known, by the same rule."""
TRAINING = 0.6
"""Share of a recording's duration that is proposed for training, before the test."""


def _begin_study(found: "Inspection") -> None:
    """Print the rest of a study of this recording alone, and the command that begins it."""
    from adaptune import yaml

    named = (yaml.Document(found.entry).data or {}).get("sequences")
    if not named:
        return
    if found.missing.get("offline"):
        say(
            "Next: mend what is lacking, see docs/your-bag.md; where only the reference does not "
            "serve, write `reference: estimated`"
        )
        return
    (name,), share = named, f"{100 * TRAINING:.0f}"
    say(
        f"training: [{name}: 0-{share}%]\ntest: [{name}: {share}-100%]\n"
        f"sub_trajectory: {_of_path(found)}\n"
        "odometry: {name: gicp}    # or another one, see docs/your-odometry.md\n"
    )
    first = f"put the lines from `sequences:` on in {name}.yaml; then "
    say_next("train on a part of it", "offline", f"{name}.yaml", first=first)


def _of_path(found: "Inspection") -> str:
    """The length of sub-trajectories to propose, with a remark where the path is not known."""
    return UNKNOWN if found.reference is None else str(proposed_sub_trajectory(found.reference))


def proposed_sub_trajectory(reference: "Trajectory") -> float:
    """The first of `LENGTHS` for which the test's part of the path is long enough; 1 m if none."""
    from adaptune.metrics import travelled

    first, last = reference.stamps[[0, -1]]
    tested = reference.T_world_sensor[reference.stamps >= first + TRAINING * (last - first)]
    path = travelled(tested)[-1]
    return next((length for length, n in LENGTHS.items() if n * length <= path), 1.0)


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
        say(f"Freed {clear_cache() / 1e9:.2f} GB. Bags are decoded again when they are read.")
    else:
        console.print(render_cache())
        say_next("free all of it", "cache", "clear")


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

    begin_work()
    if listen is not None:
        if odometry is None:
            raise AdaptuneError("--listen serves one odometry: give its name")
        serving.listen(listen, odometry, lambda at: say(f"{odometry} at {at}"))
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as writer:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        serving.serve(sys.stdin.buffer, writer, odometry)


def show(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="An error model, or a study's folder.", show_default=False
        ),
    ],
) -> None:
    """Describe an error model: its sets, sequences, provenance, and validation."""
    from adaptune.model import ErrorModel
    from adaptune.model.show import render
    from adaptune.study.run_folder import CONFIGURATION, MODEL

    file = file / MODEL if file.is_dir() else file
    console.print(render(ErrorModel.load(file), file))
    if (study := file.parent / CONFIGURATION).exists():
        other = [] if file.name == MODEL else ["--model", file]
        why = "replay the test sequences with it"
        say_next(why, "online", study, "--folder", file.parent, *other)
