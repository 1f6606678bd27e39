"""Small ROS 1 bags with clouds and poses."""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS1_NOETIC)
START = 1_700_000_000_000_000_000


def header(stamp: int) -> Any:
    time = STORE.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return STORE.types["std_msgs/msg/Header"](0, time, "lidar")


def cloud(stamp: int, n: int = 200) -> Any:
    raw = np.zeros((n, 4), "<f4")
    raw[:, :3] = np.random.default_rng(0).normal(0, 10, (n, 3))
    raw[:5] = np.nan
    raw[5:, 3] = np.linspace(0, 0.1, n - 5)
    field = STORE.types["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * i, 7, 1) for i, name in enumerate(("x", "y", "z", "time"))]
    data = raw.view(np.uint8).ravel()
    return STORE.types["sensor_msgs/msg/PointCloud2"](
        header(stamp), 1, n, fields, False, 16, 16 * n, data, True
    )


def bad_cloud(stamp: int, of: str) -> Any:
    """A cloud that is cut, or has no or few valid points."""
    made = cloud(stamp)
    if of == "cut":
        made.data = made.data[:-1]
        return made
    values = {"NaN": np.nan, "zero": 0.0, "far": 2000.0, "few": 0.0}
    raw = made.data.view("<f4").reshape(-1, 4)
    raw[19 if of == "few" else 0 :, :3] = values[of]
    if of == "few":
        raw[:19, :3] = 1.0
    return made


def pose(stamp: int, x: float) -> Any:
    types = STORE.types
    return types["geometry_msgs/msg/PoseStamped"](
        header(stamp),
        types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](x, 0, 0),
            types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1),
        ),
    )


def write(path: Path, messages: list[tuple[str, int, Any]]) -> Path:
    with rosbag1.Writer(path) as writer:
        topics: dict[str, Any] = {}
        for topic, recorded, message in messages:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(topics[topic], recorded, STORE.serialize_ros1(message, kind))
    return path


def drive(path: Path, stamps: list[float], poses: list[tuple[float, float]]) -> Path:
    messages: list[tuple[str, int, Any]] = [
        ("/points", START + i * 10**8, cloud(START + round(s * 1e9))) for i, s in enumerate(stamps)
    ]
    messages += [("/poses", START, pose(START + round(s * 1e9), x)) for s, x in poses]
    return write(path, messages)
