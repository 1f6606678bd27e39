"""Commands that begin with recordings: look at one, or tune an odometry on them."""

from collections.abc import Sequence
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from adaptune._system.files import write_text
from adaptune.commands.online import Details, say_compared
from adaptune.commands.terminal import (
    As,
    Cluster,
    Given,
    Override,
    Points,
    console,
    load,
    progress,
    say,
    say_next,
    show_table,
)
from adaptune.errors import AdaptuneError
from adaptune.tuning import TRIALS

if TYPE_CHECKING:
    from adaptune.recording.fleet import Reading
    from adaptune.tuning.tuned import Tuned
    from offline.config import OfflineStudy


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
    study: Annotated[
        Path | None,
        typer.Option(metavar="YAML", help="Write the study to this file.", dir_okay=False),
    ] = None,
    reading: As = None,
) -> None:
    """Show what is in a recording, what each stage lacks, and how to name it in a study.

    Of a folder with several recordings, show each in a line. Of an error model, or of a study's
    folder, show what it is of and its best sets.
    """
    if file.suffix == ".safetensors" or (file / "model.safetensors").exists():
        _show_model(file)
        return
    if file.suffix in (".yaml", ".yml") and _look(file):
        return
    from adaptune._system.yaml12 import dump
    from adaptune.odometry.portfolio import portfolios_of
    from adaptune.recording.inspect import inspect as inspect_file
    from adaptune.recording.rendering import render_inspection
    from adaptune.tuning.asked import check_no_study
    from adaptune.tuning.studies import ROLES, proposed, roles

    check_no_study(file)
    if study is not None and study.exists():
        raise AdaptuneError(f"{study}: exists; name another file with --study, or move it away")
    if _show_several(file, reading):
        return
    with progress() as show:
        found = inspect_file(file, deep, show)
        share, length, accuracy = proposed(found, deep, show)
    console.print(render_inspection(found, accuracy), crop=False)
    if not found.name:
        return
    if found.missing.get("offline"):
        help_ = "where only the reference does not serve, write `reference: estimated`"
        say(f"Next: mend what is lacking, see docs/your-bag.md; {help_}")
        return
    rest = roles([found.name], length, {"name": "gicp"}, share)
    rest |= {"offline": {"portfolio": portfolios_of(["gicp"])}}
    say(dump(rest, ROLES))
    path = study or Path(f"{found.name}.yaml")
    first = "" if study else f"put the lines from `sequences:` on in {path}; then "
    if study is not None:
        data = {"sequences": {found.name: found.given}} | rest
        write_text(study, dump(data, found.hints | ROLES))
    if found.reference is None and study is None:
        say_next("find where it moves, train on a part of it and compare", "tune", file)
    else:
        say_next("train on a part of it", "offline", path, first=first)


def _show_several(path: Path, reading: "Reading | None") -> bool:
    """Show the recordings of a folder, a line each; False if it holds one, or may."""
    from adaptune.recording.fleet import both_readings, check_alike, read_folder
    from adaptune.recording.inspect import inspect as inspect_file

    folder = read_folder(path) if path.exists() else None
    if folder is None or (reading or folder.reading) == "one":
        return False
    if reading is None and folder.reading is None:
        say(f"{path}: {both_readings(folder)}. As several:")
    with progress() as show:
        found = [inspect_file(one, False, show) for one in folder.recordings]
    rows = []
    for at, one in zip(folder.recordings, found, strict=True):
        topic = one.topics.get(one.used.get("points", ""))
        scans = {"scans": topic and topic.count, "rate [Hz]": topic and topic.rate}
        given = {"reference": one.used.get("reference", "estimated")}
        wrong = {"lacks": ", ".join(one.missing.get("offline", ())) or None}
        rows.append({"recording": str(at.relative_to(path)), **scans, **given, **wrong})
    show_table(f"{path}: {len(rows)} recordings ({folder.why})", rows)
    if reading is None and folder.reading is None:
        say("As one:")
        return False
    check_alike([one for one in found if "points" in one.used])
    say_next("tune on all of them", "tune", path)
    return True


_LOOK = 20.0
"""Seconds of a recording on which a ROS system is looked at."""


