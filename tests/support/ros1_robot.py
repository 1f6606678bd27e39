"""A ROS 1 node with a parameter that can be set while it runs; by the Python of ROS.

Its parameter `voxel` is at most 1. It quits with its input.
"""

import sys
import threading

import rospy
from dynamic_reconfigure.server import Server


class Parameters:
    config_description = {  # noqa: RUF012
        "name": "Default",
        "type": "",
        "id": 0,
        "parent": 0,
        "state": True,
        "groups": [],
        "parameters": [
            {
                "name": "voxel",
                "type": "double",
                "level": 0,
                "description": "",
                "edit_method": "",
                "default": 0.5,
                "min": 0.1,
                "max": 1.0,
            }
        ],
    }
    defaults, level = {"voxel": 0.5}, {"voxel": 0}
    min, max = {"voxel": 0.1}, {"voxel": 1.0}


def wait():
    sys.stdin.read()
    rospy.signal_shutdown("the test has ended")


rospy.init_node("robot", disable_signals=True)
Server(Parameters, lambda config, _: config)
threading.Thread(target=wait, daemon=True).start()
sys.stdout.write("ready\n")
sys.stdout.flush()
rospy.spin()
