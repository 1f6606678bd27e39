"""Stored replays of a sequence as plain arrays, for recordings to look at."""

import heapq
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.errors import nearest
from adaptune.files import replacing_folder
from adaptune.geometry import Poses, invert
from adaptune.recording.export import Message, Messages
from adaptune.recording.scan import Scan
from adaptune.report.paper import LINES
from adaptune.selector import Schedule
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory
from online.modes import sequences_without_model
from online.record import (
    StoredReplay,
    StoredReplayError,
    check_reference,
    damaged,
    read_applied,
    read_columns,
)
from online.statistics import Reference

CLOUD_PERIOD = 1.0
"""Seconds from one cloud to the next."""
MAX_POINTS = 20_000
"""Points of a cloud."""
_PLACING = ("adaptive", "bank", "one_set", "untrained", "paper", "fixed")
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


# Replays as messages of ROS 2 in an MCAP file, for Foxglove.


POINTS, TF, REFERENCE = "/points", "/tf", "/reference/path"
"""Topics that belong to no mode."""
ODOM, SENSOR = "odom", "sensor"
"""Frames: that of all poses, and that of the clouds."""
_UNDER = ("parameters", "weights")
"""Kinds of series that are part of the topic's name."""
_CLOUD = "sensor_msgs/msg/PointCloud2"
_TRANSFORM = "tf2_msgs/msg/TFMessage"
_ODOMETRY = "nav_msgs/msg/Odometry"
_PATH = "nav_msgs/msg/Path"
_NUMBER = "std_msgs/msg/Float64"
_TEXT = "std_msgs/msg/String"


def write_mcap(path: Path, replays: RecordedReplays, clouds: Iterable[Cloud]) -> None:
    """Write replays to a folder that holds an MCAP file, whole or not at all.

    Parameters
    ----------
    path
        Of the folder; the file in it has the same name.
    replays
        What is written besides the clouds.
    clouds
        In order of time.
    """
    composer = _Composer(Messages(2))
    composer.add(POINTS, _CLOUD, composer.clouds(clouds))
    placing = replays.modes[replays.placing].trajectory
    composer.add(TF, _TRANSFORM, composer.transforms(placing))
    if replays.reference is not None:
        composer.add(REFERENCE, _PATH, composer.path(replays.reference, replays.start))
    for mode, recorded in replays.modes.items():
        child = SENSOR if mode == replays.placing else f"{SENSOR}_{mode}"
        composer.add_mode(mode, recorded, child, replays.start)
    with replacing_folder(path) as new:
        composer.messages.write(new, composer.topics, composer.ordered(), mcap=True)


def topic(mode: str, kind: str, name: str) -> str:
    """Of a series, in which letters that ROS does not allow in names are underscores."""
    parts = (mode, kind, name) if kind in _UNDER else (mode, name)
    return "".join("/" + re.sub(r"\W", "_", part, flags=re.ASCII) for part in parts)


class _Composer:
    """Collects the messages of all topics."""

    def __init__(self, messages: Messages):
        self.messages = messages
        self.topics: dict[str, str] = {}
        self._types = messages.types
        self._streams: list[Iterator[Message]] = []

    def add(self, name: str, kind: str, stamped: Iterable[tuple[int, Any]]) -> None:
        """Add a topic, with its messages in order of time."""
        self.topics[name] = kind
        self._streams.append((name, stamp, message) for stamp, message in stamped)

    def ordered(self) -> Iterator[Message]:
        """All messages in order of time."""
        return heapq.merge(*self._streams, key=itemgetter(1))

    def add_mode(self, mode: str, recorded: RecordedMode, child: str, start: int) -> None:
        """Add all topics of a mode, whose sensor is the frame `child`."""
        trajectory = recorded.trajectory
        self.add(topic(mode, "", "path"), _PATH, self.path(trajectory, start))
        self.add(topic(mode, "", "odometry"), _ODOMETRY, self._odometry(trajectory, child))
        for kind, of in recorded.series.items():
            for name, (stamps, values) in of.items():
                numbers = self._data(_NUMBER, stamps, values.tolist())
                self.add(topic(mode, kind, name), _NUMBER, numbers)
        for name, (stamps, texts) in recorded.words.items():
            self.add(topic(mode, "parameters", name), _TEXT, self._data(_TEXT, stamps, texts))
        self.add(topic(mode, "", "selection"), _TEXT, self._data(_TEXT, *recorded.selections))

    def clouds(self, clouds: Iterable[Cloud]) -> Iterator[tuple[int, Any]]:
        """The points in the sensor's frame."""
        for cloud in clouds:
            points = np.ascontiguousarray(cloud.points, "<f4")
            structured = points.view([(axis, "<f4") for axis in "xyz"]).reshape(-1)
            header = self.messages.header(POINTS, cloud.stamp, SENSOR)
            yield cloud.stamp, self.messages.cloud(header, structured)

    def transforms(self, trajectory: Trajectory) -> Iterator[tuple[int, Any]]:
        """Where the sensor is."""
        types = self._types
        vector, transform = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Transform"]
        for stamp, xyz, turn in _poses(trajectory):
            moved = types["geometry_msgs/msg/TransformStamped"](
                header=self.messages.header(TF, stamp, ODOM),
                child_frame_id=SENSOR,
                transform=transform(translation=vector(*xyz), rotation=self._quaternion(turn)),
            )
            yield stamp, types[_TRANSFORM](transforms=[moved])

    def path(self, trajectory: Trajectory, start: int) -> Iterator[tuple[int, Any]]:
        """The whole path, which is there from the start."""
        stamped = self._types["geometry_msgs/msg/PoseStamped"]
        poses = [
            stamped(header=self.messages.header("", stamp, ODOM), pose=self._pose(xyz, turn))
            for stamp, xyz, turn in _poses(trajectory)
        ]
        header = self.messages.header("", start, ODOM)
        yield start, self._types[_PATH](header=header, poses=poses)

    def _odometry(self, trajectory: Trajectory, child: str) -> Iterator[tuple[int, Any]]:
        types, unknown = self._types, np.zeros(36)
        vector = types["geometry_msgs/msg/Vector3"]
        twist = types["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        still = types["geometry_msgs/msg/TwistWithCovariance"](twist, unknown)
        uncertain = types["geometry_msgs/msg/PoseWithCovariance"]
        for stamp, xyz, turn in _poses(trajectory):
            header = self.messages.header("", stamp, ODOM)
            pose = uncertain(self._pose(xyz, turn), unknown)
            yield stamp, types[_ODOMETRY](header, child, pose, still)

    def _data(
        self, kind: str, stamps: NDArray[np.int64], values: Iterable[Any]
    ) -> Iterator[tuple[int, Any]]:
        for stamp, value in zip(stamps.tolist(), values, strict=True):
            yield stamp, self._types[kind](data=value)

    def _pose(self, xyz: list[float], turn: list[float]) -> Any:
        point = self._types["geometry_msgs/msg/Point"]
        pose = self._types["geometry_msgs/msg/Pose"]
        return pose(position=point(*xyz), orientation=self._quaternion(turn))

    def _quaternion(self, turn: list[float]) -> Any:
        return self._types["geometry_msgs/msg/Quaternion"](*turn)


def _poses(trajectory: Trajectory) -> Iterator[tuple[int, list[float], list[float]]]:
    """Stamps, positions and quaternions."""
    xyz: NDArray[np.float64] = trajectory.T_world_sensor[:, :3, 3]
    turns = geometry.to_quaternions(trajectory.T_world_sensor)
    return zip(trajectory.stamps.tolist(), xyz.tolist(), turns.tolist(), strict=True)