def _look(path: Path) -> bool:
    """Show what the ROS system of a study does; False if it has none."""
    from adaptune._system.yaml12 import Document, YamlError
    from adaptune.odometry.registry import ROS_SYSTEMS
    from adaptune.trajectory import is_kitti
    from adaptune.tuning.studies import LACKING

    if path.is_file():
        given: Any = None
        with suppress(YamlError):
            given = Document.of_file(path).data
        if not isinstance(given, dict) or "odometry" not in given:
            is_kitti(path)  # poses as YAML are refused
    loaded = load(path, [], None)
    factory: Any = loaded.odometry
    if loaded.config.odometries.keys().isdisjoint(ROS_SYSTEMS) or len(loaded.config.odometries) > 1:
        return False
    lines = enumerate(path.read_text("utf-8").splitlines(), 1)
    if lacking := [str(n) for n, line in lines if LACKING in line.partition("#")[0]]:
        raise AdaptuneError(f"{path}, line {', '.join(lacking)}: fill in what stands as {LACKING}")
    from adaptune.odometry.systems.probe import far_ends, look

    load(path, [], None, runs=True)  # what is not installed is told as by other commands
    name = loaded.config.training[0]
    scans = loaded.sequences.open(name)
    first = next(iter(scans)).stamp
    some = takewhile(lambda scan: scan.stamp < first + _LOOK * 1e9, scans)
    say(f"{factory.name} on the first {_LOOK:g} s of {name}, with the baseline's parameters:")
    space = factory.space
    found = look(factory.settings, space.baseline, factory.limits, some, far_ends(space))
    found |= _frames(scans, factory.settings)
    show_table("What it does", [{"": key, "found": value} for key, value in found.items()])
    if "went wrong" not in found:
        say_next("run the trials", "offline", path)
    return True


def _frames(recording: Any, given: Any) -> dict[str, str]:
    """The recording's frames as the settings take them, where they have none."""
    from adaptune.recording.bag import BagSource

    source = getattr(recording, "source", None)
    if given.system.ros == 1 or given.play == "bag" or not isinstance(source, BagSource):
        return {}
    frame, fixed = source.fixed_frames()
    if given.transforms or not fixed:
        return {}
    every = (f"{child}: [{parent}, {pose}]" for child, (parent, pose) in fixed.items())
    return {
        "frames of the recording": "if it needs them, set odometry.settings."
        + f"frame: {frame}, and " * bool(frame)
        + f"transforms: {{{', '.join(every)}}}"
    }


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


Trials = Annotated[
    int | None, typer.Option(help="Parameter sets to try.", min=2, show_default=f"{TRIALS}")
]
Minutes = Annotated[
    float | None, typer.Option(help="Time for all of it; without, all sets are tried.", min=0.01)
]
Budget = Annotated[
    str | None,
    typer.Option(
        metavar="MS|TIMES",
        help="CPU time a scan that may be spent: milliseconds, or times what the odometry's own "
        "parameters take, as in 3x.",
        show_default="2x for one set, more for a bank",
    ),
]


Portfolio = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Parameter sets to try first, in place of ours; or none."),
]


Bags = Annotated[
    list[Path],
    typer.Argument(
        metavar="BAG...", help="Bags of one robot, or folders of them.", show_default=False
    ),
]
Odometry = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="gicp, my_module:MyClass, ..., several with commas, or `all`; or an image.",
        show_default="gicp; with --config kiss_icp",
    ),
]
Config = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Your parameter file: the baseline, and all that is not tuned."
    ),
]
Test = Annotated[
    list[Path], typer.Option(metavar="BAG", help="A recording for the test. May be repeated.")
]


Kept = Annotated[
    Path | None,
    typer.Option(help="The study's folder.", show_default="the first bag's name, under runs/"),
]


