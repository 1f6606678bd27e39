"""Replays on disk: trajectory, selections, frames, and what they were made from."""

import csv
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError

from adaptune import manifest
from adaptune.errors import AdaptuneError
from adaptune.files import replacing, write_text
from adaptune.odometry.tracker import RegisteredScan
from adaptune.strict import ConfigurationError, in_one_line
from adaptune.trajectory import Trajectory, TrajectoryError, read_tum, write_tum
from online.replay import Choice, ReplayRecord

_TABLES = ("frames.csv", "selections.csv")
"""Files of a replay besides its trajectory."""
_TIMES = ("prepare_ms", "register_ms")
"""Columns of ``frames.csv``: milliseconds of a scan."""


class StoredReplayError(AdaptuneError):
    """A replay that is missing or damaged."""


class ReplaySummary(BaseModel):
    """The content of ``replay.json``."""

    scans: int
    duration_s: float  # of the recording
    replay_s: float  # of its replay
    restarts: int  # how often the health check restarted the odometry
    unhealthy: dict[str, int]  # how often the health check found what
    poor_scans: int  # scans that were too poor to register
    selections: int
    lost_seconds: float = 0.0  # how long the bank was lost
    # Percent: mean of the odometry's own error as it was measured without ground truth.
    mean_estimated_error: float | None = None
    cpu_ms: float | None = None  # milliseconds of CPU time a scan, without reading it
    memory_mb: float | None = None  # most megabytes of all processes
    real_time: dict[str, float] | None = None  # how it kept up, see `kept_up`
    model_file: str | None  # of the model that it was made with; None if it needed none
    inputs: dict[str, Any] = Field({}, exclude=True)  # see `adaptune.manifest`

    @property
    def mode(self) -> str:
        """Which mode was replayed."""
        return str(self.inputs["mode"])

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read ``replay.json``. All files of a replay are there, for this one is written last.

        Raises
        ------
        StoredReplayError
        """
        path = folder / "replay.json"
        if not path.exists():
            raise StoredReplayError(
                f"{folder}: there is no replay; run `adaptune online` with this study first"
            )
        try:
            inputs = manifest.recorded(folder / manifest.FILE)
            return cls.model_validate_json(path.read_bytes()).model_copy(update={"inputs": inputs})
        except (OSError, ValidationError, ConfigurationError) as error:
            raise damaged(path, error) from error


def repeat_folder(folder: Path, repeat: int) -> Path:
    """Folder of a repeat of the replay in `folder`, which is the first."""
    return folder if repeat == 1 else folder / f"repeat_{repeat}"


def read_repeats(folder: Path) -> list["StoredReplay"]:
    """A mode's replay on a sequence, and its repeats in order.

    What was repeated of something else, such as another model, does not count.

    Parameters
    ----------
    folder
        Of the mode, which holds the first.

    Raises
    ------
    StoredReplayError
        If the first one is missing, or one of them is damaged.
    """
    replays = [StoredReplay.read(folder)]
    inputs = replays[0].summary.inputs
    while True:
        repeat = len(replays) + 1
        of = repeat_folder(folder, repeat)
        if replay_changes(of, inputs | {"repeat": repeat}) != []:
            return replays
        replays.append(StoredReplay.read(of))


def replay_changes(
    folder: Path, inputs: manifest.Inputs, files: Mapping[str, Sequence[Path]] | None = None
) -> list[str] | None:
    """In what a stored replay's inputs differ from others, in words; None if it is not complete."""
    if not all((folder / name).exists() for name in ("replay.json", "trajectory.tum", *_TABLES)):
        return None
    try:
        return manifest.changes(ReplaySummary.read(folder).inputs, inputs, files)
    except StoredReplayError:
        return None


