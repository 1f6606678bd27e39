"""The ROS 2 reference in its image and on this machine, scan by scan and by a bag that is played.

Its node is RustDDS, which shares no code with what carries adaptune's messages.
"""

import json
import re
import socket
from types import SimpleNamespace

import commands
import drives
import numpy as np
import pytest
import rec
from contained import LIMITS, N_SCANS, containers, drive, recording, scans, truth
from needs import module_of, ros2_image
from ros2_reference import ros2

from adaptune.errors import warn_once
from adaptune.odometry import OdometryError
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.systems import lockstep, played_bag, probe, ros2_system
from adaptune.odometry.systems.probe import check_live, look
from adaptune.odometry.systems.ros2_system import Ros2, Ros2System
from adaptune.recording import Imu, Scan
from adaptune.space import ParameterSpace, Selection

pytestmark = [
    pytest.mark.services,
    pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning"),
]

VALUES = {"voxel_size": 0.5, "icp.max_iterations": 30}


@pytest.fixture(scope="module", autouse=True)
def _image():
    ros2_image()


@pytest.fixture
def make(tmp_path):
    odometries = []

    def begin(parameters=VALUES, given=None, **settings):
        chosen = ros2(tmp_path / "icp.yaml", **({"patience": 60.0} | settings))
        odometries.append(Ros2.instance(parameters, chosen, LIMITS, given and (lambda: given)))
        return odometries[-1]

    yield begin
    for odometry in odometries:
        odometry.close()
    assert not containers()


def test_parameters_get_there_and_change_while_it_runs(make, monkeypatch):
    systems = []

    class Noted(Ros2System):
        def __init__(self, *given):
            super().__init__(*given)
            systems.append(self)

    monkeypatch.setattr(ros2_system.Ros2Settings, "system", Noted)
    odometry = make(node="/icp")
    poses = drive(odometry)
    np.testing.assert_allclose(poses[:, :3, 3], truth()[:, :3, 3], atol=0.08)
    assert not odometry.faults
    assert 0.0 < odometry.usage.cpu < 100.0
    assert 0.0 < odometry.usage.memory < 1000.0
    # The system, and adaptune's node in its network.
    assert len(containers()) == 2
    (system,) = systems
    held = system.link.ask("parameters")["/icp"]
    assert held["voxel_size"] == 0.5
    assert held["icp.max_iterations"] == 30
    assert held["icp.max_correspondence_distance"] == 1.5
    odometry.apply(Selection(0, {"icp.max_iterations": 1}))
    assert system.link.ask("parameters")["/icp"]["icp.max_iterations"] == 1
    with pytest.raises(OdometryError, match=r"/icp refuses icp\.max_iterations = 'many'"):
        odometry.apply(Selection(0, {"icp.max_iterations": "many"}))


def test_on_this_machine_it_needs_no_container(make):
    node = module_of("docker/build.py").build_node()
    command = (str(node), "--params-file", "{parameters}")
    odometry = make(image=None, command=command)
    Ros2.check(odometry._settings, VALUES)
    poses = drive(odometry)
    np.testing.assert_allclose(poses[:, :3, 3], truth()[:, :3, 3], atol=0.08)
    assert odometry.usage.cpu > 0.0
    assert not containers()
    with pytest.raises(OdometryError, match="a login shell of this machine finds no 'ros3'"):
        Ros2.check(odometry._settings.model_copy(update={"command": ("ros3",)}), VALUES)


@pytest.mark.parametrize(
    ("parameters", "settings", "words"),
    [
        ({"other": 2}, {}, "no node declares the parameter other, .*; there is 'icp"),
        (
            {"icp.max_iterations": 2.5},
            {},
            r"adaptune-reference-ros2 .*: its process ended with code 1: icp: parameter "
            r"icp\.max_iterations has invalid type",
        ),
        (
            VALUES,
            {"points": "/velodyne", "ready": 3},
            r"no node subscribed to the clouds' topic /points .*: /velodyne\)",
        ),
        (
            VALUES,
            {"odometry": "/parameter_events"},
            "/parameter_events is rcl_interfaces/msg/ParameterEvent; .*must name poses",
        ),
        (VALUES, {"command": ("/no-such", "{parameters}")}, "its process ended with code 127: "),
        (
            VALUES,
            {"command": ("ros2", "run", "{parameters}")},
            "a login shell of the image finds no 'ros2': is it a ROS 2 image",
        ),
    ],
)
def test_one_that_cannot_begin_says_why(make, parameters, settings, words):
    odometry = make(parameters, **settings)
    with pytest.raises(OdometryError, match=words):
        odometry.start(scans()[0], np.eye(4))
    assert odometry.ended
    assert not containers()


