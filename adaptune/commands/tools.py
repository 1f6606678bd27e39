"""The command that needs no study: RUSTLE's files."""

import logging
from pathlib import Path
from typing import Annotated

import typer

from adaptune.commands.terminal import say, say_next
from adaptune.errors import AdaptuneError
from adaptune.files import write_text

_log = logging.getLogger(__name__)


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
