import io
import os
import re
import subprocess
import sys
import time

import drives
import faulty
import numpy as np
import pytest
import turns
from setups import setup_of

from adaptune import processes
from adaptune.archive import Archive
from adaptune.odometry import OdometryError, wire
from adaptune.odometry.keyframe import KeyframeGicp, KeyframeSettings
from adaptune.odometry.registry import make_here
from adaptune.odometry.remote import SERVICE, Isolated, Limits
from adaptune.odometry.tracker import HealthCheck
from adaptune.processes import server
from adaptune.recording import Imu, Scan
from adaptune.recording.scan import ImuNoise
from adaptune.selection import Selection
from offline.config import load_study
from offline.workers import Task, Workers, run
from online.replay import replay

TOLD = {
    "abort": "ended by SIGABRT: about to go wrong",
    "segmentation fault": "ended by SIGSEGV: about to go wrong",
    "exit": "ended",
    "raise": r"ended with code 1: .*RuntimeError: no planes here",
    "hang": r"a scan took longer than isolation.seconds = 0\.3: about to go wrong",
    "memory": r"out of isolation\.memory = 1 GB",
    "NaN": "a pose that is not finite",
    "not rigid": "a pose that is not rigid",
    "mirrored": "a pose that is not rigid",
    "shape": r"a pose of shape \(3, 4\)",
}


def isolated(fault, **parameters):
    settings = faulty.Settings(fault=fault)
    return Isolated("faulty:Faulty", parameters, settings, Limits(seconds=0.3, memory=1.0))


def scan(i):
    return Scan(i * 10**8, np.zeros((5, 3), np.float32))


@pytest.mark.parametrize("fault", faulty.FAULTS)
def test_every_fault_is_told_and_another_start_goes_on(fault):
    odometry = isolated(fault)
    odometry.start(scan(0), np.eye(4))
    first = 1 if fault == "shape" else 3
    for i in range(1, first):
        assert odometry.register(scan(i)).T_odom_sensor[0, 3] == pytest.approx(0.1 * i)
    for i in range(first, 6):
        T, registered = odometry.register(scan(i))
        assert np.isnan(T).all()
        assert not registered
    (told,) = odometry.faults

    assert re.search(TOLD[fault], told), told
    T = np.eye(4)
    T[1, 3] = 4.0
    odometry.start(scan(6), T)
    if fault != "shape":
        T, registered = odometry.register(scan(7))
        np.testing.assert_allclose(T[:3, 3], [0.1, 4.0, 0.0])
        # The class counts its instances in a variable of its module.
        assert registered


def test_one_that_cannot_begin_is_given_up():
    odometry = isolated("never begins")
    begin = time.perf_counter()
    for _ in range(30):
        odometry.start(scan(0), np.eye(4))
        assert np.isnan(odometry.register(scan(1)).T_odom_sensor).all()
    assert len(odometry.faults) == 10
    assert time.perf_counter() - begin < 5.0


def test_a_server_that_was_killed_is_replaced():
    odometry = isolated("none")
    odometry.start(scan(0), np.eye(4))
    server(SERVICE, "faulty:Faulty").process.kill()
    server(SERVICE, "faulty:Faulty").process.wait()
    # Those it has forked live on.
    assert odometry.register(scan(1)).T_odom_sensor[0, 3] == pytest.approx(0.1)
    odometry.start(scan(2), np.eye(4))
    assert odometry.register(scan(3)).T_odom_sensor[0, 3] == pytest.approx(0.1)
    assert not odometry.faults


def test_what_it_refuses_is_an_error():
    odometry = Isolated("ntd", {}, faulty.Settings(), Limits())
    with pytest.raises(OdometryError, match="there is no odometry 'ntd': did you mean 'ndt'"):
        odometry.start(scan(0), np.eye(4))


