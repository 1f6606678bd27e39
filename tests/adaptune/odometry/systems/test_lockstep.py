"""The reference image's system, scan by scan."""

import re

import numpy as np
import pytest
from contained import (
    FIXED,
    LIMITS,
    N_SCANS,
    VALUES,
    containers,
    drive,
    host_poses,
    rustle,
    scans,
    template,
)
from needs import reference_image
from rooms import moved

from adaptune.odometry import OdometryError
from adaptune.odometry.base import InProcess
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.systems import lockstep
from adaptune.odometry.systems.engine import engine
from adaptune.odometry.systems.rustle import Ros1System, Rustle, RustleSettings
from adaptune.space import Selection

pytestmark = [
    pytest.mark.services,
    pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning"),
]

OTHER = {"max_correspondence_distance": 3.0}
SET = """
    test {name} != gicp/keyframe_interval || { echo 'I do not know {name}'; exit 4; }
    exec rosparam set /{name} {value}
"""


@pytest.fixture(scope="module", autouse=True)
def _image():
    reference_image()


@pytest.fixture
def systems(monkeypatch):
    started = []

    class Noted(Ros1System):
        def __init__(self, *given):
            super().__init__(*given)
            started.append(self)

    monkeypatch.setattr(RustleSettings, "system", Noted)
    return started


@pytest.fixture
def make(tmp_path):
    odometries = []

    def begin(parameters=VALUES, imitate=None, points="/points", settings=()):
        file = template(tmp_path / "params.yaml", points=points, **(imitate or {}))
        given = rustle(file, **({"play": "lockstep", "patience": 60.0} | dict(settings)))
        odometries.append(Rustle.instance(parameters, given, LIMITS, None))
        return odometries[-1]

    yield begin
    for odometry in odometries:
        odometry.close()
    assert not containers()


def on(odometry, first, end):
    given = [odometry.prepare(scan) for scan in scans()[first:end]]
    return [odometry.register(prepared) for prepared in given]


def test_the_poses_are_those_of_a_played_bag_and_it_starts_again_on_the_way(make):
    odometry = make()
    assert odometry.ended
    np.testing.assert_allclose(drive(odometry), host_poses(), atol=1e-6)
    assert not odometry.faults
    assert 0.0 < odometry.usage.cpu < 100.0
    assert 0.0 < odometry.usage.memory < 1000.0
    # A start has a container of its own, a frame of its own, and forgets what was before.
    (before,) = containers()
    T = moved(5.0, 6.0, 7.0)
    again = drive(odometry, N_SCANS - 10, T)
    (after,) = containers()
    assert after != before
    here = InProcess(KeyframeGicp(VALUES | FIXED))
    np.testing.assert_allclose(again, T @ drive(here, N_SCANS - 10), atol=1e-6)
    odometry.close()
    assert odometry.ended
    assert not containers()


def test_parameters_get_there_as_numbers_and_change_while_it_runs(make, systems, caplog):
    odometry = make(settings={"node": "/gicp"})
    odometry.start(scans()[0], np.eye(4))
    on(odometry, 1, 7)
    link = systems[0].link
    held = link.ask("parameters")
    assert held["gicp"] == VALUES | FIXED
    assert isinstance(held["gicp"]["iterations"], int)
    assert isinstance(held["gicp"]["max_correspondence_distance"], float)
    assert held["use_sim_time"] is True
    odometry.apply(Selection(0, OTHER))
    assert odometry.parameters == VALUES | OTHER
    assert "does not report" not in caplog.text
    assert link.ask("parameters")["gicp"]["max_correspondence_distance"] == 3.0
    poses = [registration.T_odom_sensor for registration in on(odometry, 7, 20)]
    here = InProcess(KeyframeGicp(VALUES | FIXED))
    here.start(here.prepare(scans()[0]), np.eye(4))
    on(here, 1, 7)
    here.apply(Selection(0, OTHER))
    expected = [registration.T_odom_sensor for registration in on(here, 7, 20)]
    np.testing.assert_allclose(poses, expected, atol=1e-6)
    assert np.abs(poses - host_poses()[7:20]).max() > 1e-5
    # The node bounds it to 10, and says so.
    with pytest.raises(
        OdometryError, match=r"/gicp holds gicp/max_correspondence_distance = 10\.0"
    ):
        odometry.apply(Selection(0, {"max_correspondence_distance": 30.0}))


def test_a_clock_s_stamps_do_not_say_which_scan_is_late(make):
    odometry = make(imitate={"own_clock": 0.5}, settings={"patience": 0.3})
    drive(odometry)
    words = r"by its own clock, .*\d scans had no pose after 0\.3 s, .*; raise .*patience"
    assert re.search(words, odometry.faults[0])


