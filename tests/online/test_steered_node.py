import sys

import local_link
import numpy as np
import pytest

from adaptune.errors import OdometryError
from adaptune.recording.scan import Scan
from adaptune.ros.link import LinkError
from adaptune.space import Selection
from adaptune.study.config import SteerConfig
from online import robot
from online.robot import SteeredNode

TENTH = 10**8


def pose(x, y=0.0):
    T = np.eye(4)
    T[:2, 3] = x, y
    return T


def scan(stamp):
    return Scan(stamp, np.zeros((0, 3), np.float32))


@pytest.fixture
def link():
    return local_link.LocalLink()


@pytest.fixture
def node(link, monkeypatch):
    monkeypatch.setattr(robot, "PATIENCE", 0.01)

    def make(**settings):
        return SteeredNode(link, SteerConfig(node="/node", odometry="/odom", **settings))

    return make


def play(link, *stamps):
    """A metre a second."""
    for stamp in stamps:
        link.play("/odom", local_link.odometry(stamp, pose(100.0 + stamp * 1e-9)))


def test_its_motions_are_those_of_the_node(link, node):
    odometry = node()
    play(link, 0)
    odometry.start(odometry.prepare(scan(0)), pose(0.0, 5.0))
    # Its stamps may be others than the scans'.
    play(link, TENTH // 2, 3 * TENTH // 2, 2 * TENTH)
    for i in (1, 2):
        found = odometry.register(scan(i * TENTH))
        assert found.registered
        np.testing.assert_allclose(found.T_odom_sensor, pose(0.1 * i, 5.0), atol=1e-9)
        np.testing.assert_allclose(odometry.motions.T_previous_current, pose(0.1), atol=1e-9)


def test_a_node_that_is_silent_gives_no_pose_and_goes_on(link, node):
    odometry = node()
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    found = odometry.register(scan(TENTH))
    assert np.isnan(found.T_odom_sensor).all()
    assert not found.registered
    # The health check lets it start again where it would be.
    odometry.start(odometry.prepare(scan(TENTH)), pose(0.1))
    play(link, TENTH, 2 * TENTH)
    found = odometry.register(scan(2 * TENTH))
    np.testing.assert_allclose(found.T_odom_sensor, pose(0.2), atol=1e-9)


def test_where_the_clock_goes_back_old_poses_do_not_count(link, node):
    odometry = node()
    play(link, *range(0, 50 * TENTH, TENTH))
    # The same stamps again, at three times the speed.
    for stamp in range(0, 3 * TENTH, TENTH):
        link.play("/odom", local_link.odometry(stamp, pose(3e-9 * stamp)))
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    np.testing.assert_allclose(odometry.register(scan(TENTH)).T_odom_sensor, pose(0.3), atol=1e-9)


def test_a_topic_without_poses_is_named_once(node, caplog):
    odometry = node()
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    for i in range(1, 30):
        odometry.register(scan(i * TENTH))
    assert caplog.messages == [
        "/odom: no pose of /node for 10 scans; is it the topic, and does the node run?"
    ]


def test_poses_of_another_frame_become_those_of_the_sensor(link, node):
    turned = (0.0, 0.0, 1.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    odometry = node(extrinsic=turned)
    play(link, 0, TENTH)
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    T = odometry.register(scan(TENTH)).T_odom_sensor
    # The sensor is turned to the left: ahead is to its right.
    np.testing.assert_allclose(T[:3, 3], [0.0, -0.1, 0.0], atol=1e-9)


def test_what_the_node_holds_is_compared(link, node):
    odometry = node()
    odometry.apply(Selection(1, {"voxel": 0.5}))
    assert link.holds == {"voxel": 0.5}
    link.refuses = ("voxel",)
    with pytest.raises(LinkError, match="refuses voxel"):
        odometry.apply(Selection(2, {"voxel": 0.7}))
    link.set_parameters = lambda *_: {"voxel": "fine"}
    with pytest.raises(OdometryError, match="/node holds voxel = fine"):
        odometry.apply(Selection(2, {"voxel": 0.7}))
    link.set_parameters = lambda *_: {"voxel": 0.5}
    with pytest.raises(OdometryError, match=r"/node holds voxel = 0\.5"):
        odometry.apply(Selection(2, {"voxel": 0.7}))


def test_it_says_once_that_nobody_knows_whether_a_parameter_counts(link, node, caplog):
    odometry = node()
    link.set_parameters = lambda *_: {}
    for value in (0.5, 0.6):
        odometry.apply(Selection(1, {"voxel": value}))
    assert caplog.messages == [
        "/node: nobody says whether voxel takes effect before the node starts again"
    ]


def test_a_command_sets_parameters(tmp_path, node):
    write = "import sys; open(sys.argv[1], 'a').write(' '.join(sys.argv[2:]) + '\\n')"
    command = [sys.executable, "-c", write, str(tmp_path / "set"), "{node}", "{name}={value}"]
    odometry = node(command=command)
    odometry.apply(Selection(1, {"voxel": 1e-5, "n": 3, "on": True, "name": "a b"}))
    assert (tmp_path / "set").read_text().splitlines() == [
        "/node voxel=0.00001",
        "/node n=3",
        "/node on=true",
        "/node name=a b",
    ]


def test_a_command_that_fails_is_named(node):
    odometry = node(command=[sys.executable, "-c", "exit('no {name} {value}')"])
    with pytest.raises(OdometryError, match=r"exit code 1: no voxel 0\.5$"):
        odometry.apply(Selection(1, {"voxel": 0.5}))
    with pytest.raises(OdometryError, match="nowhere"):
        node(command=["nowhere", "{name}", "{value}"]).apply(Selection(1, {"voxel": 0.5}))


def test_a_command_names_the_parameter_and_its_value():
    with pytest.raises(ValueError, match=r"names no \{value\} in its arguments"):
        SteerConfig(node="/node", odometry="/odom", command=["set", "{name}"])
