"""A study of recordings: what it trains and tests on, over which metres, and how long."""

import logging
import re
import shutil
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import count, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from adaptune._system import manifest
from adaptune._system.files import plain_name, write_text
from adaptune._system.progress import Progress, about
from adaptune._system.yaml12 import Document, YamlError, YamlPath, dump
from adaptune.errors import AdaptuneError, NotInstalledError
from adaptune.metrics import travelled
from adaptune.odometry import registry
from adaptune.odometry.portfolio import ScanKind, portfolios_of, read_portfolio
from adaptune.recording.config import ESTIMATED, SOURCES
from adaptune.recording.fleet import recordings_at
from adaptune.recording.inspect import Inspection
from adaptune.recording.recording import open_sequence
from adaptune.reference import check
from adaptune.reference.carried import begin_of, without
from adaptune.trajectory import Trajectory, read_trajectory
from adaptune.tuning import EACH, TRIALS
from adaptune.tuning.asked import Asked, odometries_of, recorded, words_of

if TYPE_CHECKING:
    from offline.config import OfflineStudy

_log = logging.getLogger(__name__)

DISTORTED = {"gicp", "vgicp", "ndt"}
"""Odometries that do not undo the motion within scans themselves: it is undone for them."""
UNEVEN = 0.2
"""By how much the share of the path may differ from that of the duration, before the split goes by
the path."""
LEAST_SHARE = 0.01
"""Of a recording's duration, for training and for the test."""
TOLD = (10.0, 20)
"""Seconds and scans after which it is known how long a reference takes; processes start first."""
LEAST_SPEED = 2.0
"""Metres a second below which no step is called impossible."""
LEAST_PATH = 2.0
"""Metres that the part for the test has to hold."""
USUAL_LENGTH = 5.0
"""Metres of the sub-trajectories to propose where the path is not known."""
ROLES: dict[YamlPath, str] = {
    ("training",): "The part for the test is not trained on.",
    (
        "sub_trajectory",
    ): "Metres over which errors are measured: 25.0 or 10.0 where the path of the "
    "test is 8 times as long, else 5.0 or less; longer where that lasts less than 2 s.",
}
"""Comments of what `roles` returns."""
_COMMENTS: dict[YamlPath, str] = ROLES | {
    ("sequences",): "Every command works with this file; change what you like.",
    ("odometry",): "Or another one, see docs/odometries.md.",
    ("health", "max_speed"): "m/s: twice the speed of the fastest second.",
    ("offline",): "Parameter sets to try, or the time for it.",
}
LACKING = "FILL_IN"
"""Stands in the study of a ROS system where the user knows more."""
ASKED = "asked.json"
"""For what the study in a folder was decided."""


def roles(
    names: Sequence[str],
    length: float,
    odometry: Any,
    share: float | None = None,
    test: Sequence[str] = (),
) -> dict[str, Any]:
    """What a study trains and tests on, over which metres, and the odometry.

    Without a `test`, what follows after a `share` of the duration of a single recording is kept for
    it; of several, the last one.
    """
    training: list[Any] = list(names)
    tested: list[Any] = list(test)
    if not test and len(names) == 1:
        end = f"{100 * (share or check.TRAINING):.0f}"
        training, tested = [{names[0]: f"0-{end}%"}], [{names[0]: f"{end}-100%"}]
    elif not test:
        *training, last = names
        tested = [last]
    return {"training": training, "test": tested, "sub_trajectory": length, "odometry": odometry}


def undo_motion(recordings: Sequence["Inspection"], odometries: Sequence[str]) -> None:
    """Propose to undo the motion within scans for odometries that do not do so themselves."""
    for recording in recordings if set(odometries) <= DISTORTED else ():
        scan = recording.scan
        if scan is not None and scan.times is not None and scan.times.any():
            recording.given["compensate"] = "constant_velocity"


