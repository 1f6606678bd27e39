"""Commands of the offline stage, and of what it needs."""

import logging
import math
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adaptune._system.files import write_text
from adaptune.commands.terminal import (
    Cluster,
    Folder,
    Override,
    Points,
    StudyFile,
    load,
    progress,
    say,
    say_next,
    say_next_of_study,
    say_next_of_trained,
    show_front,
    show_table,
)
from adaptune.errors import AdaptuneError, Finding

if TYPE_CHECKING:
    from adaptune.reference.stored import StoredEstimate

_log = logging.getLogger(__name__)


def simulate(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    overwrite: Annotated[bool, typer.Option(help="Replace existing recordings.")] = False,
) -> None:
    """Record the study's simulated courses as bags with ground truth.

    Each course under `courses:` becomes a bag in the BotanicGarden layout, with a TUM file of its
    ground truth. What is recorded already is kept, and refused if it is of another course.
    """
    loaded = load(study, override, folder)
    from adaptune.simulation.record import record
    from adaptune.study.sequences import StudySequences

    if not loaded.config.courses:
        help_ = "add one, as in courses: {demo: {scenes: [cave]}}"
        raise AdaptuneError(f"{study}: courses: there is none to simulate; {help_}")
    loaded.open()
    # Without what the odometry says of them: it may not be installed.
    sequences = StudySequences({}, loaded.config.courses, loaded.folder)
    with progress() as show:
        courses = {name: c for name, c in loaded.config.courses.items() if c.of is None}
        due = [n for n in courses if overwrite or not sequences.recording(n).exists()]
        for name in courses:
            if name not in due:
                sequences.open(name)  # it may be of another course, or cut short since
        for name in due:
            record(courses[name], sequences.recording(name), overwrite=overwrite, progress=show)
    say(f"Recorded {len(due)} of {len(courses)} courses: {loaded.folder / 'recordings'}/")
    say_next_of_study("run trials, fit the error model", "offline")


def offline(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    cluster: Cluster = None,
) -> None:
    """Run trials on the training sequences, and fit the error model.

    Training sequences without a reference get one that is estimated from their scans, before.

    The table shows the *baseline* (the odometry's own parameters), the *fixed* set (the best over
    all sequences within the budget), and each sequence's best. Stop it with Ctrl-C, and run it
    again to resume.
    """
    loaded = load(study, override, folder, runs=True)
    from adaptune.study.driven import driven
    from offline.train import train

    with progress() as show:
        training = train(loaded, show, cluster)
    model = training.model
    n = len(training.trials)
    for sentence in training.words:
        say(sentence)
    say(driven(model, loaded.config.online, loaded.odometry, loaded.mechanism))
    show_front(loaded, training.front, "What each choice gives in training,")
    show_table(
        f"RTE [%] over {model.length:g} m in training, {n} parameter sets",
        training.rows,
        "Each set is driven as `adaptune online` does it. The drives of the finalists along whole "
        "recordings decide which set is the fixed one.",
    )
    # Nothing can be left out of a single segment.
    say_next_of_trained(loaded, validate=bool(model.expected))


def trials(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    sort: Annotated[
        str | None,
        typer.Option(metavar="COLUMN", help="With `-` before it, the largest first."),
    ] = None,
    top: Annotated[int | None, typer.Option(help="Show so many, the best first.", min=1)] = None,
    errors: Annotated[
        Path | None,
        typer.Option(help="Write errors by frame and set, as CSV or Parquet.", dir_okay=False),
    ] = None,
) -> None:
    """List the study's finished trials, also while it runs.

    The columns are the trial number, the parameters, the `mean` RTE in percent over all training
    sequences and the RTE on each of them, the number of restarts by the health check and of ended
    processes, and the other metrics.

    With `--errors`, it writes a table to compare selection rules on: for every frame its sequence,
    fold and descriptor, and the error of every set; sets and costs go to a file beside it.
    """
    loaded = load(study, override, folder)
    if errors is not None:
        from offline.scenario import scenario, write_scenario

        say(f"{errors}: errors by frame and set; sets: {write_scenario(errors, scenario(loaded))}")
        return
    from adaptune.runs.archive import Archive
    from offline.trial_table import headings, rows, select, with_units

    names, archive = loaded.training, Archive(loaded.folder / "trials")
    finished = rows(archive, names)
    if not finished:
        raise AdaptuneError(f"{archive.folder}: no trial is finished yet; run `adaptune offline`")
    labels = loaded.odometry.space.labels
    chosen = select(finished, sort, top, headings(names, labels))
    title = f"{len(chosen)} of {len(finished)} trials"
    show_table(title, with_units(chosen, names, labels))
    changed = list[str]()
    with suppress(AdaptuneError):  # the odometry need not be here
        changed = loaded.archive().changes()
    if changed:
        say(f"These trials are of another study: {'; '.join(changed)}. Run `adaptune offline`.")
        return
    if judged := [row for row in finished if row["mean"] is not None]:
        best = min(judged, key=lambda row: row["mean"])
        say(f"Best mean: {best['mean']:.3f} %, of trial {best['trial']}.")
    if (fixed := loaded.fixed) is not None:
        same = (row["trial"] for row in finished if fixed.items() <= row.items())
        if (number := next(same, None)) is not None:
            say(f"The fixed set is trial {number}, as drives along whole recordings decided.")
    if loaded.model_path.exists():
        say_next_of_trained(loaded, validate=len(names) > 1)
    else:
        say_next_of_study("run the trials that are left, fit", "offline")


