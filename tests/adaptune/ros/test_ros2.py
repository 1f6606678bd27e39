import contextlib
import os
import queue
import shutil
import socket
import subprocess
import sys
import threading
import time
from functools import partial

import drives
import local_link
import needs
import numpy as np
import pytest
import ros2_node

from adaptune.ros.link import LinkError
from adaptune.ros.ros2 import message_types, ros2_link
from adaptune.trajectory import read_tum
from offline.config import load_study
from online.live import RosMessages
from online.robot import RobotDrive

pytestmark = pytest.mark.services

STORE = message_types()
HASHES = {  # as ROS 2 Jazzy has them
    "SetParameters": "RIHS01_56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
    "GetParameters": "RIHS01_bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
    "PointCloud2": "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
}


@pytest.fixture(scope="module", autouse=True)
def _installed():
    needs.needs("zenoh_ros2_sdk", "ros2")
    needs.needs("cyclonedds", "ros2")
    with pytest.MonkeyPatch.context() as patch:
        # No test needs multicast, nor hears another.
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.delenv("ROS_DOMAIN_ID", raising=False)
        yield


def free_port():
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return bound.getsockname()[1]


@pytest.fixture(scope="module")
def port():
    return free_port()


@pytest.fixture(scope="module")
def router(port):
    import zenoh

    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    with zenoh.open(config) as session:
        yield session


@pytest.fixture(scope="module", params=["dds", "zenoh"])
def transport(request):
    return request.param


@pytest.fixture(scope="module")
def connect(transport, request):
    """What makes a link to the robot, in its domain or another."""
    if transport == "zenoh":
        from adaptune.ros.zenoh import ZenohLink

        request.getfixturevalue("router")
        return partial(ZenohLink, f"127.0.0.1:{request.getfixturevalue('port')}")
    from adaptune.ros.dds import DdsLink

    return DdsLink


@pytest.fixture(scope="module")
def domain(transport):
    return ros2_node.free_domain() if transport == "dds" else 0


@pytest.fixture(scope="module")
def robot(transport, connect, domain, request, tmp_path_factory):
    """The node of a robot, in a process of its own; a link that sees it."""
    where = [str(domain)]
    folder = tmp_path_factory.mktemp("definitions")
    if transport == "zenoh":
        where = [str(request.getfixturevalue("port")), str(folder)]
    # Nothing is downloaded; an attempt would leave the first of these folders.
    aside = {"ZENOH_ROS2_SDK_CACHE": str(folder / "cache"), "GIT_ALLOW_PROTOCOL": "none"}
    aside["ZENOH_CONFIG_OVERRIDE"] = "transport/shared_memory/enabled=false"
    aside["GIT_CONFIG_GLOBAL"] = str(folder / "gitconfig")
    process = subprocess.Popen(
        [sys.executable, ros2_node.__file__, transport, *where],
        stdin=subprocess.PIPE,
        env=os.environ | aside,
    )
    link = connect(domain=domain)
    try:
        until(lambda: process.poll() is None and "/deaf/set_parameters" in link._places())
        assert not (folder / "cache").exists()
        yield link
    finally:
        link.close()
        process.stdin.close()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def tokens(session, kind, name):
    keys = [str(r.ok.key_expr) for r in session.liveliness().get("@ros2_lv/0/**", timeout=2.0)]
    return [key for key in keys if f"/{kind}/" in key and f"%{name}" in key]


@pytest.fixture(scope="module")
def link(robot):
    return robot


def taken(link, topic, kind, n):
    messages = queue.SimpleQueue()
    link.subscribe(topic, kind, lambda m: messages.put((m, threading.current_thread())))
    return zip(*(messages.get(timeout=5.0) for _ in range(n)), strict=True)


def test_clouds_arrive_whole_in_order_and_in_a_thread_of_their_own(link):
    clouds, threads = taken(link, "/points", ros2_node.POINTS, 10)
    numbers = [cloud.header.stamp.sec for cloud in clouds]
    assert numbers == sorted(set(numbers))  # a busy machine may drop some
    for n, cloud in zip(numbers, clouds, strict=True):
        assert isinstance(cloud, STORE.types[ros2_node.POINTS])
        sent = ros2_node.cloud(STORE, n)
        assert STORE.serialize_cdr(cloud, ros2_node.POINTS) == STORE.serialize_cdr(
            sent, ros2_node.POINTS
        )
        assert cloud.data.base is not None  # a view
    assert len(set(threads)) == 1
    assert threads[0] is not threading.main_thread()


