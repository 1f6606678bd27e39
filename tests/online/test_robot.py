"""Drives on a robot that lives in this process; `test_ros1` has a real one."""

import json
import shutil
import sys
from dataclasses import replace

import drives
import local_link
import numpy as np
import pytest
from commands import refused

from adaptune.errors import AdaptuneError, OdometryError, warn_once
from adaptune.model import BankSettings, ErrorModel
from adaptune.recording.scan import Scan
from adaptune.ros.link import BusyError, LinkError
from adaptune.runs.loop import replay
from adaptune.space import Selection
from adaptune.study.config import SteerConfig
from adaptune.study.driven import ModeError
from adaptune.trajectory import read_tum
from offline.config import load_study
from online import robot as robot_drive
from online.modes import ReplaySetup
from online.robot import RobotDrive
from online.steered import SteeredNode

PATIENT = ("online.real_time={deadline: 60, queue: 0}", "online.ros={points: /points, tf: true}")
SCANS = drives.scans(2, 25)


@pytest.fixture(scope="module")
def folder(study_file, trained_folder, tmp_path_factory):
    folder = shutil.copytree(trained_folder, tmp_path_factory.mktemp("robot") / "run")
    study = load_study(study_file, [], folder)
    model = ErrorModel.load(study.model_path)
    replace(model, bank_settings=BankSettings()).save(study.model_path)
    return folder


@pytest.fixture
def make(study_file, folder, tmp_path):
    def study(*overrides):
        run = tmp_path / "run"
        if not run.exists():
            shutil.copytree(folder, run)
        return load_study(study_file, [*PATIENT, *overrides], run)

    return study


def clouds(later=0):
    for stamp, points, _ in SCANS:
        yield "/points", local_link.cloud(stamp + later, points)


def drive(study, mode, played, n, model=True):
    """Play messages and drive until n scans were seen; also what a steered node then held."""
    link, held = local_link.LocalLink(played), []
    robot = RobotDrive(study, mode, study.model_path if model else None)

    def watch(_):
        held.append(dict(link.holds))
        if len(held) == n:
            robot.stop()

    robot.run(link, watch)
    return robot, link, held


@pytest.mark.parametrize("mode", ["baseline", "fixed", "adaptive", "untrained"])
def test_it_drives_as_a_replay_in_lockstep(make, mode):
    study = make()
    found, link, _ = drive(study, mode, clouds(), len(SCANS), model=mode != "untrained")
    model = None if mode == "untrained" else ErrorModel.load(study.model_path)
    setup = ReplaySetup.of(study, model)
    made = setup.mode(mode)
    odometry, selector = setup.instance(made), made.selector and made.selector()
    scans = [Scan(stamp, points) for stamp, points, _ in SCANS]
    expected = replay(scans, odometry, study.config.health, selector)
    odometry.close()
    trajectory = read_tum(found.folder / "trajectory.tum")
    np.testing.assert_array_equal(trajectory.stamps, expected.trajectory.stamps)
    np.testing.assert_allclose(
        trajectory.T_world_sensor, expected.trajectory.T_world_sensor, atol=1e-6
    )
    assert found.done == len(SCANS)
    poses = link.published["adaptune/odometry"]
    assert len(poses) == len(link.published["/tf"]) == len(SCANS)
    last, T = poses[-1], trajectory.T_world_sensor[-1]
    point = last.pose.pose.position
    np.testing.assert_allclose([point.x, point.y, point.z], T[:3, 3], atol=1e-6)
    assert (last.header.frame_id, last.child_frame_id) == ("odom", "lidar")
    moved = link.published["/tf"][-1].transforms[0]
    assert moved.transform.translation.x == point.x
    chosen = [json.loads(one.data) for one in link.published["adaptune/selection"]]
    assert [one["stamp"] for one in chosen] == [c.stamp for c in expected.choices]
    assert [one["trial"] for one in chosen] == [c.selection.trial for c in expected.choices]