@dataclass(frozen=True, eq=False)
class StoredReplay:
    """A replay as it was stored."""

    summary: ReplaySummary
    trajectory: Trajectory
    restarted: NDArray[np.bool_]  # (n,): frames at which the health check restarted the odometry
    seconds: float  # that the odometry took to prepare and register all scans
    # (m,): nanoseconds, of the scans that selections were made from; the first one of a mode that
    # keeps its parameters.
    choice_stamps: NDArray[np.int64]
    # For every parameter its values, of shape (m,); in a bank those of the heaviest member.
    choices: dict[str, Sequence[Any]]
    weights: dict[int, Sequence[float]]  # in a bank, by trial, of shape (m,); empty without one
    # (m, 3): the odometry's own error as it was measured while driving, and the ends of its
    # interval, in percent; NaN where it is unknown.
    estimated: NDArray[np.float64]
    lost: NDArray[np.bool_]  # (m,): whether the bank was lost

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read what `write_replay` wrote.

        Raises
        ------
        StoredReplayError
            If a file is missing or damaged.
        """
        summary = ReplaySummary.read(folder)
        try:
            trajectory = read_tum(folder / "trajectory.tum")
        except TrajectoryError as error:
            raise StoredReplayError(f"{error}; {_made_again(folder)}") from error
        frames = read_columns(folder / "frames.csv")
        restarted = np.array(frames.get("restarted", [])) == "1"
        if len(restarted) != len(trajectory):
            cut = "frames.csv" if len(trajectory) == summary.scans else "trajectory.tum"
            raise damaged(folder / cut, ValueError("not a row for every scan"))
        try:
            seconds = 1e-3 * sum(float(ms) for key in _TIMES for ms in frames[key])
        except (KeyError, ValueError) as error:
            raise damaged(folder / "frames.csv", error) from error
        chosen = _choices(folder / "selections.csv", summary.selections)
        if not len(chosen.stamps):
            kept = summary.inputs["parameters"] or {}
            chosen = chosen._replace(
                stamps=trajectory.stamps[:1],
                parameters={name: _numbers([str(value)]) for name, value in kept.items()},
                estimated=np.full((1, 3), np.nan),
                lost=np.zeros(1, bool),
            )
        return cls(summary, trajectory, restarted, seconds, *chosen)


def write_replay(
    folder: Path, replay: ReplayRecord, inputs: manifest.Inputs, model_file: Path | None
) -> None:
    """Write ``trajectory.tum``, ``selections.csv``, ``frames.csv`` and, last, ``replay.json``.

    `inputs` is what it was made from, `model_file` the model that it was made with, if any.
    """
    write_tum(folder / "trajectory.tum", replay.trajectory)
    _write_selections(folder / "selections.csv", replay)
    rows = [frame_row(step, math.nan) for step in replay.steps]
    columns: tuple[str, ...] = FRAME_COLUMNS[:-1]
    if replay.rate is not None:
        columns, late = FRAME_COLUMNS, replay.late
        rows = [frame_row(*pair) for pair in zip(replay.steps, late, strict=True)]
    _write_csv(folder / "frames.csv", columns, (row[: len(columns)] for row in rows))
    stamps = replay.trajectory.stamps
    summary = ReplaySummary(
        scans=len(stamps),
        duration_s=round(float(stamps[-1] - stamps[0]) * 1e-9, 3),
        replay_s=round(replay.seconds, 3),
        restarts=int(replay.restarted.sum()),
        unhealthy=replay.unhealthy,
        poor_scans=int((~replay.registered).sum()),
        selections=len(replay.choices),
        lost_seconds=round(_lost_seconds(replay), 3),
        mean_estimated_error=_mean_estimated(replay),
        cpu_ms=round(replay.cpu_ms, 3),
        memory_mb=round(replay.memory, 1),
        real_time=kept_up(replay),
        model_file=None if model_file is None else str(model_file.resolve()),
    )
    manifest.record(folder / manifest.FILE, inputs)
    write_text(folder / "replay.json", summary.model_dump_json(indent=2) + "\n")


def kept_up(replay: ReplayRecord) -> dict[str, float] | None:
    """Counts, and medians and 99th percentiles in milliseconds, of a replay in real time."""
    if replay.rate is None:
        return None
    found: dict[str, float] = {
        "rate": replay.rate,
        "dropped_scans": replay.dropped,
        "missed_selections": replay.missed,
        "unseen_scans": replay.unseen,
        "late_members_scans": sum(replay.late_members.values()),
        "removed_members": len(replay.removed),
    }
    latencies = [choice.seconds for choice in replay.choices]
    named = {"pose": replay.late, "selection": latencies, "waited": replay.waited}
    for name, seconds in named.items():
        for q in (50, 99):
            value = 1e3 * float(np.percentile(seconds, q)) if seconds else 0.0
            found[f"{name}_ms_p{q}"] = round(value, 3)
    return found


def _lost_seconds(replay: ReplayRecord) -> float:
    """Seconds from selections at which the bank was lost to the next ones."""
    stamps = [*(choice.stamp for choice in replay.choices), int(replay.trajectory.stamps[-1])]
    spans = zip(replay.choices, itertools.pairwise(stamps), strict=True)
    return 1e-9 * sum(end - start for choice, (start, end) in spans if choice.selection.lost)


def _mean_estimated(replay: ReplayRecord) -> float | None:
    """Mean of the estimated errors, where there are any."""
    errors = [choice.selection.estimated_error for choice in replay.choices]
    known = [error for error in errors if math.isfinite(error)]
    return round(float(np.mean(known)), 4) if known else None


_ESTIMATED = ("estimated_error_percent", "estimated_low_percent", "estimated_high_percent")
SELECTION_COLUMNS = (
    *("stamp_ns", "trial", "predicted_error_percent", "predicted_fixed_percent"),
    *("familiarity", "sequences", *_ESTIMATED, "lost", "weights", "ms", "why_not", "fallen_back"),
)
"""Columns of ``selections.csv`` before the parameters."""
FRAME_COLUMNS = ("stamp_ns", "registered", "restarted", "prepare_ms", "register_ms", "late_ms")
"""Columns of ``frames.csv``."""


def _write_selections(path: Path, replay: ReplayRecord) -> None:
    # Sets of several odometries have other parameters.
    every = (name for choice in replay.choices for name in choice.selection.parameters)
    names = list(dict.fromkeys(every))
    made = sorted([*replay.choices, *replay.rejected], key=lambda choice: choice.stamp)
    rows = (selection_row(choice, names) for choice in made)
    _write_csv(path, (*SELECTION_COLUMNS, *names), rows)


def selection_row(choice: Choice, names: Sequence[str]) -> list[Any]:
    """A row of ``selections.csv``: `SELECTION_COLUMNS`, and the parameters of these names."""
    stamp, selection, seconds, why_not, fallen_back = choice
    numbers = (
        selection.predicted_error,
        selection.predicted_fixed,
        selection.familiarity,
        selection.n_sequences,
        selection.estimated_error,
        selection.estimated_low,
        selection.estimated_high,
    )
    weights = (selection.weights or {}).items()
    return [
        *(stamp, selection.trial, *(f"{x:.4f}" for x in numbers), int(selection.lost)),
        " ".join(f"{trial}:{weight:.3f}" for trial, weight in weights),
        *(f"{1e3 * seconds:.3f}", why_not, fallen_back),
        *(selection.parameters.get(name, "") for name in names),
    ]


def frame_row(step: RegisteredScan, late: float) -> list[Any]:
    """A row of ``frames.csv``, see `FRAME_COLUMNS`; `late` in seconds, NaN in lockstep."""
    restarted = int(step.unhealthy is not None)
    ms = (1e3 * seconds for seconds in (step.prepare_seconds, step.register_seconds, late))
    rounded = (round(value, 3) if math.isfinite(value) else "" for value in ms)
    return [step.stamp, int(step.registered), restarted, *rounded]


def _write_csv(path: Path, columns: Sequence[str], rows: Any) -> None:
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


class _Choices(NamedTuple):
    """The columns of ``selections.csv``, see `StoredReplay`."""

    stamps: NDArray[np.int64]
    parameters: dict[str, Sequence[Any]]
    weights: dict[int, Sequence[float]]
    estimated: NDArray[np.float64]
    lost: NDArray[np.bool_]


def _choices(path: Path, n: int) -> _Choices:
    """Read the selections that were applied, `n` of them."""
    every = read_columns(path)
    columns = _applied(every)
    try:
        stamps = np.array([int(stamp) for stamp in columns.get("stamp_ns", [])], np.int64)
        weights = _weights(columns.get("weights", []))
        # Replays of an older adaptune have no estimates.
        estimated = np.full((len(stamps), 3), np.nan)
        for i, name in enumerate(_ESTIMATED):
            if name in columns:
                estimated[:, i] = np.array(columns[name], np.float64)
        lost = np.array([text == "1" for text in columns.get("lost", ["0"] * len(stamps))], bool)
    except (TypeError, ValueError) as error:
        raise damaged(path, error) from error
    if sum(not why for why in _whys(every)) != n:
        raise damaged(path, ValueError("not a row for every selection"))
    parameters: dict[str, Sequence[Any]] = {
        name: _numbers(values) for name, values in columns.items() if name not in SELECTION_COLUMNS
    }
    return _Choices(stamps, parameters, weights, estimated, lost)


def read_applied(path: Path) -> dict[str, list[str]]:
    """The columns of ``selections.csv``, of what was applied; of the same scan, the last one."""
    return _applied(read_columns(path))


def _applied(columns: Mapping[str, list[str]]) -> dict[str, list[str]]:
    stamps = columns.get("stamp_ns", [])
    rows = list({stamps[i]: i for i, why in enumerate(_whys(columns)) if not why}.values())
    return {name: [values[i] for i in rows] for name, values in columns.items()}


def _whys(columns: Mapping[str, list[str]]) -> list[str]:
    """Why each row of ``selections.csv`` was not applied; empty where it was."""
    return columns.get("why_not", [""] * len(columns.get("stamp_ns", [])))


def _weights(texts: Sequence[str]) -> dict[int, Sequence[float]]:
    """Read the column of weights."""
    rows = [dict(pair.split(":") for pair in text.split()) for text in texts]
    if any(row.keys() != rows[0].keys() for row in rows):
        raise ValueError("weights of other trials from row to row")
    return {int(trial): [float(row[trial]) for row in rows] for trial in (rows[0] if rows else {})}


def read_columns(path: Path) -> dict[str, list[str]]:
    """Columns of a table of a replay as they are written; none if it has no rows.

    Raises
    ------
    StoredReplayError
        If it is missing or damaged.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError) as error:
        raise damaged(path, error) from error
    if any(None in row or None in row.values() for row in rows):
        raise damaged(path, ValueError("rows of other lengths than its header"))
    return {key: [row[key] for row in rows] for key in (rows[0] if rows else {})}


