"""What a container of a ROS 1 image runs: the roscore, and a node that passes messages on.

Run by the Python of the image's ROS, as `ros1_node`, which is beside it. Ends with the socket.
"""

import socket
import sys
import uuid

import ros1_node

try:
    from typing import Any
except ImportError:
    pass


def _start_master(asked):  # type: (dict[str, set[str]]) -> None
    """Start a roscore that notes which node asks for which parameter."""
    import rosmaster.master
    import rosmaster.master_api as api

    class Noting(api.ROSMasterHandler):  # type: ignore[misc]
        pass

    def noting(plain):  # type: (Any) -> Any
        def answer(self, caller, key):  # type: (Any, str, str) -> Any
            asked.setdefault(caller, set()).add(key)
            return plain(self, caller, key)

        return answer

    for name in ("getParam", "hasParam", "searchParam"):
        setattr(Noting, name, noting(getattr(api.ROSMasterHandler, name)))
    plain = api.ROSMasterHandler.subscribeParam

    def subscribe(self, caller, uri, key):  # type: (Any, str, str, str) -> Any
        asked.setdefault(caller, set()).add(key)
        return plain(self, caller, uri, key)

    Noting.subscribeParam = subscribe
    api.ROSMasterHandler = Noting
    rosmaster.master.Master().start()


def main(path, use_sim_time):  # type: (str, str) -> None
    """Start a roscore, connect to adaptune, and pass messages on."""
    import rosgraph

    asked = {}  # type: dict[str, set[str]]
    _start_master(asked)
    master = rosgraph.Master("/adaptune")
    if use_sim_time:
        master.setParam("/use_sim_time", use_sim_time == "true")
    # roslaunch waits for it.
    master.setParam("/run_id", str(uuid.uuid1()))
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.connect(path)

    def found(_):  # type: (dict[str, Any]) -> dict[str, list[str]]
        return {caller: sorted(keys) for caller, keys in dict(asked).items()}

    ros1_node.converse(ros1_node.Stream(connection), "adaptune", {"asked": found})


if __name__ == "__main__":
    try:
        import rosmaster
        import rospy
    except ImportError:
        sys.exit(9)  # another Python may
    main(*sys.argv[1:])
