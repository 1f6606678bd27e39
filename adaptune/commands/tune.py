"""Commands that begin with recordings: look at one, or tune an odometry on them."""

import json
import re
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain, count, takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from adaptune.commands.online import Details, compared, replay_missing
from adaptune.commands.terminal import (
    Points,
    console,
    load,
    progress,
    say,
    say_next,
    show_table,
)
from adaptune.errors import AdaptuneError, NotInstalledError
from adaptune.files import plain_name, write_text
from adaptune.progress import Progress

if TYPE_CHECKING:
    from adaptune.recording.inspect import Inspection
    from adaptune.trajectory import Trajectory
    from offline.config import OfflineStudy
    from offline.train import Training

UNKNOWN_LENGTH = "5.0    # metres; 10.0 for a path of 200 m or more, 25.0 for one of 500 m or more"
"""The length of sub-trajectories to propose where the path is not known."""


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
) -> None:
    """Show what is in a recording, what each stage lacks, and how to name it in a study.

    Of an error model, or of a study's folder, show what it is of and its best sets.
    """
    if file.suffix == ".safetensors" or (file / "model.safetensors").exists():
        _show_model(file)
        return
    if file.suffix in (".yaml", ".yml") and _look(file):
        return
    check_no_study(file)
    if study is not None and study.exists():
        raise AdaptuneError(f"{study}: exists; name another file with --study, or move it away")
    from adaptune.recording.inspect import inspect as inspect_file
    from adaptune.recording.rendering import render_inspection

    with progress() as show:
        found = inspect_file(file, deep, show)
        share, length, accuracy = _proposed(found, deep, show)
    console.print(render_inspection(found, accuracy), crop=False)
    if not found.name:
        return
    if found.missing.get("offline"):
        say(
            "Next: mend what is lacking, see docs/your-bag.md; where only the reference does not "
            "serve, write `reference: estimated`"
        )
        return
    rest = roles([found.name], length, ["gicp"], share)
    say(rest)
    path = study or Path(f"{found.name}.yaml")
    first = "" if study else f"put the lines from `sequences:` on in {path}; then "
    if study is not None:
        write_text(study, f"{found.entry}\n{rest}")
    say_next("train on a part of it", "offline", path, first=first)


_ROS = ("ros2", "rustle")
_LOOK = 20.0
"""Seconds of a recording on which a ROS system is looked at."""


def _look(path: Path) -> bool:
    """Show what the ROS system of a study does; False if it has none."""
    loaded = load(path, [], None)
    factory: Any = loaded.odometry
    if loaded.config.odometries.keys().isdisjoint(_ROS) or len(loaded.config.odometries) > 1:
        return False
    from adaptune.odometry.docker.probe import look

    name = loaded.config.training[0]
    scans = loaded.sequences.open(name)
    first = next(iter(scans)).stamp
    some = takewhile(lambda scan: scan.stamp < first + _LOOK * 1e9, scans)
    say(f"{factory.name} on the first {_LOOK:g} s of {name}, with the baseline's parameters:")
    space = factory.space
    # The far end of each range.
    (others,) = space.from_unit((space.to_unit([space.baseline]) < 0.5).astype(float))
    found = look(factory.settings, space.baseline, factory.limits, some, others)
    show_table("What it does", [{"": key, "found": value} for key, value in found.items()])
    return True


def check_no_study(path: Path) -> None:
    """Refuse a study where a recording is expected."""
    if path.suffix in (".yaml", ".yml") or (path / "study.yaml").is_file():
        raise AdaptuneError(
            f"{path}: is a study, not a recording; `adaptune offline`, `online` and `compare` take "
            f"it, and `adaptune inspect` takes its folder once it has a model"
        )


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


