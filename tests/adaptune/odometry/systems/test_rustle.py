"""Stamps and poses that a system publishes, without a container."""

from pathlib import Path
from types import SimpleNamespace

import contained
import local_link
import numpy as np
import pytest
from contained import template
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from random_models import random_model
from rooms import moved

from adaptune.odometry import OdometryError
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.program import ProgramInput
from adaptune.odometry.remote import Limits
from adaptune.odometry.systems.engine import EngineError
from adaptune.odometry.systems.played_bag import Drain, PlayedBag, PoseRecorder, check_stamps
from adaptune.odometry.systems.ros_system import PoseReader
from adaptune.odometry.systems.rustle import Rustle, RustleSettings
from adaptune.recording.pose_messages import usable
from adaptune.ros.link import LinkError
from adaptune.space import ParameterSpace
from adaptune.study.config import StudyConfig
from online.modes import ReplaySetup

PERIOD = 10**8
SCANS = 1_700_000_000_123_456_789 + PERIOD * np.arange(40)


@given(
    late=st.integers(0, PERIOD),
    drop=st.sets(st.integers(0, 39), max_size=30),
    jitter=st.integers(0, 4_000_000),
    seed=st.integers(0, 100),
)
def test_stamps_of_the_scans_pass_wherever_in_the_scan_they_are(late, drop, jitter, seed):
    wobble = np.random.default_rng(seed).integers(0, jitter + 1, 40)
    kept = [i for i in range(40) if i not in drop]
    check_stamps((SCANS + late + wobble)[kept], SCANS)


@given(often=st.integers(2, 20), late=st.integers(0, PERIOD))
def test_poses_that_come_more_often_are_judged_by_begin_and_end(often, late):
    stamps = SCANS[0] + late + PERIOD // often * np.arange(40 * often)
    check_stamps(stamps, SCANS)
    with pytest.raises(OdometryError, match=r"its poses are of .* s, the scans of .*its own clock"):
        check_stamps(stamps + 2 * 10**9, SCANS)
    with pytest.raises(OdometryError, match="its poses are of"):
        check_stamps(stamps - 2 * 10**9, SCANS)


