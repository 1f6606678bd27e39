"""What nodes of ROS 2 do with poses, and how they end, on this machine."""

import json
import sys

import numpy as np
import pytest
from contained import LIMITS
from needs import ROOT, needs
from odometry_node import path
from ros2_reference import ros2

from adaptune.errors import OdometryError, warn_once
from adaptune.odometry.systems import lockstep, ros2_system
from adaptune.odometry.systems.probe import look
from adaptune.odometry.systems.ros2_system import Ros2
from adaptune.recording import Scan

pytestmark = pytest.mark.services

N = 20
SPAN = 0.1
LAUNCH = """
"$@" | while read -r line; do
    echo "$line"
    [ "$line" != "clouds: 3" ] || {
        echo "[ERROR] [rviz2-2]: process has died [pid 7, exit code -6, cmd 'rviz2']."
        echo "[ERROR] [map_server-3]: process has died [pid 8, exit code 1, cmd 'map']."
    }
done
"""


def scans():
    """A drive of which only stamps and times count."""
    points = np.ones((50, 3), np.float32)
    times = np.linspace(0.0, SPAN, 50, dtype=np.float32)
    return [Scan(10**12 + i * 10**8, points, times) for i in range(N)]


def truth():
    return path(0.1 * np.arange(N))


@pytest.fixture
def settings(tmp_path):
    needs("cyclonedds", "ros2")
    warn_once.cache_clear()
    lockstep._SEEN.clear()
    node = sys.executable, str(ROOT / "tests/support/odometry_node.py")

    def make(habits=None, before=(), **given):
        command = (*before, *node, json.dumps(habits or {}), "{parameters}")
        patient = {"patience": 20.0, "ready": 300.0}
        given = patient | {"image": None, "command": command} | given
        return ros2(tmp_path / "icp.yaml", **given)

    return make


@pytest.fixture
def drive(settings):
    made = []

    def begin(*given, n=N, **more):
        odometry = Ros2.instance({}, settings(*given, **more), LIMITS, None)
        made.append(odometry)
        first, *others = scans()[:n]
        odometry.start(first, np.eye(4))
        poses = [np.eye(4), *(odometry.register(scan).T_odom_sensor for scan in others)]
        return odometry, np.array(poses)

    yield begin
    for odometry in made:
        odometry.close()


def furthest(poses, others):
    return np.linalg.norm(poses[:, :3, 3] - others[:, :3, 3], axis=1).max()


@pytest.mark.parametrize(
    ("habits", "given", "right"),
    [
        ({}, {}, True),
        ({"shift": SPAN}, {"pose_time": "end"}, True),
        ({"shift": SPAN}, {}, False),
        # A stamp says so itself.
        ({"shift": SPAN, "later": SPAN}, {}, True),
        ({"shift": SPAN, "later": SPAN}, {"pose_time": "end"}, True),
        ({"shift": 0.04, "later": 0.04}, {}, True),
    ],
)
def test_poses_are_those_of_the_stamps(drive, habits, given, right):
    odometry, poses = drive(habits, **given)
    assert not odometry.faults
    assert (furthest(poses, truth()) < 0.02) == right


@pytest.mark.parametrize("inverted", [False, True])
def test_transforms_may_stand_on_their_heads(drive, settings, inverted):
    odometry, poses = drive({"inverted": inverted}, odometry="/tf")
    assert not odometry.faults
    np.testing.assert_allclose(poses, truth(), atol=1e-6)
    found = look(settings({"inverted": inverted}, odometry="/tf"), {}, LIMITS, scans()[:5])
    said = "lidar in odom" + " (the tree is inverted)" * inverted
    assert found["poses are of"] == said


def test_nodes_that_die_beside_the_odometry_are_named(drive, caplog):
    odometry, poses = drive(before=("/bin/bash", "-c", LAUNCH, "bash"))
    np.testing.assert_allclose(poses, truth(), atol=1e-6)
    odometry.close()
    assert not odometry.faults
    (told,) = [said for said in caplog.messages if "died" in said]
    assert "node rviz2 died: its process was ended by SIGABRT; node map_server died: its" in told
    assert "and poses come still; if it is not needed, let the launch file leave it out" in told


@pytest.mark.parametrize(
    ("leaves", "words", "helped"),
    [
        (1, "its process ended with code 1 before its first pose", False),
        (-6, "its process was ended by SIGABRT before its first pose", True),
    ],
)
def test_one_that_ends_with_a_code_has_said_why(drive, leaves, words, helped):
    with pytest.raises(OdometryError, match=words) as raised:
        drive({"leaves": [1, leaves], "inverted": False})
    assert "the map is corrupt" in str(raised.value)
    assert ("play: bag" in str(raised.value)) == helped


def test_one_that_rests_after_its_last_pose_does_not_work_on(drive, caplog, monkeypatch):
    monkeypatch.setattr(lockstep, "_USAGE_POLL", 0.0)
    monkeypatch.setattr(ros2_system, "_BETWEEN_LOOKS", 0.49)
    odometry, _ = drive({"computes": 0.15}, n=4)
    system = odometry._system
    system._looked = -np.inf
    assert odometry.usage.cpu > 0.4
    # What it computes from here on was before its last pose, too.
    odometry.register(scans()[4])
    odometry.close()
    assert "works on" not in caplog.text
