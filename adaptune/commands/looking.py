"""Commands that make something to look at."""

import shlex
from enum import StrEnum
from typing import Annotated

import typer

from adaptune.commands.options import Folder, Override, StudyFile, load
from adaptune.terminal import progress, say


class RecordingFormat(StrEnum):
    """What replays are written as."""

    RERUN = "rerun"
    MCAP = "mcap"
    PARQUET = "parquet"


def record(
    study: StudyFile,
    sequences: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SEQUENCE]...", help="Of the study.", show_default="all that were replayed"
        ),
    ] = None,
    to: Annotated[
        list[RecordingFormat],
        typer.Option(
            help="What to write. May be repeated.",
            show_default="all whose packages are installed",
        ),
    ] = [],  # noqa: B006
    override: Override = [],  # noqa: B006
    folder: Folder = None,
) -> None:
    """Write replays as recordings to look at, with Rerun or Foxglove, and as Parquet.

    A recording holds the paths of all modes and of the reference, one scan a second, and over time
    the chosen parameters or weights, the predicted, estimated and true errors, and the time that
    each step took. The replays stay as they are.
    """
    loaded = load(study, override, folder)
    from online.record_replays import installed_formats, record_replays
    from online.recordings import replayed_sequences

    loaded.check()
    formats = list(map(str, to)) or installed_formats()
    names = replayed_sequences(loaded, sequences or ())
    with progress() as show:
        written = [path for name in names for path in record_replays(loaded, name, formats, show)]
    for path in written:
        say(f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
    suffixes = {path.suffix: path for path in written}
    if ".parquet" in suffixes:
        say("Parquet: pandas, Polars, DuckDB and others read it.")
    if ".mcap" in suffixes:
        say(f"Foxglove: choose `Open local file`, and {suffixes['.mcap']}.")
    if ".rrd" in suffixes:
        say(f"Next: {shlex.join(['rerun', str(suffixes['.rrd'])])}    # look at it")
    for missing in (f for f in RecordingFormat if f not in formats and not to):
        say(f"Not written: {missing}; `pip install 'adaptune[{missing}]'` adds it.")