def _proposed(found: "Inspection", deep: bool, show: Progress) -> tuple[float | None, str, str]:
    """The split to propose, the length of sub-trajectories, and how wrong the reference is.

    Only what can be used to train is measured. What the scans say against it joins the findings.
    """
    if found.name:
        _undo_motion([found], ["gicp"])
    if found.reference is None or len(found.reference) < 2 or found.missing.get("offline"):
        return None, UNKNOWN_LENGTH, ""
    from adaptune.recording.recording import open_sequence
    from adaptune.reference import check
    from adaptune.reference.diagnosis import diagnose_reference
    from adaptune.reference.motions import measured_motions

    share = _share(found.reference)
    usual = check.proposed_sub_trajectory(found.reference, training=share)
    if not deep:
        return share, str(usual), "`--deep` also measures how wrong it is"
    try:
        scans = open_sequence(found.config())
        if (reference := scans.reference()) is None:
            return share, str(usual), ""
        measured = check.measure_reference(scans, reference, partial(show, "registering"))
        motions = measured_motions(scans, len(measured.stamps))
        if (cause := diagnose_reference(reference, measured.stamps, motions)) is not None:
            found.findings.append(cause.below((check.CONTRADICTS,)))
    except AdaptuneError as error:
        return share, str(usual), f"its error cannot be measured: {error}"
    length = check.proposed_sub_trajectory(reference, measured, share)
    words = check.accuracy_words(measured, usual, length), check.advice(measured, reference, share)
    return share, str(length), "; ".join(filter(None, words))


def _undo_motion(recordings: Sequence["Inspection"], odometries: Sequence[str]) -> None:
    """Propose to undo the motion within scans for odometries that do not do so themselves."""
    for one in recordings if set(odometries) <= DISTORTED else ():
        if one.scan is not None and one.scan.times is not None and one.scan.times.any():
            one.given["compensate"] = "constant_velocity"


# A study of recordings, and nothing else: what it says beside their names.


def roles(
    names: Sequence[str], length: str, odometries: Sequence[str], share: float | None = None
) -> str:
    """YAML of a study: what it trains and tests on, over which metres, and the odometry.

    Of a single recording, what follows after a `share` of its duration is kept for the test; of
    several, the last one.
    """
    from adaptune.reference.check import TRAINING
    from adaptune.yaml12 import dump

    names = [dump([name]).removeprefix("- ").strip() for name in names]
    if len(names) == 1:
        end = f"{100 * (share or TRAINING):.0f}"
        training, test = f"{names[0]}: 0-{end}%", f"{names[0]}: {end}-100%"
    else:
        training, test = ", ".join(names[:-1]), names[-1]
    if len(odometries) == 1:
        odometry = f"{{name: {odometries[0]}}}    # or another one, see docs/odometries.md"
    else:
        odometry = "".join(f"\n  - {{name: {name}}}" for name in odometries)
    return (
        f"training: [{training}]\ntest: [{test}]\nsub_trajectory: {length}\nodometry: {odometry}\n"
    )


# Tune an odometry on recordings.


TRIALS, EACH = 32, 16
"""Parameter sets to try, and at least for each of several odometries."""
DISTORTED = {"gicp", "vgicp", "ndt"}
"""Odometries that do not undo the motion within scans themselves: it is undone for them."""
UNEVEN = 0.2
"""By how much the share of the path may differ from that of the duration, before the split goes by
the path."""
LEAST_SPEED = 2.0
"""Metres a second below which no step is called impossible."""
LEAST_PATH = 2.0
"""Metres that the part for the test has to hold."""
Trials = Annotated[
    int | None, typer.Option(help="Parameter sets to try.", min=2, show_default=f"{TRIALS}")
]
Minutes = Annotated[
    float | None, typer.Option(help="Time for trying them; without, all are tried.", min=0.01)
]
Budget = Annotated[
    float | None,
    typer.Option(
        help="Milliseconds of CPU time a scan that may be spent.",
        min=1e-3,
        show_default="what the odometry's own parameters take",
    ),
]
Given = Annotated[
    str | None,
    typer.Option(
        metavar="TOPIC|FILE",
        help="The reference, or `estimated` to compute one from the scans.",
        show_default="the recording's own, or estimated",
    ),
]


