"""The command line: the one place that knows both stages."""

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from typer.core import TyperGroup

import adaptune
from adaptune.errors import AdaptuneError
from adaptune.study import load_study

# Tables that are piped are wrapped for nobody, unless COLUMNS says how wide they may be.
console = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else 200)
errors = Console(stderr=True)


class _Commands(TyperGroup):
    """Ends with code 2 for what the user can mend, and with 130 for Ctrl-C."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (AdaptuneError, OSError) as error:
            if isinstance(error, BrokenPipeError):
                raise  # whoever read our output has gone
            errors.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
            raise typer.Exit(2) from error
        except KeyboardInterrupt as error:
            errors.print("interrupted; run the same command again to resume", style="yellow")
            raise typer.Exit(130) from error


app = typer.Typer(
    name="adaptune",
    cls=_Commands,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help=(
        "Tune the parameters of a LiDAR odometry, and keep tuning them while the robot drives.\n\n"
        "A study is a YAML file: an odometry, its parameters, sequences to train and to test on. "
        "Everything about it is kept in a folder, and the same command run again goes on where "
        "the last one stopped.\n\n"
        "    adaptune inspect  my.bag               # what is in a recording\n\n"
        "    adaptune simulate configs/demo.yaml    # record its simulated sequences\n\n"
        "    adaptune offline  configs/demo.yaml    # run trials, fit the error model\n\n"
        "    adaptune trials   configs/demo.yaml    # list, sort and export its trials\n\n"
        "    adaptune validate configs/demo.yaml    # would adapting pay elsewhere?\n\n"
        "    adaptune switching configs/demo.yaml   # what a change on the way costs\n\n"
        "    adaptune online   configs/demo.yaml    # replay the test sequences\n\n"
        "    adaptune compare  configs/demo.yaml    # baseline, fixed and adaptive"
    ),
)

models = typer.Typer(no_args_is_help=True, cls=_Commands, help="Look at error models.")
app.add_typer(models, name="model")

LOG_EVERY = 5.0
"""Seconds between lines of progress where there is no terminal to draw a bar on."""

StudyFile = Annotated[
    Path, typer.Argument(metavar="STUDY", help="The study's YAML.", show_default=False)
]
Override = Annotated[
    list[str],
    typer.Option(
        "-o",
        "--override",
        metavar="KEY=VALUE",
        help="Replace a value of the YAML, as in `-o offline.trials=128`. May be repeated.",
        show_default=False,
    ),
]
Folder = Annotated[
    Path | None,
    typer.Option(
        help="The study's folder.", show_default="the YAML's name, under runs/", file_okay=False
    ),
]


def _version(show: bool) -> None:
    if show:
        console.print(f"adaptune {adaptune.__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def _main(
    verbose: Annotated[bool, typer.Option("-v", "--verbose", help="Say more.")] = False,
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which version.")
    ] = False,
) -> None:
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(message)s",
        datefmt="[%X]",
        handlers=[RichHandler(console=errors, show_path=False, show_level=False, markup=False)],
    )
    for chatty in ("matplotlib", "numba", "asyncio"):
        logging.getLogger(chatty).setLevel(logging.WARNING)


@app.command()
def inspect(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A bag, or its folder.", show_default=False)
    ],
    png: Annotated[
        Path | None, typer.Option(help="Draw the first scan to this PNG.", dir_okay=False)
    ] = None,
) -> None:
    """Tell what is in a recording, what each stage lacks, and how to name it in a study."""
    from adaptune.inspect import inspect as inspect_file
    from adaptune.inspect import render_inspection, write_inspection_png

    found = inspect_file(file)
    console.print(render_inspection(found))
    if png is not None:
        write_inspection_png(found, png)
        console.print(f"First scan: {png}", highlight=False)


class CacheAction(StrEnum):
    """What to do with the cache."""

    LIST = "list"
    CLEAR = "clear"


@app.command()
def cache(
    action: Annotated[CacheAction, typer.Argument(help="List or clear it.")] = CacheAction.LIST,
) -> None:
    """List or clear the decoded recordings that are kept on disk.

    Bags are decoded once and mapped into memory from then on. `ADAPTUNE_CACHE` names another
    folder; `ADAPTUNE_CACHE_GB` bounds its size (50), and 0 turns it off.
    """
    from adaptune.inspect import render_cache
    from adaptune.sequence.cache import clear_cache

    if action is CacheAction.CLEAR:
        console.print(f"Freed {clear_cache() / 1e9:.2f} GB.", highlight=False)
    else:
        console.print(render_cache())


@app.command()
def serve(
    odometry: Annotated[
        str | None,
        typer.Argument(help="The only one to serve.", show_default="as each hello says"),
    ] = None,
    listen: Annotated[
        str | None,
        typer.Option(help="Serve all who connect to tcp://HOST:PORT or unix:PATH instead."),
    ] = None,
) -> None:
    """Answer another program's messages with an odometry, over standard input and output.

    What the odometry itself writes goes to standard error, or is told with its fault where it has
    a process of its own. `docs/odometry.md` describes the messages.
    """
    from adaptune.odometry import serving

    if listen is not None:
        if odometry is None:
            raise AdaptuneError("--listen serves one odometry: name it")
        serving.listen(
            listen, odometry, lambda at: console.print(f"{odometry} at {at}", highlight=False)
        )
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as writer:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        serving.serve(sys.stdin.buffer, writer, odometry)


@app.command()
def simulate(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    overwrite: Annotated[bool, typer.Option(help="Record again what is there.")] = False,
) -> None:
    """Record the study's simulated courses, as bags with ground truth.

    Each course under `courses:` becomes a bag in the BotanicGarden layout, with its truth in a TUM
    file and a picture beside it.
    """
    from adaptune.simulation import record

    loaded = load_study(study, override, folder)
    if not loaded.config.courses:
        raise AdaptuneError(f"{study}: courses: there is none to simulate")
    loaded.open()
    with _progress() as progress:
        for name, course in loaded.config.courses.items():
            path = loaded.recording(name)
            if path.exists() and not overwrite:
                continue

            def step(done: int, total: int, name: str = name) -> None:
                progress(name, done, total)

            record(course, path, overwrite=overwrite, progress=step)
    console.print(f"Recordings are in {loaded.recording('*').parent}/", highlight=False)


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
) -> None:
    """Run trials on the training sequences, and fit the error model.

    Each trial runs one parameter set on every training sequence. The table shows the *baseline*
    (the odometry's own parameters), the *fixed* set (the best one over all training sequences),
    and each sequence's own best. Stop it with Ctrl-C and run it again to resume.
    """
    from adaptune import report
    from offline.train import train

    loaded = load_study(study, override, folder)
    console.print(f"Seed {loaded.config.offline.seed}.", highlight=False)
    with _progress() as progress:
        training = train(loaded, progress, cluster)
    model = training.model
    console.print(
        report.table(
            f"RTE [%] over {model.length:g} m in training, "
            f"{len(next(iter(training.means.values())))} parameter sets",
            training.rows,
            "Trials start anew at the reference after a lost track, which counts as 30 %; whole "
            "runs do not.",
        )
    )
    console.print(f"Baseline: {_short(loaded.space.baseline)}", highlight=False)
    console.print(f"Fixed: {_short(model.sets[model.fixed])}", highlight=False)
    if len(loaded.config.offline.objective) > 1:
        front = loaded.folder / "pareto"
        console.print(f"The sets that no other one beats in all: {front}.*", highlight=False)
    if loaded.mechanism == "bank" and model.fusion.hedge < 1.0:
        console.print(f"Bank: trials {', '.join(map(str, model.bank_trials))}", highlight=False)
    elif model.paired.n_sets == 1:
        console.print(
            "On the training sequences left out in turn nothing showed that adapting pays, for "
            "which it takes six or more: `paired` will always take the fixed set.",
            highlight=False,
        )
    console.print(f"Error model: {loaded.folder / 'model.safetensors'}", highlight=False)


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
    top: Annotated[int | None, typer.Option(help="How many to show.", min=1)] = None,
    csv: Annotated[bool, typer.Option("--csv", help="Write CSV to standard output.")] = False,
    export: Annotated[
        Path | None,
        typer.Option(help="Write their trajectories there, as TUM.", file_okay=False),
    ] = None,
) -> None:
    """List the study's finished trials, also while it runs.

    Columns are the trial's number, its parameters, its `mean` RTE in percent over all training
    sequences and on each of them, how often it lost track, how often its process ended, how often
    the health check would have spoken, and its other metrics.
    """
    from adaptune import report
    from adaptune import trials as table
    from adaptune.archive import Archive

    loaded = load_study(study, override, folder)
    names = loaded.training
    archive = Archive(loaded.folder / "trials")
    finished = table.rows(archive, names)
    if not finished:
        raise AdaptuneError(f"{archive.folder}: no trial is finished yet; run `adaptune offline`")
    chosen = table.select(finished, where, sort, top)
    if csv:
        sys.stdout.write(report.csv_text(chosen))
    else:
        title = f"{len(chosen)} of {len(finished)} trials, RTE [%]"
        console.print(report.table(title, chosen))
    if export is not None:
        n = table.export(archive, names, [row["trial"] for row in chosen], export)
        errors.print(f"{n} trajectories: {export}/", highlight=False)


@app.command()
def validate(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    curve: Annotated[
        bool, typer.Option("--learning-curve", help="Tell what fewer sequences would gain, too.")
    ] = False,
    sizes: Annotated[
        bool, typer.Option("--bank-sizes", help="Tell what banks of 2 to 6 would gain, too.")
    ] = False,
) -> None:
    """Tell whether adapting would pay in places that were not trained on.

    Leaves out one training sequence after the other, fits on the rest, and looks up the errors of
    the sets that would have been chosen, period by period: no odometry is run. A bank takes the
    mean of the motions that were recorded of its members. Numbers are ratios to the error of the
    fixed set, which is chosen without that sequence too.
    """
    from adaptune import report
    from offline.validate import validate as validate_study

    loaded = load_study(study, override, folder)
    with _progress() as progress:
        validation, rows, learning, banks = validate_study(loaded, curve, sizes, progress)
    console.print(
        report.table(
            "Error as a ratio to the fixed set's, each sequence left out in turn",
            rows,
            "Oracles know the errors: the best set of the sequence, and of every period. "
            "Intervals: on a sequence, of a block bootstrap over time, where it is long enough; "
            "of the geometric mean, Student's over the sequences.",
        )
    )
    known = ", ".join(f"{ratio:.2f}" for ratio in validation.portfolio())
    console.print(
        f"If the best of 1, 2, ... complementary sets were always known: {known}.", highlight=False
    )
    for title, found in (
        (f"With fewer training sequences, by `{validation.default}`", learning),
        ("Banks of so many instances", banks),
    ):
        if found:
            caption = "Ratio to the fixed set's error on sequences left out; 95 % interval."
            console.print(report.table(title, found, caption))
    for mode in validation.modes:
        console.print(validation.verdict(mode), highlight=False)
    console.print(f"Tables and picture: {loaded.folder / 'validation'}.*", highlight=False)


@app.command()
def online(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    model: Annotated[
        Path | None,
        typer.Option(help="An error model.", show_default="the study's own", dir_okay=False),
    ] = None,
    again: Annotated[bool, typer.Option(help="Replay what has been replayed.")] = False,
) -> None:
    """Replay the test sequences: baseline, fixed, and adaptive by every rule.

    Once a second, the adaptive replays describe the newest scan and take the parameter set that
    the error model prefers. Each replay writes its trajectory (TUM), every selection with its
    predicted error, and what each scan took (CSV).
    """
    from adaptune.cores import pin
    from online.comparison import run_replays

    loaded = load_study(study, override, folder)
    # It asks how many cores there are, of which the replays see one.
    _ = loaded.mechanism
    unpin = pin(os.getpid())
    try:
        with _progress() as progress:
            made = run_replays(
                loaded, model or loaded.folder / "model.safetensors", again, progress
            )
    finally:
        unpin()
    console.print(f"{made} replays made; all are in {loaded.folder / 'replays'}/", highlight=False)


@app.command()
def switching(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    seconds: Annotated[
        float, typer.Option(help="How much of every training sequence to use.", min=10.0)
    ] = 60.0,
) -> None:
    """Measure what it costs to change parameters on the way.

    Drives the training sequences with the odometry's own parameters, changing every 5 s to the
    same ones: by every mechanism that the odometry can have, and for several lengths of warm-up.
    The price of the study's own mechanism is kept with it, for selections to weigh.
    """
    from online.switching import measure_switching

    from adaptune import report

    loaded = load_study(study, override, folder)
    with _progress() as progress:
        rows = measure_switching(loaded, seconds, progress)
    console.print(
        report.table(
            f"RTE over {loaded.config.sub_trajectory:g} m as a ratio to that without switching",
            rows,
            f"This study switches by {loaded.mechanism}, at a price of {loaded.price():.1%}; kept "
            f"in {loaded.folder / 'switching.json'}.",
        )
    )


@app.command()
def compare(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
) -> None:
    """Compare the replays: a table, CSV, JSON, and a picture for every test sequence.

    *RTE* is the mean sub-trajectory error; *vs fixed* its ratio to the fixed set's, below 1 where
    adapting won. Intervals are of a block bootstrap over time: they speak of these drives, not of
    other places.
    """
    from adaptune import report
    from online.comparison import compare as compare_replays

    loaded = load_study(study, override, folder)
    loaded.check()
    rows = compare_replays(loaded)
    console.print(
        report.table(
            f"RTE over {loaded.config.sub_trajectory:g} m on test sequences",
            rows,
            "Intervals of 95 %: block bootstrap over time, where the drive is long enough; seed 0. "
            "`all`: mean RTE, and geometric mean of the ratios.",
        )
    )
    console.print(f"Tables and pictures: {loaded.folder / 'comparison'}/", highlight=False)


@models.command()
def show(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="An error model.", show_default=False)
    ],
) -> None:
    """Explain an error model: its sets, sequences, provenance, and what validation found."""
    from adaptune.model import ErrorModel
    from adaptune.model.show import render

    console.print(render(ErrorModel.load(file), file), highlight=False)


def _short(parameters: dict[str, Any]) -> str:
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in parameters.items()
    )


@contextmanager
def _progress() -> Iterator[Callable[..., None]]:
    """A bar for each thing that is done; where there is no terminal, a line now and then."""
    if not errors.is_terminal:
        log = logging.getLogger("adaptune")
        last = time.monotonic()

        def say(what: str, done: int, total: int, remark: str = "") -> None:
            nonlocal last
            if done >= total or time.monotonic() - last > LOG_EVERY:
                last = time.monotonic()
                log.info("%s: %d of %d%s", what, done, total, remark and f", {remark}")

        yield say
        return
    bars = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[remark]}"),
        console=errors,
    )
    tasks: dict[str, TaskID] = {}
    with bars:

        def show(what: str, done: int, total: int, remark: str = "") -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total, remark="")
            bars.update(tasks[what], completed=done, total=total, remark=remark)

        yield show


def main() -> None:
    """Run the command line."""
    app()


if __name__ == "__main__":
    main()
