"""Commands that begin with recordings: look at one, or tune an odometry on them."""

import json
import re
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from adaptune.commands.online import Details, compared, replay_missing
from adaptune.commands.recordings import Asked, check_no_study, recorded
from adaptune.commands.terminal import (
    Cluster,
    Override,
    Points,
    console,
    load,
    progress,
    say,
    say_next,
    show_table,
)
from adaptune.commands.trained import (
    BUYS,
    say_grown,
    say_odometries,
    say_recordings,
    say_untuned,
    show_front,
)
from adaptune.errors import AdaptuneError, NotInstalledError
from adaptune.files import plain_name, write_text
from adaptune.progress import Progress

if TYPE_CHECKING:
    from adaptune.recording.fleet import Reading
    from adaptune.recording.inspect import Inspection
    from adaptune.trajectory import Trajectory
    from offline.config import OfflineStudy

UNKNOWN_LENGTH = "5.0    # metres; 10.0 for a path of 200 m or more, 25.0 for one of 500 m or more"
"""The length of sub-trajectories to propose where the path is not known."""


As = Annotated[
    Literal["one", "several"] | None,
    typer.Option(
        "--as",
        help="Read the bags of a folder as parts of one recording, or as several.",
        show_default="as their times and names tell",
    ),
]


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
    check_no_study(file)
    if study is not None and study.exists():
        raise AdaptuneError(f"{study}: exists; name another file with --study, or move it away")
    from adaptune.recording.inspect import inspect as inspect_file
    from adaptune.recording.rendering import render_inspection

    if _show_several(file, reading):
        return
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
    for one in found:
        topic = one.topics.get(one.used.get("points", ""))
        scans = {"scans": topic and topic.count, "rate [Hz]": topic and topic.rate}
        given = {"reference": one.used.get("reference", "estimated")}
        wrong = {"lacks": ", ".join(one.missing.get("offline", ())) or None}
        rows.append({"recording": one.path.name, **scans, **given, **wrong})
    show_table(f"{path}: {len(rows)} recordings ({folder.why})", rows)
    if reading is None and folder.reading is None:
        say("As one:")
        return False
    check_alike([one for one in found if "points" in one.used])
    say_next("tune on all of them", "tune", path)
    return True


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
    names: Sequence[str],
    length: str,
    odometries: Sequence[str],
    share: float | None = None,
    test: Sequence[str] = (),
    config: Path | None = None,
) -> str:
    """YAML of a study: what it trains and tests on, over which metres, and the odometry.

    Without a `test`, what follows after a `share` of the duration of a single recording is kept for
    it; of several, the last one. `config` is the user's parameter file.
    """
    from adaptune.reference.check import TRAINING
    from adaptune.yaml12 import dump

    names, test = ([*map(_in_yaml, of)] for of in (names, test))
    if test:
        training, tested = ", ".join(names), ", ".join(test)
    elif len(names) == 1:
        end = f"{100 * (share or TRAINING):.0f}"
        training, tested = f"{names[0]}: 0-{end}%", f"{names[0]}: {end}-100%"
    else:
        training, tested = ", ".join(names[:-1]), names[-1]
    if config is not None:
        own = {"name": odometries[0], "settings": {"config": str(config.resolve())}}
        odometry = dump({"odometry": own}).removeprefix("odometry:").rstrip()
    elif len(odometries) == 1:
        odometry = f"{{name: {odometries[0]}}}    # or another one, see docs/odometries.md"
    else:
        odometry = "".join(f"\n  - {{name: {name}}}" for name in odometries)
    judged = f"training: [{training}]\ntest: [{tested}]\nsub_trajectory: {length}\n"
    return f"{judged}odometry: {odometry}\n".replace(": \n", ":\n")


