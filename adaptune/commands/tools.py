"""Commands that need no study: odometries for other programs, RUSTLE's files."""

import logging
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from adaptune.commands.terminal import begin_work, say, say_next
from adaptune.errors import AdaptuneError
from adaptune.files import write_text

_log = logging.getLogger(__name__)


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
    with its faults. `docs/programs.md` describes the messages.
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


def import_rustle(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="RUSTLE's tests, or a tuning, as YAML.", show_default=False
        ),
    ],
    algorithms: Annotated[Path, typer.Option(help="RUSTLE's algorithms.")] = Path(
        "algorithms.yaml"
    ),
    datasets: Annotated[Path, typer.Option(help="RUSTLE's data sets.")] = Path("datasets.yaml"),
    output: Annotated[
        Path, typer.Option("-o", "--output", help="The study to write.", dir_okay=False)
    ] = Path("study.yaml"),
    overwrite: Annotated[bool, typer.Option(help="Replace existing studies.")] = False,
) -> None:
    """Make studies of RUSTLE's tests and tunings.

    A test gives a study for each of its algorithms and speeds, a tuning gives one. What has no
    counterpart is logged, and stands in the comments of the study.
    """
    from adaptune.study.rustle import import_rustle as make_studies

    studies = make_studies(file, algorithms, datasets)
    names = [f"{output.stem}_{study.name}" if studies[1:] else output.stem for study in studies]
    paths = [output.with_name(name + output.suffix) for name in names]
    if len(set(paths)) < len(paths):
        raise AdaptuneError(f"{file}: two tests have the same name; give each its own")
    if there := [str(path) for path in paths if path.exists() and not overwrite]:
        raise AdaptuneError(f"{', '.join(there)}: exists; name another -o, or add --overwrite")
    for note in dict.fromkeys(note for study in studies for note in study.notes):
        _log.warning("%s", note)
    for path, study in zip(paths, studies, strict=True):
        write_text(path, study.text)
        say(f"{path}: {study.about}")
    say_next("read its comments; then run trials, fit the error model", "offline", paths[0])