def test_its_manners_are_those_of_ros_1(make, monkeypatch):
    monkeypatch.setattr(lockstep, "_MOST_SILENT", 4)
    late = make(imitate={"late": 2}, patience=0.5)
    drive(late)
    assert not late.faults
    dies = make(imitate={"die_at": 4}, patience=3.0)
    poses = drive(dies)
    assert np.isfinite(poses[:4]).all()
    assert np.isnan(poses[-1]).all()
    assert "its process ended with code 3: " in dies.faults[0]
    assert "icp: terminating after 4 scans: the map is corrupt" in dies.faults[0]
    silent = make(imitate={"silent": True}, patience=0.2)
    drive(silent)
    assert re.match(r"no pose yet on /odometry for 4 scans in a row", silent.faults[0])


def test_poses_that_come_later_than_patience_are_told(make, monkeypatch):
    monkeypatch.setattr(lockstep, "_MOST_SILENT", 4)
    slow = make(imitate={"seconds_per_scan": 0.5}, patience=0.3)
    drive(slow)
    words = r"poses came later than odometry\.settings\.patience \(0\.3 s\): raise it, or let few"
    assert re.search(words, slow.faults[0])


def test_one_that_works_on_or_stamps_by_a_clock_is_told(make, caplog):
    warn_once.cache_clear()
    lockstep._SEEN.clear()
    busy = make(imitate={"background": 5.0})
    on = [busy.prepare(scan) for scan in scans()[:2]]
    busy.start(on[0], np.eye(4))
    busy.register(on[1])
    busy.close()
    assert "it works on after its last pose" in caplog.text
    assert "by its own clock" not in caplog.text
    clocked = make(imitate={"own_clock": 0.0})
    clocked.start(on[0], np.eye(4))  # a recording is of another time than this one
    assert "by its own clock, not by the scans; poses are matched to scans" in caplog.text


def test_what_it_does_is_told_before_it_is_tuned(tmp_path):
    given = ros2(tmp_path / "icp.yaml", imitate={"late": 2, "stamp_later": 0.05}, patience=0.3)
    found = look(given, VALUES, LIMITS, scans()[:12])
    assert found["subscribed topics"] == "/points"
    assert found["published topics"] == "/odometry"
    assert found["first pose"].startswith("after 3 scans")
    assert found["stamps"] == "of the scans, 50 ms after their begin"
    assert found["poses are of"] == "lidar in odom"
    assert found["lockstep"] == "yes"
    assert "declared, not in the template" not in found
    every_second = ros2(tmp_path / "icp.yaml", frame="os", imitate={"one_of": 2}, patience=0.2)
    file = tmp_path / "icp.yaml"
    file.write_text(re.sub("max_range: .*", "", file.read_text()))
    found = look(every_second, VALUES, LIMITS, scans()[:8])
    assert found["lockstep"] == "no: set odometry.settings.play: bag"
    words = "lidar in odom; scans are of os: set odometry.settings.extrinsic if it is not there"
    assert found["poses are of"] == words
    assert found["declared, not in the template"].startswith("max_range = ")
    assert not containers()


def test_parameters_that_are_accepted_in_vain_are_told(tmp_path):
    given = ros2(tmp_path / "icp.yaml", node="/icp", patience=9.0)
    values = VALUES | {"max_range": 60.0}
    others = {"voxel_size": 2.0, "max_range": 3.0, "icp.max_iterations": "many"}
    found = look(given, values, LIMITS, scans()[:16], others)
    assert found["takes effect while it runs"] == "voxel_size"
    vain = found["has no effect while it runs"]
    assert re.match(r"max_range, icp\.max_iterations is refused \(.*\): do not switch live", vain)


def _factory(folder, parameters, **settings):
    space = ParameterSpace.load(parameters)
    return OdometryFactory("ros2", ros2(folder / "icp.yaml", **settings), space, LIMITS)