def odometry(n):
    position, quaternion = np.split(np.random.default_rng(n).normal(size=7), [3])
    return RosMessages(STORE, "odom").odometry(
        n * 10**9 + 999_999_999, (position.tolist(), quaternion.tolist()), "base_link", (0.1, 0.2)
    )


def test_the_robot_gets_what_is_published(link):
    echoed = queue.SimpleQueue()
    link.subscribe("robot/echo", ros2_node.ODOMETRY, echoed.put)
    publish = link.advertise("odometry", ros2_node.ODOMETRY)
    for n in range(5):
        back = None
        while back is None:  # until the robot has found the topic
            publish(odometry(n))
            with contextlib.suppress(queue.Empty):
                back = echoed.get(timeout=0.2 if n == 0 else 5.0)
        assert STORE.serialize_cdr(back, ros2_node.ODOMETRY) == STORE.serialize_cdr(
            odometry(n), ros2_node.ODOMETRY
        )


def test_parameters_are_set_and_read_back(link):
    given = {
        "deskew": True,
        "rate": 10,
        "voxel_size": 0.25,
        "frame": "odom",
        "max_range": np.float64(80.0),
        "threads": np.int32(2),
        "bounds": np.bool_(False),
    }
    held = link.set_parameters("/robot/slam", given)
    assert held == given
    assert [type(value) for value in held.values()] == [bool, int, float, str, float, int, bool]
    assert link.set_parameters("robot/slam", {"voxel_size": 0.5}) == {"voxel_size": 0.5}


def test_a_refusal_gives_the_reason(link):
    with pytest.raises(LinkError) as refused:
        link.set_parameters("/robot/slam", {"voxel_size": 1.0, "rings": 64})
    said = str(refused.value)
    assert said.startswith(f"/robot/slam refuses rings = 64 ({ros2_node.REASON}); it declares no r")
    with pytest.raises(LinkError, match="bounds = \\[1\\] is not a boolean, a number or a text"):
        link.set_parameters("/robot/slam", {"bounds": [1]})


@pytest.mark.parametrize("node", ["/other", "/deaf"])
def test_a_node_that_is_not_there_or_does_not_answer_is_named(link, node, domain):
    words = f"in ROS domain {domain}; the services there are /deaf/.*, /robot/slam/"
    with pytest.raises(LinkError, match=f"{node} does not answer: .* {words}"):
        link.set_parameters(node, {"voxel_size": 1.0})


def test_an_error_while_a_message_is_taken_is_logged_and_the_next_one_comes(link, caplog):
    came = queue.SimpleQueue()

    def take(message):
        came.put(message)
        if came.qsize() == 1:
            raise RuntimeError("a mistake")

    link.subscribe("/points", ros2_node.POINTS, take)
    for _ in range(3):
        came.get(timeout=5.0)
    assert "a message on /points is lost" in caplog.text
    assert "RuntimeError: a mistake" in caplog.text


@pytest.mark.parametrize("transport", ["zenoh"], indirect=True, scope="module")
def test_type_hashes_are_those_of_ros(router, robot):
    robot.advertise("odometry", ros2_node.ODOMETRY)
    assert robot.topics()["/odometry"] == ros2_node.ODOMETRY
    for token in tokens(router, "MP", "odometry"):
        assert "/%/%/adaptune/%odometry/nav_msgs::msg::dds_::Odometry_/" in token
    for service in ("Set", "Get"):
        name = f"{service}Parameters"
        # The service is called by this key above.
        (token,) = tokens(router, "SS", f"robot%slam%{service.lower()}_parameters/")
        assert f"/rcl_interfaces::srv::dds_::{name}_/{HASHES[name]}/" in token
    (token,) = tokens(router, "MP", "points")
    assert HASHES["PointCloud2"] == STORE.hash_rihs01(ros2_node.POINTS)
    assert f"/{HASHES['PointCloud2']}/" in token


