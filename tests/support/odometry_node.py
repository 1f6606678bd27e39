"""An odometry node on plain Cyclone DDS, which knows by the stamp of a cloud where it is.

    python odometry_node.py HABITS PARAMETERS

It gives a pose for each cloud of /points on /odometry, or on /tf. Its habits, as JSON, are seconds
of a scan after which its poses are (`shift`) and by which their stamps are later (`later`), seconds
for which it computes before a pose (`computes`), how it leaves after so many clouds (`leaves`), and
whether its transforms stand on their heads (`inverted`).
"""

import json
import os
import sys
import threading
import time

import numpy as np
import ros2_node
from ros2_node import DdsNode
from scipy.spatial.transform import Rotation

TRANSFORMS = "tf2_msgs/msg/TFMessage"


def path(seconds):
    """Poses of shape (n, 4, 4) of a drive that gets faster and turns."""
    T = np.tile(np.eye(4), (len(seconds), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("z", 0.3 * seconds[:, None]).as_matrix()
    T[:, 0, 3] = 0.8 * seconds**2
    return T


class OdometryNode:
    def __init__(self, habits):
        self.habits, self.node = habits, DdsNode(int(os.environ["ROS_DOMAIN_ID"]))
        self.first, self.n = None, 0
        topic = ("/tf", TRANSFORMS) if "inverted" in habits else ("/odometry", ros2_node.ODOMETRY)
        self.publish = self.node.publisher(*topic)
        self.node.subscribe("/points", ros2_node.POINTS, self.take)

    def take(self, cloud):
        of_scan = cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec
        self.first = of_scan if self.first is None else self.first
        self.n += 1
        begin = time.process_time()
        while time.process_time() - begin < self.habits.get("computes", 0.0):
            pass
        seconds = 1e-9 * (of_scan - self.first) + self.habits.get("shift", 0.0)
        self.say(of_scan + round(1e9 * self.habits.get("later", 0.0)), path(np.array([seconds]))[0])
        sys.stdout.write(f"clouds: {self.n}\n")
        sys.stdout.flush()
        if self.n == self.habits.get("leaves", [0])[0]:
            sys.stdout.write("the map is corrupt\n")
            sys.stdout.flush()
            code = self.habits["leaves"][1]
            os._exit(code) if code >= 0 else os.kill(os.getpid(), -code)

    def say(self, stamp, T):
        types, inverted = self.node.store.types, self.habits.get("inverted")
        T = np.linalg.inv(T) if inverted else T
        header = types["std_msgs/msg/Header"](
            types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)),
            "lidar" if inverted else "odom",
        )
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
        rotation = types["geometry_msgs/msg/Quaternion"](*quaternion)
        if "inverted" in self.habits:
            there = types["geometry_msgs/msg/Transform"](
                types["geometry_msgs/msg/Vector3"](*T[:3, 3]), rotation
            )
            child = "odom" if inverted else "lidar"
            stamped = types["geometry_msgs/msg/TransformStamped"](header, child, there)
            self.publish(types[TRANSFORMS]([stamped]))
            return
        zero, vector = np.zeros(36), types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        pose = types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](*T[:3, 3]), rotation
        )
        self.publish(
            types[ros2_node.ODOMETRY](
                header,
                "lidar",
                types["geometry_msgs/msg/PoseWithCovariance"](pose, zero),
                types["geometry_msgs/msg/TwistWithCovariance"](
                    types["geometry_msgs/msg/Twist"](vector, vector), zero
                ),
            )
        )


if __name__ == "__main__":
    OdometryNode(json.loads(sys.argv[1]))
    threading.Event().wait()
