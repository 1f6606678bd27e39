"""Runs as files: trajectory, selections, frames, and what they were made from."""

import csv
import io
import logging
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, cast, get_args

import numpy as np

from adaptune._system import manifest
from adaptune._system.files import write_text
from adaptune._system.strict import ConfigurationError, in_one_line
from adaptune.errors import AdaptuneError
from adaptune.odometry.base import MemberState
from adaptune.odometry.tracker import RegisteredScan
from adaptune.runs.record import Choice, Run, RunSummary
from adaptune.space import Selection
from adaptune.trajectory import TrajectoryError, read_tum, tum_lines, write_tum

_log = logging.getLogger(__name__)


class StoredReplayError(AdaptuneError):
    """A replay that is missing or damaged."""


@contextmanager
def _reading(path: Path) -> Iterator[Path]:
    """Raise a StoredReplayError where a file of a replay is missing, or cannot be understood."""
    try:
        yield path
    except (OSError, KeyError, ValueError, ConfigurationError) as error:
        what = f"{path}: is damaged ({in_one_line(error)})"
        raise StoredReplayError(f"{what}; {_made_again(path.parent)}") from error


def _made_again(folder: Path) -> str:
    return f"remove {folder} and run `adaptune online` with this study, which makes it again"


def read_summary(folder: Path) -> RunSummary:
    """Read ``replay.json``, or raise a StoredReplayError.

    All files of a replay are there, for this one is written last.
    """
    with _reading(folder / "replay.json") as path:
        inputs = manifest.recorded(folder / manifest.FILE)
        summary = RunSummary.model_validate_json(path.read_bytes())
    with _reading(folder / manifest.FILE):
        if inputs is None:
            raise FileNotFoundError("it is not there")
    return summary.model_copy(update={"inputs": inputs})


def is_complete(folder: Path) -> bool:
    """Whether a replay is there, with all its files."""
    with suppress(StoredReplayError):
        read_summary(folder)
        return all(
            (folder / n).exists() for n in ("trajectory.tum", "frames.csv", "selections.csv")
        )
    return False


def write_run(folder: Path, run: Run, inputs: manifest.Inputs) -> None:
    """Write ``trajectory.tum``, ``selections.csv``, ``frames.csv`` and, last, ``replay.json``.

    `inputs` is what it was made from.
    """
    write_tum(folder / "trajectory.tum", run.trajectory)
    # Sets of several odometries have other parameters.
    every = (name for choice in run.choices for name in choice.selection.parameters)
    names = list(dict.fromkeys(every))
    made = sorted([*run.choices, *run.rejected], key=lambda choice: choice.stamp)
    rows = (selection_row(choice, names) for choice in made)
    write_text(folder / "selections.csv", _csv((*SELECTION_COLUMNS, *names), *rows))
    # In lockstep, nothing is late.
    n, late = (7, run.late) if run.rate is not None else (6, [math.nan] * len(run.steps))
    rows = (frame_row(*pair)[:n] for pair in zip(run.steps, late, strict=True))
    write_text(folder / "frames.csv", _csv(FRAME_COLUMNS[:n], *rows))
    if run.summary.first_pose:
        what = "%s, %s: the odometry gave its first pose after %.1f s"
        mode, _, _ = folder.name.rpartition("-")
        _log.info(what, folder.parent.name, mode, run.summary.first_pose)
    manifest.record(folder / manifest.FILE, inputs)
    write_text(folder / "replay.json", run.summary.model_dump_json(indent=2) + "\n")


def read_run(folder: Path) -> Run:
    """Read what `write_run` wrote; a StoredReplayError if it is missing or damaged.

    Of the selections, it has those that were applied. The reasons of restarts are in its summary.
    """
    summary = read_summary(folder)
    try:
        trajectory = read_tum(folder / "trajectory.tum")
    except TrajectoryError as error:
        raise StoredReplayError(f"{error}; {_made_again(folder)}") from error
    cut = "frames.csv" if len(trajectory) == summary.scans else "trajectory.tum"
    with _reading(folder / "frames.csv") as path:
        frames = _rows(path)
        late = [1e-3 * _number(row["late_ms"]) for row in frames if "late_ms" in row]
        fits = [bool(_number(row["registered"])) for row in frames]
        unhealthy = ["restarted" if _number(row["restarted"]) else None for row in frames]
        prepare, register = (
            [1e-3 * _number(row[name]) for row in frames] for name in ("prepare_ms", "register_ms")
        )
        members = [_states(row.get("members", "")) for row in frames]
    with _reading(folder / cut):
        if len(frames) != len(trajectory):
            raise ValueError("not a row for every scan")
    poses = trajectory.stamps.tolist(), trajectory.T_world_sensor
    begun = [True] * len(frames)
    columns = (*poses, fits, unhealthy, prepare, register, begun, members)
    steps = [RegisteredScan._make(row) for row in zip(*columns, strict=True)]
    with _reading(folder / "selections.csv") as path:
        rows = _rows(path)
        numbers = {name for name in rows[0] if _are_numbers(rows, name)} if rows else set[str]()
        applied = [_choice(row, numbers) for row in rows if not row["why_not"]]
        if len(applied) != summary.selections:
            raise ValueError("not a row for every selection")
        if len({frozenset(choice.selection.weights or ()) for choice in applied}) > 1:
            raise ValueError("weights of other trials from row to row")
    given = (summary.inputs["parameters"] or {}).items()
    kept = {name: float(x) if type(x) in (int, float) else str(x) for name, x in given}
    alone = Choice(steps[0].stamp, Selection(0, kept), math.nan)
    # Of a scan, the last one.
    choices = {choice.stamp: choice for choice in applied or [alone]}
    run = Run(
        steps=steps,
        choices=[*choices.values()],
        late=late,
        cpu_ms=math.nan if summary.cpu_ms is None else summary.cpu_ms,
        memory=summary.memory_mb or 0.0,
        lacking=summary.lacking,
        first_pose=summary.first_pose,
        faults=(summary.fault,) * bool(summary.fault),
    )
    run.summary = summary
    return run


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if any(None in row or None in row.values() for row in rows):
        raise ValueError("rows of other lengths than its header")
    return rows


