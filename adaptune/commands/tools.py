"""Commands that need no study: recordings, the cache, odometries for other programs, models."""

import logging
import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from adaptune.commands.terminal import begin_work, console, progress, say, say_next
from adaptune.errors import AdaptuneError
from adaptune.files import write_text
from adaptune.progress import Progress

if TYPE_CHECKING:
    from adaptune.recording.inspect import Inspection

_log = logging.getLogger(__name__)

MODEL_SUFFIX = ".safetensors"
"""Of files of error models."""


def inspect(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A bag, a folder, a file of poses, an error model, or a study's folder.",
            show_default=False,
        ),
    ],
    deep: Annotated[bool, typer.Option("--deep", help="Read all messages, not a sample.")] = False,
) -> None:
    """Show what is in a recording, what each stage lacks, and how to name it in a study.

    Of an error model, or of a study's folder, show its sets, sequences, provenance and validation.
    """
    if file.suffix == MODEL_SUFFIX or (file / f"model{MODEL_SUFFIX}").exists():
        _show_model(file)
        return
    from adaptune.recording.inspect import inspect as inspect_file
    from adaptune.recording.inspect import render_inspection

    with progress() as show:
        found = inspect_file(file, deep, show)
        length, accuracy = _sub_trajectory(found, deep, show)
    console.print(render_inspection(found, accuracy), crop=False)
    _begin_study(found, length)


def _show_model(file: Path) -> None:
    from adaptune.model import ErrorModel
    from adaptune.model.error_model import render
    from adaptune.study.study import CONFIGURATION, MODEL

    file = file / MODEL if file.is_dir() else file
    console.print(render(ErrorModel.load(file), file))
    if (study := file.parent / CONFIGURATION).exists():
        other = [] if file.name == MODEL else ["--model", file]
        why = "replay the test sequences with it"
        say_next(why, "online", study, "--folder", file.parent, *other)


UNKNOWN_LENGTH = "5.0    # metres; 10.0 for a path of 200 m or more, 25.0 for one of 500 m or more"
"""The length of sub-trajectories to propose where the path is not known."""


def _sub_trajectory(found: "Inspection", deep: bool, show: Progress) -> tuple[str, str]:
    """The length of sub-trajectories to propose, and how wrong the reference is, if it is measured.

    Only what can be used to train is measured. What the scans say against it joins the faults.
    """
    if found.reference is None or not found.name or found.missing.get("offline"):
        return UNKNOWN_LENGTH, ""
    from adaptune.recording.inspect import Fault
    from adaptune.recording.recording import open_sequence
    from adaptune.reference import check
    from adaptune.reference.check import diagnose_reference, measured_motions

    usual = check.proposed_sub_trajectory(found.reference)
    if not deep:
        return str(usual), "`--deep` also measures how wrong it is"
    try:
        scans = open_sequence(found.config())
        if (reference := scans.reference()) is None:
            return str(usual), ""
        measured = check.measure_reference(scans, reference, partial(show, "registering"))
        motions = measured_motions(scans, len(measured.stamps))
        if (cause := diagnose_reference(reference, measured.stamps, motions)) is not None:
            what = f"the reference contradicts the scans: {cause}"
            found.faults.append(Fault(what, "reference"))
    except AdaptuneError as error:
        return str(usual), f"its error cannot be measured: {error}"
    length = check.proposed_sub_trajectory(reference, measured)
    words = check.accuracy_words(measured, usual, length), check.advice(measured, reference)
    return str(length), "; ".join(filter(None, words))


def _begin_study(found: "Inspection", length: str) -> None:
    """Print the rest of a study of this recording alone, and the command that begins it."""
    from adaptune.reference.check import TRAINING

    if not (name := found.name):
        return
    if found.missing.get("offline"):
        say(
            "Next: mend what is lacking, see docs/your-bag.md; where only the reference does not "
            "serve, write `reference: estimated`"
        )
        return
    share = f"{100 * TRAINING:.0f}"
    say(
        f"training: [{name}: 0-{share}%]\ntest: [{name}: {share}-100%]\n"
        f"sub_trajectory: {length}\n"
        "odometry: {name: gicp}    # or another one, see docs/your-odometry.md\n"
    )
    first = f"put the lines from `sequences:` on in {name}.yaml; then "
    say_next("train on a part of it", "offline", f"{name}.yaml", first=first)


def cache(
    action: Annotated[Literal["list", "clear"], typer.Argument(help="List or clear it.")] = "list",
) -> None:
    """List or clear the decoded recordings on disk.

    adaptune decodes a bag once, and then maps it into memory. `ADAPTUNE_CACHE` names another
    folder; `ADAPTUNE_CACHE_GB` limits its size (50), and 0 turns it off.
    """
    from adaptune.recording.cache import clear_cache
    from adaptune.recording.inspect import render_cache

    if action == "clear":
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

    studies, skipped = make_studies(file, algorithms, datasets)
    names = [f"{output.stem}_{study.name}" if studies[1:] else output.stem for study in studies]
    paths = [output.with_name(name + output.suffix) for name in names]
    if len(set(paths)) < len(paths):
        raise AdaptuneError(f"{file}: two tests have the same name; give each its own")
    if there := [str(path) for path in paths if path.exists() and not overwrite]:
        raise AdaptuneError(f"{', '.join(there)}: exists; name another -o, or add --overwrite")
    for note in dict.fromkeys((*skipped, *(note for study in studies for note in study.notes))):
        _log.warning("%s", note)
    for path, study in zip(paths, studies, strict=True):
        write_text(path, study.text)
        say(f"{path}: {study.about}")
    say_next("read its comments; then run trials, fit the error model", "offline", paths[0])