def test_the_covariance_grows_with_the_distance(make):
    _, link, _ = drive(make(), "adaptive", clouds(), len(SCANS))
    variances = [one.pose.covariance.reshape(6, 6) for one in link.published["adaptune/odometry"]]
    assert not variances[0].any()
    x, yaw = np.array([(of[0, 0], of[5, 5]) for of in variances]).T
    assert (np.diff(x) > 0.0).all()
    assert (np.diff(yaw) > 0.0).all()
    assert all((of == np.diag(np.diag(of))).all() for of in variances)


def test_where_the_clock_goes_back_another_drive_begins(make):
    study = make()
    played = [*clouds(10**11), *clouds()]
    found, _, _ = drive(study, "adaptive", played, 2 * len(SCANS))
    folders = sorted((study.folder / "drives").iterdir())
    first, second = (read_tum(folder / "trajectory.tum") for folder in folders)
    assert found.folder == folders[1]
    assert len(first) == len(second) == len(SCANS)
    np.testing.assert_allclose(first.T_world_sensor, second.T_world_sensor, atol=1e-6)


def test_a_drive_that_goes_on_does_not_need_the_disk(make, monkeypatch, caplog):
    study = make()
    monkeypatch.setattr(robot_drive, "_new_folder", lambda parent: parent / "same")
    found, link, _ = drive(study, "fixed", [*clouds(10**11), *clouds()], 2 * len(SCANS))
    # The second part cannot make its folder.
    assert "nothing more is recorded" in caplog.text
    assert found.done == len(link.published["adaptune/odometry"]) == 2 * len(SCANS)
    assert len(read_tum(study.folder / "drives/same/trajectory.tum")) == len(SCANS)


def test_it_ends_where_the_node_in_ros_has_ended(make, monkeypatch):
    monkeypatch.setattr("online.topics.SILENCE", 0.01)
    link = local_link.LocalLink()
    link.alive = False
    with pytest.raises(LinkError, match="adaptune's node in ROS has ended"):
        RobotDrive(make(), "baseline", None).run(link)


def test_a_drive_that_was_stopped_before_ends_at_once(make):
    robot = RobotDrive(make(), "baseline", None)
    robot.stop()
    assert robot.run(local_link.LocalLink()).done == 0


STEER = "online.ros.steer={node: /node, odometry: /odom}"


def test_a_node_is_steered(make):
    def played():
        for stamp, points, T in SCANS:
            yield "/odom", local_link.odometry(stamp, T)
            yield "/points", local_link.cloud(stamp, points)

    study = make(STEER)
    model = ErrorModel.load(study.model_path)
    found, link, held = drive(study, None, played(), len(SCANS))
    # It begins with the fixed set, and holds what was selected last.
    chosen = [json.loads(one.data) for one in link.published["adaptune/selection"]]
    assert len(chosen) == 3
    assert link.holds == chosen[-1]["parameters"]
    assert held[0] in [dict(own) for own in model.sets.parameters]
    # It does not publish what the node does.
    assert set(link.kinds) == {"adaptune/selection"}
    trajectory = read_tum(found.folder / "trajectory.tum")
    np.testing.assert_allclose(trajectory.T_world_sensor, [T for _, _, T in SCANS], atol=1e-6)


def test_the_log_says_once_that_the_odometry_restarts(make, caplog):
    steer = STEER.replace("}", ", patience: 0.01}")
    drive(make(steer), "standby", clouds(), 5)  # the node is silent
    said = "the odometry restarts: the health check found no_pose"
    assert caplog.messages.count(said) == 1


