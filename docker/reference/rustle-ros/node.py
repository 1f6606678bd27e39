#!/usr/bin/env python3
"""A ROS 1 node named /gicp: an odometry for a PointCloud2 topic, and habits of other systems."""

import os
import queue
import sys
import threading
import time
from collections import deque
from types import SimpleNamespace

import numpy as np
import rospy
from dynamic_reconfigure.server import Server
from lidar_odometry import (
    POINTS_TOPIC,
    LidarOdometry,
    check_layout,
    limits,
    quaternion,
    to_scan,
    tuned,
)
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2

QUEUE_SIZE = 200_000


RECONFIGURED = SimpleNamespace(
    min={name: low for name, (low, _, _) in limits().items()},
    max={name: high for name, (_, high, _) in limits().items()},
    defaults={name: default for name, (_, _, default) in limits().items()},
    level=dict.fromkeys(limits(), 0),
    config_description={
        "name": "Default",
        "type": "",
        "id": 0,
        "parent": 0,
        "state": True,
        "groups": [],
        "parameters": [
            {
                "name": name,
                "type": "int" if isinstance(default, int) else "double",
                "level": 0,
                "description": "",
                "edit_method": "",
                "default": default,
                "min": low,
                "max": high,
            }
            for name, (low, high, default) in limits().items()
        ],
    },
)
"""The parameters as dynamic_reconfigure wants them, which packages generate from a .cfg file."""


class GicpNode:
    """Scans wait in a queue until the main thread takes them, one after the other."""

    def __init__(self) -> None:
        self._imitate = rospy.get_param("/imitate", {})
        if self._imitate.get("quit_launch"):
            sys.exit(0)
        parameters = tuned(rospy.get_param("~", {}))
        self._odometry = LidarOdometry(parameters, self._imitate.get("frame"))
        self._map = LidarOdometry(parameters, self._imitate.get("frame"))
        self._T_map_odom = np.eye(4)
        self._changed: dict = {}
        self._scans: deque = deque(maxlen=self._imitate.get("queue_size", QUEUE_SIZE))
        self._came = threading.Semaphore(0)
        self._to_map: queue.Queue = queue.Queue()
        self._to_publish: queue.Queue = queue.Queue()
        for loop in (self._map_scans, self._publish_late):
            threading.Thread(target=loop, daemon=True).start()
        self._n = 0
        self._publisher = rospy.Publisher("/Odometry", Odometry, queue_size=1000)
        if not self._imitate.get("read_once"):
            # The server reads its first values there, and knows numbers only.
            for name, value in parameters.items():
                rospy.set_param(f"~{name}", value)
            self._server = Server(RECONFIGURED, self._reconfigure)
        time.sleep(self._imitate.get("ready_delay", 0.0))
        topic = rospy.get_param("/common/points_topic", POINTS_TOPIC)
        rospy.Subscriber(topic, PointCloud2, self._receive, buff_size=1 << 26)
        rospy.loginfo("ready for %s", topic)

    def _reconfigure(self, config, _level):
        self._changed = tuned(dict(config))
        return config

    def _receive(self, message: PointCloud2) -> None:
        self._scans.append(message)
        self._came.release()

    def spin(self) -> None:
        """Work on scans until ROS ends."""
        hz = self._imitate.get("rate")
        rate = rospy.Rate(hz, reset=True) if hz else None
        while not rospy.is_shutdown():
            if rate is not None:
                rate.sleep()
            elif not self._came.acquire(timeout=0.1):
                continue
            if self._scans:
                self._work(self._scans.popleft())

    def _map_scans(self) -> None:
        """Correct the odometry by the newest scan; what came while one was mapped is left out."""
        while True:
            scan, T_odom = self._to_map.get()
            while not self._to_map.empty():
                scan, T_odom = self._to_map.get()
            time.sleep(self._imitate["background"])
            self._T_map_odom = self._map.register(scan) @ np.linalg.inv(T_odom)

    def _publish_late(self) -> None:
        """Publish poses some seconds after they were found, stamped with the present time."""
        while True:
            due, T = self._to_publish.get()
            time.sleep(max(0.0, due - time.monotonic()))
            self._publish(rospy.Time.now(), T)

    def _work(self, message: PointCloud2) -> None:
        check_layout(message, self._imitate.get("layout"))
        self._n += 1
        if self._n <= self._imitate.get("late", 0):
            return
        changed, self._changed = self._changed, {}
        self._odometry.configure(changed)
        scan = to_scan(message, message.header.stamp.to_nsec())
        T = self._odometry.register(scan)
        if "background" in self._imitate:
            self._to_map.put((scan, T))
            T = self._T_map_odom @ T
        time.sleep(self._imitate.get("seconds_per_scan", 0.0))
        if self._n == self._imitate.get("jump"):
            T = T * float("nan")
        if "own_clock" in self._imitate:
            self._to_publish.put((time.monotonic() + self._imitate["own_clock"], T))
        elif not self._imitate.get("silent") and not (self._n - 1) % self._imitate.get("one_of", 1):
            self._publish(message.header.stamp, T)
        if self._n == self._imitate.get("die_at"):
            sys.stderr.write(f"gicp: terminating after {self._n} scans: the map is corrupt\n")
            sys.stderr.flush()
            time.sleep(0.2)  # its last pose is on its way, in another thread
            os._exit(1)

    def _publish(self, stamp, T) -> None:
        said = Odometry()
        later = rospy.Duration(self._imitate.get("stamp_later", 0.0))
        said.header.stamp = stamp + later
        said.header.frame_id, said.child_frame_id = "odom", "base_link"
        position, orientation = said.pose.pose.position, said.pose.pose.orientation
        position.x, position.y, position.z = T[:3, 3]
        orientation.x, orientation.y, orientation.z, orientation.w = quaternion(T)
        self._publisher.publish(said)


if __name__ == "__main__":
    rospy.init_node("gicp")
    GicpNode().spin()
