import io
import os
import pickle
import re
import socket
import struct
import subprocess
import sys
import threading

import drives
import faulty
import numpy as np
import pytest
import server
import turns
from made_drives import Tasks, task_of, trials_of
from rooms import moved
from setups import setup_of
from street import served

from adaptune._system import processes
from adaptune._system.strict import ConfigurationError
from adaptune.odometry import OdometryError, wire
from adaptune.odometry.base import InProcess
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.faults import MOST_FAULTS
from adaptune.odometry.guarded import Guarded
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.registry import make_here
from adaptune.odometry.remote import SERVICE, Isolated, Limits, Process, ProcessSettings
from adaptune.recording import Imu, Scan
from adaptune.recording.scan import ImuNoise
from adaptune.runs.archive import Archive
from adaptune.runs.loop import replay
from adaptune.space import Selection
from offline.config import load_study
from offline.workers import Workers, run

TOLD = {
    "abort": "ended by SIGABRT: about to go wrong",
    "segmentation fault": "ended by SIGSEGV: about to go wrong",
    "memory": r"out of isolation\.memory = 1 GB",
    "mirrored": "it gave a pose that is not rigid",
}
"""Faults of classes in processes of their own."""
HERE = {
    "init": "RuntimeError: no planes in init",
    "prepare": "RuntimeError: no planes in prepare",
    "start": "RuntimeError: no planes in start",
    "raise": "RuntimeError: no planes here",
    "exit": "SystemExit|ended with code 0: about to go wrong|ended",
    "hang": r"a scan took longer than isolation\.seconds = 0\.3",
    "hangs in init": r"a scan took longer than isolation\.seconds = 0\.3",
    "nothing": r"Faulty\.register \(\S+faulty\.py, line \d+\) returned None; let it return Reg",
    "text": r"faulty\.py, line \d+\) returned \('left', 1\); let it return Registration\(pose\)",
    "NaN": "it gave a pose that is not finite",
    "not rigid": "it gave a pose that is not rigid$",
    "transposed": r"not rigid: its last row is not 0 0 0 1; is it transposed\?",
    "shape": r"it gave a pose of shape \(3, 4\)",
}
"""Those that clean classes have in this process, too."""
CASES = [*((f, False) for f in TOLD | HERE), *((f, True) for f in HERE)]


def factory(fault="none", here=False, name="faulty:Clean"):
    limits = Limits(seconds=0.3 if "hang" in fault else 60.0, memory=1.0)
    return OdometryFactory(name, {"fault": fault}, faulty.Clean.space, limits, user_code=here)


def isolated(fault, **parameters):
    return factory(fault)(parameters)


def scan(i):
    return Scan(i * 10**8, np.zeros((5, 3), np.float32))


def drive(odometry, n=6):
    """Poses of some scans along x, NaN where there is none."""
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    poses = [odometry.register(odometry.prepare(scan(i))).T_odom_sensor for i in range(1, n)]
    return np.array([T[0, 3] for T in poses])


@pytest.mark.parametrize(("fault", "here"), CASES)
def test_every_fault_is_told_and_another_start_goes_on(fault, here):
    odometry = factory(fault, here)()
    assert isinstance(odometry, Guarded) == here
    x, n = drive(odometry), 0 if fault in (*faulty.ELSEWHERE, "shape") else 2
    np.testing.assert_allclose(x[:n], 0.1 * np.arange(1, n + 1))
    assert np.isnan(x[n:]).all()
    (told,) = odometry.faults
    assert re.search((TOLD | HERE)[fault], told), told
    T = moved(y=4.0)
    odometry.start(odometry.prepare(scan(6)), T)
    T, registered = odometry.register(odometry.prepare(scan(7)))
    if n:
        np.testing.assert_allclose(T[:3, 3], [0.1, 4.0, 0.0])
        # The class counts its instances in a variable of its module.
        assert registered or here
    if "hang" not in fault:
        for _ in range(20):
            odometry.start(odometry.prepare(scan(0)), np.eye(4))
            odometry.register(odometry.prepare(scan(3)))
        assert len(odometry.faults) == MOST_FAULTS


def test_only_who_says_so_runs_clean_classes_here():
    assert isinstance(factory()(), Isolated)
    assert isinstance(factory(here=True, name="faulty:Faulty")(), Isolated)
    assert isinstance(pickle.loads(pickle.dumps(factory(here=True)))(), Guarded)
    assert factory().description.module == "faulty"
    assert [factory(here=here)().warm_up for here in (False, True)] == [1.5, 1.5]