def test_what_does_not_go_together_is_refused(make):
    with pytest.raises(ModeError, match=r"--mode: there is no mode 'fxed'; .*fixed"):
        RobotDrive(make(), "fxed", make().model_path)
    with pytest.raises(ModeError, match=r"online\.ros\.steer: in the mode fixed nothing is select"):
        RobotDrive(make(STEER), "fixed", make().model_path)
    with pytest.raises(ModeError, match=r"ros\.steer: a node drives one set .* --mode standby"):
        RobotDrive(make(STEER), "adaptive", make().model_path)
    with pytest.raises(AdaptuneError, match=r"online\.ros\.like: no sequence 'tree'.*three"):
        RobotDrive(make("online.ros.like=tree"), "baseline", None)
    other = make("odometry.settings.min_range=0.9")
    with pytest.raises(AdaptuneError, match="min_range"):
        RobotDrive(other, "adaptive", other.model_path)
    study = make("online.ros.points=null", "sequences.one.points=null")
    with pytest.raises(AdaptuneError, match=r"online\.ros\.points: name the topic on the robot"):
        RobotDrive(study, "baseline", None).run(local_link.LocalLink())


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--ros", "--ros2"], "give only one of --ros and --ros2"),
        (["--mode", "fixed"], "--mode fixed is for a robot"),
        (["--ros", "--untrained", "--mode", "fixed"], "--untrained is a mode of its own"),
        (["--ros", "-o", "online.ros.points=a b"], "online.ros.points: is no name in ROS: give"),
    ],
)
def test_options_that_exclude_each_other(study_file, folder, options, said):
    assert said in refused("online", study_file, "--folder", folder, *options)


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
def node(link):
    warn_once.cache_clear()

    def make(**settings):
        given = {"node": "/node", "odometry": "/odom", "patience": 0.01} | settings
        return SteeredNode(link, SteerConfig(**given), "/points")

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


LATE = (
    "/odom: some poses come later than online.ros.steer.patience (0.01 s) allows: raise it, or "
    "let less run on this machine"
)
LOST = (
    "/odom: some poses never come, and later ones do: is the node too slow, or does it lose clouds?"
)


@pytest.mark.parametrize(
    ("late", "lost", "each", "told"),
    [
        ((), (), 1, []),
        ((7, 12), (), 1, [LATE]),
        ((), (7, 12), 1, [LOST]),
        ((7,), (12,), 1, [LATE, LOST]),
        ((), (), 2, []),
        ((8,), (), 2, [LATE]),
    ],
)
def test_a_pose_that_is_missed_came_late_or_never(link, node, caplog, late, lost, each, told):
    odometry = node()
    play(link, 0)
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    for i in range(1, 20):
        given = i not in lost and i % each == 0
        if given and i not in late:
            play(link, i * TENTH)
        assert odometry.register(scan(i * TENTH)).registered == (given and i not in late)
        if i in late:
            play(link, i * TENTH)
    assert caplog.messages == told


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
        "/odom: no pose for 10 of 10 scans; is it the topic, and does its node run?"
    ]


def test_a_node_that_answers_now_and_then_may_not_hear(link, node, caplog):
    odometry, link.deaf = node(), "/node runs on Fast DDS"
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    for i in range(1, 60):
        if i % 8 == 0:
            play(link, i * TENTH)
        odometry.register(scan(i * TENTH))
    assert caplog.messages == ["/odom: no pose for 9 of 10 scans; /node runs on Fast DDS"]
    # Half of them may be its habit.
    caplog.clear()
    for i in range(60, 90):
        if i % 2 == 0:
            play(link, i * TENTH)
        odometry.register(scan(i * TENTH))
    assert not caplog.messages


