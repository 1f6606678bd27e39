"""Sequences as bags and folders, for programs that read nothing else."""

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from adaptune._system.files import write_text
from adaptune.recording.clouds import livox_points
from adaptune.recording.scan import Imu, Scan

Message = tuple[str, int, Any]
"""Topic, nanoseconds at which it is sent, content."""

Layout = Literal["bag", "ros2", "kitti"]
"""ROS 1 bag, ROS 2 folder with sqlite3, KITTI odometry folder."""

POINTS, IMU = "/points", "/imu"  # topics of the bags

_DATATYPES = {"<f4": 7, "<u2": 4}


class Messages:
    """Makes messages of a version of ROS."""

    def __init__(self, version: Literal[1, 2]) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.version = version
        self.typestore = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        self.types = self.typestore.types
        # Only a ROS 1 header counts its messages.
        self._counts: Counter[str] = Counter()

    def header(self, topic: str, stamp: int, frame: str) -> Any:
        """A header with nanoseconds and frame, counted by topic in ROS 1."""
        time = self.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        header = self.types["std_msgs/msg/Header"]
        if self.version == 2:
            return header(stamp=time, frame_id=frame)
        number = self._counts[topic]
        self._counts[topic] += 1
        return header(seq=number, stamp=time, frame_id=frame)

    def cloud(self, header: Any, cloud: NDArray[Any]) -> Any:
        """A cloud of points in a structured array of shape (n,) of float32 and uint16."""
        field = self.types["sensor_msgs/msg/PointField"]
        layout: Any = cloud.dtype.fields
        fields = [
            field(
                name=name, offset=layout[name][1], datatype=_DATATYPES[layout[name][0].str], count=1
            )
            for name in cloud.dtype.names or ()
        ]
        return self.types["sensor_msgs/msg/PointCloud2"](
            header=header,
            height=1,
            width=len(cloud),
            fields=fields,
            is_bigendian=False,
            point_step=cloud.dtype.itemsize,
            row_step=cloud.nbytes,
            data=cloud.view(np.uint8),
            is_dense=True,
        )

    def livox(self, header: Any, scan: Scan) -> bytes:
        """A scan as a Livox driver for ROS 2 sends it, serialised."""
        stamp = scan.stamp.to_bytes(8, "little")
        head = bytes(self.typestore.serialize_cdr(header, "std_msgs/msg/Header"))
        head += bytes(-(len(head) - 4) % 8)  # behind the four bytes of the encoding
        return head + stamp + len(scan).to_bytes(4, "little") + bytes(4) + livox_points(scan)

    def imu(self, header: Any, gyro: NDArray[np.float64], accel: NDArray[np.float64]) -> Any:
        """A measurement without an orientation."""
        vector, unknown = self.types["geometry_msgs/msg/Vector3"], np.zeros(9)
        return self.types["sensor_msgs/msg/Imu"](
            header=header,
            orientation=self.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            # As the message's definition has it: no orientation is estimated.
            orientation_covariance=np.array([-1.0, *np.zeros(8)]),
            angular_velocity=vector(*gyro.tolist()),
            angular_velocity_covariance=unknown,
            linear_acceleration=vector(*accel.tolist()),
            linear_acceleration_covariance=unknown,
        )

    def write(
        self, path: Path, types: Mapping[str, str], messages: Iterable[Message], mcap: bool = False
    ) -> None:
        """Write a bag: a file of ROS 1, or a folder of ROS 2 with SQLite, or MCAP if `mcap`.

        `types` are those of the messages by topic, which come in the order in which they are sent.
        """
        from rosbags import rosbag1, rosbag2

        store, writer = self.typestore, rosbag1.Writer(path) if self.version == 1 else None
        storage = rosbag2.StoragePlugin.MCAP if mcap else rosbag2.StoragePlugin.SQLITE3
        serialize = store.serialize_cdr if writer is None else store.serialize_ros1
        with writer or rosbag2.Writer(path, version=9, storage_plugin=storage) as bag:
            topics: dict[str, Any] = {
                topic: bag.add_connection(topic, kind, typestore=store)
                for topic, kind in types.items()
            }
            for topic, stamp, message in messages:
                bag.write(topics[topic], stamp, serialize(message, types[topic]))


def export(scans: Iterable[Scan], imu: Imu | None, path: Path, layout: str) -> None:
    """Write scans, and an IMU's measurements where there are any, for another program.

    Bags hold `POINTS`, see `structured`, and `IMU`; a KITTI folder holds sequence 00. Scans are in
    order of time, the IMU is on their clock, and nothing is at `path` yet.
    """
    if layout == "kitti":
        write_kitti_sequence(scans, path)
        return
    messages = Messages(2 if layout == "ros2" else 1)
    types = {POINTS: "sensor_msgs/msg/PointCloud2"}
    streams = [_clouds(messages, scans)]
    if imu is not None:
        types[IMU] = "sensor_msgs/msg/Imu"
        streams.append(measurements(messages, imu, IMU))
    messages.write(path, types, heapq.merge(*streams, key=lambda message: message[1]))


def _clouds(messages: Messages, scans: Iterable[Scan]) -> Iterator[Message]:
    """Each cloud when its scan is over."""
    for scan in scans:
        header = messages.header(POINTS, scan.stamp, "lidar")
        yield POINTS, scan.stamp + max(scan.span, 0), messages.cloud(header, structured(scan))


def structured(scan: Scan) -> NDArray[Any]:
    """Points as Velodyne's driver writes them: intensities, or 0, and rings and times if there."""
    x, y, z = scan.points.T
    light = np.zeros(len(scan)) if scan.intensities is None else scan.intensities
    columns = {"x": x, "y": y, "z": z, "intensity": light, "ring": scan.rings, "time": scan.times}
    given = {name: values for name, values in columns.items() if values is not None}
    cloud = np.empty(len(scan), [(name, "<u2" if name == "ring" else "<f4") for name in given])
    for name, values in given.items():
        cloud[name] = values
    return cloud


def measurements(messages: Messages, imu: Imu, topic: str) -> Iterator[Message]:
    """Every measurement of an IMU on a topic."""
    measured = zip(imu.stamps.tolist(), imu.angular_velocity, imu.acceleration, strict=True)
    for stamp, gyro, accel in measured:
        yield topic, stamp, messages.imu(messages.header(topic, stamp, "imu"), gyro, accel)


def write_kitti_sequence(scans: Iterable[Scan], root: Path, name: str = "00") -> None:
    """Write ``sequences/<name>`` of the KITTI odometry benchmark, without poses, below `root`.

    Its camera is in the LiDAR's frame; intensities are 0 where scans have none.
    """
    sequence = root / "sequences" / name
    (sequence / "velodyne").mkdir(parents=True)
    stamps = []
    for number, scan in enumerate(scans):
        stamps.append(scan.stamp)
        cloud = np.zeros((len(scan), 4), "<f4")
        cloud[:, :3] = scan.points
        if scan.intensities is not None:
            cloud[:, 3] = scan.intensities
        (sequence / "velodyne" / f"{number:06d}.bin").write_bytes(cloud.tobytes())
    seconds = (np.array(stamps) - stamps[0]) * 1e-9
    write_text(sequence / "times.txt", "".join(f"{t:.6e}\n" for t in seconds))
    identity = " ".join(f"{v:.12e}" for v in np.eye(3, 4).ravel())
    names = ("P0", "P1", "P2", "P3", "Tr")
    write_text(sequence / "calib.txt", "".join(f"{name}: {identity}\n" for name in names))