def test_a_class_is_the_same_odometry_here_and_there():
    here, there = (factory(here=here)({"x": 0.2}) for here in (True, False))
    np.testing.assert_array_equal(drive(here), drive(there))
    for odometry in (here, there):
        odometry.apply(Selection(0, {"x": 0.95}))
    for i in (6, 7):
        a, b = (o.register(o.prepare(scan(i))).T_odom_sensor for o in (here, there))
        np.testing.assert_array_equal(a, b)
        assert a[0, 3] == pytest.approx(0.5 + 0.3 * (i - 5))
        np.testing.assert_array_equal(
            here.motions.T_previous_current, there.motions.T_previous_current
        )
    assert here.usage.cpu > 0.0
    assert here.usage.memory is None
    # A process that begins later has the parameters, too.
    for odometry in (here, there):
        np.testing.assert_allclose(drive(odometry, 2), [0.3])


def test_settings_are_checked_in_another_process():
    with pytest.raises(OdometryError, match=r"faulty:Clean: settings: fualt: .*'fault'"):
        OdometryFactory("faulty:Clean", {"fualt": "hang"}, faulty.Clean.space, Limits())


def test_a_server_that_was_killed_is_replaced():
    odometry = isolated("none")
    odometry.start(scan(0), np.eye(4))
    other = processes.server(SERVICE, "faulty:Faulty")
    processes.server(SERVICE, "faulty:Clean").process.kill()
    processes.servers[SERVICE, "faulty:Clean"].process.wait()
    # Those it has forked live on, and so do other servers.
    assert odometry.register(scan(1)).T_odom_sensor[0, 3] == pytest.approx(0.1)
    odometry.start(scan(2), np.eye(4))
    assert processes.server(SERVICE, "faulty:Faulty") is other
    assert odometry.register(scan(3)).T_odom_sensor[0, 3] == pytest.approx(0.1)
    assert not odometry.faults


def test_a_trial_keeps_its_faults_and_goes_on(study_file, tmp_path):
    overrides = [
        "odometry.name=faulty:Faulty",
        "odometry.parameters=",
        f"odometry.settings={{fault: abort, at: {drives.FIRST_STAMP + 12 * 10**8}}}",
        "isolation={seconds: 60, memory: 1}",
    ]
    setup = setup_of(load_study(study_file, overrides, tmp_path / "study"))
    (trial,) = trials_of(setup, [{"x": 0.5}])
    assert np.flatnonzero(trial.restarted).tolist() == [12]
    assert "SIGABRT" in trial.reasons[0]
    assert not trial.failure
    archive = Archive(tmp_path)
    archive.write("one", 0, trial)
    assert archive.read("one", 0).reasons == trial.reasons
    # And the campaign goes on.
    tasks = [task_of(setup, "one", {n: {"x": 0.5}}) for n in range(2)]
    with Workers(setup, 1, 1e9) as workers:
        found = [drive for _, of in run(workers, Tasks(*tasks)) for (drive,) in of.values()]
    assert ["SIGABRT" in drive.faults[0] for drive in found] == [True, True]


@pytest.mark.parametrize(
    ("fault", "words"),
    [("leaves", "its process ended with code 3"), ("prepare", "no planes in prepare")],
)
def test_a_class_that_ends_the_worker_then_runs_apart(study_file, tmp_path, fault, words):
    overrides = ["odometry.name=faulty:Clean", "odometry.parameters=", "odometry.settings="]
    study = load_study(study_file, overrides, tmp_path / "study")
    setup = setup_of(study, factory(fault, here=True))
    tasks = Tasks(task_of(setup, "one", {0: {"x": 0.5}}))
    with Workers(setup, 1, 1e9) as workers:
        ((_, result),) = run(workers, tasks)
        ((process, _),) = workers._workers.values()
        # It may end its process group.
        assert os.getpgid(process.pid) == process.pid
    (drive,) = result[0]
    assert words in " ".join([*drive.faults, drive.exception])


def test_a_replay_goes_on_at_the_last_healthy_motion():
    result = replay([scan(i) for i in range(8)], isolated("hang"), HealthCheck())
    assert np.flatnonzero(result.restarted).tolist() == [3]
    np.testing.assert_allclose(result.trajectory.T_world_sensor[:, 0, 3], 0.1 * np.arange(8))


HELLO = {
    "type": "hello",
    "version": 2,
    "odometry": "faulty:Faulty",
    "parameters": {},
    "settings": {},
}


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


