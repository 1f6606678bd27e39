"""Commands of the online stage."""

import logging
import math
import os
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from adaptune.commands.terminal import (
    As,
    Cluster,
    Folder,
    Given,
    Override,
    Points,
    StudyFile,
    begin_work,
    load,
    progress,
    say,
    say_next,
    say_next_of_study,
    show_front,
    show_table,
)
from adaptune.errors import AdaptuneError

if TYPE_CHECKING:
    from adaptune.runs.record import Run
    from offline.config import OfflineStudy
    from online.compare import Comparison

log = logging.getLogger(__name__)

ORACLE_SETS = 16
"""Sets that run on the test sequences in hindsight."""


Mode = Annotated[
    str | None,
    typer.Option(
        help="On a robot, what to drive: baseline, fixed, standby, adaptive or paper.",
        show_default="what is recommended",
    ),
]
Model = Annotated[
    Path | None,
    typer.Option(help="An error model.", show_default="the study's own", dir_okay=False),
]
Untrained = Annotated[
    bool, typer.Option("--untrained", help="Only the baseline, and a bank that needs no model.")
]
Ros2 = Annotated[bool, typer.Option("--ros2", help="Drive on a robot with ROS 2.")]
Details = Annotated[bool, typer.Option("--details", help="Print all sentences and tables.")]
Oracle = Annotated[
    bool, typer.Option("--oracle", help="Drive sets on the test: what was there to gain?")
]


def online(
    study: StudyFile,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    model: Model = None,
    untrained: Untrained = False,
    ros: Annotated[bool, typer.Option("--ros", help="Drive on a robot with ROS 1.")] = False,
    ros2: Ros2 = False,
    mode: Mode = None,
    oracle: Oracle = False,
    cluster: Cluster = None,
) -> None:
    """Replay the test sequences: baseline, fixed, what is recommended, and `online.modes`.

    Once a second, an adaptive replay describes the newest scan and selects a parameter set with the
    error model. Each replay writes its trajectory (TUM), every selection with its predicted error,
    and the time of each scan (CSV). Before, it estimates the reference of sequences that have none.

    With `--untrained`, it needs no trials, no model and no ground truth. It replays all sequences
    if the study names no test.

    With `-o online.modes=all`, it replays all modes, those to compare with, too.

    With `-o online.real_time.rate=1`, scans come when the sensor gave them. A selection that is
    late is dropped, and so are scans that wait too long.

    With `--ros` or `--ros2`, scans come from a topic of a robot, until Ctrl-C. Without `--mode`, it
    drives what is recommended; of a single set, `standby` where that is possible.

    With `--oracle`, it replays nothing. It runs sets of the model on the test sequences as trials,
    to know the best choice in hindsight: the fixed set, the members of the bank, and those that
    complement each other best in training. Nothing is learned from them.
    """
    robot = ros or ros2
    wrong = {
        "--cluster is for the trials of --oracle": cluster and not oracle,
        f"--untrained uses no model; leave out --model {model}": untrained and model,
        f"--untrained is a mode of its own; leave out --mode {mode}": untrained and mode,
        "give only one of --ros and --ros2": ros and ros2,
        f"--mode {mode} is for a robot (--ros, --ros2); all modes are replayed": mode and not robot,
    }
    for words, is_wrong in wrong.items():
        if is_wrong:
            raise AdaptuneError(words)
    loaded = load(study, override, folder, runs=True)
    if robot:
        _drive(loaded, mode, model, untrained=untrained, ros2=ros2)
        return
    if oracle:
        _oracle(loaded, cluster)
    else:
        from online.modes import run_replays, run_untrained

        with progress() as show:
            path = model or loaded.model_path
            made = run_untrained(loaded, show) if untrained else run_replays(loaded, path, show)
        there = f"{made} replays made" if made else "All replays were there already"
        say(f"{there}: {loaded.folder / 'replays'}/")
    say_next_of_study("table and pictures of the modes", "compare")


def _oracle(loaded: "OfflineStudy", cluster: str | None) -> None:
    from offline.train import run_oracle

    with progress() as show:
        rows = run_oracle(loaded, ORACLE_SETS, show, cluster)
    show_table(
        f"RTE [%] over {loaded.config.sub_trajectory:g} m on test sequences, as trials",
        rows,
        "The best set is known only in hindsight: no rule can rely on it.",
    )
    say(f"Trials: {loaded.folder / 'oracle'}/")


