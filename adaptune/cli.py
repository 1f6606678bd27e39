"""The command line: the one module that imports both stages."""

import logging
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from adaptune import tools
from adaptune.errors import AdaptuneError
from adaptune.next_command import (
    say_next,
    say_next_of_study,
    say_next_of_trained,
    say_next_online,
)
from adaptune.terminal import Commands, begin_work, console, errors, progress, say

if TYPE_CHECKING:
    from offline.offline_study import OfflineStudy

# Every command imports what it needs, so that `adaptune --help` answers at once.

app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    name="adaptune",
    cls=Commands,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help=(
        "Tune the parameters of a LiDAR odometry, and keep tuning them while the robot drives.\n\n"
        "A study is a YAML file: an odometry, its parameters, and sequences for training and test. "
        "Its folder keeps all results. Run the same command again to resume it.\n\n"
        "    adaptune inspect  my.bag               # what is in a recording\n\n"
        "    adaptune simulate configs/demo.yaml    # record its simulated sequences\n\n"
        "    adaptune offline  configs/demo.yaml    # run trials, fit the error model\n\n"
        "    adaptune trials   configs/demo.yaml    # list, sort and export its trials\n\n"
        "    adaptune validate configs/demo.yaml    # does adapting pay elsewhere?\n\n"
        "    adaptune switching configs/demo.yaml   # what a switch costs\n\n"
        "    adaptune online   configs/demo.yaml    # replay the test sequences\n\n"
        "    adaptune compare  configs/demo.yaml    # baseline, fixed and adaptive"
    ),
)

models = typer.Typer(no_args_is_help=True, cls=Commands, help="Look at error models.")
app.add_typer(models, name="model")
for _command in (tools.inspect, tools.cache, tools.serve):
    app.command()(_command)
models.command()(tools.show)

StudyFile = Annotated[
    Path, typer.Argument(metavar="STUDY", help="The study's YAML.", show_default=False)
]


def _complete_override(incomplete: str) -> list[str]:
    """Keys and values for `-o`, when the shell asks."""
    from adaptune.study.keys import complete
    from offline.config import OfflineStudyConfig
    from offline.samplers.settings import NAMES

    return complete(OfflineStudyConfig, incomplete, {"offline.sampler": NAMES})


Override = Annotated[
    list[str],
    typer.Option(
        "-o",
        "--override",
        metavar="KEY=VALUE",
        help="Replace a value of the YAML, as in `-o offline.trials=128`. May be repeated.",
        show_default=False,
        autocompletion=_complete_override,
    ),
]
Folder = Annotated[
    Path | None,
    typer.Option(
        help="The study's folder.", show_default="the YAML's name, under runs/", file_okay=False
    ),
]


def _load(path: Path, overrides: list[str], folder: Path | None) -> "OfflineStudy":
    from offline.offline_study import load_study

    return load_study(path, overrides, folder)


def _version(show: bool) -> None:
    if show:
        import adaptune

        say(f"adaptune {adaptune.__version__}")
        raise typer.Exit


@app.callback()
def _main(
    verbose: Annotated[bool, typer.Option("-v", "--verbose", help="Show more messages.")] = False,
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    from rich.highlighter import NullHighlighter
    from rich.logging import RichHandler

    plain: Any = {"markup": False, "highlighter": NullHighlighter(), "keywords": []}
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(message)s",
        datefmt="[%X]",
        handlers=[RichHandler(console=errors, show_path=False, show_level=False, **plain)],
    )
    for chatty in ("matplotlib", "numba", "asyncio"):
        logging.getLogger(chatty).setLevel(logging.WARNING)


@app.command()
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
    loaded = _load(study, override, folder)
    from adaptune.simulation.recording import record

    if not loaded.config.courses:
        help_ = "add one, as in courses: {demo: {scenes: [cave]}}"
        raise AdaptuneError(f"{study}: courses: there is none to simulate; {help_}")
    loaded.open()
    with progress() as show:
        courses = {name: c for name, c in loaded.config.courses.items() if c.of is None}
        due = [n for n in courses if overwrite or not loaded.sequences.recording(n).exists()]
        for name in due:

            def step(done: int, total: int, name: str = name) -> None:
                show(name, done, total)

            path = loaded.sequences.recording(name)
            record(courses[name], path, overwrite=overwrite, progress=step)
    say(f"Recorded {len(due)} of {len(courses)} courses: {loaded.folder / 'recordings'}/")
    say_next_of_study("run trials, fit the error model", "offline", study, override, folder)