def tune(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="BAG...", help="Bags of one robot, or folders (KITTI).", show_default=False
        ),
    ],
    odometry: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="gicp, my_module:MyClass, ..., several with commas, or `all`; or an image.",
        ),
    ] = "gicp",
    points: Points = None,
    reference: Given = None,
    trials: Trials = None,
    minutes: Minutes = None,
    budget: Budget = None,
    folder: Annotated[
        Path | None,
        typer.Option(help="The study's folder.", show_default="the first bag's name, under runs/"),
    ] = None,
    details: Details = False,
) -> None:
    """Tune an odometry on recordings, and say what to drive.

    It keeps the last 40 % of one recording (of its path, where the robot stands for long), or the
    last of several, for the test. It tries sets on the rest, replays the test, and compares.

    What it decides is written to a study file in its folder; run the same command to resume.
    Of a ROS 2 system (an image, or `ros2 launch ...`), it writes a study to fill in.
    """
    if reference is not None and Path(reference).is_file():
        reference = str(Path(reference).resolve())
    if _propose(recordings, odometry, points, reference):
        return
    folder = folder or Path("runs") / _study_name(recordings, odometry)
    path = folder / f"{folder.resolve().name}.yaml"
    made_by = _made_by(recordings, odometry, points, reference)
    overrides: list[str] = []
    if not path.exists():
        limits = _limits(trials, minutes), budget
        text = _decided(recordings, odometry, (points, reference), limits, folder)
        _write(path, made_by + text)
    elif not path.read_text("utf-8").startswith(made_by):
        raise AdaptuneError(
            f"{path}: another `adaptune tune` made it, for what its first line says; name the same "
            f"to resume it, or another --folder"
        )
    else:
        overrides = [f"offline.{key}={value}" for key, value in _limits(trials, minutes).items()]
        overrides += [] if budget is None else [f"online.budget={budget:g}"]
    from offline.train import train

    loaded = load(path, overrides, folder, runs=True)
    say(f"Study: {path}")
    with progress() as show:
        training = train(loaded, show)
    replay_missing(loaded)
    compared(loaded, details=details)
    say(training.elsewhere)
    show_front(training.front, *BUYS)
    say_odometries(loaded, training)
    say_next("replays to look at in Foxglove", "record", folder)


def _write(path: Path, text: str) -> None:
    try:
        write_text(path, text)
    except OSError as error:
        raise AdaptuneError(
            f"{path.parent}: cannot be written to ({error.strerror}); name another folder with "
            f"--folder"
        ) from error


def _study_name(recordings: Sequence[Path], odometry: str) -> str:
    stem = plain_name(recordings[0].resolve()) + "_and_more" * (len(recordings) > 1)
    names = (name.strip().replace(":", "_") for name in odometry.split(","))
    others = "+".join(dict.fromkeys(names))
    return stem if odometry == "gicp" else f"{stem}_{others}"


def _made_by(
    recordings: Sequence[Path], odometry: str, points: str | None, reference: str | None
) -> str:
    """The first line of a study: what it was decided for."""
    words = [*(str(bag.resolve()) for bag in recordings), "--odometry", odometry]
    words += ["--points", points] if points else []
    words += ["--reference", reference] if reference else []
    # A name may hold the end of a line, or what is no character.
    plain = (c if c.isprintable() else ascii(c)[1:-1] for c in shlex.join(words))
    return f"# adaptune tune {''.join(plain)}\n"


def _limits(trials: int | None, minutes: float | None) -> dict[str, str]:
    """The budget of the search by its keys in a study."""
    given = {"trials": trials, "hours": None if minutes is None else minutes / 60.0}
    return {key: f"{value:.10g}" for key, value in given.items() if value is not None}


