import json
import math

import local_link
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from adaptune.space import Selection
from online.live import UNKNOWN_ERROR, RosMessages, Uncertainty, placed
from online.replay import Choice, ReplayRecord

MESSAGES = RosMessages(local_link.STORE, "odom")


def record(selection):
    made = ReplayRecord(1.0, dropped=3, late=[0.5, 0.0123])
    if selection is not None:
        made.note(Choice(0, selection, 0.0))
    return made


def ahead(metres):
    T = np.eye(4)
    T[0, 3] = metres
    return T


@pytest.mark.parametrize(
    ("selection", "percent"),
    [
        (None, UNKNOWN_ERROR),
        (Selection(1, {}), UNKNOWN_ERROR),
        (Selection(1, {}, predicted_error=2.0), 2.0),
        (Selection(1, {}, predicted_error=2.0, estimated_error=3.0), 3.0),
    ],
)
def test_over_a_sub_trajectory_the_uncertainty_is_the_error(selection, percent):
    uncertainty = Uncertainty(25.0)
    if selection is not None:
        uncertainty.learn(selection)
    for _ in range(50):
        uncertainty.move(ahead(0.5))
    assert math.sqrt(uncertainty.position) == pytest.approx(25.0 * 1e-2 * percent)
    assert math.sqrt(uncertainty.rotation) == pytest.approx(1e-2 * percent)
    # Errors are independent: four times the way is twice as uncertain.
    uncertainty.move(ahead(75.0))
    assert math.sqrt(uncertainty.position) == pytest.approx(50.0 * 1e-2 * percent)
    uncertainty.move(ahead(np.nan))
    assert math.isfinite(uncertainty.position)


def test_a_pose_with_its_stamp():
    T = ahead(3.0)
    T[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    stamp = 1_700_000_000_123_456_789
    found = MESSAGES.odometry(stamp, *placed(T[None]), "lidar")
    assert (found.header.stamp.sec, found.header.stamp.nanosec) == divmod(stamp, 10**9)
    q = found.pose.pose.orientation
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    assert found.twist.covariance[0] == -1.0


def test_all_messages_are_those_of_ros_2_too():
    store = get_typestore(Stores.ROS2_JAZZY)
    messages, selection = RosMessages(store, "odom"), Selection(3, {"voxel": 0.5}, lost=True)
    for made in (
        messages.odometry(5, *placed(np.eye(4)[None]), "lidar", (0.1, 0.2)),
        messages.transform(5, *placed(np.eye(4)[None]), "lidar"),
        messages.selection(5, selection, ""),
        messages.diagnostics(5, record(selection), 0, late=True, restarted=False),
    ):
        raw = store.serialize_cdr(made, made.__msgtype__)
        found = store.deserialize_cdr(raw, made.__msgtype__)
        assert store.serialize_cdr(found, made.__msgtype__) == raw


def test_what_is_not_known_is_null():
    text = MESSAGES.selection(5, Selection(3, {"voxel": 0.5}), "too late").data
    found = json.loads(text)
    assert found["predicted_error"] is found["estimated_error"] is found["weights"] is None
    assert (found["trial"], found["parameters"], found["why_not"]) == (
        3,
        {"voxel": 0.5},
        "too late",
    )


@pytest.mark.parametrize(
    ("selection", "since", "level", "said"),
    [
        (None, (False, False), 0, "keeps up"),
        (None, (True, False), 1, "was too late"),
        (None, (True, True), 2, "restarts for want of healthy poses"),
        (Selection(3, {}, lost=True), (True, True), 2, "is lost"),
    ],
)
def test_diagnostics(selection, since, level, said):
    late, restarted = since
    message = MESSAGES.diagnostics(0, record(selection), 4, late=late, restarted=restarted)
    (found,) = message.status
    assert (found.level, found.message) == (level, said)
    values = {one.key: one.value for one in found.values}
    assert values["pose after the scan [ms]"] == "12.3"
    assert values["ignored scans"] == "4"
    assert values["dropped scans"] == "3"
    assert ("trial" in values) == (selection is not None)