def test_parameters_change_between_scans():
    odometry = isolated("none", x=0.1)
    odometry.start(scan(0), np.eye(4))
    assert odometry.register(scan(1)).T_odom_sensor[0, 3] == pytest.approx(0.1)
    odometry.apply(Selection(0, {"x": 0.95}))
    assert odometry.register(scan(2)).T_odom_sensor[0, 3] == pytest.approx(0.4)
    # A process that begins later has them too.
    odometry.start(scan(3), np.eye(4))
    assert odometry.register(scan(4)).T_odom_sensor[0, 3] == pytest.approx(0.3)


def test_it_is_the_same_odometry_in_another_process():
    here = KeyframeGicp({"keyframe_interval": 1.0})
    there = Isolated("gicp", {"keyframe_interval": 1.0}, KeyframeSettings(), Limits())
    motion = np.eye(4)
    motion[0, 3] = turns.STEP
    here.start(here.prepare(turns.turn(0)), np.eye(4), motion)
    there.start(there.prepare(turns.turn(0)), np.eye(4), motion)
    for i in range(1, 10):
        a = here.register(here.prepare(turns.turn(i)))
        b = there.register(there.prepare(turns.turn(i)))
        np.testing.assert_array_equal(a.T_odom_sensor, b.T_odom_sensor)
        assert a.registered == b.registered


def faulty_study(study_file, tmp_path, fault):
    overrides = [
        "odometry.name=faulty:Faulty",
        "odometry.parameters=",
        f"odometry.settings={{fault: {fault}, at: {drives.FIRST_STAMP + 12 * 10**8}}}",
        "isolation={seconds: 0.3, memory: 1}",
        "lost_track=100",
    ]
    return load_study(study_file, overrides, tmp_path / "study")


def test_a_trial_keeps_its_faults_and_goes_on_at_the_reference(study_file, tmp_path):
    study = faulty_study(study_file, tmp_path, "abort")
    setup = setup_of(study)
    sequence = setup.prepare("one", 1e9)
    (trial,) = setup.run(sequence, [{"x": 0.5}])
    assert np.flatnonzero(trial.restarted).tolist() == [12]
    np.testing.assert_array_equal(trial.T_odom_sensor[12], sequence.frames.T_ref_sensor[12])
    assert "SIGABRT" in trial.faults[0]
    assert np.isinf(trial.errors[5])
    assert np.isfinite(trial.errors[14])
    archive = Archive(tmp_path)
    archive.write("one", 0, trial)
    assert archive.read("one", 0).faults == trial.faults
    (whole,) = setup.run(sequence, [{"x": 0.5}], whole=True)
    assert np.isfinite(whole.errors[5])
    assert whole.faults


def test_the_campaign_goes_on(study_file, tmp_path):
    study = faulty_study(study_file, tmp_path, "segmentation fault")
    tasks = [Task("one", (n,), ({"x": 0.5},)) for n in range(2)]
    with Workers(setup_of(study), 1, 1e9) as workers:
        results = [result for _, result, _ in run(workers, tasks)]
    assert ["SIGSEGV" in result.trials[0].faults[0] for result in results] == [True, True]


def test_a_replay_goes_on_at_the_last_healthy_motion():
    result = replay([scan(i) for i in range(8)], isolated("hang"), HealthCheck())
    assert np.flatnonzero(result.restarted).tolist() == [3]
    np.testing.assert_allclose(result.trajectory.T_world_sensor[:, 0, 3], 0.1 * np.arange(8))


def exchange(*messages):
    """What a server answers to messages."""
    sent, answered = io.BytesIO(), io.BytesIO()
    for header, arrays in messages:
        processes.send(sent, header, **arrays)
    sent.seek(0)
    processes.answer_all(sent, answered, wire.conversation(None, make_here))
    answered.seek(0)
    answers = []
    while (message := processes.receive(answered)) is not None:
        answers.append(message)
    return answers


HELLO = {
    "type": "hello",
    "version": 2,
    "odometry": "faulty:Faulty",
    "parameters": {},
    "settings": {},
}


