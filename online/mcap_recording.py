"""Replays as messages of ROS 2 in an MCAP file, for Foxglove."""

import heapq
import re
from collections.abc import Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin

from adaptune import geometry
from adaptune.files import replacing_folder
from adaptune.sequence.export import Message, Messages
from adaptune.trajectory import Trajectory
from online.recordings import Cloud, RecordedMode, RecordedReplays

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
        composer.messages.write(new, composer.topics, composer.ordered(), StoragePlugin.MCAP)


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
