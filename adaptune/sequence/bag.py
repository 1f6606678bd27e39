"""Sequences in ROS 1 and ROS 2 bags."""

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from adaptune import geometry
from adaptune.errors import AdaptuneError
from adaptune.sequence import pointcloud2
from adaptune.sequence.pointcloud2 import PointCloudError, stamp_ns
from adaptune.sequence.scan import Scan
from adaptune.space import nearest
from adaptune.trajectory import Trajectory, read_tum

POINTS_TYPE = "sensor_msgs/msg/PointCloud2"
_REFERENCE_POSES = {
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
}

_log = logging.getLogger(__name__)


class SequenceError(AdaptuneError):
    """A recording that cannot be read as asked."""


class BagSequence:
    """Scans and reference trajectory of a bag.

    Parameters
    ----------
    path
        A ROS 1 ``.bag`` or a ROS 2 bag's folder.
    points
        Topic of the point clouds; may be left out where the bag has only one.
    reference
        Topic with the sensor's reference poses, or the path of a TUM file; may be left out.
    start, stop
        Seconds since the first scan: scans in [start, stop) belong to the sequence.

    Raises
    ------
    SequenceError
        If the bag cannot be opened or has no such topic.
    """

    def __init__(
        self,
        path: Path,
        points: str | None = None,
        reference: str | Path | None = None,
        start: float = 0.0,
        stop: float | None = None,
    ):
        self.path = path
        self.start, self.stop = start, stop
        with self._open() as reader:
            self.points = self._topic(reader, points, [POINTS_TYPE], "point clouds")
            self.n_messages = sum(c.msgcount for c in reader.connections if c.topic == self.points)
            if isinstance(reference, str):
                reference = self._topic(reader, reference, _REFERENCE_POSES, "poses")
        self.reference_source = reference

    def __iter__(self) -> Iterator[Scan]:
        """Read the scans in order of their recording.

        A scan whose stamp does not come after the one before it is left out, with a warning.

        Raises
        ------
        SequenceError
            Naming the message that cannot be decoded.
        """
        first = last = None
        dropped = 0
        for number, message in enumerate(self._messages(self.points), start=1):
            stamp = stamp_ns(message.header)
            first = stamp if first is None else first
            seconds = (stamp - first) * 1e-9
            if seconds < self.start or (self.stop is not None and seconds >= self.stop):
                continue
            if last is not None and stamp <= last:
                dropped += 1
                continue
            last = stamp
            try:
                yield pointcloud2.decode(message)
            except PointCloudError as error:
                raise SequenceError(
                    f"{self.path}: message {number} on {self.points}: {error}"
                ) from error
        if last is None:
            raise SequenceError(
                f"{self.path}: no scan on {self.points} between start = {self.start:g} s and "
                f"stop = {'the end' if self.stop is None else f'{self.stop:g} s'}"
            )
        if dropped:
            _log.warning("%s: left out %d scans that go back in time", self.path, dropped)

    def reference(self) -> Trajectory | None:
        """Reference poses of the sensor, if the sequence has any.

        Of poses with the same stamp the first one counts.

        Raises
        ------
        SequenceError
            If the topic holds no pose, or poses that are not finite.
        TrajectoryError
            If the file cannot be read.
        """
        if self.reference_source is None:
            return None
        if isinstance(self.reference_source, Path):
            return read_tum(self.reference_source)
        stamps, values = [], []
        for message in self._messages(self.reference_source):
            pose = _REFERENCE_POSES[message.__msgtype__](message)
            p, q = pose.position, pose.orientation
            stamps.append(stamp_ns(message.header))
            values.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        if not stamps:
            raise SequenceError(f"{self.path}: no pose on {self.reference_source}")
        unique, index = np.unique(np.array(stamps, np.int64), return_index=True)
        poses = np.array(values)[index]
        norms = np.linalg.norm(poses[:, 3:], axis=1)
        if not np.isfinite(poses).all() or np.any(norms < 0.1):
            raise SequenceError(
                f"{self.path}: a pose on {self.reference_source} is not finite or has no rotation"
            )
        return Trajectory(unique, geometry.from_quaternions(poses[:, :3], poses[:, 3:]))

    @contextmanager
    def _open(self) -> Iterator[AnyReader]:
        try:
            reader = AnyReader([self.path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            reader.open()
        except FileNotFoundError as error:
            raise SequenceError(f"{self.path}: there is no such bag") from error
        except Exception as error:
            # The readers raise what their formats and decompressors raise.
            raise SequenceError(
                f"{self.path}: cannot be opened as a bag ({error}); if the recording was cut "
                f"short, repair it first (`rosbag reindex` or `ros2 bag reindex`)"
            ) from error
        try:
            yield reader
        finally:
            reader.close()

    def _messages(self, topic: str) -> Iterator[Any]:
        with self._open() as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            messages = reader.messages(connections)
            while True:
                try:
                    connection, _, data = next(messages)
                    message = reader.deserialize(data, connection.msgtype)
                except StopIteration:
                    return
                except Exception as error:
                    raise SequenceError(
                        f"{self.path}: cannot read on ({type(error).__name__}: {error}); the "
                        f"bag is damaged"
                    ) from error
                yield message

    def _topic(self, reader: AnyReader, name: str | None, types: Iterable[str], what: str) -> str:
        fitting = sorted({c.topic for c in reader.connections if c.msgtype in types})
        if name is None:
            if len(fitting) != 1:
                raise SequenceError(
                    f"{self.path}: {len(fitting)} topics with {what}, name the one to use: "
                    f"{', '.join(fitting) or _list(reader.connections)}"
                )
            return fitting[0]
        if name in fitting:
            return name
        present = {c.topic: c.msgtype for c in reader.connections}
        if name in present:
            raise SequenceError(f"{self.path}: {name} is {present[name]}, not {what}")
        raise SequenceError(
            f"{self.path}: no topic {name}; {nearest(name, present)} "
            f"The bag holds {_list(reader.connections)}"
        )


def _list(connections: list[Connection]) -> str:
    return ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in connections})) or "nothing"
