"""A robot's node on Zenoh, which runs on, made of what the package itself has for nodes.

It publishes point clouds, says the odometry that it gets again on another topic, and has
parameters: it accepts all but `rings`. It ends when its input does.
"""

import sys
import threading
from pathlib import Path

import numpy as np
import rec
from rosbags.typesys import Stores, get_typestore

HZ = 50
POINTS = "sensor_msgs/msg/PointCloud2"
ODOMETRY = "nav_msgs/msg/Odometry"
SET, GET = "rcl_interfaces/srv/SetParameters", "rcl_interfaces/srv/GetParameters"
REASON = "parameter 'rings' cannot be set because it is read-only"
SERVICES = {
    SET: ("rcl_interfaces/Parameter[] parameters", "rcl_interfaces/SetParametersResult[] results"),
    GET: ("string[] names", "rcl_interfaces/ParameterValue[] values"),
}


def cloud(store, n):
    """The cloud of a number: of as many bytes as a real one, more or less."""
    rows = np.random.default_rng(n).integers(0, 256, (30_000 + n % 7, 12), np.uint8)
    points = rows.view([(axis, "<f4") for axis in "xyz"])[:, 0]
    return rec.cloud(points, n * 10**9 + 999_999_999, store)


def write_definitions(folder, *messages):
    """Write definitions as files, so that none is downloaded."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for message in messages:
        head, *others = store.generate_msgdef(message, ros_version=2)[0].split("=" * 80 + "\n")
        texts = {message: head}
        for other in others:
            name, _, text = other.removeprefix("MSG: ").partition("\n")
            texts[name.replace("/", "/msg/")] = text
        for name, text in texts.items():
            file = folder / f"{name}.msg"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)


class Parameters:
    def __init__(self, store, session):
        self.store, self.session, self.held = store, session, {}

    def type_named(self, name):
        return self.store.types[self.session._registered_types[name]]

    def set(self, request):
        results = []
        for given in request.parameters:
            accepted = given.name != "rings"
            if accepted:
                self.held[given.name] = given.value
            result = self.store.types["rcl_interfaces/msg/SetParametersResult"]
            results.append(result(successful=accepted, reason="" if accepted else REASON))
        return self.type_named(f"{SET}_Response")(results=results)

    def get(self, request):
        values = [self.held[name] for name in request.names]
        return self.type_named(f"{GET}_Response")(values=values)


def main(port, folder):
    from zenoh_ros2_sdk import (
        ROS2Publisher,
        ROS2ServiceServer,
        ROS2Subscriber,
        ZenohSession,
        get_registry,
    )

    folder = Path(folder)
    used = [f"rcl_interfaces/msg/{name}" for name in ("Parameter", "SetParametersResult")]
    write_definitions(folder, POINTS, ODOMETRY, *used)
    session = ZenohSession.get_instance("127.0.0.1", int(port))
    registry = get_registry(str(folder))
    for name in used:
        registry.load_message_type(name)
    parameters = Parameters(session.store, session)
    points, echo = ROS2Publisher("/points", POINTS), ROS2Publisher("/robot/echo", ODOMETRY)

    def serve(name, kind, callback=None):
        mode = "callback" if callback else "queue"
        # With the definitions it looks for no file, and so downloads none.
        return ROS2ServiceServer(name, kind, callback, *SERVICES[kind], mode=mode)

    kept = [
        ROS2Subscriber("/odometry", ODOMETRY, lambda message: echo.publish(**vars(message))),
        serve("/robot/slam/set_parameters", SET, parameters.set),
        serve("/robot/slam/get_parameters", GET, parameters.get),
        serve("/robot/slam/set_parameters_atomically", SET),
        serve("/deaf/set_parameters", SET),
    ]
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    n = 0
    while not ended.wait(1.0 / HZ):
        points.publish(**vars(cloud(session.store, n)))
        n += 1
    for each in (points, echo, *kept):
        each.close()
    session.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