def _in_yaml(name: str) -> str:
    """A name in a list of YAML."""
    from adaptune.yaml12 import dump

    return dump([name]).removeprefix("- ").strip()


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
    if reference is not None and Path(reference).is_file():
        reference = str(Path(reference).resolve())
    odometry = odometry or ("gicp" if config is None else "kiss_icp")
    asked = Asked(recordings, odometry, points, reference, config, test, reading)
    if _propose(asked):
        return
    folder = folder or Path("runs") / _study_name(recordings, odometry)
    path = folder / f"{folder.resolve().name}.yaml"
    limits = _limits(trials, minutes, budget)
    overrides, more = _written(path, asked, limits, folder)
    from offline.train import train

    loaded = load(path, [*override, *overrides], folder, runs=True)
    say(f"Study: {path}")
    say_untuned(loaded)
    before = loaded.fixed
    with progress() as show:
        training = train(loaded, show, cluster)
    replay_missing(loaded)
    found = compared(loaded, details=details)
    say(training.elsewhere)
    show_front(training.front, *BUYS)
    if more:
        say_grown(more, before, loaded.fixed)
    say_recordings(training.rows, found)
    say_odometries(loaded, training)
    say_next("replays to look at in Foxglove", "record", folder)


def _written(
    path: Path, asked: Asked, limits: dict[str, str], folder: Path
) -> tuple[list[str], list[str]]:
    """Write the study, or add what is new to the one that is there.

    Returns what overrides it, and the names of new recordings.
    """
    if not path.exists():
        _write(path, asked.line + _decided(asked, limits, folder))
        return [], []
    if not path.read_text("utf-8").startswith(asked.line):
        raise AdaptuneError(
            f"{path}: another `adaptune tune` made it, for what its first line says; name the same "
            f"to resume it, or another --folder"
        )
    return [f"{key}={value}" for key, value in limits.items()], _grown(path, asked)


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


def _limits(trials: int | None, minutes: float | None, budget: float | None) -> dict[str, str]:
    """What may be spent, by its keys in a study."""
    hours = None if minutes is None else minutes / 60.0
    given = {"offline.trials": trials, "offline.hours": hours, "online.budget": budget}
    return {key: f"{value:.10g}" for key, value in given.items() if value is not None}


def _decided(asked: Asked, limits: dict[str, str], folder: Path) -> str:
    """The study of some recordings as YAML, with comments; nothing is written but references."""
    named, test = recorded(asked)
    odometries = odometries_of(asked.odometry, all("imu" in one.given for one in named.values()))
    if asked.config is not None and len(odometries) != 1:
        raise AdaptuneError(f"--config {asked.config}: is of one odometry; name one --odometry")
    _undo_motion([*named.values()], odometries)
    if not any(key.startswith("offline.") for key in limits):
        limits = {"offline.trials": str(max(TRIALS, EACH * len(odometries)))} | limits
    tried, spent = (
        "".join(f", {key.removeprefix(stage)}: {v}" for key, v in limits.items() if stage in key)
        for stage in ("offline.", "online.")
    )

    def study(length: str, share: float | None = None, health: str = "") -> str:
        from adaptune import yaml12

        given = yaml12.dump({"sequences": {name: one.given for name, one in named.items()}})
        rest = [name for name in named if name not in test]
        return (
            f"# Every command works with this file; change what you like.\n\n{given}\n"
            f"# The part for the test is not trained on.\n"
            f"{roles(rest, length, odometries, share, test, asked.config)}{health}"
            f"offline: {{{tried[2:]}}}    # parameter sets to try, or the time for it\n"
            f"online: {{modes: [adaptive]{spent}}}\n"
        )

    if asked.reference is None:
        _replace_noisy(named, lambda: loaded_text(study("5.0"), folder))
    return study(*_split(loaded_text(study("5.0"), folder), list(named)))