@given(seed=st.integers(0, 1000), missing=st.integers(0, 4), rate=st.floats(1.1, 4.0))
def test_stamps_of_another_clock_are_refused(seed, missing, rate):
    rng = np.random.default_rng(seed)
    late = np.delete(SCANS + PERIOD + PERIOD // 2, rng.choice(40, missing, replace=False))
    for stamps, words in (
        # As of a system that stamps when it has finished, and takes its time.
        (np.sort(SCANS + rng.integers(0, PERIOD // 2, 40)), r"stamps scatter by up to 0\.0\d\d s:"),
        (SCANS + PERIOD + PERIOD // 2, r"its stamps are up to 0\.150 s late:"),
        (late + missing * PERIOD, "late:"),
        (SCANS[0] + ((SCANS - SCANS[0]) / rate).astype(np.int64), ""),
    ):
        with pytest.raises(
            OdometryError, match=f"{words}.*the system stamps poses by its own clock"
        ):
            check_stamps(stamps, SCANS)


def test_nothing_is_said_of_no_poses_and_of_one():
    check_stamps(SCANS[:0], SCANS)
    check_stamps(SCANS[:1], SCANS)


class Recorded:
    """Stands for a link whose node publishes messages of one type."""

    decode = staticmethod(local_link.STORE.deserialize_ros1)

    def record(self, topic, take):
        self.topic, self.take = topic, take

    def publish(self, message):
        kind = message.__msgtype__
        self.take(kind, bytes(local_link.STORE.serialize_ros1(message, kind)))


def heard(link, topic):
    return PoseRecorder(PoseReader(link, topic))


def odometry(i, x=0.0):
    return local_link.odometry(int(SCANS[i]), moved(x))


@pytest.fixture
def link():
    return Recorded()


def test_poses_are_kept_as_they_come(link):
    recorder = heard(link, "/found")
    assert link.topic == "/found"
    assert recorder.poses() == []
    for i in (0, 1, 3, 2):
        link.publish(odometry(i, 0.3 * i))
    assert [stamp for stamp, *_ in recorder.poses()] == SCANS[[0, 1, 3, 2]].tolist()
    trajectory, left_out = usable(recorder.poses())
    assert left_out == []
    np.testing.assert_allclose(trajectory.T_world_sensor[:, 0, 3], [0.0, 0.3, 0.6, 0.9])


def test_a_message_that_is_none_is_named(link):
    recorder = heard(link, "/found")
    link.publish(odometry(0))
    kind, data = recorder.received[0]
    recorder.received.append((kind, data[:-9]))
    with pytest.raises(OdometryError, match=f"publishes a {kind} that cannot be read"):
        recorder.newest()


@pytest.mark.parametrize(
    ("interval", "cores", "seconds"),
    # Nodes that rest wake up with the clock; one that works is waited for, but not forever.
    [(0.1, 0.03, 2.0), (1.5, 0.03, 4.5), (30, 0.03, 90.0), (0.1, 0.4, 60.0), (None, 0.0, 10.0)],
)
def test_a_system_is_waited_for_until_it_rests(link, monkeypatch, interval, cores, seconds):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    recorder = heard(link, "/found")
    for i in range(3 if interval else 0):
        now[0] += interval
        link.publish(odometry(i))
    drain = Drain(recorder, len(SCANS), int(SCANS[-1]), lambda: cores * now[0])
    over = now[0]
    while not drain.over():
        now[0] += 0.1
    assert seconds <= now[0] - over < 1.1 * seconds + 2.5


def test_a_pose_that_comes_late_is_waited_for(link, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    recorder = heard(link, "/found")
    drain = Drain(recorder, len(SCANS), int(SCANS[-1]), lambda: 0.4 * now[0])
    for i in range(39):
        # Stamps of a clock that goes on tell nothing of the end.
        link.publish(odometry(39) if i % 2 else odometry(i))
        now[0] += 1.9
        assert not drain.over()
    link.publish(odometry(39))
    assert drain.over()


def test_messages_that_hold_no_poses_are_refused(link):
    recorder = heard(link, "/found")
    link.publish(local_link.imu(0))
    with pytest.raises(OdometryError, match=r"/found is sensor_msgs/msg/Imu; odometry\.settings"):
        recorder.poses()


@pytest.fixture
def played(tmp_path):
    """A system that hears a bag of the scans, as it is before a trial."""
    file = contained.template(tmp_path / "template.yaml")
    settings = RustleSettings(image="an image", template=str(file), odometry="/Odometry", rate=4.0)
    return PlayedBag(contained.VALUES, settings, contained.LIMITS, None)


GIVEN = ProgramInput(Path("drive.bag"), "/points", "", SCANS, None)


def test_a_system_whose_poses_cannot_be_heard_is_ended(played, tmp_path, monkeypatch):
    done = []

    class Deaf(RustleSettings.system):
        def __init__(self, *_):
            pass

        def reader(self):
            raise LinkError("the node has ended")

        def words(self):
            return ""

        def stop(self):
            done.append("stop")

        def close(self):
            done.append("close")

    monkeypatch.setattr(RustleSettings, "system", Deaf)
    with pytest.raises(LinkError, match="the node has ended"):
        played.trajectory(GIVEN, tmp_path)
    assert done == ["stop", "close"]


def test_a_topic_without_poses_is_told_with_the_others(link, played):
    system = SimpleNamespace(link=SimpleNamespace(topics=lambda: {"/odom": "", "/clock": ""}))
    words = (
        "on /Odometry until the system had rested for 10 s after the bag; nodes announce /odom. "
    )
    with pytest.raises(OdometryError, match=words):
        played._check_published(system, heard(link, "/Odometry"))


def test_poses_that_are_none_are_refused(link, played):
    recorder = heard(link, "/Odometry")
    for i in range(40):
        link.publish(odometry(i, np.nan if i == 20 else 0.3 * i))
    with pytest.raises(OdometryError, match="1 of 40 poses are not finite or have no rotation"):
        played._checked(recorder, GIVEN)


def test_scans_without_a_pose_are_counted(link, played, caplog):
    recorder = heard(link, "/Odometry")
    for i in range(0, 40, 2):
        link.publish(odometry(i, 0.3 * i))
    assert len(played._checked(recorder, GIVEN)) == 20
    assert "20 of 40 scans have no pose at rate 4; the first pose at 0.0 s" in caplog.text


def test_stamps_of_a_clock_are_matched_by_number_or_refused(link, played, caplog):
    recorder, late = heard(link, "/Odometry"), np.linspace(0, 4 * PERIOD, 40, dtype=int)
    for i in range(40):
        link.publish(local_link.odometry(int(SCANS[i] + late[i]), moved(0.3 * i)))
    found = played._checked(recorder, GIVEN)
    np.testing.assert_array_equal(found.stamps, SCANS)
    np.testing.assert_allclose(found.T_world_sensor[:, 0, 3], 0.3 * np.arange(40))
    assert "own clock, not by the scans; poses are matched to scans by number" in caplog.text
    recorder.received.pop()
    with pytest.raises(OdometryError, match=r"39 poses for 40 .*play: lockstep"):
        played._checked(recorder, GIVEN)


def test_of_paths_the_last_holds_all(link):
    recorder, types = heard(link, "/path"), local_link.TYPES
    poses = []
    for i in range(3):
        said = odometry(i, 0.1 * i)
        poses.append(types["geometry_msgs/msg/PoseStamped"](said.header, said.pose.pose))
        link.publish(types["nav_msgs/msg/Path"](said.header, list(poses)))
    assert [stamp for stamp, *_ in recorder.poses()] == SCANS[:3].tolist()
    link.publish(types["nav_msgs/msg/Path"](said.header, []))
    assert recorder.poses() == []


def settings(**told):
    return RustleSettings(**({"image": "x", "template": "p.yaml", "odometry": "/o"} | told))


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"odometry": "Odometry"}, "odometry"),
        ({"points": "points"}, "points"),
        ({"package": "a; rm"}, "package"),
        ({"arguments": ("a:=$(b)",)}, "arguments"),
        ({"play": "both"}, "play"),
        ({"rate": 0}, "rate: 0 is for play: lockstep"),
        ({"rate": -1}, "rate"),
        ({"image": ""}, "image"),
        ({"node": "/gicp"}, "node: parameters change only with play: lockstep"),
        (
            {"play": "lockstep", "set_parameter": ("x", "{name}={value}")},
            r"set_parameter: name the node, too \(node\)",
        ),
        (
            {"play": "lockstep", "node": "/n", "set_parameter": ("x", "{value}")},
            "names no {name} in its arguments",
        ),
    ],
)
def test_settings_that_are_refused(told, words):
    with pytest.raises(ValidationError, match=words):
        settings(**told)


def test_what_it_says_of_itself():
    for told, live, needs_imu, whole in (
        ({}, False, False, True),
        ({"imu": "/imu"}, False, False, True),
        ({"play": "lockstep"}, False, False, False),
        ({"play": "lockstep", "imu": "/imu"}, False, True, False),
        ({"play": "lockstep", "node": "/n"}, True, False, False),
    ):
        described = Rustle.describe(settings(**told))
        assert described.space is None
        assert (described.live, described.needs_imu, described.whole) == (live, needs_imu, whole)
    assert settings().packages == ("rustle-ros", "rustle")
    assert settings(package="own").packages == ("own",)


def test_trials_do_not_depend_on_how_parameters_are_set_while_it_runs():
    def made(**told):
        given = settings(play="lockstep", **told).model_dump()
        return OdometryFactory("rustle", given, ParameterSpace({}), Limits())

    one, steered = made(), made(node="/n", set_parameter=("x", "{name}", "{value}"))
    assert one.identity == steered.identity != made(imu="/imu").identity
    assert one.steering == {}
    assert steered.steering == {"node": "/n", "set_parameter": ("x", "{name}", "{value}")}
    config = StudyConfig(odometry={"name": "rustle"}, training=("a",))
    setup = ReplaySetup(config, steered, "live", (), model=random_model())
    assert setup.identity("standby")["switching"] == {"mechanism": "live"} | steered.steering


def test_what_is_checked_before_a_campaign(tmp_path, monkeypatch):
    file = template(tmp_path / "params.yaml")
    with pytest.raises(OdometryError, match=r"no-file\.yaml: there is no such file"):
        Rustle.check(settings(template=str(tmp_path / "no-file.yaml")), {})
    json = tmp_path / "params.json"
    json.write_text("{}")
    with pytest.raises(OdometryError, match=r"template: .*params\.json is not YAML, as ROS 1"):
        Rustle.check(settings(template=str(json)), {})
    told = settings(template=str(file))
    with pytest.raises(OdometryError, match=r"voxl: .*params\.yaml has no such value; .*voxel"):
        Rustle.check(told, {"voxl": 1.0})
    asked = []

    def image_digest(name):
        asked.append(name)
        raise EngineError("there is no image")

    monkeypatch.setattr("adaptune.odometry.systems.rustle.image_digest", image_digest)
    with pytest.raises(OdometryError, match="there is no image"):
        Rustle.check(told, {"other.voxel": 1.0, "keyframe_interval": 1.0})
    assert asked == ["x"]
