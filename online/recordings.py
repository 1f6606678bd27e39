"""Stored replays of a sequence as plain arrays, for recordings to look at."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.drawing import LINES
from adaptune.geometry import Poses, invert
from adaptune.sequence.scan import Scan
from adaptune.space import nearest
from adaptune.study.study import Study
from adaptune.timed_selector import Schedule
from adaptune.trajectory import Trajectory
from online.modes import sequences_without_model
from online.statistics import Reference
from online.stored_reference import check_reference
from online.stored_replays import (
    StoredReplay,
    StoredReplayError,
    damaged,
    read_applied,
    read_columns,
)

CLOUD_PERIOD = 1.0
"""Seconds from one cloud to the next."""
MAX_POINTS = 20_000
"""Points of a cloud."""
_PLACING = ("paired", "bank", "one_set", "untrained", "paper", "fixed")
"""Modes whose poses place the clouds, the first that was replayed."""
_ERRORS = {
    "predicted_error": "predicted_error_percent",
    "predicted_fixed_error": "predicted_fixed_percent",
    "estimated_error": "estimated_error_percent",
    "estimated_error_low": "estimated_low_percent",
    "estimated_error_high": "estimated_high_percent",
}
"""Series of a mode by column of ``selections.csv``."""
_TIMES = ("prepare_ms", "register_ms", "late_ms")
"""Columns of ``frames.csv`` that are series."""

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""


class Series(NamedTuple):
    """Finite numbers over time."""

    stamps: NDArray[np.int64]  # (n,): nanoseconds
    values: NDArray[np.float64]  # (n,)


class Words(NamedTuple):
    """Texts over time."""

    stamps: NDArray[np.int64]  # (n,): nanoseconds
    texts: list[str]


class Cloud(NamedTuple):
    """A thinned scan, and where it was taken."""

    stamp: int  # nanoseconds
    points: NDArray[np.float32]  # (n, 3): metres, in the sensor's frame
    T_odom_sensor: Poses  # (4, 4)


@dataclass(frozen=True, eq=False)
class RecordedMode:
    """What one mode did along a sequence."""

    # Poses in the frame that all modes and the reference share: that of the sensor at the
    # reference's first pose, or, without a reference, at the first scan.
    trajectory: Trajectory
    # By kind ("errors", "parameters", "weights", "milliseconds", "health") and name.
    series: Mapping[str, Mapping[str, Series]]
    words: Mapping[str, Words]  # parameters that are names
    selections: Words  # every selection in words


@dataclass(frozen=True, eq=False)
class RecordedReplays:
    """The replays of a sequence."""

    title: str  # of the study and the sequence
    modes: Mapping[str, RecordedMode]
    reference: Trajectory | None  # in the frame of the modes' poses
    placing: str  # the mode whose poses place the clouds

    @property
    def start(self) -> int:
        """Nanoseconds, of the first scan."""
        return min(int(mode.trajectory.stamps[0]) for mode in self.modes.values())

    @property
    def end(self) -> int:
        """Nanoseconds, of the last scan."""
        return max(int(mode.trajectory.stamps[-1]) for mode in self.modes.values())


def replayed_modes(study: Study, name: str) -> list[str]:
    """The modes in which a sequence was replayed, in the order of their lines in pictures."""
    folder = study.folder / "replays" / name
    return [mode for mode in LINES if (folder / mode / "replay.json").exists()]


def replayed_sequences(study: Study, wanted: Sequence[str] = ()) -> list[str]:
    """The sequences of a study that were replayed, or those of them that are wanted.

    Raises
    ------
    StoredReplayError
        If there is none, or not one that is wanted.
    """
    config = study.config
    default = sequences_without_model(study)
    every = dict.fromkeys([*default, *config.sequences, *config.courses])
    there = [name for name in every if replayed_modes(study, name)]
    for name in wanted:
        if name not in every:
            raise StoredReplayError(
                f"{name}: there is no such sequence in the study: {nearest(name, list(every))}"
            )
        if name not in there:
            raise StoredReplayError(
                f"{name}: there is no replay of it; name it in the `test` of the study, and run "
                f"`adaptune online`"
            )
    found = list(dict.fromkeys(wanted)) or [name for name in default if name in there]
    if not found:
        raise StoredReplayError(
            f"{study.folder / 'replays'}: there is no replay; run `adaptune online` with this "
            f"study first"
        )
    return found


def gather(study: Study, name: str) -> RecordedReplays:
    """Read the replays of a sequence, in all modes that were made.

    Raises
    ------
    StoredReplayError
        If one is damaged, or of another recording than the sequence is now.
    """
    folder = study.folder / "replays" / name
    modes = replayed_modes(study, name)
    replays = {mode: StoredReplay.read(folder / mode) for mode in modes}
    now = study.sequences.identity(name)
    for mode, replay in replays.items():
        about = replay.summary.about.model_dump()
        if differing := [key for key, value in now.items() if about[key] != value]:
            raise StoredReplayError(
                f"{folder / mode}: was replayed with another {', '.join(differing)}; run "
                f"`adaptune online` with this study"
            )
    check_reference(folder, study.sequences.reference(name))
    reference = Reference.read(folder, study.config.sub_trajectory)
    known = reference.trajectory
    return RecordedReplays(
        f"{study.name}: {name}",
        {mode: _mode(folder / mode, replay, reference) for mode, replay in replays.items()},
        known and Trajectory(known.stamps, invert(known.T_world_sensor[0]) @ known.T_world_sensor),
        next((mode for mode in _PLACING if mode in modes), modes[0]),
    )


def clouds(
    scans: Iterable[Scan], trajectory: Trajectory, progress: Callable[[], None] = lambda: None
) -> Iterator[Cloud]:
    """One scan a second, thinned, with its pose; scans without a pose are left out.

    Parameters
    ----------
    scans
        In order of time.
    trajectory
        Gives the poses.
    progress
        Called after every scan.
    """
    schedule = Schedule(CLOUD_PERIOD * 1e9)
    for scan in scans:
        if schedule.due(scan.stamp):
            T = trajectory.at(np.array([scan.stamp]))[0]
            if np.isfinite(T).all():
                yield Cloud(scan.stamp, _thinned(scan.points), T)
        progress()


def _thinned(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Some points, always the same; every n-th one might be all of one laser."""
    if len(points) <= MAX_POINTS:
        return points
    chosen = np.random.default_rng(0).choice(len(points), MAX_POINTS, replace=False)
    return points[np.sort(chosen)]