@pytest.mark.parametrize(
    ("first", "message"),
    [
        (HELLO | {"version": 1}, "speaks version 2 of the protocol, not 1"),
        (HELLO | {"settings": {"fualt": "hang"}}, "settings: fualt: unknown key"),
    ],
)
def test_what_a_server_refuses(first, message):
    sent, answered = io.BytesIO(), io.BytesIO()
    processes.send(sent, first)
    sent.seek(0)
    processes.answer_all(sent, answered, wire.conversation("faulty:Faulty", make_here))
    answered.seek(0)
    answer = processes.receive(answered)
    assert processes.receive(answered) is None
    assert answer.header["type"] == "refused"
    assert message in answer.header["message"]
    assert "https://" not in answer.header["message"]


def with_length(header):
    return struct.pack("<I", len(header)) + header


@pytest.mark.parametrize(
    "data",
    [
        *(b"Hello, world!", b"\x02\0\0\0{}", b"\x05\0\0\0{}", b"\x01", b"\x03\0\0\0[1]"),
        with_length(b'"words"'),
        with_length(b"7"),
        with_length(b'{"arrays": [["pose", ",", [4, 4]]]}'),
        with_length(b'{"arrays": [["pose", "<f8", 16]]}'),
        with_length(b'{"arrays": [["pose", "<f8", ["4", "4"]]]}'),
        with_length(b'{"arrays": [["pose", "<f8", [-4, 4]]]}') + bytes(128),
        # Not allocated.
        with_length(b'{"arrays": [["pose", "<f8", [4, 4000000000000]]]}'),
        with_length(b'{"arrays": [["pose", "<f8", [4294967296, 4294967296]]]}'),
        with_length(b'{"arrays": [["pose", "<U1000000000", [4, 4]]]}'),
    ],
)
def test_what_is_no_message(data):
    with pytest.raises(processes.WireError, match="the stream"):
        processes.receive(io.BytesIO(data))


LIMITS = Limits(seconds=20.0)


def program(fault="none"):
    return ProcessSettings(command=(sys.executable, server.__file__, fault))


TOLD_BY_PROGRAMS = {
    "exit": "its process ended with code 3: about to go wrong",
    "hang": r"a scan took longer than isolation\.seconds = 0\.5: about to go wrong",
    "words": r"the stream of \S+python\S* holds no message of adaptune's.*: about to go wrong",
    "backwards": r"a pose of another time, -0\.200 s from the scan's",
    "no pose": "an answer without 'pose'",
    "types": "an answer of other types",
    "shape": r"stream of \S+ holds no message of adaptune's \(pose: \[4, 4000000000000\]\)",
    "fault": "it does not say why",
}


@pytest.mark.parametrize("fault", TOLD_BY_PROGRAMS)
def test_faults_are_told_and_another_start_goes_on(fault, caplog):
    odometry = Process({}, program(fault), Limits(seconds=0.5 if fault == "hang" else 20.0))
    odometry.start(scan(0), np.eye(4))
    for i in (1, 2):
        assert np.isfinite(odometry.register(scan(i)).T_odom_sensor).all()
    for i in (3, 4):
        assert np.isnan(odometry.register(scan(i)).T_odom_sensor).all()
    (told,) = odometry.faults
    assert re.search(TOLD_BY_PROGRAMS[fault], told), told
    assert f"{sys.executable} with {{}}: {told}" in caplog.messages
    odometry.start(scan(5), np.eye(4))
    assert odometry.register(scan(6)).T_odom_sensor[0, 3] == 1.0


def test_what_a_program_takes_is_seen_where_it_does_not_tell_it():
    odometry = Process({}, program("works"), LIMITS)
    for starts in (1, 2):
        odometry.start(scan(0), np.eye(4))
        for i in (1, 2, 3, 4):
            odometry.register(scan(i))
        assert odometry.usage.cpu >= 0.2 * starts - 0.02  # a tick of the clock is 0.01 s
        assert odometry.usage.memory > 1.0
        odometry.close()


def test_of_a_program_elsewhere_the_time_until_its_poses_counts(tmp_path):
    where = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(where))
        listener.listen()
        odometry = Process({}, ProcessSettings(address=f"unix:{where}"), LIMITS)
        started = []

        def serve():
            with listener.accept()[0] as there:
                command = program("works").command
                started.append(subprocess.Popen(command, stdin=there, stdout=there))

        serving = threading.Thread(target=serve)
        serving.start()
        odometry.start(scan(0), np.eye(4))
        serving.join()
        for i in (1, 2, 3):
            odometry.register(scan(i))
        assert odometry.usage.cpu >= 0.15
        odometry.close()
    started[0].wait()