def proposed(found: Inspection, deep: bool, show: Progress) -> tuple[float | None, float, str]:
    """The split to propose, the length of sub-trajectories, and how wrong the reference is.

    Only what can be used to train is measured. What the scans say against it joins the findings.
    """
    if found.name:
        undo_motion([found], ["gicp"])
    if found.reference is None or len(found.reference) < 2 or found.missing.get("offline"):
        return None, USUAL_LENGTH, ""
    from adaptune.reference import diagnosis

    share = share_of(found.reference)
    usual = check.proposed_sub_trajectory(found.reference, training=share)
    if not deep:
        return share, usual, "`--deep` also measures how wrong it is"
    try:
        scans = open_sequence(found.config())
        if (reference := scans.reference()) is None:
            return share, usual, ""
        measured = check.measure_reference(scans, reference, partial(show, "registering"))
        found.findings += measured.carried
        reference = without(reference, measured.carried, begin_of(scans, measured.stamps))
        motions = diagnosis.measured_motions(scans, len(measured.stamps))
        if (cause := diagnosis.diagnose_reference(reference, measured.stamps, motions)) is not None:
            found.findings.append(cause.below((check.CONTRADICTS,)))
    except AdaptuneError as why:
        return share, usual, f"its error cannot be measured: {why}"
    length = check.proposed_sub_trajectory(reference, measured, share)
    accuracy, error = check.accuracy_words(measured, usual, length), measured.error(length)
    if cause is None and not measured.doubt and error and error.low > diagnosis.SUSPICIOUS:
        accuracy += diagnosis.UNEXPLAINED
    words = accuracy, check.advice(measured, reference, share)
    return share, length, "; ".join(filter(None, words))


def write_study(
    asked: Asked, overrides: Sequence[str], folder: Path, show: Progress
) -> tuple["OfflineStudy", list[str]]:
    """Write the study's file, or add what is new to it; the study.

    It has the overrides, which the file has not. Returns the names of new recordings, too.
    """
    from offline.config import load_study

    path, known = folder / f"{folder.resolve().name}.yaml", folder / ASKED
    if not path.exists():
        made = _decided(asked, overrides, folder, show)
        study, text = load_study(made, overrides, folder), dump(made, _COMMENTS)
        manifest.record(known, asked.inputs)
        write_text(path, text)
        _log.info("study: %s", path)
        return study, []
    if (before := manifest.recorded(known)) is None:
        raise AdaptuneError(
            f"{path}: {ASKED} beside it is gone, or an older adaptune made it; `adaptune offline "
            f"{path}` goes on with it; or name another --folder"
        )
    if others := manifest.changes(before, asked.inputs):
        numbered = (folder.with_name(f"{folder.resolve().name}_{n}") for n in count(2))
        free = next(other for other in numbered if not other.exists())
        raise AdaptuneError(
            f"{path}: another `adaptune tune` made it: {'; '.join(others)}; name the same to "
            f"resume it, or tune in a folder of its own with `--folder {free}`"
        )
    new = _add_recordings(path, asked, show)
    limits = (f"{key}={value}" for key, value in asked.limits.items())
    return load_study(path, [*overrides, *limits], folder), new


