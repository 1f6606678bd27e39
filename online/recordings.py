"""Stored replays of a sequence as messages of ROS 2 in an MCAP file, for Foxglove and Rerun."""

import heapq
import re
from collections.abc import Iterable, Iterator, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune._system.files import replacing_folder
from adaptune._system.progress import Progress, unseen
from adaptune.errors import nearest
from adaptune.geometry import invert
from adaptune.recording.export import Message, Messages
from adaptune.recording.scan import Recording
from adaptune.reference.judge import Reference
from adaptune.runs.files import StoredReplayError
from adaptune.runs.record import Run
from adaptune.selector import Periods
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory
from online.modes import Replays, sequences_without_model
from online.reference import read_reference
from online.topics import Placed, RosMessages, placed

CLOUD_PERIOD = 1.0
"""Seconds from one cloud to the next."""
MAX_POINTS = 20_000
"""Points of a cloud."""
POINTS, TF, REFERENCE = "/points", "/tf", "/reference/path"
"""Topics that belong to no mode."""
ODOM, SENSOR = "odom", "sensor"
"""Frames: that of all poses, and that of the clouds."""
_PLACING = ("adaptive", "untrained", "paper", "fixed")
"""Modes whose poses place the clouds, the first that was replayed."""
_OF_SELECTIONS = {
    "predicted_error": "predicted_error",
    "predicted_fixed_error": "predicted_fixed",
    "estimated_error": "estimated_error",
    "estimated_error_low": "estimated_low",
    "estimated_error_high": "estimated_high",
    "similarity": "similarity",
}
"""What a mode's topics have of its selections."""
_PATH = "nav_msgs/msg/Path"


def replayed_sequences(study: Study, wanted: Sequence[str] = ()) -> list[str]:
    """The sequences of a study that were replayed, or those of them that are wanted.

    Raises
    ------
    StoredReplayError
        If there is none, or not one that is wanted.
    """
    config, replays = study.config, Replays.of(study)
    default = sequences_without_model(config)
    every = list(dict.fromkeys([*default, *config.sequences, *config.courses]))
    if unknown := [name for name in wanted if name not in every]:
        what = f"there is no such sequence in the study: {nearest(unknown[0], every)}"
        raise StoredReplayError(f"{unknown[0]}: {what}")
    names = list(dict.fromkeys(wanted or default))
    found = [name for name in names if replays.made(name)]
    missing = [name for name in names if name not in found]
    if missing and (wanted or not found):
        raise StoredReplayError(
            f"{missing[0]}: there is no replay; name it in the `test` of the study, and run "
            f"`adaptune online`"
        )
    return found


def record_replays(study: Study, name: str, progress: Progress = unseen) -> Path:
    """Write the replays of a sequence, in all modes that were made, as an MCAP file.

    It holds the paths of all modes and of the reference, one scan a second, and over time what was
    selected, the errors, and the time of each step. All poses are in one frame: that of the sensor
    at the reference's first pose, or, without a reference, at the first scan. The file is in a
    folder of its own under ``recordings`` of the study's folder, written whole or not at all.

    Raises
    ------
    AdaptuneError
        If a replay is damaged, or the disk is full.
    """
    stored = Replays.of(study)
    replays = {mode: stored.read(name, mode) for mode in stored.made(name)}
    reference = read_reference(study, name)
    known = reference.trajectory
    paths = {mode: _placed(replay.trajectory, known) for mode, replay in replays.items()}
    placing = next((mode for mode in _PLACING if mode in paths), next(iter(paths)))
    start = min(int(trajectory.stamps[0]) for trajectory in paths.values())
    composer = _Composer()
    clouds = composer.clouds(study.sequences.open(name), paths[placing], name, progress)
    composer.add(POINTS, "sensor_msgs/msg/PointCloud2", clouds)
    composer.add(TF, "tf2_msgs/msg/TFMessage", composer.transforms(paths[placing]))
    if known is not None:
        first = Trajectory(known.stamps, invert(known.T_world_sensor[0]) @ known.T_world_sensor)
        composer.add(REFERENCE, _PATH, composer.path(first, start))
    for mode, replay in replays.items():
        composer.add(topic(mode, "path"), _PATH, composer.path(paths[mode], start))
        composer.add_mode(mode, replay, reference)
    path = study.folder / "recordings" / name
    with replacing_folder(path) as new:
        messages = heapq.merge(*composer.streams, key=itemgetter(1))
        composer.messages.write(new, composer.topics, messages, mcap=True)
    return path / f"{name}.mcap"


def topic(*parts: str) -> str:
    """A name in which letters that ROS does not allow are underscores."""
    return "".join("/" + re.sub(r"\W", "_", part, flags=re.ASCII) for part in parts)


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


