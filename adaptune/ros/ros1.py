"""A link to ROS 1, by a node that the Python of a ROS installation runs."""

import os
import shutil
import socket
import subprocess
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from adaptune.ros import ros1_node
from adaptune.ros.link import LinkError
from adaptune.ros.relay import Relay


def ros_python() -> str:
    """The Python that imports ROS 1: the first ``python3`` of the system's that does.

    There is a `LinkError` if none does.
    """
    found = [shutil.which("python3", path=folder) for folder in os.get_exec_path()]
    for python in dict.fromkeys([*filter(None, found), "/usr/bin/python3"]):
        # Not what lies in the working folder under a name of Python's.
        code = "import sys; sys.path[:] = filter(None, sys.path); import rospy"
        done = subprocess.run([python, "-c", code], capture_output=True, check=False)
        if done.returncode == 0:
            return python
    raise LinkError(
        "no python3 on PATH can import rospy: source the setup of your ROS 1 first (`source "
        "/opt/ros/noetic/setup.bash`), or install it (`apt-get install python3-rospy`)"
    )


def local_ros1() -> "Ros1":
    """A node in the ROS 1 that runs on this machine, or that ROS_MASTER_URI names.

    There is a `LinkError` if no Python can import it, or no roscore answers.
    """
    here, there = socket.socketpair()
    command = [ros_python(), ros1_node.__file__, str(there.fileno())]
    # A session of its own: Ctrl-C ends adaptune, and that ends the node.
    process = subprocess.Popen(
        command, pass_fds=[there.fileno()], stdout=subprocess.DEVNULL, start_new_session=True
    )
    there.close()

    def end() -> None:
        try:
            # It takes leave of the roscore.
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    try:
        return Ros1(here, lambda: process.poll() is None, end)
    except LinkError as error:
        raise LinkError(f"{error}; start `roscore`, and source your ROS's setup") from error


class Ros1(Relay):
    """A node in a running ROS 1: the Python of any ROS will do."""

    version = 1

    def __init__(self, *given: Any):
        self.store = get_typestore(Stores.ROS1_NOETIC)
        text = "geometry_msgs/TransformStamped[] transforms\n"
        self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        super().__init__(*given)

    def encode(self, message: Any, kind: str) -> Any:
        return self.store.serialize_ros1(message, kind)

    def decode(self, data: bytes, kind: str) -> Any:
        return self.store.deserialize_ros1(data, kind)

    def _names(self, kind: str) -> dict[str, str]:
        text, md5 = self.store.generate_msgdef(kind, ros_version=1)
        return {"text": text, "md5": md5}