def test_equal_faults_are_told_once(caplog):
    odometry = Process({}, program("no pose"), LIMITS)
    for _ in range(2):
        odometry.start(scan(0), np.eye(4))
        for i in (1, 2, 3):
            odometry.register(scan(i))
    first, second = odometry.faults
    assert first == second
    assert len(caplog.messages) == 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (program("version"), r"it speaks version 1 of the protocol, this adaptune 2"),
        (program("space"), "its answer to hello does not describe it: 'space'"),
        (
            ProcessSettings(command=("sh", "-c", "echo no licence >&2; exit 7")),
            "its process ended with code 7: no licence",
        ),
        (ProcessSettings(command=("echo", "Hello, world!")), "ended|no message of adaptune's"),
        (ProcessSettings(command=("no-such-program",)), "no-such-program: not found"),
        (
            ProcessSettings(address="tcp://127.0.0.1:9"),
            r"nothing listens at tcp://127.0.0.1:9 \(Conn.*\): start the program there first",
        ),
        (ProcessSettings(address="127.0.0.1:9000"), "neither tcp://HOST:PORT nor unix:PATH"),
    ],
)
def test_programs_that_do_not_serve(settings, message):
    with pytest.raises(OdometryError, match=message):
        Process.describe(settings)


def driven(odometry, n=12):
    poses = []
    odometry.start(odometry.prepare(turns.turn(0)), np.eye(4))
    for i in range(1, n):
        if i == 6:
            odometry.apply(Selection(0, {"keyframe_interval": 2.0}))
        poses.append(odometry.register(odometry.prepare(turns.turn(i))).T_odom_sensor)
    return np.array(poses)


NEAR = {"max_correspondence_distance": 2.0, "keyframe_interval": 1.0}


def test_it_is_the_same_odometry_in_a_program():
    settings = served().model_copy(update={"settings": {"downsampling": 0.4}})
    described = Process.describe(settings)
    settings_of = KeyframeGicp.settings_type(downsampling=0.4)
    assert described.space == KeyframeGicp.describe(settings_of).space
    assert described.live
    with pytest.raises(OdometryError, match="downsmapling"):
        Process.describe(settings.model_copy(update={"settings": {"downsmapling": 1}}))
    here = InProcess(KeyframeGicp(NEAR, KeyframeGicp.settings_type(downsampling=0.4)))
    there, other = (Process(NEAR, settings, LIMITS) for _ in range(2))
    other.start(turns.turn(5), np.eye(4))
    np.testing.assert_array_equal(driven(there), driven(here))
    assert not there.faults


def test_a_study_takes_its_space(study_file, tmp_path):
    command = f"[{sys.executable}, {server.__file__}]"
    overrides = [
        "odometry.name=process",
        f"odometry.settings={{command: {command}}}",
        "odometry.parameters={speed: {high: 2.0}}",
    ]
    study = load_study(study_file, overrides, tmp_path / "study")
    assert study.odometry.space.parameters["speed"].high == 2.0
    assert study.odometry.description.live
    odometry = study.odometry({"speed": 1.5})
    odometry.start(scan(0), np.eye(4))
    assert odometry.register(scan(1)).T_odom_sensor[0, 3] == 1.5
    for more, words in (
        ("odometry.parameters={sped: {high: 2.0}}", "process has no parameter 'sped': did you"),
        ("odometry.settings={address: 'tcp://127.0.0.1:9'}", "odometry.settings: nothing listens"),
        ("odometry.settings={}", "odometry.settings: give a command or an address"),
    ):
        with pytest.raises(ConfigurationError) as caught:
            load_study(study_file, [*overrides, more])
        assert words in str(caught.value)


def test_one_whose_program_has_gone_is_a_fault(tmp_path):
    where = tmp_path / "socket"
    settings = ProcessSettings(address=f"unix:{where}")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(where))
        listener.listen()
        odometry = Process({}, settings, LIMITS)

        def hang_up():
            listener.accept()[0].close()

        ending = threading.Thread(target=hang_up)
        ending.start()
        odometry.start(scan(0), np.eye(4))
        ending.join()
    assert odometry.ended
    for _ in range(MOST_FAULTS + 5):
        odometry.start(scan(1), np.eye(4))
        assert np.isnan(odometry.register(scan(2)).T_odom_sensor).all()
    assert odometry.given_up
    assert len(odometry.faults) == MOST_FAULTS
    assert "nothing listens at unix:" in odometry.faults[-1]
    # A new one says what to do.
    with pytest.raises(OdometryError, match="start the program there first"):
        Process({}, settings, LIMITS).start(scan(0), np.eye(4))