class _Composer:
    """Collects the messages of all topics."""

    def __init__(self) -> None:
        self.messages = Messages(2)
        self.topics: dict[str, str] = {}
        self.streams: list[Iterator[Message]] = []
        self._types = self.messages.types
        self._made = RosMessages(self.messages.typestore, ODOM)

    def add(self, name: str, kind: str, stamped: Iterable[tuple[int, Any]]) -> None:
        """Add a topic, with its messages in order of time."""
        self.topics[name] = kind
        self.streams.append((name, stamp, message) for stamp, message in stamped)

    def add_mode(self, mode: str, replay: Run, reference: Reference) -> None:
        """Add what a mode selected, its errors and its times."""
        trajectory, made = replay.trajectory, replay.choice_stamps
        stamps, end = trajectory.stamps, trajectory.stamps[-1:]
        selections = [choice.selection for choice in replay.choices]
        for name, of in _OF_SELECTIONS.items():
            self._numbers(topic(mode, name), made, [getattr(one, of) for one in selections])
        took = {"prepare": [s.prepare_seconds for s in replay.steps], "late": replay.late}
        took |= {"register": [step.register_seconds for step in replay.steps]}
        took |= {"selection": [choice.seconds for choice in replay.choices]}
        for name, seconds in took.items():
            at = made if name == "selection" else stamps
            self._numbers(topic(mode, f"{name}_ms"), at[: len(seconds)], 1e3 * np.array(seconds))
        # The one looks ahead, as predictions do, the other back, as estimates do.
        self._numbers(topic(mode, "true_error"), stamps, reference.errors(trajectory))
        self._numbers(topic(mode, "true_error_behind"), stamps, reference.errors_behind(trajectory))
        self._numbers(topic(mode, "restarted"), stamps, replay.restarted)
        self._numbers(topic(mode, "lost"), made, [one.lost for one in selections], end)
        for trial, weights in replay.weights.items():
            self._numbers(topic(mode, "weights", str(trial)), made, weights, end)
        for name, chosen in replay.values.items():
            if any(isinstance(value, str) for value in chosen):
                texts = list(map(str, chosen))
                self._add_data(topic(mode, "parameters", name), "std_msgs/msg/String", made, texts)
            else:
                self._numbers(topic(mode, "parameters", name), made, chosen, end)

    def _numbers(
        self,
        name: str,
        stamps: NDArray[np.int64],
        given: Sequence[Any] | NDArray[Any],
        end: NDArray[np.int64] | None = None,
    ) -> None:
        """Add the finite numbers; what stays until the next selection stays until the `end`."""
        values = np.asarray(given, np.float64)
        if end is not None and len(values) and stamps[-1] < end[0]:
            stamps, values = np.append(stamps, end), np.append(values, values[-1])
        known = np.isfinite(values)
        if known.any():
            self._add_data(name, "std_msgs/msg/Float64", stamps[known], values[known].tolist())

    def _add_data(
        self, name: str, kind: str, stamps: NDArray[np.int64], values: Sequence[Any]
    ) -> None:
        message = self._types[kind]
        stamped = zip(stamps.tolist(), values, strict=True)
        self.add(name, kind, ((stamp, message(data=value)) for stamp, value in stamped))

    def clouds(
        self, scans: Recording, trajectory: Trajectory, name: str, progress: Progress
    ) -> Iterator[tuple[int, Any]]:
        """One scan a second, thinned, in the sensor's frame; none where it has no pose."""
        periods, n = Periods(CLOUD_PERIOD * 1e9), scans.n_messages
        for number, scan in enumerate(scans, start=1):
            due = periods.due(scan.stamp)
            if due and np.isfinite(trajectory.at(np.array([scan.stamp]))).all():
                points = np.ascontiguousarray(_thinned(scan.points), "<f4")
                structured = points.view([(axis, "<f4") for axis in "xyz"]).reshape(-1)
                header = self._made.header(scan.stamp, SENSOR)
                yield scan.stamp, self.messages.cloud(header, structured)
            progress(name, number, n)
        progress(name, n, n)

    def path(self, trajectory: Trajectory, start: int) -> Iterator[tuple[int, Any]]:
        """The whole path, which is there from the start."""
        stamped, header = self._types["geometry_msgs/msg/PoseStamped"], self._made.header
        poses = [stamped(header(stamp), self._made.pose(at)) for stamp, at in _poses(trajectory)]
        yield start, self._types[_PATH](header=header(start), poses=poses)

    def transforms(self, trajectory: Trajectory) -> Iterator[tuple[int, Any]]:
        """Where the sensor is."""
        return ((s, self._made.transform(s, at, SENSOR)) for s, at in _poses(trajectory))


def _poses(trajectory: Trajectory) -> Iterator[tuple[int, Placed]]:
    return zip(trajectory.stamps.tolist(), placed(trajectory.T_world_sensor), strict=True)


def _thinned(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Some points, always the same; every n-th one might be all of one laser."""
    if len(points) <= MAX_POINTS:
        return points
    chosen = np.random.default_rng(0).choice(len(points), MAX_POINTS, replace=False)
    return points[np.sort(chosen)]
