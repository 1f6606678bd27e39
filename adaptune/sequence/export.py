"""Sequences as bags and folders, for programs that read nothing else."""

import heapq
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from adaptune.files import write_text
from adaptune.geometry import Poses
from adaptune.sequence.imu import Imu
from adaptune.sequence.scan import Scan

Message = tuple[str, int, Any]
"""Topic, nanoseconds at which it is sent, content."""

Layout = Literal["bag", "ros2", "kitti"]
"""ROS 1 bag, ROS 2 folder with sqlite3, KITTI odometry folder."""

POINTS, IMU = "/points", "/imu"
"""Topics of the bags."""

_KINDS = {"<f4": 7, "<u2": 4}


class Messages:
    """Makes ROS messages.

    Parameters
    ----------
    version
        Of ROS.
    """

    def __init__(self, version: Literal[1, 2]) -> None:
        store = Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE
        self.version = version
        self.typestore = get_typestore(store)
        self.types = self.typestore.types
        # Only a ROS 1 header counts its messages.
        self._counts: dict[str, int] = {}

    def header(self, topic: str, stamp: int, frame: str) -> Any:
        """A header with nanoseconds and frame, counted by topic in ROS 1."""
        time = self.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        header = self.types["std_msgs/msg/Header"]
        if self.version == 2:
            return header(stamp=time, frame_id=frame)
        self._counts[topic] = self._counts.get(topic, -1) + 1
        return header(seq=self._counts[topic], stamp=time, frame_id=frame)

    def cloud(self, header: Any, cloud: NDArray[Any]) -> Any:
        """A cloud of points in a structured array of shape (n,) of float32 and uint16."""
        field = self.types["sensor_msgs/msg/PointField"]
        layout: Any = cloud.dtype.fields
        fields = [
            field(name=name, offset=layout[name][1], datatype=_KINDS[layout[name][0].str], count=1)
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

    def imu(self, header: Any, gyro: NDArray[np.float64], accel: NDArray[np.float64]) -> Any:
        """A measurement without an orientation."""
        t = self.types
        vector = t["geometry_msgs/msg/Vector3"]
        unknown = np.zeros(9)
        # As the message's definition has it: no orientation is estimated.
        unoriented = np.array([-1.0, *np.zeros(8)])
        return t["sensor_msgs/msg/Imu"](
            header=header,
            orientation=t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            orientation_covariance=unoriented,
            angular_velocity=vector(*gyro.tolist()),
            angular_velocity_covariance=unknown,
            linear_acceleration=vector(*accel.tolist()),
            linear_acceleration_covariance=unknown,
        )

    def write(
        self,
        path: Path,
        types: Mapping[str, str],
        messages: Iterable[Message],
        storage: StoragePlugin = StoragePlugin.SQLITE3,
    ) -> None:
        """Write a bag: a file of ROS 1, or a folder of ROS 2.

        Parameters
        ----------
        path
            Where nothing is yet.
        types
            Of the messages on each topic.
        messages
            In the order in which they are sent.
        storage
            Format of a ROS 2 bag's files.
        """
        store = self.typestore
        writer = (
            Writer1(path) if self.version == 1 else Writer2(path, version=9, storage_plugin=storage)
        )
        serialize = store.serialize_ros1 if self.version == 1 else store.serialize_cdr
        with writer:
            topics: dict[str, Any] = {
                topic: writer.add_connection(topic, kind, typestore=store)
                for topic, kind in types.items()
            }
            for topic, stamp, message in messages:
                writer.write(topics[topic], stamp, serialize(message, types[topic]))


def export(scans: Iterable[Scan], imu: Imu | None, path: Path, layout: Layout) -> None:
    """Write scans, and an IMU's measurements where there are any, for another program.

    Bags hold `POINTS` (x, y, z, intensity, which is 0 where the scans have none, and ring and time
    where they have them) and `IMU`. A KITTI folder holds sequence 00, its camera in the LiDAR's
    frame.

    Parameters
    ----------
    scans
        In order of time.
    imu
        On the clock of the scans.
    path
        Where nothing is yet.
    layout
        What to write.
    """
    if layout == "kitti":
        _write_kitti(scans, path)
        return
    messages = Messages(1 if layout == "bag" else 2)
    types = {POINTS: "sensor_msgs/msg/PointCloud2"}
    streams = [_clouds(messages, scans)]
    if imu is not None:
        types[IMU] = "sensor_msgs/msg/Imu"
        streams.append(_measurements(messages, imu))
    messages.write(path, types, heapq.merge(*streams, key=lambda message: message[1]))


def _clouds(messages: Messages, scans: Iterable[Scan]) -> Iterator[Message]:
    """Each cloud when its scan is over."""
    for scan in scans:
        over = 0.0 if scan.times is None or not len(scan) else float(scan.times.max())
        header = messages.header(POINTS, scan.stamp, "lidar")
        message = messages.cloud(header, _structured(scan))
        yield POINTS, scan.stamp + max(round(over * 1e9), 0), message


def _structured(scan: Scan) -> NDArray[Any]:
    kinds = [(name, "<f4") for name in ("x", "y", "z", "intensity")]
    if scan.rings is not None:
        kinds.append(("ring", "<u2"))
    if scan.times is not None:
        kinds.append(("time", "<f4"))
    cloud = np.zeros(len(scan), kinds)
    cloud["x"], cloud["y"], cloud["z"] = scan.points.T
    if scan.intensities is not None:
        cloud["intensity"] = scan.intensities
    if scan.rings is not None:
        cloud["ring"] = scan.rings
    if scan.times is not None:
        cloud["time"] = scan.times
    return cloud


def _measurements(messages: Messages, imu: Imu) -> Iterator[Message]:
    for stamp, gyro, accel in zip(
        imu.stamps.tolist(), imu.angular_velocity, imu.acceleration, strict=True
    ):
        header = messages.header(IMU, stamp, "imu")
        yield IMU, stamp, messages.imu(header, gyro, accel)


def _write_kitti(scans: Iterable[Scan], path: Path) -> None:
    sequence = path / "sequences" / "00"
    (sequence / "velodyne").mkdir(parents=True)
    stamps = []
    for number, scan in enumerate(scans):
        stamps.append(scan.stamp)
        cloud = np.zeros((len(scan), 4), "<f4")
        cloud[:, :3] = scan.points
        if scan.intensities is not None:
            cloud[:, 3] = scan.intensities
        (sequence / "velodyne" / f"{number:06d}.bin").write_bytes(cloud.tobytes())
    write_kitti_times(sequence, (np.array(stamps) - stamps[0]) * 1e-9, np.eye(4))


def write_kitti_times(sequence: Path, seconds: NDArray[np.float64], T_camera_lidar: Poses) -> None:
    """Write ``times.txt`` and ``calib.txt`` of a KITTI odometry sequence.

    Parameters
    ----------
    sequence
        Its folder.
    seconds
        Of each scan, of shape (n,).
    T_camera_lidar
        The LiDAR's pose in the frame that KITTI's poses are of, of shape (4, 4).
    """
    write_text(sequence / "times.txt", "".join(f"{t:.6e}\n" for t in seconds))
    rows = " ".join(f"{v:.12e}" for v in T_camera_lidar[:3].ravel())
    camera = " ".join(f"{v:.12e}" for v in np.eye(3, 4).ravel())
    lines = [*(f"P{i}: {camera}\n" for i in range(4)), f"Tr: {rows}\n"]
    write_text(sequence / "calib.txt", "".join(lines))
