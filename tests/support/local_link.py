"""A robot in this process: what is published is taken at once."""

import threading
from collections import defaultdict

import drives
import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from adaptune.ros.link import LinkError
from online.live import CLOUD, IMU

STORE = get_typestore(Stores.ROS1_NOETIC)
STORE.register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage")
)
TYPES = STORE.types


class LocalLink:
    """Stands for `adaptune.ros.ros1.Ros1`; `holds` are the parameters of its only node, ``/node``.

    What is `played`, topics and messages, begins when somebody subscribes to ``/points``.
    """

    def __init__(self, played=()):
        self._played = played
        self.alive = True
        self.store = STORE
        self.published = defaultdict(list)
        self.kinds = {}
        self.holds = {}
        self.refuses = ()
        self._takers = defaultdict(list)

    def subscribe(self, topic, _kind, take):
        self._takers[topic].append(take)
        if topic == "/points":
            threading.Thread(target=self._play_all, daemon=True).start()

    def _play_all(self):
        played, self._played = self._played, ()
        for topic, message in played:
            self.play(topic, message)

    def advertise(self, topic, kind):
        self.kinds[topic] = kind

        def publish(message):
            # Whatever cannot be sent fails here, too.
            whole = self.store.deserialize_ros1(self.store.serialize_ros1(message, kind), kind)
            self.published[topic].append(whole)

        return publish

    def play(self, topic, message):
        for take in self._takers[topic]:
            take(message)

    def set_parameters(self, node, values):
        if node != "/node":
            raise LinkError(f"{node}: unknown node")
        if refused := [name for name in values if name in self.refuses]:
            raise LinkError(f"{node} refuses {refused[0]}")
        self.holds |= values
        return dict(self.holds)

    def topics(self):
        return {"/points": CLOUD, "/imu": IMU}

    def close(self):
        pass


def header(stamp, frame="lidar"):
    time = TYPES["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    return TYPES["std_msgs/msg/Header"](0, time, frame)


def cloud(stamp, points, names="xyz"):
    """sensor_msgs/PointCloud2 of points of shape (n, 3)."""
    made = drives.cloud(stamp, points)
    made.header = header(stamp)
    for field, name in zip(made.fields, names, strict=True):
        field.name = name
    return made


def imu(stamp, rate=0.0):
    vector = TYPES["geometry_msgs/msg/Vector3"]
    still = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    unknown = np.zeros(9)
    measured = vector(0.0, 0.0, rate), unknown, vector(0.0, 0.0, 9.81), unknown
    return TYPES[IMU](header(stamp), still, unknown, *measured)


def odometry(stamp, T):
    """nav_msgs/Odometry of a pose without rotation."""
    point = TYPES["geometry_msgs/msg/Point"](*map(float, T[:3, 3]))
    still = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    zero = TYPES["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    pose = TYPES["geometry_msgs/msg/PoseWithCovariance"](
        TYPES["geometry_msgs/msg/Pose"](point, still), np.zeros(36)
    )
    twist = TYPES["geometry_msgs/msg/TwistWithCovariance"](
        TYPES["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
    )
    return TYPES["nav_msgs/msg/Odometry"](header(stamp, "odom"), "base", pose, twist)
