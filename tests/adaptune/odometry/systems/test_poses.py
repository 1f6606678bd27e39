import local_link
import numpy as np
import pytest
from rooms import moved

from adaptune.geometry import invert, to_pose, to_quaternions
from adaptune.odometry.systems import ros_system
from adaptune.odometry.systems.ros_system import PoseReader, matrix
from adaptune.recording.pose_messages import TRANSFORMS
from adaptune.ros.ros2 import message_types

STORE = message_types()
KIND = TRANSFORMS[0]
ODOM_BASE, BASE_LIDAR = moved(3.0, 4.0, 0.5), to_pose((1, 0, 0.2, 0, 0, 0.6, 0.8))


class Link:
    """Stands for a link to ROS 2."""

    store = STORE

    def __init__(self):
        self.takes = {}

    def record(self, topic, take):
        self.takes[topic] = take

    def decode(self, data, kind):
        return STORE.deserialize_cdr(data, kind)

    def publish(self, topic, *transforms):
        types, all_ = STORE.types, []
        for stamp, parent, child, T in transforms:
            at = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
            translation = types["geometry_msgs/msg/Vector3"](*T[:3, 3])
            rotation = types["geometry_msgs/msg/Quaternion"](*to_quaternions(T[None])[0])
            header = types["std_msgs/msg/Header"](at, parent)
            transform = types["geometry_msgs/msg/Transform"](translation, rotation)
            all_.append(types["geometry_msgs/msg/TransformStamped"](header, child, transform))
        self.takes[topic](KIND, bytes(STORE.serialize_cdr(types[KIND](all_), KIND)))


@pytest.fixture
def heard():
    """A link, what it hears on /tf, and its reader."""

    def make(**given):
        link, found = Link(), []
        reader = PoseReader(link, "/tf", **given)
        reader.hear(lambda *of: found.extend(reader.read(*of)))
        return link, found, reader

    return make


@pytest.mark.parametrize("given", [False, True])
def test_transforms_are_followed_to_the_sensor(heard, given):
    fixed = {"lidar": ("base", BASE_LIDAR)} if given else None
    link, found, reader = heard(fixed=fixed)
    if not given:
        link.publish("/tf_static", (0, "base", "lidar", BASE_LIDAR))
    link.publish("/tf", (5, "map", "/odom", moved(10.0, 0.0)))
    assert not found  # nothing has moved the sensor yet
    link.publish("/tf", (6, "odom", "base", ODOM_BASE), (7, "base", "wheel", moved(0.0, 9.0)))
    link.publish("/tf", (8, "map", "odom", moved(11.0, 0.0)), (9, "base", "wheel", np.eye(4)))
    ((stamp, frame, p, q),) = found
    assert (stamp, frame) == (6, "map")
    np.testing.assert_allclose(matrix(p, q), moved(10.0, 0.0) @ ODOM_BASE @ BASE_LIDAR, atol=1e-9)
    assert reader.about == "lidar in map"
    assert not reader.lacking


def test_the_only_frame_that_moves_counts(heard):
    link, found, reader = heard()
    link.publish("/tf", (6, "odom", "body", ODOM_BASE))
    ((stamp, frame, p, q),) = found
    assert (stamp, frame, reader.about) == (6, "odom", "body in odom")
    np.testing.assert_allclose(matrix(p, q), ODOM_BASE, atol=1e-9)
    link.publish("/tf", (7, "body", "wheel", invert(ODOM_BASE)))
    assert len(found) == 1
    assert reader.lacking == (
        "/tf moves body, wheel, and does not say where lidar is; name the sensor's frame as "
        "odometry.settings.frame"
    )


@pytest.mark.parametrize(
    ("fixed", "transforms"),
    [
        ((), [("lidar", "odom", invert(ODOM_BASE @ BASE_LIDAR))]),
        ([("base", "lidar", BASE_LIDAR)], [("base", "odom", invert(ODOM_BASE))]),
        ([("lidar", "base", invert(BASE_LIDAR))], [("base", "odom", invert(ODOM_BASE))]),
        (
            [("base", "lidar", BASE_LIDAR)],
            [("base", "step", moved(1.0, 0.0)), ("step", "odom", moved(-1.0, 0.0))],
        ),
    ],
)
def test_an_inverted_tree_is_turned_round(heard, fixed, transforms):
    link, found, reader = heard()
    link.publish("/tf_static", *((0, *of) for of in fixed))
    link.publish("/tf", *((6, *of) for of in transforms))
    ((stamp, frame, p, q),) = found
    expected = ODOM_BASE if len(transforms) == 1 else np.eye(4)
    assert (stamp, frame) == (6, "odom")
    np.testing.assert_allclose(matrix(p, q), expected @ BASE_LIDAR, atol=1e-9)
    assert reader.about == "lidar in odom (the tree is inverted)"
    assert not reader.lacking
    # Of two, nobody knows which is the odometry's.
    link.publish("/tf", (7, transforms[0][0], "wheel", moved(0.0, 9.0)))
    assert len(found) == 1
    assert "moves odom, wheel below" in reader.lacking
    assert "let the system publish lidar below the frame of its odometry" in reader.lacking


def test_frames_that_do_not_move_and_circles_have_no_pose(heard):
    link, found, reader = heard()
    link.publish("/tf_static", (0, "base", "lidar", BASE_LIDAR))
    link.publish("/tf", (6, "odom", "other", ODOM_BASE))
    assert not found
    assert reader.lacking == "nothing on /tf moves lidar"
    link.publish("/tf", (7, "lidar", "base", ODOM_BASE))
    assert found  # of one frame in itself, which ends


def test_a_flood_is_told(heard, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    link, _, reader = heard()
    for n in range(3 * ros_system._FLOOD):
        now[0] = n / (0.9 * ros_system._FLOOD)
        link.publish("/tf")
    assert not reader.fault
    for _ in range(ros_system._FLOOD):
        link.publish("/tf")
    assert reader.fault == "it publishes more than 2000 messages a second on /tf"


def test_the_frame_of_an_odometry_is_known(heard):
    link, _, reader = heard()
    message = local_link.odometry(7, np.eye(4))
    kind = message.__msgtype__
    link.decode = local_link.STORE.deserialize_ros1
    link.takes["/tf"](kind, bytes(local_link.STORE.serialize_ros1(message, kind)))
    assert reader.about == f"{message.child_frame_id} in {message.header.frame_id}"