def _numbers(values: Sequence[str]) -> list[Any]:
    """Numbers if all are, NaN where the set of another odometry has no value; texts otherwise."""
    try:
        return [float(value or "nan") for value in values]
    except ValueError:
        return list(values)


def damaged(path: Path, error: Exception) -> StoredReplayError:
    """What is raised on a file of a replay that cannot be understood."""
    what = f"is damaged ({in_one_line(error)})"
    return StoredReplayError(f"{path}: {what}; {_made_again(path.parent)}")


def _made_again(folder: Path) -> str:
    return f"remove {folder} and run `adaptune online` with this study, which makes it again"


# The reference beside the replays of a sequence, and what it was made from.


_REFERENCE_INPUTS = f"reference.{manifest.FILE}"


class StoredReferenceError(AdaptuneError):
    """A reference that does not go with a replay."""


def is_reference_of(folder: Path, about: manifest.Inputs) -> bool:
    """Whether the reference in a folder was made from just this."""
    known = (folder / "reference.tum").exists()
    try:
        made = manifest.recorded(folder / _REFERENCE_INPUTS)
    except ConfigurationError:
        return False
    return made is not None and not manifest.changes(made, {**about, "known": known})


def check_reference(folder: Path, about: manifest.Inputs, option: str = "") -> None:
    """Refuse a reference that was made from something else; the command with `option` makes it.

    Raises
    ------
    StoredReplayError
    """
    if not is_reference_of(folder, about):
        raise StoredReplayError(
            f"{folder}: was judged by another reference; run `adaptune online{option}` with this "
            f"study, which replays nothing for it"
        )


def write_reference(
    folder: Path, reference: Trajectory | None, odometry: Trajectory, about: manifest.Inputs
) -> None:
    """Write ``reference.tum``, at the stamps of a replay; remove it if there is none.

    `about` is what the reference is made from, see `adaptune.manifest`.
    """
    path = folder / "reference.tum"
    if reference is None:
        path.unlink(missing_ok=True)
    else:
        T = reference.at(odometry.stamps)
        known = ~np.isnan(T[:, 0, 0])
        if not known.any():
            raise StoredReferenceError(
                f"{folder.name}: the reference does not overlap the scans in time; check that both "
                f"are of the same recording and clock"
            )
        write_tum(path, Trajectory(odometry.stamps[known], T[known]))
    manifest.record(folder / _REFERENCE_INPUTS, {**about, "known": reference is not None})