def validate(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
) -> None:
    """Estimate what adapting gains in places without training data.

    Leaves out one training recording after the other (with fewer than six, one segment after the
    other), chooses on the rest what to drive, and looks up the errors of the sets that are selected
    in each period. No odometry runs. A bank averages the recorded motions of its members. Numbers
    are ratios to the error of the fixed set, which is chosen without what is left out, too.
    """
    loaded = load(study, override, folder)
    from offline.validate import validate as validate_study

    with progress() as show:
        _, rows, verdicts = validate_study(loaded, show)
    for verdict in verdicts:
        say(verdict)
    show_table(
        "Error as a ratio to the fixed set's, each recording or segment left out in turn",
        rows,
        "The oracle knows the errors: the best set of the sequence. Intervals: "
        "for a recording, from blocks along it, if it is long enough; for the geometric "
        "mean over the segments, what is expected elsewhere.",
    )
    say(f"Tables and picture: {loaded.folder / 'validation'}.*, {loaded.folder / 'segments'}.*")
    say_next_of_trained(loaded, validate=False)


def cost(
    study: StudyFile,
    recording: Annotated[
        Path, typer.Argument(metavar="BAG", help="A recording of the robot's.", show_default=False)
    ],
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    points: Points = None,
) -> None:
    """Measure on this machine what the rows of a study's front cost, and say which to drive.

    Run it on the robot, with nothing else running: it drives each over a minute of a recording.
    Recommended is the least bound of the error within the budget, as `offline` chooses. A row whose
    99th percentile takes more than half of the time from scan to scan is not recommended.
    """
    from adaptune.recording.inspect import inspect
    from adaptune.recording.recording import open_sequence
    from adaptune.reference.estimate import recording_config
    from offline.front import measured_front

    loaded = load(study, override, folder, runs=True)
    scans = open_sequence(recording_config(inspect(recording), points))
    with progress() as show:
        rows = measured_front(loaded, scans, show)
    chosen = next(row for row in rows if row["recommended"])
    say(f"Drive trial {chosen['trial']}: {chosen['parameters']}.")
    show_front(loaded, rows, f"What each choice costs on {recording.name}, here, and in training")


def reference(
    recording: Annotated[
        Path, typer.Argument(metavar="BAG", help="A bag, or a folder.", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option(help="Where to write.", show_default="here", file_okay=False)
    ] = Path(),
    points: Points = None,
) -> None:
    """Estimate the reference of a recording from its scans, without ground truth.

    It writes the poses (TUM), what is known of their error (JSON), and a picture. Of a study,
    `adaptune offline` and `online` estimate the references that are lacking.
    """
    from adaptune.recording.inspect import inspect
    from adaptune.recording.recording import open_sequence
    from adaptune.reference import estimate, stored
    from adaptune.reference.check import proposed_sub_trajectory
    from adaptune.tuning.asked import check_no_study

    check_no_study(recording)
    config = estimate.recording_config(inspect(recording), points)
    path = out / f"{recording.resolve().stem}_reference.tum"
    # What can fail is found before the estimate, which takes minutes.
    stored.check_writable(path)
    with progress() as show:
        found = estimate.estimate_reference(open_sequence(config), partial(show, "estimating"))
        about = {"recording": str(recording.resolve()), "points": config.points}
        written = stored.write_estimate(path, found, about)
    _say_estimate(written, found.gaps(), proposed_sub_trajectory(found.trajectory()))
    say(f"Files: {path}, {path.with_suffix('.json').name}, {path.with_suffix('.png').name}")
    first = f"write `reference: {path}` under this sequence in a study; then "
    say_next("train with it, as with a given one", "offline", "STUDY.yaml", first=first)


def _say_estimate(stored: "StoredEstimate", unknown: list[Finding], length: float) -> None:
    say(f"Estimated reference: {stored.metres:.1f} m, {stored.scans:,} scans.")
    error = stored.error(length)
    if math.isnan(error):
        say(f"Its error is not known: the path holds no {length:g} m without interruption.")
    else:
        say(f"It is wrong by about {error:.2g} % over {length:g} m, as its two halves tell.")
    if unknown:
        where = ", ".join(map(str, unknown))
        share = f"{100.0 * stored.unknown_share:.1f} % of the scans"
        say(f"It is unknown for {share}, which have no pose: {where} after the first scan.")
    else:
        say("It is known everywhere.")


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
