"""The image of docker/reference, as tests of containers use it: as another user, offline."""

import subprocess
import time

import drives
import numpy as np
import pytest
import small_bag
from needs import reference_image

from adaptune.odometry.base import InProcess
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.remote import Limits, Process, ProcessSettings
from adaptune.recording.scan import Scan
from adaptune.trajectory import read_tum

pytestmark = pytest.mark.services

USER = "1234:1234"
PARAMETERS = {"max_correspondence_distance": 2.0, "keyframe_interval": 1.5}
FILE = """\
use_sim_time: true
common: {points_topic: /points}
gicp: {max_correspondence_distance: 2.0, keyframe_interval: 1.5, downsampling: 2e-1, other: 3}
"""
LAUNCH = "exec roslaunch rustle-ros rustle.launch required:=false"
DRIVE = """\
until rostopic info /points | grep -q '/gicp'; do sleep 0.1; done
[ -z "$SET" ] || rosservice call /gicp/set_parameters "$SET"
rostopic echo -p /Odometry > /output/poses.csv &
until rostopic info /Odometry | grep -q '/rostopic'; do sleep 0.1; done
rosbag play --quiet --clock -r 4 --delay 1 --wait-for-subscribers \\
    /rustle/dataset/drive.bag > /dev/null
for i in $(seq 600); do [ $(wc -l < /output/poses.csv) -gt $POSES ] && break; sleep 0.1; done
kill %1
"""


def docker(*arguments, check=False):
    command = ["docker", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=check)


@pytest.fixture(scope="module")
def scans():
    return [Scan(stamp, points) for stamp, points, _ in drives.scans(n_scans=12)]


@pytest.fixture(scope="module")
def bags(scans, tmp_path_factory):
    """A folder with a bag of the scans."""
    folder = tmp_path_factory.mktemp("bags")
    clouds = [("/points", scan.stamp, drives.cloud(scan.stamp, scan.points)) for scan in scans]
    small_bag.write(folder / "drive.bag", clouds)
    folder.chmod(0o755)
    return folder


@pytest.fixture
def mounts(bags, tmp_path):
    """Options of `docker run`, and the folder that is /output."""
    output, parameters = tmp_path / "output", tmp_path / "params.yaml"
    output.mkdir()
    output.chmod(0o777)
    parameters.write_text(FILE)
    mounted = [f"{bags}:/rustle/dataset:ro", f"{bags}:/data:ro", f"{output}:/output"]
    mounted += [f"{parameters}:/rustle/config/params.yaml:ro", f"{parameters}:/parameters.yaml:ro"]
    # ROS makes its folder of logs in one that belongs to the same group.
    alone = ["--network=none", f"--user={USER}", "--tmpfs=/home/ros:uid=1234,gid=1234"]
    alone += ["--env=ROS_IP=127.0.0.1", "--env=ROS_HOME=/home/ros"]
    return [*alone, *(f"--volume={it}" for it in mounted)], output, parameters


def expected(scans, parameters):
    odometry = InProcess(KeyframeGicp(parameters))
    odometry.start(odometry.prepare(scans[0]), np.eye(4))
    rest = [odometry.register(odometry.prepare(scan)).T_odom_sensor for scan in scans[1:]]
    return np.array([np.eye(4), *rest])


def stop(name):
    docker("rm", "--force", name, check=True)


def drive(mounts, poses=12, **environment):
    """Start the node, play the bag, and read stamps and positions; also what roslaunch said."""
    options, output, _ = mounts
    started = docker(
        *("run", "--detach", *options), *(reference_image(), "bash", "-lc", LAUNCH), check=True
    )
    name = started.stdout.strip()
    try:
        given = environment | {"POSES": poses}
        env = [f"--env={key}={value}" for key, value in given.items()]
        docker("exec", *env, name, "bash", "-lc", DRIVE, check=True)
        rows = [line.split(",") for line in (output / "poses.csv").read_text().splitlines()[1:]]
    finally:
        said = docker("logs", name)
        stop(name)
    stamps = np.array([int(row[2]) for row in rows])
    return stamps, np.array([row[5:8] for row in rows], float), said.stdout + said.stderr


def test_any_user_finds_the_package_and_the_launch_file():
    found = docker(
        *("run", "--rm", "--network=none", f"--user={USER}", reference_image()),
        *("bash", "-lc", "rospack find rustle-ros && roslaunch --files rustle-ros rustle.launch"),
    )
    package = "/catkin_ws/src/rustle-ros"
    assert found.stdout.split() == [package, f"{package}/rustle.launch"], found.stderr


def test_the_node_publishes_the_pose_of_each_scan(scans, mounts):
    stamps, positions, _ = drive(mounts)
    # ROS reads 2e-1 as a string: the default stands.
    poses = expected(scans, PARAMETERS)
    assert stamps.tolist() == [scan.stamp for scan in scans]
    np.testing.assert_allclose(positions, poses[:, :3, 3], atol=1e-6)


def test_parameters_can_be_set_while_it_runs(scans, mounts):
    stamps, positions, _ = drive(
        mounts, SET="{config: {doubles: [{name: downsampling, value: 0.7}]}}"
    )
    assert len(stamps) == len(scans)
    poses = expected(scans, PARAMETERS | {"downsampling": 0.7})
    np.testing.assert_allclose(positions, poses[:, :3, 3], atol=1e-6)


def test_it_can_end_like_a_node_that_crashes(mounts):
    *_, parameters = mounts
    parameters.write_text(FILE + "imitate: {die_at: 3, frame: camera}\n")
    stamps, positions, said = drive(mounts, poses=3)
    assert len(stamps) == 3
    assert positions[-1].argmax() == 2
    assert "gicp: terminating after 3 scans: the map is corrupt" in said
    assert "exit code 1" in said


def test_the_plain_program_writes_a_trajectory(scans, mounts):
    options, output, _ = mounts
    done = docker("run", "--rm", *options, reference_image(), "odometry-plain")
    assert done.returncode == 0, done.stderr
    written = read_tum(output / "trajectory.tum")
    assert written.stamps.tolist() == [scan.stamp for scan in scans]
    np.testing.assert_allclose(written.T_world_sensor, expected(scans, PARAMETERS), atol=1e-6)


def test_the_server_speaks_the_protocol(scans, mounts):
    options, output, _ = mounts
    server = docker(
        *("run", "--detach", *options, reference_image(), "odometry-serve", "/output/socket"),
        check=True,
    )
    try:
        end = time.monotonic() + 60.0
        while not (output / "socket").exists() and time.monotonic() < end:
            time.sleep(0.05)
        settings = ProcessSettings(address=f"unix:{output}/socket")
        odometry = Process(PARAMETERS, settings, Limits())
        odometry.start(scans[0], np.eye(4))
        poses = [odometry.register(scan).T_odom_sensor for scan in scans[1:]]
        odometry.close()
        docker("stop", "--time=5", server.stdout.strip(), check=True)
    finally:
        stop(server.stdout.strip())
    np.testing.assert_allclose(poses, expected(scans, PARAMETERS)[1:], atol=1e-6)
    assert not (output / "socket").exists()