def _choice(row: dict[str, str], numbers: set[str]) -> Choice:
    """A selection by its row, see `selection_row`, and the columns that hold numbers alone."""
    others = [name for name in SELECTION_COLUMNS if name not in _NUMBERS.values()]
    stamp, trial, _, weights, ms, why_not, fallen_back, state = (row.pop(name) for name in others)
    about: dict[str, Any] = {name: _number(row.pop(of)) for name, of in _NUMBERS.items()}
    shares = {trial: float(weight) for trial, weight in _by_trial(weights).items()}
    about |= {"weights": shares or None, "state": state}
    parameters = {
        name: float(text) if name in numbers else text for name, text in row.items() if text
    }
    selection = Selection(int(trial), parameters, **about)
    return Choice(int(stamp), selection, 1e-3 * float(ms), why_not, fallen_back)


def _number(text: str) -> float:
    return float(text or "nan")


def _by_trial(cell: str) -> dict[int, str]:
    """What a cell says of each member of a bank, by its trial number."""
    pairs = [pair.partition(":") for pair in cell.split()]
    if not all(trial.isdecimal() and text for trial, _, text in pairs):
        raise ValueError(f"{cell!r} is not trial:value")
    return {int(trial): text for trial, _, text in pairs}


def _states(cell: str) -> dict[int, MemberState]:
    states = _by_trial(cell)
    if unknown := {*states.values()} - {*get_args(MemberState)}:
        raise ValueError(f"{cell!r}: there is no {unknown.pop()!r}")
    return cast("dict[int, MemberState]", states)


def _are_numbers(rows: Iterable[dict[str, str]], name: str) -> bool:
    """Whether a column holds numbers, but for empty cells."""
    try:
        [_number(row[name]) for row in rows]
    except ValueError:
        return False
    return True


_NUMBERS = {
    "predicted_error": "predicted_error_percent",
    "predicted_fixed": "predicted_fixed_percent",
    "similarity": "similarity",
    "estimated_error": "estimated_error_percent",
    "estimated_low": "estimated_low_percent",
    "estimated_high": "estimated_high_percent",
}
"""Columns of ``selections.csv`` by what they have of a `Selection`."""
_BESIDE = ("lost", "weights", "ms", "why_not", "fallen_back", "state")
SELECTION_COLUMNS = ("stamp_ns", "trial", *_NUMBERS.values(), *_BESIDE)
"""Columns of ``selections.csv`` before the parameters."""
_EVERYWHERE = ("stamp_ns", "registered", "restarted", "prepare_ms", "register_ms", "members")
FRAME_COLUMNS = (*_EVERYWHERE, "late_ms")
"""Columns of ``frames.csv``."""


def selection_row(choice: Choice, names: Sequence[str]) -> list[Any]:
    """A row of ``selections.csv``: `SELECTION_COLUMNS`, and the parameters of these names."""
    stamp, selection, seconds, why_not, fallen_back = choice
    numbers = (f"{getattr(selection, name):.4f}" for name in _NUMBERS)
    weights = (f"{trial}:{weight:.3f}" for trial, weight in (selection.weights or {}).items())
    return [
        *(stamp, selection.trial, *numbers, int(selection.lost), " ".join(weights)),
        *(f"{1e3 * seconds:.3f}", why_not, fallen_back, selection.state),
        *(selection.parameters.get(name, "") for name in names),
    ]


def frame_row(step: RegisteredScan, late: float) -> list[Any]:
    """A row of ``frames.csv``, see `FRAME_COLUMNS`; `late` in seconds, NaN in lockstep."""
    restarted = int(step.unhealthy is not None)
    ms = (1e3 * seconds for seconds in (step.prepare_seconds, step.register_seconds, late))
    prepare, register, late_ms = (round(value, 3) if math.isfinite(value) else "" for value in ms)
    members = " ".join(f"{trial}:{state}" for trial, state in step.states.items())
    return [step.stamp, int(step.registered), restarted, prepare, register, members, late_ms]


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


def _csv(*rows: Iterable[Any]) -> str:
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue()