def _drive(
    loaded: "OfflineStudy", mode: str | None, model: Path | None, *, untrained: bool, ros2: bool
) -> None:
    from adaptune._system.machine import pin
    from adaptune.ros.relay import local_ros1
    from adaptune.ros.ros2 import local_ros2
    from online.modes import UNTRAINED, WITHOUT_MODEL
    from online.robot import RobotDrive

    mode = UNTRAINED if untrained else mode
    path = None if mode in WITHOUT_MODEL else model or loaded.model_path
    drive = RobotDrive(loaded, mode, path)
    link = local_ros2() if ros2 else local_ros1()
    with closing(link), pin(os.getpid(), alone=True), progress() as show:
        log.info("drive, %s: Ctrl-C ends it", drive.mode)
        run = drive.run(link, lambda of: show("drive", of.done, of.done, now(of)))
    dropped = f", {run.dropped} of them dropped" if run.dropped else ""
    say(f"{drive.done} scans{dropped}: {drive.folder}/")


def now(run: "Run") -> str:
    """How a drive goes, in a few words."""
    late = {"dropped": run.dropped, "selections missed": run.missed}
    words = [f"{n} {what}" for what, n in late.items() if n]
    if (choice := run.newest) is not None:
        words.append(f"trial {choice.selection.trial}")
        if math.isfinite(error := choice.selection.estimated_error):
            words.append(f"error {error:.2f} %")
        if choice.selection.lost:
            words.append("lost: do not rely on the pose")
    return ", ".join(words)


NewSide = Annotated[
    str,
    typer.Argument(metavar="STUDY", help="A study's YAML, or its folder.", show_default=False),
]
Driven = Annotated[
    list[Path] | None,
    typer.Argument(metavar="[BAG]...", help="With --against, what to drive.", show_default=False),
]
Against = Annotated[
    str | None,
    typer.Option(
        metavar="OLD",
        help="Is STUDY worse than this one? Both may also be parameter files, or odometries "
        "(names, commands, images), to be driven on bags.",
    ),
]
OfFiles = Annotated[str | None, typer.Option(metavar="NAME", help="Of parameter files.")]
Worse = Annotated[
    str, typer.Option(metavar="PERCENT", help="Increase of the error that is tolerated.")
]
Cost = Annotated[
    str, typer.Option(metavar="PERCENT", help="Increase of the cost that is tolerated, or `off`.")
]
Length = Annotated[
    float | None,
    typer.Option(
        metavar="METRES",
        help="What errors are measured over.",
        show_default="the studies'; of cars 10 m, else 2 m",
    ),
]
Unclear = Annotated[
    Literal["pass", "fail"], typer.Option(help="How to treat an inconclusive result.")
]
Out = Annotated[
    Path, typer.Option(help="Folder of verdict.json, junit.xml and summary.md.", file_okay=False)
]


def compare(
    study: NewSide,
    recordings: Driven = None,
    against: Against = None,
    odometry: OfFiles = None,
    points: Points = None,
    reference: Given = None,
    reading: As = None,
    worse: Worse = "5%",
    cost: Cost = "10%",
    sub_trajectory: Length = None,
    unclear: Unclear = "pass",
    out: Out = Path("runs/compare"),
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    model: Model = None,
    details: Details = False,
) -> None:
    """Compare the replays: what to drive, what adapting gained, and at what cost.

    *RTE* is the mean sub-trajectory error. *vs fixed* is its ratio to the fixed set's error: below
    1, adapting is better. Intervals come from blocks of scans. With six test sequences or more,
    they speak of other sequences like these, else of these alone. Where an estimated
    reference judged, they include its own error.

    The study's folder receives a page (HTML) of all that is known of the study, also of one that
    is not finished. It opens without a network, and its charts lie beside it as PNG and SVG. All
    tables are there as CSV, JSON and Markdown, too; `--details` prints them.

    With `--against`, it says whether STUDY is worse than OLD, recording by recording, in error, in
    CPU time and in restarts by the health check. Its exit code is 3 then. For the CPU time, it
    drives both twice, by turns.
    """
    of_bags: dict[str, object] = {"BAG": recordings, "--odometry": odometry, "--points": points}
    of_bags |= {"--reference": reference, "--as": reading}
    of_both = of_bags | {"--sub-trajectory": sub_trajectory}
    if against is not None:
        if override or folder or model or details:
            words = "-o, --folder, --model and --details go with one study, not with --against"
            raise AdaptuneError(words)
        if not recordings and any(of_bags.values()):
            raise AdaptuneError(f"{_given(of_bags)}: goes with the bags to drive; name them, too")
        if sub_trajectory is not None and not 0.0 < sub_trajectory < math.inf:
            raise AdaptuneError(f"--sub-trajectory {sub_trajectory:g}: give metres, more than 0")
        given: dict[str, Any] = {"points": points, "reference": reference, "reading": reading}
        given |= {"odometry": odometry or "", "sub_trajectory": sub_trajectory}
        _gate((study, against), recordings or (), (worse, cost), given, unclear, out)
        return
    if any(of_both.values()):
        raise AdaptuneError(f"{_given(of_both)}: goes with --against, which names the other side")
    from adaptune.tuning.tuned import write_comparison

    loaded = _with_model(load(Path(study), override, folder), model)
    begin_work()
    found, page = write_comparison(loaded)
    say_compared(loaded, found, page, details=details)
    _say_next(loaded, found)