def test_poses_of_another_frame_become_those_of_the_sensor(link, node):
    turned = (0.0, 0.0, 1.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    odometry = node(extrinsic=turned)
    play(link, 0, TENTH)
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    T = odometry.register(scan(TENTH)).T_odom_sensor
    # The sensor is turned to the left: ahead is to its right.
    np.testing.assert_allclose(T[:3, 3], [0.0, -0.1, 0.0], atol=1e-9)


def apply(odometry, trial, **parameters):
    """Apply a set, and wait until the node has said what becomes of it."""
    odometry.apply(Selection(trial, parameters))
    assert odometry.confirmed(20.0)


def test_what_the_node_holds_is_compared(link, node):
    odometry = node()
    apply(odometry, 1, voxel=0.5)
    assert link.holds == {"voxel": 0.5}
    link.refuses = ("voxel",)
    with pytest.raises(LinkError, match="refuses voxel"):
        apply(odometry, 2, voxel=0.7)
    link.set_parameters = lambda *_: {"voxel": "fine"}
    with pytest.raises(OdometryError, match="/node holds voxel = fine"):
        apply(odometry, 2, voxel=0.7)
    link.set_parameters = lambda *_: {"voxel": 0.5}
    with pytest.raises(OdometryError, match=r"/node holds voxel = 0\.5"):
        apply(odometry, 2, voxel=0.7)


def test_it_says_once_that_nobody_knows_whether_a_parameter_counts(link, node, caplog):
    odometry = node()
    link.set_parameters = lambda *_: {}
    for value in (0.5, 0.6):
        apply(odometry, 1, voxel=value)
    assert caplog.messages == [
        "/node does not report whether voxel, which was set, applies before it starts again"
    ]


def test_a_command_sets_parameters(tmp_path, node):
    write = "import sys; open(sys.argv[1], 'a').write(' '.join(sys.argv[2:]) + '\\n')"
    command = [sys.executable, "-c", write, str(tmp_path / "set"), "{node}", "{name}={value}"]
    odometry = node(command=command)
    apply(odometry, 1, voxel=1e-5, n=3, on=True, name="a b")
    assert (tmp_path / "set").read_text().splitlines() == [
        "/node voxel=0.00001",
        "/node n=3",
        "/node on=true",
        "/node name=a b",
    ]


def test_a_command_that_fails_is_named(node):
    odometry = node(command=[sys.executable, "-c", "exit('no {name} {value}')"])
    with pytest.raises(OdometryError, match=r"exit code 1: no voxel 0\.5$"):
        apply(odometry, 1, voxel=0.5)
    with pytest.raises(OdometryError, match="nowhere"):
        apply(node(command=["nowhere", "{name}", "{value}"]), 1, voxel=0.5)


def test_nobody_waits_for_a_node_that_is_busy_and_it_gets_the_newest_set_last(link, node, caplog):
    odometry = node()
    apply(odometry, 0, voxel=0.5)
    link.free.clear()
    for trial, voxel in ((1, 0.6), (2, 0.7), (0, 0.5)):
        odometry.apply(Selection(trial, {"voxel": voxel}))
    play(link, 0, TENTH)
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    assert odometry.register(scan(TENTH)).registered
    assert not odometry.confirmed()
    link.free.set()
    assert odometry.confirmed(20.0)
    assert link.holds == link.asked[-1] == {"voxel": 0.5}
    assert not caplog.messages


def test_what_a_busy_node_has_confirmed_is_told(link, node, caplog):
    odometry = node()
    apply(odometry, 0, voxel=0.5, n=3)
    busy, given = link.set_parameters, [BusyError("/node is busy"), BusyError("still")]

    def answer(*asked):
        if given:
            raise given.pop(0)
        return busy(*asked)

    link.set_parameters = answer
    apply(odometry, 1, voxel=0.6, n=4)
    first, second = caplog.messages
    said = "/node is busy; the newest set stays asked for; it has confirmed voxel = 0.5, n = 3 at "
    assert first.startswith(said)
    assert second.startswith("/node answers again: it has confirmed voxel = 0.6, n = 4 at ")


def test_a_refusal_of_what_is_no_longer_asked_for_does_not_count(link, node):
    odometry = node()
    answers = [BusyError("/node is busy"), LinkError("/node refuses voxel = 9")]

    def answer(_, values, __):
        if answers:
            raise answers.pop(0)
        return values

    link.set_parameters = answer
    apply(odometry, 1, voxel=0.5)
    answers += [LinkError("/node refuses voxel = 0.6")]
    with pytest.raises(LinkError, match=r"refuses voxel = 0\.6"):
        apply(odometry, 1, voxel=0.6)


def test_a_command_names_the_parameter_and_its_value():
    with pytest.raises(ValueError, match=r"names no \{value\} in its arguments"):
        SteerConfig(node="/node", odometry="/odom", command=["set", "{name}"])