def _decided(
    recordings: Sequence[Path],
    odometry: str,
    topics: tuple[str | None, str | None],
    limits: tuple[dict[str, str], float | None],
    folder: Path,
) -> str:
    """The study of some recordings as YAML, with comments; nothing is written but references."""
    points, reference = topics
    for path in recordings:
        if [one.resolve() for one in recordings].count(path.resolve()) > 1:
            raise AdaptuneError(f"{path}: is named twice; the test needs a recording of its own")
    if len(recordings) > 1 and reference is not None and Path(reference).is_file():
        raise AdaptuneError(
            f"--reference {reference}: is a file, and of {len(recordings)} recordings each needs "
            f"its own; write a study file, see docs/your-bag.md"
        )
    with progress() as show:
        found = [_usable(path, points, reference, show) for path in recordings]
    named: dict[str, Inspection] = {}
    for one in found:
        names = chain([one.name], (f"{one.name}_{i}" for i in count(2)))
        named[next(name for name in names if name not in named)] = one
    odometries = odometries_of(odometry, all("imu" in one.given for one in found))
    _undo_motion(found, odometries)
    search, budget = limits
    search = search or {"trials": str(max(TRIALS, EACH * len(odometries)))}
    tried = ", ".join(f"{key}: {value}" for key, value in search.items())
    spent = "" if budget is None else f", budget: {budget:g}"

    def study(length: str, share: float | None = None, health: str = "") -> str:
        from adaptune import yaml12

        recorded = yaml12.dump({"sequences": {name: one.given for name, one in named.items()}})
        return (
            f"# Every command works with this file; change what you like.\n\n{recorded}\n"
            f"# The part for the test is not trained on.\n"
            f"{roles(list(named), length, odometries, share)}{health}"
            f"offline: {{{tried}}}    # parameter sets to try, or the time for it\n"
            f"online: {{modes: [adaptive]{spent}}}\n"
        )

    if reference is None:
        _replace_noisy(named, lambda: _loaded(study("5.0"), folder))
    return study(*_split(_loaded(study("5.0"), folder), list(named)))


def _replace_noisy(named: "Mapping[str, Inspection]", loaded: "Callable[[], OfflineStudy]") -> None:
    """Let references be estimated that are surely noisier than estimates of them."""
    from adaptune.recording.recording import open_sequence
    from adaptune.reference.check import measure_reference, proposed_sub_trajectory

    for name, one in named.items():
        scans = open_sequence(one.config())
        if "estimated" in one.given.values() or (reference := scans.reference()) is None:
            continue
        length = proposed_sub_trajectory(reference, training=_share(reference))
        with progress() as show:
            measured = measure_reference(scans, reference, partial(show, "registering"))
        if not measured.is_noisy(length) or (error := measured.error(length)) is None:
            continue
        before, one.given = one.given, one.given | {"reference": "estimated"}
        with suppress(AdaptuneError):
            study = loaded()
            _estimate(study, [name])
            own = study.sequences.estimate(name)
            if own is not None and own.error(length) < error.low:
                say(
                    f"{name}: its reference is wrong by {error.mean:.2g} % ({error.low:.2g}-"
                    f"{error.high:.2g}) over {length:g} m, as registrations of scans tell; an "
                    f"estimated one, by {own.error(length):.2g} %, judges instead. To insist: "
                    f"`--reference {before.get('reference', 'FILE')}`"
                )
                continue
        one.given = before


def _usable(path: Path, points: str | None, reference: str | None, show: Progress) -> "Inspection":
    """Look at a recording; it has scans of one topic, and a reference or is to get one."""
    from adaptune.recording.clouds import CLOUDS
    from adaptune.recording.inspect import inspect as inspect_file
    from adaptune.reference.estimate import recording_config

    check_no_study(path)
    found = inspect_file(path, False, show)
    clouds = [topic for topic in found.topics.values() if topic.type in CLOUDS]
    if len(clouds) > 1 and points is None:
        each = ", ".join(f"{one.name} ({one.count:,} of {one.type})" for one in clouds)
        raise AdaptuneError(
            f"{path}: has {len(clouds)} topics of point clouds: {each}; name one with --points"
        )
    recording_config(found, points, reference)
    if reference is None and found.missing["offline"]:
        why = "; ".join(str(one) for one in found.findings if one.of == "reference")
        say(f"{path}: its reference does not serve ({why}): one is estimated")
        found.given["reference"] = "estimated"
    return found


_SYSTEM = """\
odometry:
  name: ros2    # or rustle, for a ROS 1 system, see docs/docker.md
  settings:
    {image}command: {command}
    template: {lacking}    # the parameter file that you use now
    odometry: /{lacking}    # the topic of its poses
    points: /points    # the topics that it hears
    {imu}
  parameters:
    {lacking}: {{type: float, low: 0.1, high: 2.0, baseline: 0.5}}    # what to tune
"""
_LACKING = "FILL_IN"


