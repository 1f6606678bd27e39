import re

import numpy as np
import pytest
from contained import FIXED, LIMITS, VALUES, containers, drive, host_poses, scans
from needs import reference_image

from adaptune.odometry import OdometryError
from adaptune.odometry.base import InProcess
from adaptune.odometry.docker import programs
from adaptune.odometry.docker.engine import engine
from adaptune.odometry.docker.programs import DockerProcess, DockerProcessSettings
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.remote import Limits
from adaptune.space import Selection

pytestmark = pytest.mark.services

SERVE = ("odometry-serve", "{socket}")


def settings(*command, **more):
    return DockerProcessSettings(image=reference_image(), command=command or SERVE, **more)


def shell(script):
    return settings("sh", "-c", script)


@pytest.fixture
def make():
    odometries = []

    def begin(given=None, parameters=VALUES | FIXED, limits=LIMITS):
        odometries.append(DockerProcess.instance(parameters, given or settings(), limits))
        return odometries[-1]

    yield begin
    for odometry in odometries:
        odometry.close()


def changing(odometry):
    poses = []
    odometry.start(odometry.prepare(scans()[0]), np.eye(4))
    for i, scan in enumerate(scans()[1:20]):
        if i == 6:
            odometry.apply(Selection(0, {"max_correspondence_distance": 3.0}))
        poses.append(odometry.register(odometry.prepare(scan)).T_odom_sensor)
    return np.array(poses)


def test_it_is_the_same_odometry_and_changes_its_parameters(make):
    odometry = make()
    here = changing(InProcess(KeyframeGicp(VALUES | FIXED)))
    assert np.abs(here - host_poses()[1:20]).max() > 1e-5
    np.testing.assert_allclose(changing(odometry), here, atol=1e-6)
    # It keeps its container, and its parameters, from start to start.
    before = containers()
    again = drive(odometry)
    assert containers() == before
    np.testing.assert_allclose(again, host_poses(max_correspondence_distance=3.0), atol=1e-6)
    assert not odometry.faults
    assert odometry.usage.cpu > 0.0
    odometry.close()
    assert not containers()


def test_one_that_is_killed_is_a_fault_and_the_next_start_works(make):
    odometry = make(shell('echo at "$ADAPTUNE_SOCKET"; exec odometry-serve {socket}'))
    odometry.start(scans()[0], np.eye(4))
    (container,) = containers()
    engine().api.kill(container)
    for scan in scans()[1:3]:
        assert np.isnan(odometry.register(scan).T_odom_sensor).all()
    (told,) = odometry.faults
    words = r"its process was ended by SIGKILL: at (\S+) \| unix:\1"
    assert re.fullmatch(words, told), told
    assert odometry.ended
    assert not containers()
    np.testing.assert_allclose(drive(odometry), host_poses(), atol=1e-6)
    assert len(odometry.faults) == 1


@pytest.mark.parametrize(
    ("script", "words"),
    [
        (
            "echo no licence >&2; exit 7",
            r"its process ended with code 7 before it listened at its socket: no licence",
        ),
        ("echo waiting; exec sleep 300", r"it does not listen at its socket: waiting"),
        (
            "no-such-program",
            r"its process ended with code 127 before it listened at its socket: .*no-such.*",
        ),
        (
            "python3 -c 'bytearray(10**9)'",
            r"out of isolation\.memory = 0\.3 GB before it listened at its socket: Killed",
        ),
    ],
)
def test_programs_that_do_not_serve(make, script, words, monkeypatch):
    monkeypatch.setattr(programs, "FIRST_ANSWER", 3.0)
    odometry = make(shell(script), limits=Limits(memory=0.3))
    with pytest.raises(OdometryError, match=rf"{reference_image()}: {words}$"):
        odometry.start(scans()[0], np.eye(4))
    assert not containers()


QUIET = """
import socket, sys, time
server = socket.socket(socket.AF_UNIX)
server.bind(sys.argv[1])
server.listen()
connection, _ = server.accept()
connection.recv(1000)
time.sleep(300)
"""


def test_one_that_answers_nothing(make, monkeypatch):
    monkeypatch.setattr(programs, "FIRST_ANSWER", 3.0)
    odometry = make(settings("python3", "-c", QUIET, "{socket}"), limits=Limits(seconds=0.5))
    odometry.start(scans()[0], np.eye(4))
    (told,) = odometry.faults
    assert told.startswith("a scan took longer than isolation.seconds = 0.5")
    assert not containers()