def test_a_system_adapts_live_only_by_what_has_an_effect(tmp_path):
    given = {"node": "/icp", "patience": 9.0}
    size = {"voxel_size": {"type": "float", "low": 0.5, "high": 2.0, "baseline": 0.5}}
    vain = {"max_range": {"type": "float", "low": 3.0, "high": 60.0, "baseline": 60.0}}
    check_live(_factory(tmp_path, size, **given), scans()[:16])
    what = "/icp, set while it runs, changes nothing by max_range (the first 50 scans): it cannot "
    with pytest.raises(OdometryError, match=re.escape(what)):
        check_live(_factory(tmp_path, vain | size, **given), scans()[:16])
    # Of a system at rest nothing is known.
    points = scans()[0].points
    at_rest = [Scan(scan.stamp, points) for scan in scans()[:16]]
    check_live(_factory(tmp_path, vain, **given), at_rest)
    assert not containers()


def test_one_that_works_on_is_driven_without_waiting_too(tmp_path):
    given = ros2(tmp_path / "icp.yaml", imitate={"background": 2.5}, patience=9.0)
    found = look(given, VALUES, LIMITS, scans()[:5])
    words = r"yes: at rate: 0 its path is up to 0\.00 m off that at rate: 1, on 1\.\d m; keep"
    assert re.match(words, found["works on after a pose"])
    assert "takes effect while it runs" not in found


def test_an_imu_is_heard_until_the_end_of_a_scan(make):
    odometry = make(imitate={"imu": True}, imu="/imu", patience=10.0)
    given = []
    for scan in scans()[:10]:
        times = np.linspace(0, 0.1, len(scan), dtype=np.float32)
        stamps = scan.stamp + np.arange(0, 110_000_000, 10_000_000)
        imu = Imu(stamps, np.zeros((11, 3)), np.tile([0.0, 0.0, 9.81], (11, 1)))
        given.append(Scan(scan.stamp, scan.points, times, imu=imu))
    odometry.start(given[0], np.eye(4))
    assert all(odometry.register(scan).registered for scan in given[1:])


@pytest.mark.parametrize(
    "given",
    [
        {"imitate": {"livox": True}},
        {"sim_time": True},
        {
            "imitate": {"wants_imu_frame": True, "ready_delay": 2.0},
            "transforms": {"imu": ("lidar", (0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))},
        },
    ],
    ids=["a Livox's messages", "the recording's clock", "frames of the robot"],
)
def test_it_is_given_what_it_wants(make, given):
    odometry = make(**given)
    poses = drive(odometry)
    np.testing.assert_allclose(poses[:, :3, 3], truth()[:, :3, 3], atol=0.08)
    assert not odometry.faults


def test_a_ros_1_bag_is_played_as_it_was_recorded(make, tmp_path, monkeypatch):
    monkeypatch.setattr(played_bag, "_FIRST_POSE", 2.0)
    logs = tmp_path / "logs"
    logs.mkdir()
    given = recording(tmp_path / "bag", logs)
    odometry = make(given=given, play="bag", rate=4.0)
    poses = drive(odometry)
    np.testing.assert_allclose(poses[:, :3, 3], truth()[:, :3, 3], atol=0.08)
    assert not odometry.faults
    (kept,) = logs.iterdir()
    assert "max_iterations: 30" in (kept / "params.yaml").read_text()
    assert "ready for /points" in (kept / "output.log").read_text()
    assert "digest" in (kept / "trial.yaml").read_text()
    assert len(poses) == N_SCANS