def _with_model(loaded: "OfflineStudy", model: Path | None) -> "OfflineStudy":
    return loaded if model is None else replace(loaded, model_file=model)


def _say_next(loaded: "OfflineStudy", found: "Comparison") -> None:
    from adaptune.paired import MIN_RECORDINGS

    if found.rows[0].yardstick == "baseline":
        sequences = loaded.sequences
        unjudged = sequences.unjudged(loaded.training)
        keys = " and ".join(dict.fromkeys(sequences.recorded_in(name) for name in unjudged))
        first = f"leave out `reference: none` of {keys}; then " if keys else ""
        say_next_of_study("look for better sets", "offline", first)
    elif found.unfinished:
        say_next_of_study("replay what is missing", "online")
    elif {*loaded.config.training, *loaded.config.test} <= loaded.config.courses.keys():
        say_next("tune on a recording of your own", "tune", "your.bag")
    elif loaded.rules and (n := len(loaded.config.training)) < MIN_RECORDINGS:
        first = f"name {MIN_RECORDINGS} training recordings or more, the study has {n}; then "
        say_next_of_study("find out what adapting gains elsewhere", "offline", first)
    else:
        say_next_of_study("replays to look at in Foxglove", "record")


WORSE = 3
"""Exit code of the gate."""


def _given(options: Mapping[str, object]) -> str:
    return ", ".join(name for name, value in options.items() if value)


def _gate(
    both: tuple[str, str],
    recordings: Sequence[Path],
    percents: tuple[str, str],
    given: Mapping[str, Any],
    unclear: str,
    out: Path,
) -> None:
    """Say whether the first side is worse than the second one, and exit with a code."""
    from adaptune.tuning import sides
    from online.gate import write_gate

    worse, cost = percents
    bounds = percent(worse, "worse"), None if cost == "off" else percent(cost, "cost")
    with progress() as show:
        gate = sides.compare(
            *both, recordings, worse=bounds[0], cost=bounds[1], progress=show, **given
        )
    write_gate(out, gate)
    say(gate.words)
    title = f"New against old, RTE over {gate.length:g} m"
    show_table(title, [row.columns() for row in gate.rows])
    say(f"Files: {out}/verdict.json, junit.xml, summary.md")
    if gate.verdict == "worse" or (gate.verdict == "unclear" and unclear == "fail"):
        raise typer.Exit(WORSE)


def percent(text: str, key: str) -> float:
    """The percentage of an option."""
    with suppress(ValueError):
        if 0.0 <= (value := float(text.removesuffix("%"))) < math.inf:
            return value
    off = ", or `off`" * (key == "cost")
    raise AdaptuneError(f"--{key} {text}: give a percentage, as in --{key} 5%{off}")


def say_compared(
    loaded: "OfflineStudy", found: "Comparison", page: Path, *, details: bool = False
) -> None:
    """Print what to do and what may be driven; with `details`, all that is on the page."""
    from online.tables import controls, tables

    length = loaded.config.sub_trajectory
    say(" ".join(found.verdict))
    if found.front:
        show_front(loaded, found.front)
    say(f"More: {page}")
    for sentence in found.details if details else ():
        say(sentence)
    for made in tables(found.rows, length) if details else controls(found.rows, length):
        show_table(*made)


def record(
    study: StudyFile,
    sequences: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[SEQUENCE]...", help="Of the study.", show_default="all that were replayed"
        ),
    ] = None,
    override: Override = [],  # noqa: B006
    folder: Folder = None,
    model: Model = None,
) -> None:
    """Write replays as MCAP files to look at, with Foxglove or Rerun.

    A file holds the paths of all modes and of the reference, one scan a second, and over time the
    chosen parameters or weights, the predicted, estimated and true errors, and the time that each
    step took. The replays stay as they are.
    """
    loaded = _with_model(load(study, override, folder), model)
    from online.recordings import record_replays, replayed_sequences

    with progress() as show:
        names = replayed_sequences(loaded, sequences or ())
        written = [record_replays(loaded, name, show) for name in names]
    for path in written:
        say(f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
    say("Foxglove shows all of it (`Open local file`), Rerun the scans and the motion.")