def _system(given: str) -> dict[str, str] | None:
    """What is known of a ROS system, by its image or its launch command; None if it is none."""
    words = shlex.split(given)
    if words[:1] == ["ros2"]:
        if not any("{parameters}" in word for word in words):
            words.append("FILL_IN:={parameters}")
        return {"image": "", "command": json.dumps(words)}
    if not re.fullmatch(r"[a-z0-9][\w./-]*(:[\w.-]+)?", given):
        return None
    from adaptune.odometry import registry
    from adaptune.odometry.docker.engine import EngineError, image_digest

    if given in registry.ODOMETRIES or given in registry.PROGRAMS or given == "all":
        return None
    try:
        image_digest(given)
    except (EngineError, NotInstalledError):
        if "/" in given:  # no name of an odometry
            raise
        return None
    launch = ["ros2", "launch", _LACKING, f"{_LACKING}.launch.py", f"{_LACKING}:={{parameters}}"]
    return {"image": f"image: {given}\n    ", "command": json.dumps(launch)}


def _propose(
    recordings: Sequence[Path], odometry: str, points: str | None, reference: str | None
) -> bool:
    """Write a study of a ROS system to fill in; False if the odometry is none."""
    if (system := _system(odometry)) is None:
        return False
    path = Path(f"{plain_name(recordings[0].resolve())}_ros2.yaml")
    if path.exists():
        raise AdaptuneError(f"{path}: exists; fill it in, or move it away")
    with progress() as show:
        found = [_usable(one, points, reference, show) for one in recordings]
    rest = roles([one.name for one in found], UNKNOWN_LENGTH, ["ros2"]).partition("odometry:")[0]
    imu = "imu: /imu" if all("imu" in one.given for one in found) else "# imu: /imu"
    block = _SYSTEM.format(lacking=_LACKING, imu=imu, **system)
    entries = "\n".join(one.entry.removeprefix("sequences:\n") for one in found)
    write_text(path, f"sequences:\n{entries}\n{rest}{block}")
    say(
        f"{path}: is a study of this system. Fill in what stands there as {_LACKING}, as "
        f"docs/docker.md#a-ros-2-system says. Then look at what the system does:"
    )
    say(f"  adaptune inspect {path}")
    return True


def odometries_of(given: str, imu: bool) -> list[str]:
    """The odometries that a name, several, or `all` stand for."""
    from adaptune.odometry import registry

    if given != "all":
        names = list(dict.fromkeys(filter(None, map(str.strip, given.split(",")))))
        if programs := [name for name in names if name in registry.PROGRAMS]:
            raise AdaptuneError(
                f"--odometry {programs[0]}: a program needs settings; write a study file, see "
                f"docs/programs.md"
            )
        return names
    there = []
    for name in registry.ODOMETRIES:
        with suppress(NotInstalledError):
            needs_imu = registry.declare(name, {}).sound(name)[1].needs_imu
            # The other one is the same KISS-ICP.
            if name != "evalio_kiss_icp" and (imu or not needs_imu):
                there.append(name)
    return there


def _loaded(text: str, folder: Path) -> "OfflineStudy":
    """A study whose YAML is given and that is in no file yet."""
    from offline.config import load_study

    with TemporaryDirectory() as temporary:
        path = Path(temporary) / "study.yaml"
        write_text(path, text)
        try:
            return load_study(path, folder=folder)
        except AdaptuneError as error:
            # The file is nowhere for the user to look.
            told = re.sub(rf"{re.escape(str(path))}(, line \d+)?: ", "", str(error))
            raise AdaptuneError(told.replace(f"{temporary}/", "")) from error


