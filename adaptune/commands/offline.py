"""Commands of the offline stage."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from adaptune.commands.terminal import (
    Cluster,
    Folder,
    Override,
    StudyFile,
    begin_work,
    console,
    errors,
    load,
    progress,
    say,
    say_next_of_study,
    say_next_of_trained,
    say_next_online,
)
from adaptune.errors import AdaptuneError


def simulate(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    overwrite: Annotated[bool, typer.Option(help="Replace existing recordings.")] = False,
) -> None:
    """Record the study's simulated courses as bags with ground truth.

    Each course under `courses:` becomes a bag in the BotanicGarden layout, with a TUM file of its
    ground truth and a picture.
    """
    loaded = load(study, override, folder)
    from adaptune.simulation.record import record

    if not loaded.config.courses:
        help_ = "add one, as in courses: {demo: {scenes: [cave]}}"
        raise AdaptuneError(f"{study}: courses: there is none to simulate; {help_}")
    loaded.open()
    with progress() as show:
        courses = {name: c for name, c in loaded.config.courses.items() if c.of is None}
        due = [n for n in courses if overwrite or not loaded.sequences.recording(n).exists()]
        for name in due:
            path = loaded.sequences.recording(name)
            record(courses[name], path, overwrite=overwrite, progress=show)
    say(f"Recorded {len(due)} of {len(courses)} courses: {loaded.folder / 'recordings'}/")
    say_next_of_study("run trials, fit the error model", "offline", study, override, folder)


def offline(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    cluster: Cluster = None,
) -> None:
    """Run trials on the training sequences, and fit the error model.

    Training sequences without a reference get one that is estimated from their scans, before.

    The table shows the *baseline* (the odometry's own parameters), the *fixed* set (the best over
    all sequences), and each sequence's best. Stop it with Ctrl-C, and run it again to resume.
    """
    loaded = load(study, override, folder)
    from adaptune.report import tables
    from adaptune.study.study import driven
    from offline.train import train

    with progress() as show:
        training = train(loaded, show, cluster)
    model = training.model
    console.print(
        tables.table(
            f"RTE [%] over {model.length:g} m in training, "
            f"{len(next(iter(training.means.values())))} parameter sets",
            training.rows,
            "A trial that loses track restarts at the reference, which counts as 30 %. A whole run "
            "is driven as `adaptune online` does it; whole runs decide which set is the fixed one.",
        )
    )
    for sentence in training.words:
        say(sentence)
    say(f"Fixed set: {loaded.folder / 'fixed.yaml'}")
    if len(loaded.config.offline.objective) > 1:
        front = loaded.folder / "pareto"
        say(f"The sets that no other set beats in every objective: {front}.*")
    say(driven(loaded, model))
    say(f"Error model: {loaded.model_path}")
    say_next_of_trained(bool(model.expected), loaded.config.test, study, override, folder)


def trials(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    where: Annotated[
        list[str],
        typer.Option(metavar="CONDITION", help="As in `--where 'mean < 1'`. May be repeated."),
    ] = [],  # noqa: B006
    sort: Annotated[
        str | None,
        typer.Option(metavar="COLUMN", help="With `-` before it, the largest first."),
    ] = None,
    top: Annotated[int | None, typer.Option(help="Number of trials to show.", min=1)] = None,
    csv: Annotated[bool, typer.Option("--csv", help="Write CSV to standard output.")] = False,
    export: Annotated[
        Path | None,
        typer.Option(help="Write their trajectories to this folder, as TUM.", file_okay=False),
    ] = None,
) -> None:
    """List the study's finished trials, also while it runs.

    The columns are the trial number, the parameters, the `mean` RTE in percent over all training
    sequences and the RTE on each of them, the number of lost tracks, of ended processes and of
    steps that the health check rejects, and the other metrics.
    """
    loaded = load(study, override, folder)
    from adaptune import archive as table
    from adaptune.archive import Archive
    from adaptune.report import tables
    from adaptune.study.references import estimates_in_words, estimates_of
    from offline.search import has_ended

    names, archive = loaded.training, Archive(loaded.folder / "trials")
    finished = table.rows(archive, names)
    if not finished:
        raise AdaptuneError(f"{archive.folder}: no trial is finished yet; run `adaptune offline`")
    chosen = table.select(finished, where, sort, top)
    labels = loaded.odometry.space.labels
    if csv:
        sys.stdout.write(tables.csv_text(chosen))
    else:
        title = f"{len(chosen)} of {len(finished)} trials"
        console.print(tables.table(title, table.with_units(chosen, names, labels)))
        if judged := [row for row in finished if row["mean"] is not None]:
            best = min(judged, key=lambda row: row["mean"])
            say(f"Best mean: {best['mean']:.3f} %, of trial {best['trial']}.")
        estimates = estimates_of(loaded.sequences, names)
        for sentence in estimates_in_words(estimates, loaded.config.sub_trajectory):
            say(sentence)
        if has_ended(loaded.folder):
            say_next_of_trained(len(names) > 1, loaded.config.test, study, override, folder)
        else:
            why = "run the trials that are left, fit"
            say_next_of_study(why, "offline", study, override, folder)
    if export is not None:
        begin_work()
        n = table.export(archive, names, [row["trial"] for row in chosen], export)
        errors.print(f"{n} trajectories: {export}/")


def validate(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
) -> None:
    """Estimate what adapting gains in places without training data.

    Leaves out one training recording after the other (with fewer than six, one stretch after the
    other), chooses on the rest what to drive, and looks up the errors of the sets that are selected
    in each period. No odometry runs. A bank averages the recorded motions of its members. Numbers
    are ratios to the error of the fixed set, which is chosen without what is left out, too.
    """
    loaded = load(study, override, folder)
    from adaptune.report import tables
    from offline.validate import validate as validate_study

    with progress() as show:
        _, rows, verdicts = validate_study(loaded, show)
    console.print(
        tables.table(
            "Error as a ratio to the fixed set's, each recording or stretch left out in turn",
            rows,
            "Oracles know the errors: the best set of the sequence, and of every period. "
            "Intervals: for a recording, a block bootstrap over time, if it is long enough; for "
            "the geometric mean over the stretches, what is expected elsewhere.",
        )
    )
    for verdict in verdicts:
        say(verdict)
    names = ("validation", "stretches")
    say(f"Tables and picture: {', '.join(f'{loaded.folder / name}.*' for name in names)}")
    say_next_online(loaded.config.test, study, override, folder)