@app.command()
def offline(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Run the trials on a Dask cluster, as tcp://scheduler:8786.",
            show_default="processes of this machine",
        ),
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Renew what has changed.")] = False,
) -> None:
    """Run trials on the training sequences, and fit the error model.

    The table shows the *baseline* (the odometry's own parameters), the *fixed* set (the best over
    all sequences), and each sequence's best. Stop it with Ctrl-C, and run it again to resume.
    """
    loaded = _load(study, override, folder)
    from adaptune import report
    from adaptune.study.driven import driven
    from offline.train import train

    with progress() as show:
        training = train(loaded, show, cluster, again)
    model = training.model
    console.print(
        report.table(
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
    say(driven(loaded, model).words)
    say(f"Error model: {loaded.model_path}")
    say_next_of_trained(bool(model.expected), loaded.config.test, study, override, folder)


@app.command()
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
    loaded = _load(study, override, folder)
    from adaptune import report
    from adaptune import trials as table
    from adaptune.archive import Archive
    from adaptune.study.inputs import warn_of_stale
    from offline.budget import all_done

    warn_of_stale(loaded)
    names = loaded.training
    archive = Archive(loaded.folder / "trials")
    finished = table.rows(archive, names)
    if not finished:
        raise AdaptuneError(f"{archive.folder}: no trial is finished yet; run `adaptune offline`")
    chosen = table.select(finished, where, sort, top)
    if csv:
        sys.stdout.write(report.csv_text(chosen))
    else:
        title = f"{len(chosen)} of {len(finished)} trials"
        console.print(report.table(title, table.with_units(chosen, names)))
        if judged := [row for row in finished if row["mean"] is not None]:
            best = min(judged, key=lambda row: row["mean"])
            say(f"Best mean: {best['mean']:.3f} %, of trial {best['trial']}.")
        if all_done(loaded.config.offline, loaded.folder, (row["trial"] for row in finished)):
            several = len(loaded.training) > 1
            say_next_of_trained(several, loaded.config.test, study, override, folder)
        else:
            why = "run the trials that are left, fit"
            say_next_of_study(why, "offline", study, override, folder)
    if export is not None:
        begin_work()
        n = table.export(archive, names, [row["trial"] for row in chosen], export)
        errors.print(f"{n} trajectories: {export}/")


@app.command()
def validate(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    curve: Annotated[
        bool, typer.Option("--learning-curve", help="Add the gain with fewer stretches.")
    ] = False,
    sizes: Annotated[
        bool, typer.Option("--bank-sizes", help="Add the gain of banks of 2 to 6 members.")
    ] = False,
) -> None:
    """Estimate what adapting gains in places without training data.

    Leaves out one training recording after the other (with fewer than six, one stretch after the
    other), chooses on the rest what to drive, and looks up the errors of the sets that are selected
    in each period. No odometry runs. A bank averages the recorded motions of its members. Numbers
    are ratios to the error of the fixed set, which is chosen without what is left out, too.
    """
    loaded = _load(study, override, folder)
    from adaptune import report
    from offline.validate import validate as validate_study

    with progress() as show:
        validated = validate_study(loaded, curve, sizes, show)
    validation, rows, learning, banks, verdicts = validated
    console.print(
        report.table(
            "Error as a ratio to the fixed set's, each recording or stretch left out in turn",
            rows,
            "Oracles know the errors: the best set of the sequence, and of every period. "
            "Intervals: for a recording, a block bootstrap over time, if it is long enough; for "
            "the geometric mean over the stretches, what is expected elsewhere.",
        )
    )
    known = ", ".join(f"{ratio:.2f}" for ratio in validation.portfolio())
    say(f"If the best of 1, 2, ... complementary sets were always known: {known}.")
    for title, found in (
        (f"With fewer training stretches, by `{validation.default}`", learning),
        ("Banks by number of members", banks),
    ):
        if found:
            caption = "Ratio to the fixed set's error on what is left out; 95 % interval."
            console.print(report.table(title, found, caption))
    for verdict in verdicts:
        say(verdict)
    say(f"Tables and picture: {loaded.folder / 'validation'}.*, {loaded.folder / 'stretches'}.*")
    say_next_online(loaded.config.test, study, override, folder)


@app.command()
def online(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    model: Annotated[
        Path | None,
        typer.Option(help="An error model.", show_default="the study's own", dir_okay=False),
    ] = None,
    again: Annotated[bool, typer.Option(help="Repeat finished replays.")] = False,
    untrained: Annotated[
        bool,
        typer.Option("--untrained", help="Only the baseline, and a bank that needs no model."),
    ] = False,
) -> None:
    """Replay the test sequences: baseline, fixed, and adaptive by every rule.

    Once a second, an adaptive replay describes the newest scan and selects a parameter set with the
    error model. Each replay writes its trajectory (TUM), every selection with its predicted error,
    and the time of each scan (CSV).

    With `--untrained`, it needs no trials, no model and no ground truth. It replays all sequences
    if the study names no test.
    """
    if untrained and model is not None:
        raise AdaptuneError(f"--untrained uses no model; leave out --model {model}")
    loaded = _load(study, override, folder)
    from adaptune.cores import pin
    from online.modes import WITHOUT_MODEL, ReplaySetup, sequences_without_model
    from online.run_replays import run_replays, run_untrained

    # Ask for the number of cores before the replays are bound to one.
    _ = loaded.mechanism
    unpin = pin(os.getpid())
    try:
        with progress() as show:
            if untrained:
                made = run_untrained(loaded, again, show)
            else:
                made = run_replays(loaded, model or loaded.model_path, again, show)
    finally:
        unpin()
    n = len(loaded.config.test) * len(ReplaySetup.of(loaded).modes)
    if untrained:
        n = len(sequences_without_model(loaded)) * len(WITHOUT_MODEL)
    there = f"{made} of {n} replays made" if made else f"All {n} replays were there already"
    say(f"{there}: {loaded.folder / 'replays'}/")
    say_next_of_study("table and pictures of the modes", "compare", study, override, folder)


@app.command()
def switching(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    seconds: Annotated[
        float, typer.Option(help="Seconds of every training sequence to use.", min=10.0)
    ] = 60.0,
) -> None:
    """Measure what a change of parameters costs during a replay.

    Replays the training sequences with the odometry's own parameters, and switches every 5 s to the
    same parameters: with every mechanism that the odometry supports, and several warm-ups. The
    study keeps the switch cost of one set at a time, which selections take into account.
    """
    loaded = _load(study, override, folder)
    from adaptune import report
    from online.switch_cost import measure_switching, switch_cost_in_words

    with progress() as show:
        rows, caption = measure_switching(loaded, seconds, show)
    console.print(
        report.table(
            f"RTE over {loaded.config.sub_trajectory:g} m as a ratio to that without switching",
            rows,
            caption,
        )
    )
    say(switch_cost_in_words(loaded))
    say(f"Kept in {loaded.folder / 'switching.json'}.")
    say_next_online(loaded.config.test, study, override, folder)


@app.command()
def compare(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
) -> None:
    """Compare the replays: a table, CSV, JSON, and a picture for every sequence replayed.

    *RTE* is the mean sub-trajectory error. *vs fixed* is its ratio to the fixed set's error: below
    1, adapting is better. *estimated* is the error that a bank measured itself. Intervals come from a block bootstrap over time: they hold for these
    recordings, not for other places.
    """
    loaded = _load(study, override, folder)
    from adaptune.study.driven import MIN_RECORDINGS
    from offline.budget import TRIALS, more_trials
    from online.comparison import compare as compare_replays
    from online.comparison import remarks, tables

    loaded.check()
    begin_work()
    rows = compare_replays(loaded)
    for table in tables(rows, loaded.config.sub_trajectory):
        console.print(table)
    for said in remarks(rows):
        say(said)
    say(f"Tables and pictures: {loaded.folder / 'comparison'}/")
    if rows[0].yardstick == "baseline":
        known = any(row.rte is not None for row in rows)
        first = "" if known else "give the training sequences a reference; then "
        say_next_of_study("look for better sets", "offline", study, override, folder, first)
        return
    say(f"Fixed set: {loaded.folder / 'fixed.yaml'}")
    n, more = len(loaded.config.training), more_trials(loaded.config.offline, override)
    if n < MIN_RECORDINGS and more is not None:
        why = f"try {TRIALS} sets; {MIN_RECORDINGS} training recordings tell of other recordings"
        say_next_of_study(why, "offline", study, more, folder)
    elif n < MIN_RECORDINGS:
        first = f"name {MIN_RECORDINGS} training recordings or more, the study has {n}; then "
        why = "find out what adapting gains elsewhere"
        say_next_of_study(why, "offline", study, override, folder, first)
    else:
        why = "what it has learned; docs/adapting-live.md brings it to the robot"
        say_next(why, "model", "show", loaded.model_path)


def main() -> None:
    """Run the command line."""
    app(prog_name="adaptune")


if __name__ == "__main__":
    main()