def _split(study: "OfflineStudy", whole: Sequence[str]) -> tuple[str, float, str]:
    """Metres of the sub-trajectories by which a study should judge.

    And the share of a single recording to train on, and what the health check is to know. A
    reference that is lacking is estimated: it tells how far the robot has moved. `whole` has the
    names of the recordings.
    """
    from adaptune.reference.check import greatest_speed, path_after, proposed_sub_trajectory
    from adaptune.trajectory import read_trajectory

    sequences = study.sequences
    known = [one for name in whole if (one := sequences.open(name).reference()) is not None]
    reference = sequences.open(whole[-1]).reference()
    if reference is None:
        _estimate(study, whole[-1:])
        reference = read_trajectory(sequences.estimate_path(whole[-1]))
    share = _share(reference) if len(whole) == 1 else 0.0
    metres, _ = path_after(reference, share)
    if metres < LEAST_PATH:
        raise AdaptuneError(
            f"{whole[-1]}: moves {metres:.1f} m in the part for the test, which takes "
            f"{LEAST_PATH:g} m at least; record a longer drive, or name another recording for the "
            f"test as the last one"
        )
    length = proposed_sub_trajectory(reference, training=share)
    words = f"{length}    # metres over which errors are measured; the test moves {metres:.0f} m"
    speed = max(LEAST_SPEED, 2.0 * max(map(greatest_speed, [*known, reference])))
    health = f"health: {{max_speed: {speed:.0f}}}    # m/s: twice the speed of the fastest second\n"
    return words, share, health


def _share(reference: "Trajectory") -> float:
    """Share of a recording's duration to train on: of its path, where it stands for long."""
    import numpy as np

    from adaptune.metrics import travelled
    from adaptune.reference.check import TRAINING

    metres = travelled(reference.T_world_sensor)
    time = (reference.stamps - reference.stamps[0]) / np.ptp(reference.stamps)
    of_path = float(np.interp(TRAINING, time, metres / max(float(metres[-1]), 1e-9)))
    if abs(of_path - TRAINING) <= UNEVEN:
        return TRAINING
    return round(float(np.interp(TRAINING * metres[-1], metres, time).clip(0.01, 0.99)), 2)


def _estimate(study: "OfflineStudy", names: Sequence[str]) -> None:
    """Estimate references; where one is refused, nothing is left behind."""
    from adaptune.study.references import ensure_references

    there = study.folder.exists()
    study.open()
    try:
        with progress() as show:
            ensure_references(study.sequences, names, 5.0, show)
    except AdaptuneError as error:
        if not there:
            shutil.rmtree(study.folder)
        raise AdaptuneError(f"{error}; or give a --reference") from error


def show_front(rows: "Sequence[Mapping[str, Any]]", title: str, caption: str) -> None:
    """The table of what CPU time buys."""
    shown = [
        {
            "": ("-> " if row["recommended"] else "") + row["what"],
            **{key: row[key] for key in ("cost [ms]", "99 % [ms]", "memory [MB]") if key in row},
            "RTE [%]": row["error [%]"],
            "vs baseline": row["vs baseline"],
            "95 %": None
            if row["low"] is None or row["low"] != row["low"]
            else f"{row['low']:.2f}-{row['high']:.2f}",
            "parameters": row["parameters"],
        }
        for row in rows
    ]
    show_table(title, shown, caption)


BUYS = (
    "What CPU time buys, in training",
    "The arrow marks what is recommended: of what costs no more than the baseline, or than the"
    " budget, the best, if it is surely better than the baseline.",
)


def say_odometries(study: "OfflineStudy", training: "Training") -> None:
    """Of several odometries, what each gives with its own parameters and tuned, in training."""
    from adaptune.space import ODOMETRY
    from offline.front import COST

    labels = list(study.config.odometries)
    if len(labels) < 2:
        return
    rows = []
    for label in labels:
        mine = [row for row in training.trials if row[ODOMETRY] == label]
        known = [row for row in mine if row["mean"] is not None]
        best = min(known, key=lambda row: row["mean"], default=None)
        rows.append(
            {
                "odometry": label,
                "its own parameters [%]": mine[0]["mean"] if mine else None,
                "tuned [%]": None if best is None else best["mean"],
                COST: None if best is None else best[COST],
            }
        )
    rows.sort(key=lambda row: row["tuned [%]"] if row["tuned [%]"] is not None else float("inf"))
    fixed = training.model.sets[training.model.fixed][ODOMETRY]
    say(
        f"Best odometry in training: {rows[0]['odometry']}. On the test, the fixed set is "
        f"{fixed}'s, the baseline {labels[0]}'s; to see another there, name it alone (--odometry)."
    )
    show_table("RTE of each odometry in training", rows)
