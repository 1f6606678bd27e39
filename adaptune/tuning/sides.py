"""The gate for changes: drive what is not known yet on both sides, and compare."""

import logging
import math
import os
import shutil
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from adaptune._system.files import plain_name
from adaptune._system.machine import pin
from adaptune._system.manifest import digest, plain
from adaptune._system.progress import Progress, bars_and_words
from adaptune._system.yaml12 import Document, YamlError
from adaptune.errors import AdaptuneError
from adaptune.odometry import Odometry
from adaptune.odometry.base import ToolSettings
from adaptune.odometry.registry import is_user_class, odometry_class
from adaptune.recording.fleet import Reading
from adaptune.reference.check import greatest_speed
from adaptune.space import in_words
from adaptune.study.references import ensure_references
from adaptune.study.study import CONFIGURATION
from adaptune.tuning.asked import Asked, check_guarded, named_odometry, recorded, words_of
from adaptune.tuning.studies import is_image
from offline.config import OfflineStudy, load_study
from online.gate import Gate, SharedReplays, compare_sides, shared_replays, stored_replays
from online.modes import BASELINE, FIXED, replay_modes, sequences_without_model
from online.turns import Costs, by_turns

_log = logging.getLogger(__name__)
FOLDER = Path("runs/compare")
"""Where what the gate drives is kept."""


FAST, CAR, ROBOT = 4.0, 10.0, 2.0
"""Metres a second that only cars drive, and metres of a sub-trajectory for these and for others.
Lengths that suit the recordings would change with each that is added, and with them all errors."""


def sides(
    given: Sequence[Any], asked: Asked, length: float | None, show: Progress
) -> tuple[OfflineStudy, OfflineStudy]:
    """Both sides as studies, the new one first; replays that are missing are made.

    See `compare` for what a side is. They are driven by turns, each alone on a core. `length` is
    that of sub-trajectories; by default the studies', or `CAR` or `ROBOT`.
    """
    called, now = [*map(_called, given)], time.time()
    studies = _driven(given, asked, show) if asked.recordings else _studies(called)
    studies = [replace(one, called=name) for one, name in zip(studies, called, strict=True)]
    _drive(studies, show)
    new, old = studies if length is None else (_over(length, one) for one in studies)
    for side in (new, old):
        replays = (stored_replays(side, mode).values() for mode in (FIXED, BASELINE))
        made = [one.made for of in replays for one in of]
        if made and (first := min(made)) < now:
            _log.info(
                f"{side.name}: its replays of {datetime.fromtimestamp(first):%Y-%m-%d %H:%M} are "
                f"compared. Libraries and other files that it loads may have changed since; to "
                f"drive it anew, remove {side.folder / 'replays'}"
            )
    return new, old


def _called(given: Any) -> str:
    """A side in words; of an object, with its parameters."""
    name, about = named_odometry(given)
    values = {key: of["baseline"] for key, of in about[name]["parameters"].items()} if about else {}
    return f"{name} ({in_words(values)})" if about else name


def compare(
    new: str | Path | type[Odometry] | Odometry,
    old: str | Path | type[Odometry] | Odometry,
    recordings: "str | Path | Sequence[str | Path]" = (),
    *,
    odometry: str = "",
    points: str | None = None,
    reference: str | Path | None = None,
    reading: Reading | None = None,
    sub_trajectory: float | None = None,
    worse: float = 5.0,
    cost: float | None = 10.0,
    progress: Progress | None = None,
) -> Gate:
    """Say whether an odometry is worse than another, as ``compare NEW --against OLD`` does.

    The result's `verdict` is ``"worse"``, ``"equal"``, ``"better"`` or ``"unclear"``, its `words`
    say why, and its `rows` have each quantity on each recording. In a script, call it below
    ``if __name__ == "__main__":``. There is an AdaptuneError where the two do not compare.

    Parameters
    ----------
    new, old
        Studies or their folders, whose replays are there; or where `recordings` are given, what
        to drive: names of odometries, classes, objects with their parameters, commands, images,
        or parameter files of an `odometry`.
    recordings
        Bags, or folders of them; `reading`, ``"one"`` or ``"several"``, says how to read these.
    points, reference
        Topics, where not the recording's own; or a reference's file, or ``"estimated"``.
    sub_trajectory
        Metres over which errors are measured; by default the studies', or 2 m, of cars 10 m.
    worse, cost
        Percent of error and of CPU time that are no matter; with None, no cost is.
    progress
        Called with how far each task is; by default, bars show it.
    """
    check_guarded("compare")
    bags = [recordings] if isinstance(recordings, str | Path) else recordings
    judge = None if reference is None else str(reference)
    asked = Asked([*map(Path, bags)], odometry, points, judge, reading=reading)
    given = [str(side) if isinstance(side, Path) else side for side in (new, old)]
    with ExitStack() as stack:
        show = progress or stack.enter_context(bars_and_words())
        shared = shared_replays(*sides(given, asked, sub_trajectory, show))
        measured = None if cost is None else costs(shared, show)
    bound = math.inf if cost is None else cost / 100.0
    return compare_sides(shared, measured, worse / 100.0, bound)