def _grown(path: Path, asked: Asked) -> list[str]:
    """Add the recordings that a study does not name yet to where they belong; their names."""
    from adaptune import yaml12
    from adaptune.recording.config import SOURCES
    from adaptune.recording.fleet import recordings_at

    text = path.read_text("utf-8")
    try:
        data: Any = yaml12.Document(text).data
        known = {str(one.get(key)) for one in data["sequences"].values() for key in SOURCES}
    except (yaml12.YamlError, AttributeError, KeyError, TypeError):
        return []  # loading it says what is wrong
    tested = [one.resolve() for one in recordings_at(asked.test, asked.reading)]
    others = [one.resolve() for one in recordings_at(asked.recordings, asked.reading)]
    there = list(dict.fromkeys([*others, *tested]))
    new = [one for one in there if known.isdisjoint({str(one), str(one.parent)})]
    if not new:
        return []
    named, _ = recorded(asked._replace(recordings=there, test=(), reading="one"))
    _undo_motion([*named.values()], odometries_of(asked.odometry, False))
    added = {name: one for name, one in named.items() if one.path in new}
    if taken := [name for name in added if name in data["sequences"]]:
        raise AdaptuneError(
            f"{path}: sequences.{taken[0]} is another recording; rename the new one"
        )
    entries = yaml12.dump({name: one.given for name, one in added.items()})
    indented = "".join(f"  {line}\n" for line in entries.splitlines())
    grown = re.sub(r"(?m)^sequences:\n", lambda m: m[0] + indented, text, count=1)
    into = {
        "training": [name for name, one in added.items() if one.path not in tested],
        "test": [name for name, one in added.items() if one.path in tested],
    }
    for role, names in into.items():
        listed = "".join(f", {_in_yaml(name)}" for name in names)
        if found := re.search(rf"(?m)^{role}: \[.*(?=\])", grown):
            grown = grown[: found.end()] + listed + grown[found.end() :]
    n = (data.get("offline") or {}).get("stretches", 12)
    if into["training"] and isinstance(n, int):
        # As many stretches of each as before: the trials that there are stay.
        before, now = len(data["training"]), len(data["training"]) + len(into["training"])
        pinned = f"offline: {{stretches: {max(4, -(-n // before)) * now}, "
        grown = re.sub(r"(?m)^offline: \{(stretches: \d+, )?", pinned, grown, count=1)
    data = yaml12.Document(grown).data
    if not all(name in data[role] for role, names in into.items() for name in names):
        raise AdaptuneError(
            f"{path}: add {', '.join(added)} to sequences, and training or test, by hand"
        )
    write_text(path, grown)
    return list(added)


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


_SYSTEM = """\
odometry:
  name: ros2    # or rustle, for a ROS 1 system, see docs/docker.md
  settings:
    {image}command: {command}
    template: {template}    # the parameter file that you use now
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
    if not is_image(given):
        return None
    launch = ["ros2", "launch", _LACKING, f"{_LACKING}.launch.py", f"{_LACKING}:={{parameters}}"]
    return {"image": f"image: {given}\n    ", "command": json.dumps(launch)}


def is_image(given: str) -> bool:
    """Whether a name is that of an image, and of no odometry."""
    from adaptune.odometry import registry
    from adaptune.odometry.docker.engine import EngineError, image_digest

    of_odometry = given in {*registry.ODOMETRIES, *registry.PROGRAMS, "all"}
    if of_odometry or not re.fullmatch(r"[a-z0-9][\w./-]*(:[\w.-]+)?", given):
        return False
    try:
        image_digest(given)
    except (EngineError, NotInstalledError):
        if "/" in given:  # no name of an odometry
            raise
        return False
    return True


def _propose(asked: Asked) -> bool:
    """Write a study of a ROS system to fill in; False if the odometry is none."""
    if (system := _system(asked.odometry)) is None:
        return False
    path = Path(f"{plain_name(asked.recordings[0].resolve())}_ros2.yaml")
    if path.exists():
        raise AdaptuneError(f"{path}: exists; fill it in, or move it away")
    named, test = recorded(asked)
    training = [name for name in named if name not in test]
    rest = roles(training, UNKNOWN_LENGTH, ["ros2"], test=test).partition("odometry:")[0]
    imu = "imu: /imu" if all("imu" in one.given for one in named.values()) else "# imu: /imu"
    template = json.dumps(str(asked.config.resolve())) if asked.config else _LACKING
    block = _SYSTEM.format(lacking=_LACKING, template=template, imu=imu, **system)
    entries = "\n".join(one.entry.removeprefix("sequences:\n") for one in named.values())
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


def loaded_text(text: str, folder: Path) -> "OfflineStudy":
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
    known = {n: one for n in whole if (one := sequences.open(n).reference()) is not None}
    reference = known.get(whole[-1])
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
    others = [one for name, one in known.items() if name != whole[-1]]
    # One that fits into each of several.
    lengths = [proposed_sub_trajectory(other, training=0.0) for other in others]
    length = min([proposed_sub_trajectory(reference, training=share), *lengths])
    words = f"{length}    # metres over which errors are measured; the test moves {metres:.0f} m"
    speed = max(LEAST_SPEED, 2.0 * max(map(greatest_speed, [*known.values(), reference])))
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
