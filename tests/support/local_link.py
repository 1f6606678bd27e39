"""A robot in this process: what is published is taken at once."""

import threading
from collections import defaultdict

import numpy as np
import rec
from drives import cloud

from adaptune.ros.link import LinkError
from online.live import CLOUD, IMU

STORE = rec.ROS1
TYPES = STORE.types
__all__ = ["STORE", "TYPES", "LocalLink", "cloud", "header", "imu", "odometry"]


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
    return rec.header(stamp, frame, STORE)


def imu(stamp, rate=0.0):
    made = rec.imu(stamp, (0.0, 0.0, rate), (0.0, 0.0, 9.81), STORE)
    made.header = header(stamp)
    return made


def odometry(stamp, T):
    """nav_msgs/Odometry of a pose without rotation."""
    zero = TYPES["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    still = rec.bare_pose(map(float, T[:3, 3]), (0.0, 0.0, 0.0, 1.0), STORE)
    pose = TYPES["geometry_msgs/msg/PoseWithCovariance"](still, np.zeros(36))
    twist = TYPES["geometry_msgs/msg/TwistWithCovariance"](
        TYPES["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
    )
    return TYPES["nav_msgs/msg/Odometry"](header(stamp, "odom"), "base", pose, twist)