def _decided(
    asked: Asked, overrides: Sequence[str], folder: Path, show: Progress
) -> dict[str, Any]:
    """What the study of some recordings says; nothing is written but references."""
    from offline.config import load_study

    portfolios_of((), asked.portfolio)  # a wrong one is known before all is read
    about = {name: manifest.plain(given) for name, given in asked.about.items()}
    for name in odometries_of(asked.odometry, True):
        registry.declare(name, about.get(name, {}).get("settings", {}), folder.resolve())
    named, test = recorded(asked, show)
    odometries = odometries_of(asked.odometry, all("imu" in one.given for one in named.values()))
    if asked.config is not None and about:
        raise AdaptuneError("config: give it in the object's settings, or name its class")
    if asked.config is not None and len(odometries) != 1:
        raise AdaptuneError(f"--config {asked.config}: is of one odometry; name one --odometry")
    undo_motion([*named.values()], odometries)
    portfolios = portfolios_of(odometries, asked.portfolio)
    _tell_unlike(portfolios, named)
    entries: list[Any] = [{"name": n, **about.get(n, {})} for n in odometries]
    if asked.config is not None:
        entries[0]["settings"] = {"config": str(asked.config.resolve())}
    if asked.trials is None and asked.minutes is None:
        asked = asked._replace(trials=max(TRIALS, EACH * len(odometries)))
    begin: dict[str, Any] = {"portfolio": portfolios} if portfolios else {}
    spent: dict[str, dict[str, Any]] = {"offline": begin, "online": {"modes": ["adaptive"]}}
    for key, value in asked.limits.items():
        stage, _, name = key.partition(".")
        spent[stage][name] = value
    odometry = entries[0] if len(entries) == 1 else entries
    rest = [name for name in named if name not in test]

    def study(length: float, share: float | None = None) -> dict[str, Any]:
        sequences = {name: dict(recording.given) for name, recording in named.items()}
        return {"sequences": sequences, **roles(rest, length, odometry, share, test)} | spent

    # An error comes before all is measured: what is wrong with the least parts is so with all.
    least = study(USUAL_LENGTH, LEAST_SHARE), study(USUAL_LENGTH, 1.0 - LEAST_SHARE)
    draft = load_study(least[0] | {"test": least[1]["test"]}, overrides, folder)
    for name, one in named.items() if asked.reference is None else ():
        insisted = draft.config.sequences[name].reference != one.given.get("reference")
        if not insisted and (estimated := _less_noisy(draft, name, show)) is not None:
            draft, one.given["reference"] = estimated, ESTIMATED
    length, share, speed = _measure_split(draft, list(named), show)
    return study(length, share) | {"health": {"max_speed": speed}}


def _tell_unlike(portfolios: Iterable[str], recordings: Mapping[str, Inspection]) -> None:
    """Tell where a recording is unlike what portfolios know."""
    for portfolio, (name, one) in product(map(read_portfolio, portfolios), recordings.items()):
        topic = one.topics.get(one.used.get("points", ""))
        if topic is None or one.scan is None or not topic.rate:
            continue
        if what := portfolio.unlike(ScanKind.of(one.scan, topic.rate)):
            _log.warning(
                f"{name}: its scans are unlike those that the portfolio of "
                f"{portfolio.odometry} was chosen on: {what}. It says little here"
            )