def tune(
    recordings: Bags,
    odometry: Odometry = None,
    config: Config = None,
    test: Test = [],  # noqa: B006
    reading: As = None,
    points: Points = None,
    reference: Given = None,
    trials: Trials = None,
    minutes: Minutes = None,
    budget: Budget = None,
    portfolio: Portfolio = None,
    override: Override = [],  # noqa: B006
    folder: Kept = None,
    cluster: Cluster = None,
    details: Details = False,
) -> None:
    """Tune an odometry on recordings, and say what to drive.

    It keeps the last 40 % of one recording (of its path, where the robot stands for long), or the
    last of several, for the test. It tries sets on the rest, replays the test, and compares. Of
    three or more, it says what the others would have recommended for each.

    What it decides is written to a study file in its folder; run the same command to resume, also
    when a folder holds more recordings than before.
    Of a ROS 2 system (an image, or `ros2 launch ...`), it writes a study to fill in.
    """
    from adaptune.tuning.asked import Asked
    from adaptune.tuning.studies import LACKING, write_system_study
    from adaptune.tuning.tuned import tune_asked

    odometry = odometry or ("gicp" if config is None else "kiss_icp")
    limits = (trials, minutes, budget, portfolio)
    asked = Asked(recordings, odometry, points, reference, config, test, reading, {}, *limits)
    with progress() as show:
        if (path := write_system_study(asked, folder, show)) is None:
            tuned = tune_asked(asked, override, folder, cluster, show)
    if path is not None:
        say(
            f"{path} is a study of this system. Fill in what stands there as {LACKING}, as "
            f"docs/docker.md#a-ros-2-system says. Then look at what the system does:"
        )
        say(f"  adaptune inspect {path}")
        if folder is not None:
            say(f"Name the folder again where results go there, too: --folder {folder}")
        return
    _say_untuned(tuned.study)
    say_compared(tuned.study, tuned.comparison, tuned.page, details=details)
    for sentence in tuned.training.failed:
        say(sentence)
    if tuned.more:
        _say_grown(tuned.more, tuned.before, tuned.fixed)
    _say_recordings(tuned)
    say_odometries(tuned)
    say_next("replays to look at in Foxglove", "record", tuned.study.folder)


def _say_untuned(study: "OfflineStudy") -> None:
    """Name the parameters that are not tuned because the user's file does not hold them."""
    from adaptune.odometry.registry import ODOMETRIES, odometry_class

    for own in study.config.odometries.values():
        if own.name in ODOMETRIES and (config := own.settings.get("config")):
            known = odometry_class(own.name).space.names
            if lacking := [name for name in known if name not in study.odometry.space.names]:
                say(f"Not tuned, because {config} does not hold them: {', '.join(lacking)}.")


def _say_grown(more: Sequence[str], before: Any, now: Any) -> None:
    """What recordings that were not there before have changed."""
    from adaptune.space import in_words

    changed = "the recommended set is the same as before"
    if before is not None and before != now:
        names = [name for name in now if now[name] != before.get(name)]
        old, new = (in_words({name: of.get(name, "-") for name in names}) for of in (before, now))
        changed = f"recommended is {new} instead of {old}"
    say(f"New in training: {', '.join(more)}; {changed}.")


def _say_recordings(tuned: "Tuned") -> None:
    """What the other recordings recommend for each, the worst first; or what a third would add."""
    from adaptune.tuning.tuned import left_out_rows

    rows = left_out_rows(tuned.training, tuned.comparison)
    if len(tuned.training.rows) < 2 or len(rows) < 3:
        say(
            "With three recordings, each would also be left out in turn: the table would say "
            "where the recommended set does worst."
        )
        return
    show_table(
        "Each recording left out, the worst first",
        rows,
        "Recommended is the finalist that the others choose; for the test, the fixed set.",
    )


def say_odometries(tuned: "Tuned") -> None:
    """Of several odometries, which does best on the test, and what each has there, and tuned."""
    from adaptune.report.tables import cell_text
    from adaptune.study.driven import COST

    if not (rows := tuned.of_each):
        return
    best, allowed = rows[0], tuned.training.model.allowed()
    if best["test [%]"] is not None:
        cost = f"{cell_text(best['test [%]'])} % at {cell_text(best[COST])} ms a scan"
        dear = allowed is not None and best["_trial"] not in allowed
        more = " It costs more than the budget." * dear
        of = f"{best['odometry']} with {best['set']}"
        say(f"Best odometry on the test: {of}, {cost}.{more}")
    for row in rows:
        if row["_state"] != "complete":
            say(f"Not run on the test: {row['odometry']}, trial {row['_trial']}: {row['_state']}.")
    show_table(
        "RTE of each odometry, in trials on the test",
        rows,
        "A trial goes on from the reference after an impossible motion; the modes above do not.",
    )