def test_an_unknown_type_is_refused(link):
    with pytest.raises(LinkError, match="/a: the message type a_msgs/msg/A is not known"):
        link.subscribe("/a", "a_msgs/msg/A", print)
    with pytest.raises(LinkError, match="/a#b: "):
        link.advertise("/a#b", ros2_node.POINTS)


def test_another_type_than_what_is_published_is_refused(link):
    told = "/points is published as sensor_msgs/msg/PointCloud2.*, not as nav_msgs/msg/Odometry"
    with pytest.raises(LinkError, match=f"^{told}"):
        link.subscribe("/points", ros2_node.ODOMETRY, print)


@pytest.mark.usefixtures("robot")
def test_no_messages_come_after_it_is_closed(connect, domain):
    threads = threading.active_count()
    link, came = connect(domain=domain), queue.SimpleQueue()
    link.subscribe("/points", ros2_node.POINTS, came.put)
    came.get(timeout=5.0)
    link.close()
    link.close()
    n = came.qsize()
    time.sleep(0.1)
    assert came.qsize() == n
    assert threading.active_count() == threads
    for use in (link.topics, lambda: link.set_parameters("/robot/slam", {"voxel_size": 1.0})):
        with pytest.raises(LinkError, match="closed"):
            use()


@pytest.mark.usefixtures("robot")
def test_another_domain_is_another_world(connect, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "77")
    link = connect()
    assert not link.topics()
    link.close()
    for name in ("seven", "-1", "233"):
        monkeypatch.setenv("ROS_DOMAIN_ID", name)
        with pytest.raises(LinkError, match=f"ROS_DOMAIN_ID is {name}; it is a number "):
            connect()


def test_a_router_must_answer():
    words = r"no Zenoh router answers at .*rmw_zenohd.*7447"
    with pytest.raises(LinkError, match=words) as told:
        ros2_link(f"127.0.0.1:{free_port()}")
    assert ".rs:" not in str(told.value)


def test_it_drives(link, connect, domain, study_file, trained_folder, tmp_path):
    folder = shutil.copytree(trained_folder, tmp_path / "run")
    patient = ["online.real_time={deadline: 60, queue: 0}", "online.ros.points=/velodyne"]
    study = load_study(study_file, patient, folder)
    drive = RobotDrive(study, "fixed", study.model_path)
    scans, poses = drives.scans(2, 15), []
    cloud = link.advertise("/velodyne", "sensor_msgs/msg/PointCloud2")
    link.subscribe("/adaptune/odometry", "nav_msgs/msg/Odometry", poses.append)
    other = connect(domain=domain)

    def play():
        end = time.monotonic() + 30.0
        for n, (stamp, xyz, _) in enumerate(scans, 1):
            message = of_ros_2(local_link.cloud(stamp, xyz))
            # A message may be lost on a busy machine. One that comes again is ignored.
            while len(poses) < n and time.monotonic() < end:
                cloud(message)
                time.sleep(0.05)
        drive.stop()

    playing = threading.Thread(target=play, daemon=True)
    playing.start()

    found = drive.run(other)
    playing.join(10.0)
    assert len(poses) == len(scans)
    other.close()
    trajectory = read_tum(found.folder / "trajectory.tum")
    moved = [one.pose.pose.position.x for one in poses]
    np.testing.assert_allclose(moved, trajectory.T_world_sensor[:, 0, 3], atol=1e-6)
    np.testing.assert_allclose(moved, 0.3 * np.arange(len(scans)), atol=0.1)


def of_ros_2(cloud):
    types, kind = STORE.types, "sensor_msgs/msg/PointCloud2"
    stamp = types["builtin_interfaces/msg/Time"](cloud.header.stamp.sec, cloud.header.stamp.nanosec)
    header = types["std_msgs/msg/Header"](stamp, cloud.header.frame_id)
    field = types["sensor_msgs/msg/PointField"]
    fields = [field(one.name, one.offset, one.datatype, one.count) for one in cloud.fields]
    n = cloud.width
    return types[kind](header, 1, n, fields, False, 12, 12 * n, cloud.data, True)