def test_nobody_says_whether_a_node_without_reconfigure_reads_them_again(make, systems, caplog):
    odometry = make(imitate={"read_once": True, "jump": 11}, settings={"node": "/gicp"})
    odometry.start(scans()[0], np.eye(4))
    odometry.apply(Selection(0, OTHER))
    words = "/gicp does not report whether gicp/max_correspondence_distance, which was set,"
    assert words in caplog.text
    held = systems[0].link.ask("parameters")
    assert held["gicp"]["max_correspondence_distance"] == 3.0
    poses = [registration.T_odom_sensor for registration in on(odometry, 1, 10)]
    np.testing.assert_allclose(poses, host_poses()[1:10], atol=1e-6)
    # A pose that is none is a fault.
    assert np.isnan([found.T_odom_sensor for found in on(odometry, 10, 12)]).all()
    (fault,) = odometry.faults
    assert fault.startswith("it gave a pose that is not finite: ")
    assert odometry.ended


def test_a_command_sets_parameters(make, systems):
    odometry = make(settings={"node": "/gicp", "set_parameter": ("sh", "-c", SET)})
    odometry.start(scans()[0], np.eye(4))
    odometry.apply(Selection(0, {"max_correspondence_distance": 3.5}))
    held = systems[0].link.ask("parameters")
    assert held["gicp"]["max_correspondence_distance"] == 3.5
    with pytest.raises(OdometryError, match="exit code 4: I do not know gicp/keyframe_interval"):
        odometry.apply(Selection(0, {"keyframe_interval": 2.0}))
    # A container that is killed is a fault.
    (container,) = containers()
    engine().api.kill(container)
    assert all(np.isnan(found.T_odom_sensor).all() for found in on(odometry, 1, 4))
    assert len(odometry.faults) == 1
    assert odometry.ended


def test_one_that_dies_is_a_fault_with_its_last_lines(make):
    odometry = make(imitate={"die_at": 4}, settings={"patience": 10.0})
    poses = drive(odometry)
    np.testing.assert_allclose(poses[:4], host_poses()[:4], atol=1e-6)
    assert np.isnan(poses[-1]).all()
    (fault,) = odometry.faults
    assert re.match(r"(node /gicp died|roslaunch ended with code \d+): ", fault), fault
    assert "gicp: terminating after 4 scans: the map is corrupt" in fault
    assert odometry.ended
    assert not containers()


def test_scans_without_a_pose_continue_the_motion(make, monkeypatch):
    monkeypatch.setattr(lockstep, "_MOST_SILENT", 4)
    odometry = make(imitate={"silent": True}, settings={"patience": 0.3})
    T, step = np.eye(4), np.eye(4)
    T[:3, 3], step[:3, 3] = (5.0, 6.0, 7.0), (0.3, 0.1, 0.0)
    odometry.start(scans()[0], T, step)
    for found in on(odometry, 1, 3):
        T = T @ step
        assert not found.registered
        np.testing.assert_allclose(found.T_odom_sensor, T, atol=1e-9)
    assert not odometry.faults
    assert np.isnan(on(odometry, 3, 5)[-1].T_odom_sensor).all()
    (fault,) = odometry.faults
    words = "no pose yet on /Odometry for 4 scans in a row; topics that are published.*play: bag"
    assert re.match(words, fault), fault


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"imitate": {"quit_launch": True}}, "roslaunch ended with code 0: "),
        (
            {"points": "/velodyne", "settings": {"ready": 8}},
            "no node subscribed to the clouds' topic /points .*/velodyne",
        ),
        ({"settings": {"package": "other"}}, "roslaunch ended with code 1: there is no package"),
    ],
)
def test_one_that_cannot_begin_says_why(make, given, words):
    odometry = make(**given)
    with pytest.raises(OdometryError, match=f"^{reference_image()}: {words}"):
        odometry.start(scans()[0], np.eye(4))
    assert odometry.ended
    assert not containers()


@pytest.mark.parametrize("later", [0.05, 0.1])
def test_poses_at_the_end_of_scans_are_those_of_their_stamps(make, later):
    T = drive(make(imitate={"stamp_later": later}))
    expected = host_poses()
    # The system says of each pose that it is of a later time.
    share = later / 0.1
    lag = (1.0 - share) * expected[2:, 0, 3] + share * expected[1:-1, 0, 3]
    np.testing.assert_allclose(np.diff(T[2:, 0, 3]), np.diff(lag), atol=1e-3)
