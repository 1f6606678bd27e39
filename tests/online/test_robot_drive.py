"""Drives on a robot that lives in this process; `test_ros1` has a real one."""

import json
import shutil
from dataclasses import replace

import drives
import local_link
import numpy as np
import pytest
from commands import call

from adaptune.errors import AdaptuneError
from adaptune.model import BankSettings, ErrorModel
from adaptune.recording.scan import Scan
from adaptune.ros.link import LinkError
from adaptune.study.study import ModeError
from adaptune.trajectory import read_tum
from offline.config import load_study
from online import robot as robot_drive
from online.modes import ReplaySetup
from online.replay import replay
from online.robot import RobotDrive

PATIENT = (
    "online.real_time={deadline: 60, queue: 0}",
    "online.ros={points: /points, tf: true}",
)
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

    return robot.run(link, watch), link, held


@pytest.mark.parametrize("mode", ["baseline", "fixed", "adaptive", "untrained"])
def test_it_drives_as_a_replay_in_lockstep(make, mode):
    study = make()
    found, link, _ = drive(study, mode, clouds(), len(SCANS), model=mode != "untrained")
    setup = ReplaySetup.of(study)
    model = None if mode == "untrained" else ErrorModel.load(study.model_path)
    made = setup.mode(mode, model)
    odometry, selector = setup.instance(made), made.selector and made.selector()
    scans = [Scan(stamp, points) for stamp, points, _ in SCANS]
    expected = replay(scans, odometry, study.config.health, selector)
    odometry.close()
    trajectory = read_tum(found.folder / "trajectory.tum")
    np.testing.assert_array_equal(trajectory.stamps, expected.trajectory.stamps)
    np.testing.assert_allclose(
        trajectory.T_world_sensor, expected.trajectory.T_world_sensor, atol=1e-6
    )
    assert (found.scans, found.record.dropped) == (len(SCANS), 0)
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
    # Once a second.
    status = [one.status[0] for one in link.published["/diagnostics"]]
    assert [one.message for one in status] == ["keeps up"] * 3


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
    assert found.scans == len(link.published["adaptune/odometry"]) == 2 * len(SCANS)
    assert len(read_tum(study.folder / "drives/same/trajectory.tum")) == len(SCANS)


def test_it_ends_where_the_node_in_ros_has_ended(make, monkeypatch):
    monkeypatch.setattr("online.live.SILENCE", 0.01)
    link = local_link.LocalLink()
    link.alive = False
    with pytest.raises(LinkError, match="adaptune's node in ROS has ended"):
        RobotDrive(make(), "baseline", None).run(link)


def test_a_drive_that_was_stopped_before_ends_at_once(make):
    robot = RobotDrive(make(), "baseline", None)
    robot.stop()
    assert robot.run(local_link.LocalLink()).scans == 0


STEER = "online.ros.steer={node: /node, odometry: /odom}"


def test_a_node_is_steered(make):
    def played():
        for stamp, points, T in SCANS:
            yield "/odom", local_link.odometry(stamp, T)
            yield "/points", local_link.cloud(stamp, points)

    study = make(STEER)
    model = ErrorModel.load(study.model_path)
    found, link, held = drive(study, "adaptive", played(), len(SCANS))
    # It begins with the fixed set, and holds what was selected last.
    chosen = [json.loads(one.data) for one in link.published["adaptune/selection"]]
    assert len(chosen) == 3
    assert link.holds == chosen[-1]["parameters"]
    assert held[0] in [dict(own) for own in model.sets.parameters]
    # It does not publish what the node does.
    assert set(link.kinds) == {"adaptune/selection", "/diagnostics"}
    trajectory = read_tum(found.folder / "trajectory.tum")
    np.testing.assert_allclose(trajectory.T_world_sensor, [T for _, _, T in SCANS], atol=1e-6)


def test_what_does_not_go_together_is_refused(make, monkeypatch):
    with pytest.raises(ModeError, match=r"--mode: there is no mode 'fxed'; .*fixed"):
        RobotDrive(make(), "fxed", make().model_path)
    with pytest.raises(ModeError, match=r"online\.ros\.steer: in the mode fixed nothing is select"):
        RobotDrive(make(STEER), "fixed", make().model_path)
    with pytest.raises(AdaptuneError, match=r"online\.ros\.like: no sequence 'tree'.*three"):
        RobotDrive(make("online.ros.like=tree"), "baseline", None)
    other = make("odometry.settings.min_range=0.9")
    with pytest.raises(AdaptuneError, match="min_range"):
        RobotDrive(other, "adaptive", other.model_path)
    monkeypatch.setattr(robot_drive, "_PUBLISHED", 0.0)
    study = make("online.ros.points=null", "sequences.one.points=null")
    link = local_link.LocalLink()
    link.topics = dict
    with pytest.raises(AdaptuneError, match=r"online\.ros\.points: name the topic; .*none is pub"):
        RobotDrive(study, "baseline", None).run(link)


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
    result = call("online", study_file, "--folder", folder, *options)
    assert result.exit_code == 2
    assert said in result.output
