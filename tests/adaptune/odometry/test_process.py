import os
import re
import socket
import sys
import threading

import numpy as np
import pytest
import server
import turns
from commands import call
from street import listening

from adaptune.odometry import OdometryError
from adaptune.odometry.base import MOST_FAULTS, InProcess
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.remote import Limits, Process, ProcessSettings
from adaptune.recording import Scan
from adaptune.space import Selection
from adaptune.strict import ConfigurationError
from offline.config import load_study

LIMITS = Limits(seconds=20.0)


def program(fault="none"):
    return ProcessSettings(command=(sys.executable, server.__file__, fault))


def scan(i):
    return Scan(i * 10**8, np.zeros((5, 3), np.float32))


FAULTS = {
    "exit": "its process ended with code 3: about to go wrong",
    "hang": r"a scan took longer than isolation\.seconds = 0\.5: about to go wrong",
    "words": r"the stream holds no message of adaptune's.*: about to go wrong",
    "backwards": r"a pose of another time, -0\.200 s from the scan's",
    "no pose": "an answer without 'pose'",
    "types": "an answer of other types",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_told_and_another_start_goes_on(fault, caplog):
    odometry = Process({}, program(fault), Limits(seconds=0.5 if fault == "hang" else 20.0))
    odometry.start(scan(0), np.eye(4))
    for i in (1, 2):
        assert np.isfinite(odometry.register(scan(i)).T_odom_sensor).all()
    for i in (3, 4):
        assert np.isnan(odometry.register(scan(i)).T_odom_sensor).all()
    (told,) = odometry.faults
    assert re.search(FAULTS[fault], told), told
    assert f"{sys.executable} with {{}}: {told}" in caplog.messages
    odometry.start(scan(5), np.eye(4))
    assert odometry.register(scan(6)).T_odom_sensor[0, 3] == 1.0


def test_equal_faults_are_told_once(caplog):
    odometry = Process({}, program("no pose"), Limits(seconds=20.0))
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


def drive(odometry, n=12):
    poses = []
    odometry.start(odometry.prepare(turns.turn(0)), np.eye(4))
    for i in range(1, n):
        if i == 6:
            odometry.apply(Selection(0, {"keyframe_interval": 2.0}))
        poses.append(odometry.register(odometry.prepare(turns.turn(i))).T_odom_sensor)
    return np.array(poses)


NEAR = {"max_correspondence_distance": 2.0, "keyframe_interval": 1.0}


@pytest.mark.parametrize("kind", ["tcp", "unix"])
def test_it_is_the_same_odometry_behind_a_socket(tmp_path, kind):
    where = "tcp://127.0.0.1:0" if kind == "tcp" else f"unix:{tmp_path / 'socket'}"
    settings = ProcessSettings(address=listening(where, "gicp"), settings={"downsampling": 0.4})
    described = Process.describe(settings)
    settings_of = KeyframeGicp.settings_type(downsampling=0.4)
    assert described.space == KeyframeGicp.describe(settings_of).space
    assert described.live
    with pytest.raises(OdometryError, match="downsmapling"):
        Process.describe(settings.model_copy(update={"settings": {"downsmapling": 1}}))
    here = InProcess(KeyframeGicp(NEAR, KeyframeGicp.settings_type(downsampling=0.4)))
    there, other = (Process(NEAR, settings, LIMITS) for _ in range(2))
    other.start(turns.turn(5), np.eye(4))
    np.testing.assert_array_equal(drive(there), drive(here))
    assert not there.faults


def test_it_is_the_same_odometry_behind_the_command_line(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    command = (sys.executable, "-m", "adaptune.commands.cli", "serve", "gicp")
    odometry = Process(NEAR, ProcessSettings(command=command), Limits(seconds=60.0))
    np.testing.assert_array_equal(drive(odometry), drive(InProcess(KeyframeGicp(NEAR))))
    assert not odometry.faults


@pytest.mark.parametrize(
    ("name", "words"),
    [("command", "command is a program of the user: serve"), ("gipc", "did you mean 'gicp'")],
)
def test_what_cannot_be_served(name, words):
    done = call("serve", name, "--listen", "tcp://127.0.0.1:0")
    assert done.exit_code == 2
    assert words in " ".join(done.output.split())


def test_a_fault_of_a_served_odometry_arrives():
    settings = ProcessSettings(
        address=listening("tcp://127.0.0.1:0", "faulty:Faulty"), settings={"fault": "abort"}
    )
    odometry = Process({}, settings, LIMITS)
    odometry.start(scan(0), np.eye(4))
    odometry.apply(Selection(0, {"x": 1.0}))
    assert odometry.register(scan(1)).T_odom_sensor[0, 3] == pytest.approx(0.3)
    odometry.register(scan(2))
    assert np.isnan(odometry.register(scan(3)).T_odom_sensor).all()
    assert odometry.faults == ["its process was ended by SIGABRT: about to go wrong"]


def test_garbage_ends_its_own_conversation_only():
    address = listening("tcp://127.0.0.1:0", "gicp")
    host, port = address.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port))) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert not connection.recv(100)
    assert Process.describe(ProcessSettings(address=address)).live


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