def _mode(folder: Path, replay: StoredReplay, reference: Reference) -> RecordedMode:
    trajectory = replay.trajectory
    stamps, end = trajectory.stamps, int(trajectory.stamps[-1])
    frames = _Table(folder / "frames.csv", read_columns(folder / "frames.csv"), stamps)
    path = folder / "selections.csv"
    selections = _Table(path, read_applied(path), replay.choice_stamps)
    errors = {name: selections.series(column) for name, column in _ERRORS.items()}
    # The one looks ahead, as predictions do, the other back, as estimates do.
    errors["true_error"] = _finite(stamps, reference.errors(trajectory))
    errors["true_error_behind"] = _finite(stamps, reference.errors_behind(trajectory))
    numbers, words = {}, {}
    for name, values in replay.choices.items():
        if any(isinstance(value, str) for value in values):
            words[name] = Words(replay.choice_stamps, list(map(str, values)))
        else:
            numbers[name] = _held(replay.choice_stamps, values, end)
    weights = {
        str(trial): _held(replay.choice_stamps, values, end)
        for trial, values in replay.weights.items()
    }
    times = {"selection_ms": selections.series("ms")} | {
        name: frames.series(name) for name in _TIMES
    }
    health = {
        "lost": _held(replay.choice_stamps, replay.lost, end),
        "restarted": _finite(stamps, replay.restarted),
    }
    kinds = {
        "errors": errors,
        "parameters": numbers,
        "weights": weights,
        "milliseconds": times,
        "health": health,
    }
    return RecordedMode(
        _placed(trajectory, reference.trajectory),
        {kind: {k: v for k, v in of.items() if len(v.stamps)} for kind, of in kinds.items()},
        words,
        Words(replay.choice_stamps, _in_words(replay, selections)),
    )


def _placed(odometry: Trajectory, reference: Trajectory | None) -> Trajectory:
    """Poses as seen from the reference's first one; both agree where they first overlap."""
    T, start, T_first = odometry.T_world_sensor, 0, np.eye(4)
    if reference is not None:
        T_ref = reference.at(odometry.stamps)
        known = np.isfinite(T_ref[:, 0, 0])
        if known.any():
            start = int(np.argmax(known))
            T_first = invert(reference.T_world_sensor[0]) @ T_ref[start]
    return Trajectory(odometry.stamps, T_first @ invert(T[start]) @ T)


class _Table:
    """A table of a replay, and the stamps of its rows."""

    def __init__(self, path: Path, columns: dict[str, list[str]], stamps: NDArray[np.int64]):
        self._path, self.columns, self._stamps = path, columns, stamps

    def series(self, column: str) -> Series:
        """The finite numbers of a column; none where there is no such column."""
        try:
            values = np.array(self.columns.get(column, []), np.float64)
        except (TypeError, ValueError) as error:
            raise damaged(self._path, error) from error
        return _finite(self._stamps, values) if len(values) else _finite(self._stamps[:0], values)


def _finite(stamps: NDArray[np.int64], values: NDArray[Any]) -> Series:
    known = np.isfinite(values)
    return Series(stamps[known], values[known].astype(np.float64))


def _held(stamps: NDArray[np.int64], values: Sequence[Any] | NDArray[Any], end: int) -> Series:
    """What stays until the next selection; the last one until the end."""
    held = np.asarray(values, np.float64)
    if len(held) and stamps[-1] < end:
        stamps, held = np.append(stamps, end), np.append(held, held[-1])
    return _finite(stamps, held)


def _in_words(replay: StoredReplay, selections: _Table) -> list[str]:
    """Every selection in words: the members' weights, or the parameters."""
    trials = selections.columns.get("trial")
    said = []
    for i, lost in enumerate(replay.lost.tolist()):
        if replay.weights:
            shares = {trial: weights[i] for trial, weights in replay.weights.items()}
            what = ", ".join(f"trial {trial}: {share:.0%}" for trial, share in shares.items())
        else:
            chosen = {name: values[i] for name, values in replay.choices.items()}
            # Sets of several odometries have other parameters, which are NaN or empty.
            known = {name: _plainly(value) for name, value in chosen.items()}
            what = ", ".join(f"{k} {v}" for k, v in known.items() if v) or "no parameters"
            what = what if trials is None else f"trial {trials[i]}: {what}"
        said.append(f"{what} (lost)" if lost else what)
    return said


def _plainly(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "" if np.isnan(value) else f"{value:.6g}"
