"""Replays and drives on disk: trajectory, selections, frames, and what they were made from."""

import csv
import io
import itertools
import logging
import math
import os
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError

from adaptune import manifest
from adaptune.errors import AdaptuneError
from adaptune.files import replacing, write_text
from adaptune.odometry.tracker import RegisteredScan
from adaptune.strict import ConfigurationError, in_one_line
from adaptune.trajectory import Trajectory, TrajectoryError, read_tum, tum_lines, write_tum
from online.replay import Choice, ReplayRecord

_log = logging.getLogger(__name__)


class StoredReplayError(AdaptuneError):
    """A replay that is missing or damaged."""


class ReplaySummary(BaseModel):
    """The content of ``replay.json``."""

    scans: int
    restarts: int  # how often the health check restarted the odometry
    unhealthy: dict[str, int]  # how often the health check found what
    poor_scans: int  # scans that were too poor to register
    selections: int
    lost_seconds: float = 0.0  # how long the bank was lost
    cpu_ms: float | None = None  # milliseconds of CPU time a scan, without reading it
    memory_mb: float | None = None  # most megabytes of all processes
    real_time: dict[str, float] | None = None  # how it kept up, see `kept_up`
    first_pose: float = 0.0  # seconds from the first scan; what was before is left out
    lacking: int = 0  # scans without a pose
    fault: str = ""  # the last one of the odometry
    machine: str | None = None  # on which it was driven
    inputs: dict[str, Any] = Field({}, exclude=True)  # see `adaptune.manifest`

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read ``replay.json``, or raise a StoredReplayError.

        All files of a replay are there, for this one is written last.
        """
        path = folder / "replay.json"
        try:
            inputs = manifest.recorded(folder / manifest.FILE)
            summary = cls.model_validate_json(path.read_bytes())
        except (OSError, ValidationError, ConfigurationError) as error:
            raise damaged(path, error) from error
        if inputs is None:
            raise damaged(folder / manifest.FILE, FileNotFoundError("it is not there"))
        return summary.model_copy(update={"inputs": inputs})


def is_complete(folder: Path) -> bool:
    """Whether a replay is there, with all its files."""
    with suppress(StoredReplayError):
        ReplaySummary.read(folder)
        return all(
            (folder / n).exists() for n in ("trajectory.tum", "frames.csv", "selections.csv")
        )
    return False


@dataclass(frozen=True, eq=False)
class StoredReplay:
    """A replay as it was stored."""

    summary: ReplaySummary
    trajectory: Trajectory
    # Columns of ``frames.csv``, of shape (n,); `late_ms` is empty where it was not in real time.
    frames: Mapping[str, NDArray[np.float64]]
    # (m,): nanoseconds, of the scans that selections were made from; the first one of a mode that
    # keeps its parameters.
    choice_stamps: NDArray[np.int64]
    # For every parameter its values, of shape (m,); in a bank those of the heaviest member.
    choices: Mapping[str, Sequence[Any]]
    weights: Mapping[int, Sequence[float]]  # in a bank, by trial, of shape (m,); empty without one
    # Other columns of ``selections.csv``, of shape (m,): NaN where they are unknown, and of a mode
    # that keeps its parameters.
    selections: Mapping[str, NDArray[np.float64]]
    states: NDArray[np.str_]  # of shape (m,), see `Selection`

    @property
    def restarted(self) -> NDArray[np.bool_]:
        """Frames at which the health check restarted the odometry, of shape (n,)."""
        return np.asarray(self.frames["restarted"] == 1.0)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Whether the bank was lost, of shape (m,)."""
        return np.asarray(self.selections["lost"] == 1.0)

    @property
    def estimated(self) -> NDArray[np.float64]:
        """The odometry's own error as measured while driving, in percent, of shape (m, 3).

        It is followed by the ends of its interval; NaN where it is unknown.
        """
        return np.column_stack([self.selections[name] for name in _ESTIMATED])

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read what `write_replay` wrote; a StoredReplayError if it is missing or damaged."""
        summary = ReplaySummary.read(folder)
        try:
            trajectory = read_tum(folder / "trajectory.tum")
        except TrajectoryError as error:
            raise StoredReplayError(f"{error}; {_made_again(folder)}") from error
        path = folder / "frames.csv"
        try:
            columns = _columns(path)
            frames = {name: _floats(columns.get(name, [])) for name in FRAME_COLUMNS[1:]}
            path = folder / "selections.csv"
            columns = _applied(_columns(path), summary.selections)
            stamps = np.array(list(map(int, columns.pop("stamp_ns"))), np.int64)
            weights = _weights(columns.pop("weights"))
            selections = {name: _floats(columns.pop(name)) for name in _NUMBERS}
            states = np.array(columns.pop("state"), np.str_)
        except (OSError, KeyError, ValueError) as error:
            raise damaged(path, error) from error
        if {len(frames[name]) for name in FRAME_COLUMNS[1:-1]} != {len(trajectory)}:
            cut = "frames.csv" if len(trajectory) == summary.scans else "trajectory.tum"
            raise damaged(folder / cut, ValueError("not a row for every scan"))
        if not len(stamps):
            kept = summary.inputs["parameters"] or {}
            columns = {name: [str(value)] for name, value in kept.items()}
            stamps, selections = trajectory.stamps[:1], dict.fromkeys(_NUMBERS, np.full(1, np.nan))
            states = np.array(["unknown"])
        choices = {name: _numbers(values) for name, values in columns.items()}
        return cls(summary, trajectory, frames, stamps, choices, weights, selections, states)


def switched(choices: Mapping[str, Sequence[Any]]) -> NDArray[np.bool_]:
    """Which of m selections changed a parameter, of shape (m,), from their values by name."""
    # As texts, because NaN does not equal itself.
    rows = list(map(repr, zip(*choices.values(), strict=True)))
    return np.array([False, *(a != b for a, b in itertools.pairwise(rows))])


def write_replay(folder: Path, replay: ReplayRecord, inputs: manifest.Inputs) -> None:
    """Write ``trajectory.tum``, ``selections.csv``, ``frames.csv`` and, last, ``replay.json``.

    `inputs` is what it was made from.
    """
    write_tum(folder / "trajectory.tum", replay.trajectory)
    # Sets of several odometries have other parameters.
    every = (name for choice in replay.choices for name in choice.selection.parameters)
    names = list(dict.fromkeys(every))
    made = sorted([*replay.choices, *replay.rejected], key=lambda choice: choice.stamp)
    rows = (selection_row(choice, names) for choice in made)
    _write_csv(folder / "selections.csv", (*SELECTION_COLUMNS, *names), rows)
    columns = FRAME_COLUMNS if replay.rate is not None else FRAME_COLUMNS[:-1]
    late = replay.late if replay.rate is not None else itertools.repeat(math.nan)
    rows = (frame_row(*pair)[: len(columns)] for pair in zip(replay.steps, late, strict=False))
    _write_csv(folder / "frames.csv", columns, rows)
    summary = ReplaySummary(
        scans=len(replay.steps),
        restarts=int(replay.restarted.sum()),
        unhealthy=replay.unhealthy,
        poor_scans=sum(not step.registered for step in replay.steps),
        selections=len(replay.choices),
        lost_seconds=round(_lost_seconds(replay), 3),
        cpu_ms=round(replay.cpu_ms, 3),
        memory_mb=round(replay.memory, 1),
        real_time=kept_up(replay),
        first_pose=round(replay.first_pose, 3),
        lacking=replay.lacking,
        fault=replay.faults[-1] if replay.faults else "",
        machine=machine(),
    )
    if replay.first_pose:
        what = "%s, %s: the odometry gave its first pose after %.1f s"
        mode, _, _ = folder.name.rpartition("-")
        _log.info(what, folder.parent.name, mode, replay.first_pose)
    manifest.record(folder / manifest.FILE, inputs)
    write_text(folder / "replay.json", summary.model_dump_json(indent=2) + "\n")


@cache
def machine() -> str:
    """The kind of this machine: costs that were measured on others cannot be compared."""
    name = None
    with suppress(OSError):
        listed = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        name = re.search(r"model name\s*: (.*)", listed)
    return f"{name[1] if name else platform.machine()}, {os.cpu_count()} cores"


def kept_up(replay: ReplayRecord) -> dict[str, float] | None:
    """Counts, and medians and 99th percentiles in milliseconds, of a replay in real time."""
    if replay.rate is None:
        return None
    counts: dict[str, float] = {
        "rate": replay.rate,
        "dropped_scans": replay.dropped,
        "missed_selections": replay.missed,
        "unseen_scans": replay.unseen,
        "late_members_scans": replay.late_members,
        "removed_members": replay.removed,
    }
    latencies = [choice.seconds for choice in replay.choices]
    named = {"pose": replay.late, "selection": latencies, "waited": replay.waited}
    for name, seconds in named.items():
        for q in (50, 99):
            value = 1e3 * float(np.percentile(seconds, q)) if seconds else 0.0
            counts[f"{name}_ms_p{q}"] = round(value, 3)
    return counts


def _lost_seconds(replay: ReplayRecord) -> float:
    """Seconds from selections at which the bank was lost to the next ones."""
    stamps = [*(choice.stamp for choice in replay.choices), int(replay.trajectory.stamps[-1])]
    spans = zip(replay.choices, itertools.pairwise(stamps), strict=True)
    return 1e-9 * sum(end - start for choice, (start, end) in spans if choice.selection.lost)


_ESTIMATED = ("estimated_error_percent", "estimated_low_percent", "estimated_high_percent")
_PREDICTED = ("predicted_error_percent", "predicted_fixed_percent", "familiarity")
_NUMBERS = ("trial", *_PREDICTED, *_ESTIMATED, "lost", "ms")
_TEXTS = ("why_not", "fallen_back")
SELECTION_COLUMNS = ("stamp_ns", *_NUMBERS[:-1], "weights", "ms", *_TEXTS, "state")
"""Columns of ``selections.csv`` before the parameters."""
FRAME_COLUMNS = ("stamp_ns", "registered", "restarted", "prepare_ms", "register_ms", "late_ms")
"""Columns of ``frames.csv``."""


def selection_row(choice: Choice, names: Sequence[str]) -> list[Any]:
    """A row of ``selections.csv``: `SELECTION_COLUMNS`, and the parameters of these names."""
    stamp, selection, seconds, why_not, fallen_back = choice
    predicted = selection.predicted_error, selection.predicted_fixed, selection.familiarity
    measured = selection.estimated_error, selection.estimated_low, selection.estimated_high
    numbers, weights = (*predicted, *measured), (selection.weights or {}).items()
    return [
        *(stamp, selection.trial, *(f"{x:.4f}" for x in numbers), int(selection.lost)),
        " ".join(f"{trial}:{weight:.3f}" for trial, weight in weights),
        *(f"{1e3 * seconds:.3f}", why_not, fallen_back, selection.state),
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
        csv.writer(file).writerows(itertools.chain([columns], rows))


def _columns(path: Path) -> dict[str, list[str]]:
    with path.open(newline="", encoding="utf-8") as file:
        table = list(csv.reader(file))
    if len(set(map(len, table))) > 1:
        raise ValueError("rows of other lengths than its header")
    return {name: values for name, *values in zip(*table, strict=True)}


def _applied(columns: Mapping[str, list[str]], n: int) -> dict[str, list[str]]:
    """The `n` selections that were applied, without those columns; of a scan, the last one."""
    rows = [i for i, why in enumerate(columns["why_not"]) if not why]
    if len(rows) != n:
        raise ValueError("not a row for every selection")
    last = {columns["stamp_ns"][i]: i for i in rows}.values()
    return {
        name: [values[i] for i in last] for name, values in columns.items() if name not in _TEXTS
    }


def _weights(texts: Sequence[str]) -> dict[int, Sequence[float]]:
    rows = [dict(pair.split(":") for pair in text.split()) for text in texts]
    if any(row.keys() != rows[0].keys() for row in rows):
        raise ValueError("weights of other trials from row to row")
    return {int(trial): [float(row[trial]) for row in rows] for trial in (rows[0] if rows else {})}


def _floats(values: Sequence[str]) -> NDArray[np.float64]:
    return np.array([float(value or "nan") for value in values])


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


class DriveLog:
    """Writes ``trajectory.tum``, ``frames.csv`` and ``selections.csv``, line by line.

    Where the disk is full, the log ends and the drive goes on; `lost` says why. Where the files
    cannot be made, it raises an OSError, unless the drive `goes_on`, too. `names` are those of the
    parameters, columns of ``selections.csv``.
    """

    def __init__(self, folder: Path, names: list[str], *, goes_on: bool = False):
        self.folder, self.lost = folder, ""
        self._names = names
        self._files: dict[str, IO[str]] = {}
        try:
            folder.mkdir(parents=True)
            for name in ("trajectory.tum", "frames.csv", "selections.csv"):
                # A line is on disk when it is written: the robot may be switched off.
                file = (folder / name).open("w", buffering=1, newline="", encoding="utf-8")
                self._files[name] = file
        except OSError as error:
            if not goes_on:
                raise
            self._end(error)
        self._write("frames.csv", _csv(FRAME_COLUMNS))
        self._write("selections.csv", _csv((*SELECTION_COLUMNS, *names)))

    def scan(self, step: RegisteredScan, late: float) -> None:
        """Note a scan: its pose, and how late that was in seconds."""
        stamps = np.array([step.stamp], np.int64)
        (line,) = tum_lines(stamps, step.T_odom_sensor[None])
        self._write("trajectory.tum", line)
        self._write("frames.csv", _csv(frame_row(step, late)))

    def choice(self, choice: Choice) -> None:
        """Note a selection."""
        self._write("selections.csv", _csv(selection_row(choice, self._names)))

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            try:
                file.close()
            except OSError as error:
                self._end(error)

    def _write(self, name: str, line: str) -> None:
        if not self.lost:
            try:
                self._files[name].write(line)
            except OSError as error:
                self._end(error)

    def _end(self, error: OSError) -> None:
        if not self.lost:
            self.lost = in_one_line(error)
            _log.warning("%s: nothing more is recorded (%s); the drive goes on", self.folder, error)


def _csv(row: Iterable[Any]) -> str:
    text = io.StringIO()
    csv.writer(text).writerow(row)
    return text.getvalue()