def costs(shared: SharedReplays, show: Progress) -> dict[str, Costs | str]:
    """What both sides cost on each recording, driven twice by turns; or why that is not known."""
    found: dict[str, Costs | str] = {}
    for pair in shared.pairs:
        found[pair.name] = next(filter(None, (one.obstacle for one in pair.both)), "")
        if not found[pair.name]:
            # How many cores there are is asked before this process keeps to one.
            _ = [one.study.mechanism for one in pair.both]
            with pin(os.getpid(), alone=True):
                found[pair.name] = by_turns(pair.both, FOLDER / "turns", show)
    return found


def _studies(given: Sequence[str]) -> list[OfflineStudy]:
    for name in given:
        if not Path(name).exists():
            raise AdaptuneError(f"{name}: there is no such study; or name the bags to drive, too")
    return [load_study(name, needed=Path(name).is_file()) for name in given]


def _driven(given: Sequence[Any], asked: Asked, show: Progress) -> list[OfflineStudy]:
    """Both sides as studies of the same recordings."""
    for side in given:
        if isinstance(side, str) and _is_study(Path(side)):
            bags = ", ".join(map(str, asked.recordings))
            raise AdaptuneError(f"{side}: a study has its own recordings; leave {bags} out")
    named, _ = recorded(asked, show, alike=False)  # nothing is tuned on them
    names = list(named)
    shared: dict[str, Any] = {
        "sequences": {name: one.given for name, one in named.items()},
        "training": names,
    }
    entries = [_entry(side, asked.odometry) for side in given]
    folders = []
    for side, entry in zip(given, entries, strict=True):
        about = side if isinstance(side, str) else entry
        folders.append(FOLDER / f"{plain_name(Path(_called(side)))[:40]}_{digest(about)[:6]}")
    each = zip(entries, folders, strict=True)
    both = [load_study(shared | {"odometry": of}, folder=folder) for of, folder in each]
    both[0].open()
    sequences = both[0].sequences
    refused = ensure_references(sequences, names, 5.0, show, required=False)
    known = [sequences.open(name).reference() for name in names if name not in refused]
    fastest = max((greatest_speed(one) for one in known if one is not None), default=0.0)
    if folders[0] != folders[1] and (estimates := folders[0] / "references").exists():
        shutil.copytree(estimates, folders[1] / "references", dirs_exist_ok=True)
    return [_over(CAR if fastest > FAST else ROBOT, one) for one in both]


def _over(length: float, study: OfflineStudy) -> OfflineStudy:
    """The study with errors over another length."""
    return replace(study, config=study.config.model_copy(update={"sub_trajectory": length}))


def _is_study(path: Path) -> bool:
    with suppress(YamlError, OSError):  # files of parameters may be templates; commands are long
        if path.suffix not in (".yaml", ".yml") or not path.is_file():
            return (path / CONFIGURATION).is_file()
        data = Document.of_file(path).data
        return isinstance(data, dict) and {"odometry", "training"} <= data.keys()
    return False


def _entry(given: Any, odometry: str) -> dict[str, Any]:
    if not isinstance(given, str):
        name, about = named_odometry(given)
        return {"name": name, **plain(about.get(name, {}))}
    file = Path(given)
    if len(words_of(given)) > 1 or file.suffix not in (".yaml", ".yml", ".json"):
        return _named(given)
    if not file.is_file():
        raise AdaptuneError(f"{given}: there is no such file")
    if not odometry:
        raise AdaptuneError(f"{given}: is a parameter file; name its --odometry, too")
    entry = _named(odometry)
    if entry["name"] in ("command", "docker_command"):
        entry["settings"]["template"] = str(file.resolve())
    elif not is_user_class(odometry) and issubclass(
        odometry_class(odometry).settings_type, ToolSettings
    ):
        entry["settings"] = {"config": str(file.resolve())}
    else:  # a set as adaptune writes it
        values = Document.of_file(file).data
        if not isinstance(values, dict) or any(isinstance(v, dict | list) for v in values.values()):
            raise AdaptuneError(
                f"{given}: give the value of each parameter, as fixed.yaml has them"
            )
        entry["parameters"] = {name: {"baseline": value} for name, value in values.items()}
    return entry


def _named(given: str) -> dict[str, Any]:
    words = words_of(given)
    if len(words) > 1:
        # It runs in a folder of its own.
        words = [str(Path(w).absolute()) if Path(w).is_file() else w for w in words]
        return {"name": "command", "settings": {"command": words}, "parameters": {}}
    if is_image(given):
        return {"name": "docker_command", "settings": {"image": given}, "parameters": {}}
    return {"name": given}


def _drive(studies: Sequence[OfflineStudy], show: Progress) -> None:
    """Make the replays of the baselines that are missing, of a study that is a file.

    Both sides take turns on each recording, so that both meet the same state of the machine.
    """
    due = [
        (name, study)
        for study in studies
        if not stored_replays(study, FIXED)
        for name in sequences_without_model(study.config)
    ]
    for name, study in sorted(due, key=lambda one: one[0]):
        # Of the same text, the second one would not be shown.
        texts = {f"{name}, {BASELINE}": f"{name}, {study.name}"}

        def shown(text: str, *how: Any, texts: dict[str, str] = texts) -> None:
            show(texts.get(text, text), *how)

        replay_modes(study, [name], (BASELINE,), shown)