def test_a_conversation():
    points = {"points": np.zeros((0, 3), np.float32)}
    pose = {"pose": np.eye(4)}
    answers = exchange(
        (HELLO, {}),
        ({"type": "start", "stamp": 0}, points | pose),
        ({"type": "configure", "parameters": {"x": 1.0}}, {}),
        ({"type": "register", "stamp": 10**8}, points),
    )
    assert [a.header["type"] for a in answers] == ["done", "done", "done", "pose"]
    assert answers[0].header["live"] is True
    assert answers[3].arrays["pose"][0, 3] == pytest.approx(0.3)


def test_what_an_imu_measured_arrives():
    imu = Imu(
        np.arange(3),
        np.arange(9.0).reshape(3, 3),
        -np.arange(9.0).reshape(3, 3),
        2 * np.eye(4),
        ImuNoise(1.0, 2.0, 3.0, 4.0),
    )
    for given in (imu, imu.part(0, 0), None):
        sent = io.BytesIO()
        light = np.arange(5, dtype=np.float32)
        whole = Scan(7, np.ones((5, 3), np.float32), intensities=light, imu=given)
        processes.send(sent, {"type": "register", "stamp": 7}, **wire.scan_arrays(whole))
        sent.seek(0)
        there = wire.to_scan(processes.receive(sent))
        assert there.times is there.rings is None
        np.testing.assert_array_equal(there.intensities, light)
        got = there.imu
        for name in ("stamps", "angular_velocity", "acceleration", "T_sensor_imu", "noise"):
            np.testing.assert_array_equal(getattr(got, name, None), getattr(given, name, None))


def test_a_conversation_with_the_command_line():
    process = subprocess.Popen(
        [sys.executable, "-m", "adaptune.commands.cli", "serve"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    settings = {"fault": "words", "at": 0}
    points = np.zeros((5, 3), np.float32)
    with process:
        processes.send(process.stdin, HELLO | {"settings": settings})
        assert processes.receive(process.stdout).header["version"] == 2
        processes.send(process.stdin, {"type": "start", "stamp": -1}, points=points, pose=np.eye(4))
        assert processes.receive(process.stdout).header["type"] == "done"
        # What the odometry writes does not come between the messages.
        processes.send(process.stdin, {"type": "register", "stamp": 0}, points=points)
        assert processes.receive(process.stdout).arrays["pose"][0, 3] == pytest.approx(0.1)
        process.stdin.close()
        assert b"Traceback" not in process.stderr.read()
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("first", "message"),
    [
        ({"type": "configure", "parameters": {}}, "the first message must be a hello"),
        (HELLO | {"version": 1}, "speaks version 2 of the protocol, not 1"),
        (HELLO | {"odometry": None}, "the hello names no odometry"),
        (HELLO | {"odometry": "gipc"}, "did you mean 'gicp'"),
        (HELLO | {"settings": {"fualt": "hang"}}, "settings: fualt: unknown key"),
        ({"type": "hello", "version": 2}, "hello lacks parameters, settings"),
        ({"type": "begin"}, "no message of type 'begin'"),
        ({"type": "start", "stamp": 0}, "start lacks points, pose"),
        ({"type": "register", "stamp": 0}, "register lacks points"),
        ({}, "no message of type None"),
    ],
)
def test_what_a_server_refuses(first, message):
    (answer,) = exchange((first, {}))
    assert answer.header["type"] == "refused"
    assert message in answer.header["message"]
    assert "https://" not in answer.header["message"]


@pytest.mark.parametrize(
    "data", [b"Hello, world!", b"\x02\0\0\0{}", b"\x05\0\0\0{}", b"\x01", b"\x03\0\0\0[1]"]
)
def test_what_is_no_message(data):
    with pytest.raises(processes.WireError, match="the stream"):
        processes.receive(io.BytesIO(data))
