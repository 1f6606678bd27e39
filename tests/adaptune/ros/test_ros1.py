import json
import os
import queue
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import drives
import local_link
import numpy as np
import pytest
from needs import needs_program

from adaptune._system import processes
from adaptune._system.keeper import descendants
from adaptune.ros import relay
from adaptune.ros.link import LinkError
from adaptune.ros.relay import Ros1, local_ros1, ros_python
from adaptune.trajectory import read_tum
from offline.config import load_study
from offline.train import train

pytestmark = pytest.mark.services

ROBOT = Path(drives.__file__).with_name("ros1_robot.py")
"""Only the Python of ROS can import it."""


@pytest.fixture(scope="module", autouse=True)
def master():
    needs_program("roscore", "ros1")
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        port = bound.getsockname()[1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{port}")
        patch.setenv("ROS_IP", "127.0.0.1")
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        core = subprocess.Popen(["roscore", "-p", str(port)], start_new_session=True, **quiet)
        try:
            yield core
        finally:
            os.killpg(core.pid, signal.SIGTERM)
            core.wait(20.0)


@pytest.fixture(scope="module")
def link(master):
    end = time.monotonic() + 30.0
    while True:
        assert master.poll() is None
        try:
            made = local_ros1()
            break
        except LinkError:
            assert time.monotonic() < end
            time.sleep(0.1)
    yield made
    made.close()


@pytest.fixture(scope="module")
def robot(link):  # noqa: ARG001
    process = subprocess.Popen(
        [ros_python(), str(ROBOT)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout.readline() == b"ready\n"
    yield "/robot"
    process.communicate()


def taken(link, topic, kind):
    messages = queue.SimpleQueue()
    link.subscribe(topic, kind, messages.put)
    return messages


def until(true, seconds=20.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def connected(link, topic, kind, message):
    """Publish until the first message arrives: rospy connects on its own time."""
    messages, publish = taken(link, topic, kind), link.advertise(topic, kind)
    until(lambda: publish(message) or not messages.empty())
    return messages, publish


def test_messages_arrive_whole(link):
    points = np.random.default_rng(0).normal(size=(100_000, 3)).astype(np.float32)
    sent = local_link.cloud(drives.FIRST_STAMP, points)
    messages, _ = connected(link, "/points", "sensor_msgs/msg/PointCloud2", sent)
    found = messages.get(timeout=5.0)
    assert link.store.serialize_ros1(found, found.__msgtype__) == local_link.STORE.serialize_ros1(
        sent, sent.__msgtype__
    )
    assert link.topics()["/points"] == "sensor_msgs/msg/PointCloud2"


def test_messages_of_another_type_are_ignored_and_named(link, caplog):
    imu = local_link.imu(0)
    connected(link, "/imu", "sensor_msgs/msg/Imu", imu)
    other = local_ros1()
    messages, publish = taken(other, "/imu", "sensor_msgs/msg/PointCloud2"), link.advertise
    publish = publish("/imu", "sensor_msgs/msg/Imu")
    until(lambda: publish(imu) or "/imu is sensor_msgs/msg/Imu, not" in caplog.text)
    assert messages.empty()
    other.close()


def test_parameters_are_set_while_a_node_runs(link, robot):
    assert link.set_parameters(robot, {"voxel": 0.25}) == {"voxel": 0.25}
    # The node holds to its bounds.
    assert link.set_parameters(robot, {"voxel": 7.0}) == {"voxel": 1.0}
    # What it does not know goes to the parameter server.
    assert link.set_parameters(robot, {"voxel": 0.5, "rings": 4}) == {"voxel": 0.5}
    get = ["rosparam", "get", "/robot/rings"]
    assert subprocess.run(get, capture_output=True, check=True, text=True).stdout == "4\n"


def test_a_node_that_is_not_there_is_named(link):
    with pytest.raises(LinkError, match="/nobody: unknown node"):
        link.set_parameters("/nobody", {"voxel": 0.5})


def test_without_a_roscore_it_says_so(monkeypatch):
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:9")
    with pytest.raises(LinkError, match=r"no roscore answers at .*127\.0\.0\.1:9; start `roscore`"):
        local_ros1()


def test_a_node_that_is_killed_is_noticed(link):
    before = descendants(os.getpid())
    other = local_ros1()
    assert other.alive
    publish = other.advertise("/lost", "std_msgs/msg/String")
    (process,) = set(descendants(os.getpid())) - set(before)
    os.kill(process, signal.SIGKILL)
    until(lambda: not other.alive)
    with pytest.raises(LinkError, match="adaptune's node has ended"):
        publish(local_link.TYPES["std_msgs/msg/String"]("lost"))
    with pytest.raises(LinkError):
        other.topics()
    other.close()
    assert link.alive


def test_a_node_that_reads_nothing_any_more_is_an_error(monkeypatch):
    monkeypatch.setattr(relay, "_DEAF", 0.2)
    here, there = socket.socketpair()
    processes.send(processes.SocketStream(there), {"type": "ready"})
    link = Ros1(here, lambda: True, there.close)
    publish = link.advertise("/points", "sensor_msgs/msg/PointCloud2")
    with pytest.raises(LinkError, match=r"has read nothing for 0\.2 s"):
        publish(local_link.cloud(0, np.zeros((1_000_000, 3), np.float32)))
    link.close()


def test_the_command_drives_until_ctrl_c(link, study_file, tmp_path):
    folder, given = tmp_path / "run", ["odometry.name=gicp", "offline.trials=4"]
    train(load_study(study_file, given, folder))
    extra = ["-o", given[0], "-o", given[1]]
    extra += ["-o", "online.ros.points=/velodyne", "-o", "online.ros.odometry=/found"]
    # Nothing is too late, also where the tests share a core.
    extra += ["-o", "online.real_time={deadline: 60, queue: 0}"]
    poses = taken(link, "/found", "nav_msgs/msg/Odometry")
    chosen = taken(link, "/adaptune/selection", "std_msgs/msg/String")
    cloud = link.advertise("/velodyne", "sensor_msgs/msg/PointCloud2")
    command = [sys.executable, "-m", "adaptune", "online", str(study_file), "--ros"]
    process = subprocess.Popen(
        [*command, "--folder", str(folder), *extra],
        stderr=subprocess.PIPE,
        # Processes in the background ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
        text=True,
        stdout=subprocess.PIPE,
    )
    try:
        until(lambda: "/adaptune/selection" in link.topics(), 60.0)
        # The first messages may be lost: rospy connects on its own time.
        for stamp, points, _ in drives.scans(2, 60):
            cloud(local_link.cloud(stamp, points))
            time.sleep(0.1)
        until(lambda: chosen.qsize() >= 4)
        process.send_signal(signal.SIGINT)
        said, log = process.communicate(timeout=30.0)
    except AssertionError:
        process.send_signal(signal.SIGINT)
        print(process.communicate()[1])  # noqa: T201
        raise
    finally:
        process.kill()
    assert process.returncode == 0, log
    (drive,) = (folder / "drives").iterdir()
    assert f"scans: {drive}/" in said or "dropped" in said
    found = read_tum(drive / "trajectory.tum")
    assert len(found) >= 30
    moved = found.T_world_sensor[-1, 0, 3] - found.T_world_sensor[0, 0, 3]
    seconds = (found.stamps[-1] - found.stamps[0]) * 1e-9
    assert moved == pytest.approx(3.0 * seconds, rel=0.05)
    selections = [json.loads(chosen.get().data) for _ in range(4)]
    assert [s["stamp"] for s in selections[1:]] == sorted(s["stamp"] for s in selections[1:])
    while not poses.empty():
        last = poses.get()
    assert last.header.frame_id == "odom"
    assert last.pose.pose.position.x == pytest.approx(moved, abs=0.5)
    assert last.pose.covariance[0] > 0.0
