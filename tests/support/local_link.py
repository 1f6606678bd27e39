"""A robot in this process: what is published is taken at once."""

import threading
from collections import defaultdict

import rec
from drives import cloud

from adaptune.ros.link import BusyError, LinkError
from online.topics import IMU_TYPE, RosMessages, placed

STORE = rec.ROS1
TYPES = STORE.types
__all__ = ["STORE", "TYPES", "LocalLink", "cloud", "imu", "odometry"]


class LocalLink:
    """Stands for `adaptune.ros.relay.Ros1`; `holds` are the parameters of its only node, ``/node``.

    What is `played`, topics and messages, begins when somebody subscribes to ``/points``.
    """

    def __init__(self, played=()):
        self._played = played
        self.alive, self.is2, self.clouds = True, False, "sensor_msgs/msg/PointCloud2"
        self.store = STORE
        self.published = defaultdict(list)
        self.kinds = {}
        self.holds = {}
        self.refuses = ()
        self.free, self.asked, self._owed = threading.Event(), [], []
        self.free.set()  # otherwise the node is busy, and takes what it got afterwards
        self.deaf = ""
        self._takers = defaultdict(list)

    def subscribe(self, topic, kind, take, raw=False):
        read = (lambda m: bytes(self.store.serialize_ros1(m, kind))) if raw else (lambda m: m)
        self._takers[topic].append(lambda message: take(read(message)))
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

    def set_parameters(self, node, values, outdated):
        if node != "/node":
            raise LinkError(f"{node}: unknown node")
        self.asked.append(dict(values))
        self._owed.append(values)
        while not self.free.wait(0.001):
            if outdated():
                raise BusyError(f"{node} is busy")
        while len(self._owed) > 1:
            self.holds |= self._owed.pop(0)
        self._owed.clear()
        if refused := [name for name in values if name in self.refuses]:
            raise LinkError(f"{node} refuses {refused[0]}")
        self.holds |= values
        return dict(self.holds)

    def topics(self):
        return {"/points": self.clouds, "/imu": IMU_TYPE}

    def why_unheard(self, topic):
        return self.deaf if topic == "/points" else ""

    def close(self):
        pass


def imu(stamp, rate=0.0):
    return rec.imu(stamp, (0.0, 0.0, rate), (0.0, 0.0, 9.81), STORE)


def odometry(stamp, T):
    return RosMessages(STORE, "odom").odometry(stamp, placed(T[None])[0], "base")
