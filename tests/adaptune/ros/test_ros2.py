import contextlib
import queue
import re
import shutil
import subprocess
import sys
import threading
import time

import drives
import local_link
import needs
import numpy as np
import pytest
import ros2_node
from commands import refused

from adaptune.ros.link import BusyError, LinkError
from adaptune.ros.ros2 import local_ros2, message_types
from adaptune.space import Selection
from adaptune.study.config import SteerConfig
from adaptune.trajectory import read_tum
from offline.config import load_study
from online.robot import RobotDrive
from online.steered import SteeredNode
from online.topics import RosMessages

pytestmark = pytest.mark.services

STORE = message_types()
HASH = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
"""That of point clouds, as ROS 2 Jazzy has it."""


@pytest.fixture(scope="module", autouse=True)
def domain():
    """A ROS domain in which no test needs multicast, nor hears another."""
    needs.needs("cyclonedds", "ros2")
    with pytest.MonkeyPatch.context() as patch:
        domain = ros2_node.free_domain()
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        yield domain


@pytest.fixture(scope="module")
def link(domain):
    """A link that sees the node of a robot, which is in a process of its own."""
    command = [sys.executable, ros2_node.__file__, str(domain)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE)
    made = local_ros2()
    try:
        until(lambda: process.poll() is None and "/deaf/set_parameters" in made._places())
        yield made
    finally:
        made.close()
        process.stdin.close()
        try:
            process.wait(5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@pytest.fixture
def dds():
    from adaptune.ros import dds

    return dds


@pytest.fixture
def alone(dds, monkeypatch):
    """Make links in a domain of their own."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros2_node.free_domain()))
    made = []

    def make():
        made.append(dds.DdsLink())
        return made[-1]

    yield make
    for each in made:
        each.close()


def until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


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
        # Until the robot has found the topic; the first message may come back twice.
        while back is None or back.header.stamp.sec < n:
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


def test_a_node_that_is_not_there_or_does_not_answer_is_named(link, domain):
    words = f"in ROS domain {domain}; the services there are /deaf/.*, /robot/slam/"
    with pytest.raises(LinkError, match=f"/other does not answer: .* {words}"):
        link.set_parameters("/other", {"voxel_size": 1.0})
    words = "/deaf does not answer: /deaf/set_parameters .*; it is there, but busy, and may"
    with pytest.raises(BusyError, match=words):
        link.set_parameters("/deaf", {"voxel_size": 1.0})


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


def test_type_hashes_are_those_of_ros(alone):
    from cyclonedds.qos import Policy

    link, other = alone(), alone()
    link.advertise("/clouds", ros2_node.POINTS)
    until(lambda: [e.topic for e in other.endpoints(0)] == ["/clouds"])
    (found,) = other.endpoints(0)
    assert found.qos[Policy.Userdata].data == f"typehash={HASH};".encode()


def test_it_is_seen_as_ros_sees_nodes_until_it_leaves(alone):
    link, other = alone(), alone()
    node, told = ros2_node.DdsNode(link.domain), queue.SimpleQueue()
    info = "rmw_dds_common/msg/ParticipantEntitiesInfo"
    node.subscribe("ros_discovery_info", info, told.put, latched=True)
    publish = link.advertise("/a", "std_msgs/msg/String")
    link.subscribe("/b", "std_msgs/msg/String", print)
    seen = None
    while seen is None or seen.gid.data.tobytes() != link._participant.guid.bytes:
        (seen,) = (message := told.get(timeout=5.0)).node_entities_info_seq or [None]
        seen = message if seen and seen.reader_gid_seq and seen.writer_gid_seq else None
    (named,) = seen.node_entities_info_seq
    assert (named.node_namespace, named.node_name) == ("/", "adaptune")
    until(lambda: other.why_unheard("/b") == "" and "/a" in other.topics())
    (end,) = (e for e in other.endpoints(0) if e.topic == "/a")
    assert end.node == "/adaptune"
    link.close()
    until(lambda: other.why_unheard("/b") and "/a" not in other.topics())
    with pytest.raises(LinkError, match="/a: the link was closed"):
        publish(STORE.types["std_msgs/msg/String"]("late"))


@pytest.mark.parametrize("foreign", [False, True])
def test_services_of_other_vendors_have_no_header(alone, dds, monkeypatch, foreign):
    monkeypatch.setattr(dds, "_CYCLONE", b"\x01\x12")  # the node is of Cyclone, then
    link = alone()
    node = ros2_node.DdsNode(link.domain, bare=True)
    parameters = ros2_node.Parameters(node)
    parameters.held["other"] = None
    for name, kind in (("set", ros2_node.SET), ("get", ros2_node.GET), ("list", ros2_node.LIST)):
        answer = getattr(parameters, name)
        # Somebody else asked, too, and is answered before.
        empty = node.type_named(f"{kind}_Response")([]) if foreign and name != "list" else None
        node.serve(f"/slam/{name}_parameters", kind, answer, empty)
    given = {"voxel_size": 0.5, "threads": 4}
    assert link.set_parameters("slam", given) == given
    del parameters.held["other"]
    assert link.parameters("slam") == given


@pytest.mark.parametrize("bare", [False, True])
@pytest.mark.parametrize("brief", [False, True])
def test_a_node_that_is_busy_gets_the_newest_set_at_once(alone, dds, monkeypatch, bare, brief):
    """One thread runs its services, as an executor that works on a cloud."""
    link = alone()
    node = ros2_node.DdsNode(link.domain, bare=bare)
    if bare:
        monkeypatch.setattr(dds, "_CYCLONE", b"\x01\x12")
    parameters, busy, came = ros2_node.Parameters(node), threading.Lock(), []

    def serve(name, kind, answer):
        def when_free(request):
            with busy:
                return answer(request)

        node.serve(f"/slam/{name}_parameters", kind, when_free)

    serve("set", ros2_node.SET, parameters.set)
    serve("get", ros2_node.GET, parameters.get)
    node.watch("/slam/set_parameters", ros2_node.SET, came.append)
    steered = SteeredNode(link, SteerConfig(node="/slam", odometry="/odom"), "/points")

    def ask(trial, voxel_size):
        n = len(came)
        steered.apply(Selection(trial, {"voxel_size": voxel_size}))
        until(lambda: len(came) > n)

    ask(0, 0.5)
    assert steered.confirmed(20.0)
    monkeypatch.setattr(dds, "_ANSWER", 0.1 if brief else 1e3)
    with busy:
        ask(1, 0.25)
        ask(0, 0.5)  # nobody has answered the one before
        assert not steered.confirmed()
        if brief:  # it asks again
            n = len(came)
            until(lambda: len(came) > n)
    assert steered.confirmed(20.0)
    assert parameters.held["voxel_size"].double_value == 0.5
    steered.apply(Selection(1, {"voxel_size": 0.25}))
    assert steered.confirmed(20.0)
    assert parameters.held["voxel_size"].double_value == 0.25


def test_two_that_publish_a_topic_are_named_once(alone, caplog):
    link, other = alone(), alone()
    node, came = ros2_node.DdsNode(link.domain), queue.SimpleQueue()
    kind = "std_msgs/msg/String"
    link.subscribe("/odom", kind, came.put)
    senders = [other.advertise("/odom", kind), node.publisher("/odom", kind)]
    for sender in (*senders, *senders, *senders):
        message = STORE.types[kind]("a")
        while True:  # until they have found each other
            sender(message)
            with contextlib.suppress(queue.Empty):
                came.get(timeout=0.5)
                break
    said = "/odom is published by two (/adaptune and a node), whose messages mix; end one of them"
    assert caplog.messages == [said]


def test_it_says_why_nobody_hears(alone, dds, monkeypatch):
    link = alone()
    node = ros2_node.DdsNode(link.domain)
    publish = link.advertise("/points", ros2_node.POINTS)
    assert link.why_unheard("/points") == "nobody else subscribes to /points"
    node.subscribe("/points", ros2_node.POINTS, print)
    until(lambda: link.why_unheard("/points") == "")
    assert link.hearers("/points") == 1
    monkeypatch.setattr(dds, "_FAST_DDS", dds._CYCLONE)
    words = "a node runs on Fast DDS, which loses clouds .* -w net.core.rmem_default=4194304` on it"
    assert re.match(words, link.why_unheard("/points"))
    node.subscribe("/points", ros2_node.ODOMETRY, print)
    words = f"a node subscribes to /points as {ros2_node.ODOMETRY}, not {ros2_node.POINTS}"
    until(lambda: link.why_unheard("points") == words)
    del publish


def test_a_subscriber_that_wants_another_qos_is_named(alone):
    link = alone()
    node = ros2_node.DdsNode(link.domain)
    link.advertise("/points", ros2_node.POINTS)
    node.subscribe("rt/points", ros2_node.POINTS, print, latched=True)
    words = "a node wants /points transient local, with what was published before it came"
    until(lambda: link.why_unheard("/points").startswith(words))
    link.advertise("/tf_static", "tf2_msgs/msg/TFMessage")
    node.subscribe("rt/tf_static", "tf2_msgs/msg/TFMessage", print, latched=True)
    until(lambda: link.hearers("/tf_static") == 1)


def test_a_small_receive_buffer_is_told(alone, dds, monkeypatch, caplog):
    monkeypatch.setattr(dds, "_receive_buffer", lambda: 212_992)
    link = alone()
    link.subscribe("/odom", ros2_node.ODOMETRY, print)
    assert not caplog.messages
    link.subscribe("/points", ros2_node.POINTS, print)
    assert "/points: clouds may be lost, as this machine receives 212 kB ahead" in caplog.text
    assert "sudo sysctl -w net.core.rmem_max=4194304" in caplog.text


@pytest.mark.parametrize(
    ("given", "there", "lacking"),
    [
        ({}, ['address="localhost"', "<ParticipantIndex>auto"], ["AllowMulticast"]),
        ({"RANGE": "localhost"}, ["<AllowMulticast>false", 'address="localhost"'], ["<Tag>"]),
        ({"RANGE": "OFF"}, ["<AllowMulticast>false", "<Tag>"], []),
        ({"RANGE": "SYSTEM_DEFAULT"}, [], ["Discovery", "AllowMulticast"]),
        ({"PEERS": "10.0.0.1; 10.0.0.2"}, ['address="10.0.0.1"', 'address="10.0.0.2"'], []),
        ({"ONLY": "1", "PEERS": "10.0.0.1"}, ["<AllowMulticast>false"], ["10.0.0.1"]),
        ({"URI": "<CycloneDDS/>"}, ["</CycloneDDS>,<CycloneDDS/>"], []),
    ],
)
def test_others_are_found_as_ros_is_told(dds, monkeypatch, given, there, lacking):
    names = {
        "RANGE": "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "PEERS": "ROS_STATIC_PEERS",
        "ONLY": "ROS_LOCALHOST_ONLY",
        "URI": "CYCLONEDDS_URI",
    }
    for key, name in names.items():
        monkeypatch.delenv(name, raising=False)
        if key in given:
            monkeypatch.setenv(name, given[key])
    found = dds._configuration()
    assert all(word in found for word in there)
    assert not any(word in found for word in lacking)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros2_node.free_domain()))
    dds.DdsLink().close()  # Cyclone takes it


def test_what_ros_does_not_know_is_refused(dds, monkeypatch):
    domain = ros2_node.free_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "WORLD")
    words = "ROS_AUTOMATIC_DISCOVERY_RANGE is WORLD; it is SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT"
    with pytest.raises(LinkError, match=words):
        dds.DdsLink()
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_STATIC_PEERS", "127.0.0.1;no.such.host.invalid")
    with pytest.raises(LinkError, match=r"ROS_STATIC_PEERS: no\.such\.host\.invalid: "):
        dds.DdsLink()
    monkeypatch.delenv("ROS_STATIC_PEERS")
    monkeypatch.setenv("CYCLONEDDS_URI", "<CycloneDDS><Nonsense")
    with pytest.raises(LinkError, match=f"ROS domain {domain}: DDS does not start; see CYC"):
        dds.DdsLink()


def test_an_unknown_type_is_refused(link):
    with pytest.raises(LinkError, match="/a: the message type a_msgs/msg/A is not known"):
        link.subscribe("/a", "a_msgs/msg/A", print)
    with pytest.raises(LinkError, match="/a#b: "):
        link.advertise("/a#b", ros2_node.POINTS)


def test_another_type_than_what_is_published_is_refused(link):
    told = "/points is published as sensor_msgs/msg/PointCloud2.*, not as nav_msgs/msg/Odometry"
    with pytest.raises(LinkError, match=f"^{told}"):
        link.subscribe("/points", ros2_node.ODOMETRY, print)


@pytest.mark.usefixtures("link")
def test_no_messages_come_after_it_is_closed():
    threads = threading.active_count()
    link, came = local_ros2(), queue.SimpleQueue()
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


@pytest.mark.usefixtures("link")
def test_another_domain_is_another_world(alone, monkeypatch, study_file, tmp_path):
    assert not alone().topics()
    for name in ("seven", "-1", "233"):
        monkeypatch.setenv("ROS_DOMAIN_ID", name)
        with pytest.raises(LinkError, match=f"ROS_DOMAIN_ID is {name}; it is a number from 0 to"):
            local_ros2()
    command = "online", study_file, "--folder", tmp_path / "run", "--ros2", "--untrained"
    assert "ROS_DOMAIN_ID is 233; it is a number from 0 to 232" in refused(*command)


def test_it_drives(link, study_file, trained_folder, tmp_path):
    folder = shutil.copytree(trained_folder, tmp_path / "run")
    patient = ["online.real_time={deadline: 60, queue: 0}", "online.ros.points=/velodyne"]
    study = load_study(study_file, patient, folder)
    drive = RobotDrive(study, "fixed", study.model_path)
    scans, poses = drives.scans(2, 15), []
    cloud = link.advertise("/velodyne", "sensor_msgs/msg/PointCloud2")
    link.subscribe("/adaptune/odometry", "nav_msgs/msg/Odometry", poses.append)
    other = local_ros2()

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

    drive.run(other)
    playing.join(10.0)
    assert len(poses) == len(scans)
    other.close()
    trajectory = read_tum(drive.folder / "trajectory.tum")
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