def mounted():
    """The reference's LiDAR on its base."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    T[:3, 3] = 1.0, 0.5, 0.3
    return T


@pytest.mark.parametrize("play", ["lockstep", "bag"])
def test_poses_may_come_as_transforms(make, tmp_path, play):
    given = recording(tmp_path / "bag") if play == "bag" else None
    odometry = make(imitate={"tf": True}, odometry="/tf", given=given, play=play, rate=4.0)
    poses = drive(odometry)
    assert not odometry.faults
    # In the frame of the LiDAR, by way of the base, and not of the wheel.
    np.testing.assert_allclose(poses[:, :3, 3], truth()[:, :3, 3], atol=0.08)


def test_a_frame_that_is_not_there_is_told(make, monkeypatch):
    monkeypatch.setattr(lockstep, "_MOST_SILENT", 4)
    odometry = make(imitate={"tf": True}, odometry="/tf", frame="laser", patience=0.3)
    drive(odometry)
    words = "/tf moves base, wheel, and does not say where laser is; name the sensor's frame"
    assert words in odometry.faults[0]
    other = make(odometry="/odometri", patience=0.3)
    drive(other)
    assert "topics that are published: /odometry; did you mean '/odometry'?" in other.faults[0]


@pytest.mark.parametrize(
    ("imitate", "words"),
    [
        ({"twice": True}, "/odometry is published by two (/icp and /icp), whose poses would mix"),
        ({"times": 3000}, "it publishes more than 2000 messages a second on /odometry"),
        ({"wants_old": True}, "/icp wants /points transient local, with what was published before"),
    ],
)
def test_what_a_node_does_that_no_odometry_may_is_told(make, imitate, words):
    odometry = make(imitate=imitate, ready=6)

    def fault():
        drive(odometry)
        raise OdometryError(odometry.faults[0])

    with pytest.raises(OdometryError, match=re.escape(words)):
        fault()
    assert odometry.ended


def test_poses_of_another_frame_are_told(make, caplog):
    warn_once.cache_clear()
    odometry = make(frame="os", imitate={"late": 0})
    odometry.start(scans()[0], np.eye(4))
    words = "its poses are of lidar in odom; scans are of os: set odometry.settings.extrinsic if"
    assert words in caplog.text


def test_nodes_that_do_not_tell_their_parameters_are_told(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(ros2_system, "_UNDECLARED", 0.0)
    settings = ros2(tmp_path / "icp.yaml")
    deaf = SimpleNamespace(ask=lambda _: {})
    system = SimpleNamespace(link=deaf, _settings=settings, whole_name=lambda _, name: name)
    Ros2System.check(system, None, {"voxel_size": 0.5})
    assert "no node tells its parameters, so nobody knows whether voxel_size has" in caplog.text


def test_a_study_looks_tunes_and_replays_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fixed = "/tf_static", drives.FIRST_STAMP, rec.fixed_frame("lidar", "base", (0.0, 0.0, 0.3))
    for seed, name in enumerate("ab"):
        drives.write_bag(tmp_path / f"{name}.bag", drives.scans(seed, 60), [fixed])
    given = ros2(tmp_path / "icp.yaml", node="/icp")
    settings = given.model_dump(mode="json", exclude_defaults=True)
    study = {
        "sequences": {
            name: {"bag": f"{name}.bag", "points": "/points", "reference": "/truth"}
            for name in "ab"
        },
        "training": ["a"],
        "test": ["b"],
        "sub_trajectory": 3.0,
        "odometry": {
            "name": "ros2",
            "settings": settings,
            "parameters": {
                "voxel_size": {"type": "float", "low": 0.2, "high": 1.5, "baseline": 0.9}
            },
        },
        "offline": {"trials": 3, "workers": 1},
        # A mode that is a bank whatever the training found.
        "online": {"modes": ["adaptive", "untrained"], "switching": {"size": 2}},
    }
    (tmp_path / "icp_study.yaml").write_text(json.dumps(study))
    looked = commands.call("inspect", "icp_study.yaml")
    assert looked.exit_code == 0, looked.output
    assert "lockstep" in looked.stdout
    words = "settings.frame: lidar, and transforms: {lidar: [base, [0.0, 0.0, 0.3,"
    assert words in " ".join(looked.stdout.split())
    for command in ("offline", "online", "compare"):
        done = commands.call(command, "icp_study.yaml")
        assert done.exit_code == 0, done.output
    runs = tmp_path / "runs/icp_study"
    assert (runs / "fixed_icp.yaml").exists()
    (bank,) = (runs / "replays/b").glob("untrained-*")
    inputs = json.loads((bank / "inputs.json").read_text())["inputs"]
    assert inputs["switching"]["mechanism"] == "bank"
    assert json.loads((bank / "replay.json").read_text())["restarts"] == 0
    checked = []
    monkeypatch.setattr(probe, "check_live", lambda odometry, _: checked.append(odometry.name))
    one = ["-o", "online.switching.mechanism=live", "-o", "online.modes=[standby]"]
    live = commands.call("online", "icp_study.yaml", *one)
    assert live.exit_code == 0, live.output
    assert checked == ["ros2"]
    assert not containers()


def test_a_domain_that_others_use_is_left_to_them(monkeypatch):
    free, held = ros2_system._free_domain()
    held.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 7400 + 250 * free + 11))
        chosen, held = ros2_system._free_domain()
        held.close()
        assert chosen != free
        monkeypatch.setattr(ros2_system, "_DOMAINS", range(free, free + 1))
        words = f"all ROS domains from {free} to {free} are in use on this machine"
        with pytest.raises(OdometryError, match=words):
            ros2_system._free_domain()
