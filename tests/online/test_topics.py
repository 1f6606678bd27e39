import json
import math
import time

import local_link
import numpy as np
import pytest
import rec
from rosbags.typesys import Stores, get_typestore

from adaptune.recording.clouds import CLOUDS
from adaptune.recording.config import ImuConfig
from adaptune.recording.timing import Timing
from adaptune.ros.link import LinkError
from adaptune.space import Selection
from online import topics
from online.topics import UNKNOWN_ERROR, RosMessages, TopicScans, Uncertainty, placed

TENTH = 10**8
START = 1_700_000_000 * 10**9


def points(i):
    return np.random.default_rng(i).normal(5.0, 1.0, (50, 3)).astype(np.float32)


@pytest.fixture
def link():
    return local_link.LocalLink()


def topic(link, queue=0, imu=None):
    return TopicScans(link, "/points", Timing(), queue, imu)


def play(link, numbers):
    for i in numbers:
        link.play("/points", local_link.cloud(START + i * TENTH, points(i)))


def numbers(scans):
    """Play what waits to its end; the scans by their numbers."""
    found = []
    # What is to come ends the iteration.
    for arrival in scans.arrivals():
        found.append(round((arrival.scan.stamp - START) / TENTH))
        if not scans._waiting:
            scans.stop()
    return found


def test_scans_come_as_they_are(link):
    scans = topic(link)
    play(link, range(3))
    arrivals = []
    for arrival in scans.arrivals():
        arrivals.append(arrival)
        if len(arrivals) == 3:
            scans.stop()
    for i, (scan, due, dropped) in enumerate(arrivals):
        np.testing.assert_array_equal(scan.points, points(i))
        assert scan.stamp == START + i * TENTH
        assert due <= time.perf_counter()
        assert dropped == 0
    assert scans.frame == "lidar"


def test_doubled_and_reordered_scans_are_ignored_and_missing_ones_are_missed(link):
    scans = topic(link)
    play(link, [0, 1, 1, 2, 4, 3, 4, 9])
    assert numbers(scans) == [0, 1, 2, 4, 9]


def test_the_newest_wait(link):
    scans = topic(link, queue=2)
    play(link, range(5))
    first = next(scans.arrivals())
    assert (round((first.scan.stamp - START) / TENTH), first.dropped) == (3, 3)


def test_those_dropped_before_a_doubled_one_count_with_the_next(link):
    scans = topic(link, queue=2)
    play(link, [0, 1])
    arrivals = scans.arrivals()
    assert [next(arrivals).dropped for _ in range(2)] == [0, 0]
    play(link, [2, 3, 1, 4])
    assert next(arrivals).dropped == 2


@pytest.mark.parametrize("kind", [*CLOUDS])
@pytest.mark.parametrize("late", [False, True])
def test_every_type_of_clouds_is_read_also_where_its_driver_starts_late(
    link, monkeypatch, kind, late
):
    monkeypatch.setattr(topics, "SILENCE", 0.01)
    link.clouds = kind
    cloud = local_link.cloud(START, points(0))
    if "livox" in kind:
        cloud = rec.livox(link.store, kind, points(0), START)
    there, nobody, subscribe = link.topics, iter([{}] * late), link.subscribe
    link.topics = lambda: next(nobody, None) or there()

    def subscribed(topic, of, take, raw):
        subscribe(topic, of, take, raw)
        if of == kind:
            link.play(topic, cloud)

    link.subscribe = subscribed
    scans = topic(link)
    scan = next(scans.arrivals()).scan
    np.testing.assert_array_equal(scan.points, points(0))
    assert scan.stamp == START
    assert scans.frame in ("lidar", "x")


def test_a_topic_of_another_type_is_refused(link):
    link.clouds = "sensor_msgs/msg/Image"
    with pytest.raises(LinkError, match=r"/points is sensor_msgs/msg/Image; name a topic of point"):
        topic(link)


def test_what_is_no_point_cloud_is_left_out(link, caplog):
    scans = topic(link)
    play(link, [0])
    link.play("/points", local_link.cloud(START + TENTH, points(1), names="abc"))
    short = local_link.cloud(START + TENTH, points(1))
    short.data = short.data[:100]
    link.play("/points", short)
    play(link, [2])
    assert numbers(scans) == [0, 2]
    assert "no field x, y, z; there is a, b, c; the scan is left out" in caplog.text


def test_a_topic_that_falls_silent_and_comes_back(link, caplog, monkeypatch):
    monkeypatch.setattr(topics, "SILENCE", 0.01)
    scans, there, asked = TopicScans(link, "/other", Timing()), link.topics(), []

    def look():
        asked.append(0)
        if len(asked) == 4:
            link.play("/other", local_link.cloud(START, points(0)))
        return there

    link.topics = look
    next(scans.arrivals())
    *silent, again = caplog.records
    hint = "; nobody publishes it (point clouds come on /points)"
    assert silent[0].getMessage() == f"/other: no scan for 0 s{hint}"
    # Again after twice as long.
    assert [one.args[1] for one in silent] == pytest.approx([0.01, 0.02, 0.04, 0.08])
    assert again.getMessage().startswith("/other: scans come again, after ")


def test_scans_bring_along_what_the_imu_measured(link, monkeypatch):
    monkeypatch.setattr(topics, "IMU_WAIT", 0.01)
    settings = ImuConfig(topic="/imu", unit="g")
    scans = topic(link, imu=settings)
    for i in range(-50, 250):
        link.play("/imu", local_link.imu(START + i * 10**6, rate=float(i)))
    play(link, range(3))
    found = []
    for arrival in scans.arrivals():
        found.append(arrival.scan.imu)
        if len(found) == 3:
            scans.stop()
    # All but the first, up to the first measurement at the scan or after it.
    rates = [imu.angular_velocity[:, 2].tolist() for imu in found]
    assert rates[0][-1] == 0.0
    assert rates[1] == list(range(1, 101))
    assert rates[2] == list(range(101, 201))
    assert found[1].acceleration[0, 2] == pytest.approx(9.80665 * 9.81)


def test_an_imu_that_is_silent_does_not_hold_up_the_scans(link, monkeypatch):
    monkeypatch.setattr(topics, "IMU_WAIT", 0.01)
    scans = topic(link, imu=ImuConfig(topic="/imu"))
    play(link, range(2))
    for i, arrival in enumerate(scans.arrivals()):
        assert len(arrival.scan.imu) == 0
        if i == 1:
            scans.stop()


MESSAGES = RosMessages(local_link.STORE, "odom")


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
    messages = RosMessages(store, "odom")
    selection = Selection(3, {"voxel": 0.5}, state="lost", why="no pose for 2.0 s")
    for made in (
        messages.diagnostics(5, "/odom", 2, "no pose for 2.0 s", {"state": "lost"}),
        messages.odometry(5, *placed(np.eye(4)[None]), "lidar", (0.1, 0.2)),
        messages.transform(5, *placed(np.eye(4)[None]), "lidar"),
        messages.selection(5, selection, ""),
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
