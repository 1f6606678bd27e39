import os
import re
import tempfile

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
    recording,
    scans,
    template,
    truth,
)
from made_drives import described, trials_of
from needs import reference_image
from rooms import moved
from setups import setup_of

from adaptune._system.strict import ConfigurationError
from adaptune.odometry import OdometryError
from adaptune.odometry.base import InProcess
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.remote import Limits
from adaptune.odometry.systems import programs
from adaptune.odometry.systems.engine import Container, EngineError, engine
from adaptune.odometry.systems.programs import (
    DockerCommand,
    DockerCommandSettings,
    DockerProcess,
    DockerProcessSettings,
)
from adaptune.odometry.template import Template
from adaptune.space import Selection
from offline.config import load_study

pytestmark = pytest.mark.services

PLAIN = ("odometry-plain", "{points}")


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    reference_image()
    return recording(tmp_path_factory.mktemp("recording"))


@pytest.fixture
def nothing_left(tmp_path, monkeypatch):
    """The folder of temporary files is empty, and no container runs, when a test ends."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    before = set(containers())
    yield
    assert not list(folder.iterdir())
    assert set(containers()) <= before


def settings(tmp_path, *command, name="params.yaml", **more):
    file = template(tmp_path / name)
    return DockerCommandSettings(
        image=reference_image(), command=command or PLAIN, template=str(file), **more
    )


def made(settings, given, limits=LIMITS, parameters=VALUES):
    DockerCommand.check(settings, parameters)
    return DockerCommand.instance(parameters, settings, limits, lambda: given)


def shell(tmp_path, script, **more):
    return settings(tmp_path, "sh", "-c", script, **more)


@pytest.mark.usefixtures("nothing_left")
def test_the_poses_are_those_of_the_program_on_this_machine(tmp_path, given):
    odometry = made(settings(tmp_path), given)
    poses = drive(odometry)
    assert not odometry.faults
    np.testing.assert_allclose(poses, host_poses(), atol=1e-6)
    assert 0.0 < odometry.usage.cpu < 60.0
    assert 0.0 < odometry.usage.memory < 2000.0
    assert 0.0 < odometry.usage.seconds < 60.0 / N_SCANS
    # Later starts run nothing.
    begun = odometry.usage.cpu
    T = moved(5.0, 6.0, 7.0)
    np.testing.assert_allclose(drive(odometry, T=T)[-1], T @ poses[-1], atol=1e-9)
    assert odometry.usage.cpu == begun


def study_overrides(tmp_path):
    template(tmp_path / "params.yaml")
    return [
        "odometry.name=docker_command",
        f"odometry.settings={{image: {reference_image()}, command: [odometry-plain, '{{points}}'], "
        f"template: {tmp_path}/params.yaml}}",
        "odometry.parameters={max_correspondence_distance: {type: float, low: 1, high: 5, "
        "baseline: 2}, gicp.keyframe_interval: {type: float, low: 1, high: 5, baseline: 1.5}}",
    ]


def test_a_trial_of_a_study(tmp_path, study_file):
    overrides = study_overrides(tmp_path)
    study = load_study(study_file, overrides, tmp_path / "run")
    assert study.odometry.one_by_one
    parameters = {"max_correspondence_distance": 2.0, "gicp.keyframe_interval": 1.5}
    (trial,) = trials_of(setup_of(study), [parameters])
    assert not trial.faults
    np.testing.assert_allclose(trial.T_odom_sensor, host_poses(), atol=1e-6)
    content = study.odometry.content
    assert any(
        name.startswith("image ") and of.startswith("sha256:") for name, of in content.items()
    )
    assert f"{tmp_path}/params.yaml" in content
    for override, words in (
        ("odometry.settings.image=no-such", "there is no image 'no-such' on this machine"),
        ("odometry.settings.cpus=0", "odometry.settings.cpus"),
        ("odometry.settings.command=[x, '{ouput}']", "{ouput} is nothing; did you mean 'output'?"),
        ("odometry.parameters.voxl={type: float, low: 1, high: 2, baseline: 1}", "voxl: no argum"),
    ):
        with pytest.raises(ConfigurationError) as caught:
            load_study(study_file, [*overrides, override])
        assert words in str(caught.value)


def test_every_placeholder_and_the_file_get_there(tmp_path, given):
    script = """
        env | grep ADAPTUNE_ | sort
        echo {input} {points} {parameters} {output} {voxel}
        ls /data; exit 1
    """
    odometry = made(
        shell(tmp_path, script, name="params.yml", output="poses/run.tum"),
        given,
        parameters=VALUES | {"voxel": 3},
    )
    drive(odometry)
    (fault,) = odometry.faults
    assert fault.endswith(
        "ADAPTUNE_IMU= | ADAPTUNE_POINTS=/points | "
        "/data/drive.bag /points /parameters.yml /output/poses/run.tum 3 | drive.bag"
    )
    filled = Template(tmp_path / "params.yml").fill(odometry.parameters)
    assert "max_correspondence_distance: 2.0" in filled
    assert "voxel: 3" in filled


FAULTS = {
    "exit": ("echo no planes here >&2; exit 3", r"its process ended with code 3: no planes here"),
    "another code": ("exit 255", r"its process ended with code 255.*"),
    "nothing": ("echo done", r"it left no trajectory\.tum: done"),
    "pipe": ("mkfifo /output/trajectory.tum", r"it left no trajectory\.tum.*"),
    "link": ("ln -s /etc/hostname /output/trajectory.tum", r"it left no trajectory\.tum.*"),
    "memory": ("python3 -c 'bytearray(10**9)'", r"out of isolation\.memory = 0\.3 GB: Killed"),
    "hang": ("echo waiting; exec sleep 300", "it took longer than isolation.seconds.*: waiting"),
    "deaf": ("trap '' TERM; echo I stay; sleep 300; sleep 300", r"it took longer .*: I stay"),
    "prints": ("yes", r"it took longer than isolation.seconds.*: y( \| y)+"),
    "disk": (
        "exec dd if=/dev/zero of=/output/big bs=1M count=20",
        r"its process was ended by SIGXFSZ \(it wrote too large a file\)(: .*)?",
    ),
}


@pytest.mark.usefixtures("nothing_left")
@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_told_with_the_last_lines(fault, tmp_path, given, caplog, monkeypatch):
    script, words = FAULTS[fault]
    monkeypatch.setattr("adaptune.odometry.systems.engine._MOST_WRITTEN", 10**6)
    seconds = 2.0 / N_SCANS if fault in ("hang", "deaf", "prints") else 60.0
    limits = Limits(seconds=seconds, memory=0.3 if fault == "memory" else 2.0)
    odometry = made(shell(tmp_path, script), given, limits)
    poses = drive(odometry)
    (told,) = odometry.faults
    assert re.fullmatch(words, told), told
    assert f"{reference_image()} with {VALUES}: {told}" in caplog.messages
    assert np.isnan(poses[-1]).all()


@pytest.mark.usefixtures("nothing_left")
def test_a_file_of_another_user_is_read(tmp_path, given):
    script = "umask 077; odometry-plain && stat -c %u:%a /output/trajectory.tum"
    odometry = made(shell(tmp_path, script, user="1234:1234"), given)
    poses = drive(odometry)
    if os.getuid():
        # Nobody else may read it then.
        assert "trajectory.tum" in odometry.faults[0]
        return
    assert not odometry.faults
    np.testing.assert_allclose(poses[:, :3, 3], truth()[:, :3, 3], atol=0.1)


def test_an_engine_that_goes_away_is_no_trial(tmp_path, study_file, monkeypatch):
    def gone(_):
        raise EngineError("the Docker engine does not answer any more")

    setup = setup_of(load_study(study_file, study_overrides(tmp_path), tmp_path / "run"))
    frames = described(setup)
    monkeypatch.setattr(Container, "ended", gone)
    with pytest.raises(EngineError, match="does not answer"):
        trials_of(setup, [{"max_correspondence_distance": 2.0}], frames=frames)


SERVE = ("odometry-serve", "{socket}")


def serving(*command, **more):
    return DockerProcessSettings(image=reference_image(), command=command or SERVE, **more)


def serving_shell(script):
    return serving("sh", "-c", script)


@pytest.fixture
def make():
    odometries = []

    def begin(given=None, parameters=VALUES | FIXED, limits=LIMITS):
        odometries.append(DockerProcess.instance(parameters, given or serving(), limits))
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
    odometry = make(serving_shell('echo at "$ADAPTUNE_SOCKET"; exec odometry-serve {socket}'))
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
            "python3 -c 'bytearray(10**9)'",
            r"out of isolation\.memory = 0\.3 GB before it listened at its socket: Killed",
        ),
    ],
)
def test_programs_that_do_not_serve(make, script, words, monkeypatch):
    monkeypatch.setattr(programs, "FIRST_ANSWER", 3.0)
    odometry = make(serving_shell(script), limits=Limits(memory=0.3))
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
    odometry = make(serving("python3", "-c", QUIET, "{socket}"), limits=Limits(seconds=0.5))
    odometry.start(scans()[0], np.eye(4))
    (told,) = odometry.faults
    assert told.startswith("a scan took longer than isolation.seconds = 0.5")
    assert not containers()