def _add_recordings(path: Path, asked: Asked, show: Progress) -> list[str]:
    """Add the recordings that a study does not name yet to where they belong; their names."""
    try:
        document = Document.of_file(path)
        data: Any = document.data
        known = {str(entry.get(key)) for entry in data["sequences"].values() for key in SOURCES}
        if not all(isinstance(data.get(role) or [], list) for role in ("training", "test")):
            return []
        offline: dict[str, Any] = {} | (data.get("offline") or {})
    except (YamlError, AttributeError, KeyError, TypeError):
        return []  # loading it says what is wrong

    def is_new(bag: Path) -> bool:
        return known.isdisjoint(map(str, (bag.resolve(), bag.resolve().parent)))

    there = recordings_at([*asked.recordings, *asked.test], asked.reading)
    if not any(map(is_new, there)):
        return []
    named, test = recorded(asked, show)
    undo_motion([*named.values()], odometries_of(asked.odometry, False))
    added = {name: recording for name, recording in named.items() if is_new(recording.path)}
    if taken := [name for name in added if name in data["sequences"]]:
        raise AdaptuneError(
            f"{path}: sequences.{taken[0]} is another recording; rename the new one"
        )
    into: dict[str, list[str]] = {
        "training": [name for name in added if name not in test],
        "test": [name for name in added if name in test],
    }
    new_of = {name: recording.given for name, recording in added.items()}
    more: dict[YamlPath, Any] = {("sequences",): new_of} | {(r,): n for r, n in into.items() if n}
    n, before = offline.get("segments", 12), len(data.get("training") or ()) or 1
    if into["training"] and isinstance(n, int):
        # As many segments of each as before: the trials that there are stay.
        each, now = max(4, -(-n // before)), before + len(into["training"])
        more[("offline", "segments")] = each * now
    for at, value in more.items():
        document = Document(document.with_added(at, value))
    if (document.data or {})["sequences"] != data["sequences"] | new_of:
        raise AdaptuneError(f"{path}: cannot be added to; add {', '.join(new_of)} as the others")
    write_text(path, document.text)
    return list(added)


def _less_noisy(study: "OfflineStudy", name: str, show: Progress) -> "OfflineStudy | None":
    """The study with an estimated reference of a sequence, if its own is surely noisier."""
    config = study.config.sequences[name]
    scans = open_sequence(config)
    if (reference := scans.reference()) is None:
        return None
    length = check.proposed_sub_trajectory(reference, training=share_of(reference))
    measured = check.measure_reference(scans, reference, partial(show, "registering"))
    if not measured.is_noisy(length) or (error := measured.error(length)) is None:
        return None
    estimated = config.model_copy(update={"reference": ESTIMATED})
    every = {"sequences": {**study.config.sequences, name: estimated}}
    study = replace(study, config=study.config.model_copy(update=every))
    try:
        _estimate(study, [name], show)
    except AdaptuneError as why:
        _log.warning("%s: its reference is noisy, and none can be estimated: %s", name, why)
        return None
    own = study.sequences.estimate(name)
    if own is None or own.error(length) >= error.low:
        return None
    _log.warning(
        f"{name}: its reference is wrong by {error.mean:.2g} % ({error.low:.2g}-"
        f"{error.high:.2g}) over {length:g} m, as registrations of scans tell; an "
        f"estimated one, by {own.error(length):.2g} %, judges instead. To insist: "
        f"`--reference {config.reference or 'FILE'}`"
    )
    return study


def _measure_split(
    study: "OfflineStudy", whole: Sequence[str], show: Progress
) -> tuple[float, float, float]:
    """Metres of the sub-trajectories by which a study should judge.

    And the share of a single recording to train on, and the speed of which the health check is to
    know. A reference that is lacking is estimated: it tells how far the robot has moved. `whole`
    has the names of the recordings.
    """
    sequences = study.sequences
    known = {n: one for n in whole if (one := sequences.open(n).reference()) is not None}
    reference = known.get(whole[-1])
    if reference is None:
        _estimate(study, whole[-1:], show)
        reference = read_trajectory(sequences.estimate_path(whole[-1]))
    share = share_of(reference) if len(whole) == 1 else 0.0
    metres, _ = check.path_after(reference, share)
    if metres < LEAST_PATH:
        raise AdaptuneError(
            f"{whole[-1]}: moves {metres:.1f} m in the part for the test, which takes "
            f"{LEAST_PATH:g} m at least; record a longer drive, or name another recording for the "
            f"test as the last one"
        )
    others = [one for name, one in known.items() if name != whole[-1]]
    # One that fits into each of several.
    lengths = [check.proposed_sub_trajectory(other, training=0.0) for other in others]
    length = min([check.proposed_sub_trajectory(reference, training=share), *lengths])
    speed = max(LEAST_SPEED, 2.0 * max(map(check.greatest_speed, [*known.values(), reference])))
    return length, share, float(round(speed))


def share_of(reference: Trajectory) -> float:
    """Share of a recording's duration to train on: of its path, where it stands for long."""
    metres = travelled(reference.T_world_sensor)
    time = (reference.stamps - reference.stamps[0]) / np.ptp(reference.stamps)
    of_path = float(np.interp(check.TRAINING, time, metres / max(float(metres[-1]), 1e-9)))
    if abs(of_path - check.TRAINING) <= UNEVEN:
        return check.TRAINING
    share = np.interp(check.TRAINING * metres[-1], metres, time)
    return round(float(np.clip(share, LEAST_SHARE, 1.0 - LEAST_SHARE)), 2)


def _in_time(show: Progress, hours: float | None) -> Progress:
    """Progress of references, with an AdaptuneError where one alone takes longer than allowed."""
    if hours is None:
        return show
    begun: dict[str, tuple[float, float]] = {}

    def shown(text: str, done: float, of: int, remark: str = "", /) -> None:
        show(text, done, of, remark)
        if done < TOLD[1]:
            return
        now = time.monotonic()
        first, there = begun.setdefault(text, (now, done))
        spent, new = now - first, done - there
        if spent > TOLD[0] and new >= TOLD[1] and of * spent > 3600.0 * hours * new:
            name, takes = text.partition(",")[0], about(of * spent / new)
            raise AdaptuneError(
                f"{name}: estimating its reference alone takes {takes}, and --minutes is "
                f"{60.0 * hours:g}: allow twice as long at least, tune on a part "
                f"(`-o sequences.{name}.stop=SECONDS`)"
            )

    return shown


def _estimate(study: "OfflineStudy", names: Sequence[str], show: Progress) -> None:
    """Estimate references; where one is refused, nothing is left behind."""
    from adaptune.study.references import ensure_references

    there = study.folder.exists()
    study.open()
    try:
        ensure_references(study.sequences, names, 5.0, _in_time(show, study.config.offline.hours))
    except AdaptuneError as error:
        if not there:
            shutil.rmtree(study.folder)
        raise AdaptuneError(f"{error}; or give a --reference") from error


_TOPIC = re.compile(r"(?:topic|\w*(?:points|cloud|lidar)\w*):=(/\w[\w/]*)")
"""An argument that names the clouds' topic."""


def _system_of(given: str) -> dict[str, Any] | None:
    """The image or the launch command of a ROS system, as settings; None if it is none."""
    words = words_of(given)
    image: dict[str, Any] = {}
    if words[:1] != ["ros2"]:
        if not is_image(given):
            return None
        image, words = {"image": given}, ["ros2", "launch", LACKING, f"{LACKING}.launch.py"]
    file, points = [f"{LACKING}:={{parameters}}"], [f"{LACKING}:={{points}}"]
    if words[1:2] == ["run"]:
        words += ["--ros-args"] * ("--ros-args" not in words)
        file, points = ["--params-file", "{parameters}"], ["-r", *points]
    topic = next(filter(None, map(_TOPIC.fullmatch, words)), None)
    words += file * ("{parameters}" not in given)
    words += points * (topic is None and "{points}" not in given)
    return image | {"command": words, "points": topic[1] if topic else "/points"}


def is_image(given: str) -> bool:
    """Whether a name is that of an image, and of no odometry."""
    from adaptune.odometry.systems.engine import EngineError, image_digest

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


def write_system_study(asked: Asked, folder: Path | None, show: Progress) -> Path | None:
    """Write a study of a ROS system to fill in; None if the odometry is none."""
    if (settings := _system_of(asked.odometry)) is None:
        return None
    path = (folder or Path()) / f"{plain_name(asked.recordings[0].resolve())}_ros2.yaml"
    if path.exists():
        raise AdaptuneError(f"{path}: exists; fill it in, or move it away")
    named, test = recorded(asked, show)
    settings |= {
        "template": str(asked.config.resolve()) if asked.config else LACKING,
        "odometry": f"/{LACKING}",
    }
    below: YamlPath = ("odometry", "settings")
    comments: dict[YamlPath, str] = ROLES | {
        ("odometry", "name"): "Or rustle, for a ROS 1 system, see docs/docker.md.",
        (*below, "command"): "{points} is the topic below; an argument that is not needed can go.",
        (*below, "template"): "The parameter file that you use now.",
        (*below, "odometry"): "The topic of its poses.",
        (*below, "points"): "The topics that it hears, as imu: /imu",
        ("odometry", "parameters"): "What to tune.",
    }
    if all("imu" in one.given for one in named.values()):
        settings["imu"] = "/imu"
    guess = {"type": "float", "low": 0.1, "high": 2.0, "baseline": 0.5}
    odometry = {"name": "ros2", "settings": settings, "parameters": {LACKING: guess}}
    sequences = {name: one.given for name, one in named.items()}
    training = [name for name in named if name not in test]
    data = {"sequences": sequences} | roles(training, USUAL_LENGTH, odometry, test=test)
    write_text(path, dump(data, comments))
    return path
