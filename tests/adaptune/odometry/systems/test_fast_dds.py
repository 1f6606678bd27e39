"""A node on Fast DDS, whose receive buffer is the kernel's."""

import re
import subprocess
from itertools import takewhile
from pathlib import Path

import drives
import numpy as np
import pytest
from contained import LIMITS
from needs import ROOT, lacking, needs, needs_program
from ros2_reference import ros2

from adaptune.odometry.program import ProgramInput
from adaptune.odometry.systems import lockstep
from adaptune.odometry.systems.probe import look
from adaptune.odometry.systems.ros2_system import Ros2
from adaptune.recording import Scan
from adaptune.ros import relay

pytestmark = pytest.mark.services

CURE = "sudo sysctl -w net.core.rmem_default=4194304"


@pytest.fixture(scope="module")
def node():
    """The program of the node."""
    needs("cyclonedds", "ros2")
    if not Path("/usr/include/fastdds").exists():
        lacking("ros2", "there is no Fast DDS to build with: make services")
    source, target = ROOT / "tests/support/fast_dds_node.cpp", ROOT / "build/fast-dds-node"
    if not target.exists() or target.stat().st_mtime < source.stat().st_mtime:
        compiler = needs_program("g++", "ros2")
        target.parent.mkdir(exist_ok=True)
        with_fast_dds = ["-std=c++17", "-o", target, source, "-lfastrtps", "-lfastcdr"]
        subprocess.run([compiler, *with_fast_dds], check=True)
    return str(target)


def scans(n_points):
    points = np.random.default_rng(0).uniform(-9.0, 9.0, (n_points, 3)).astype(np.float32)
    return [Scan(10**9 + stamp, points) for stamp in range(0, 4 * 10**9, 10**8)]


@pytest.fixture
def settings(node, tmp_path):
    given = {"image": None, "command": (node, "{parameters}"), "patience": 0.5}
    return lambda **more: ros2(tmp_path / "icp.yaml", **(given | more))


@pytest.fixture
def drive(settings, monkeypatch):
    monkeypatch.setattr(lockstep, "_MOST_SILENT", 6)
    made = []

    def begin(n_points, read=None, **more):
        odometry = Ros2.instance({}, settings(**more), LIMITS, read)
        made.append(odometry)
        first, *others = map(odometry.prepare, scans(n_points))
        odometry.start(first, np.eye(4))
        left = takewhile(lambda _: not odometry.faults, others)
        found = [odometry.register(scan).registered for scan in left]
        return odometry, found

    yield begin
    for odometry in made:
        odometry.close()


def test_clouds_that_fit_get_there(drive):
    odometry, found = drive(5000)
    assert all(found)
    assert not odometry.faults


@pytest.mark.skipif(relay.receives_clouds(), reason="this machine's buffers hold clouds")
def test_larger_ones_are_lost_and_the_line_that_cures_it_is_told(drive):
    odometry, found = drive(29_000)
    assert not all(found)
    (fault,) = odometry.faults
    assert "a node runs on Fast DDS, which loses clouds that do not fit in the receive" in fault
    assert CURE in fault


@pytest.mark.skipif(relay.receives_clouds(), reason="this machine's buffers hold clouds")
def test_where_it_is_looked_at_the_same_line_is_told(settings):
    found = look(settings(), {}, LIMITS, scans(150_000)[:12])  # some of smaller ones get there
    assert CURE in found["lockstep"]
    assert "play: bag" not in found["lockstep"]


@pytest.mark.skipif(relay.receives_clouds(), reason="this machine's buffers hold clouds")
def test_of_a_bag_each_error_tells_it_and_counts_the_same_scans(drive, tmp_path, caplog):
    every = scans(29_000)
    bag = drives.write_bag(tmp_path / "a.bag", [(s.stamp, s.points, np.eye(4)) for s in every])
    stamps = np.array([scan.stamp for scan in every], np.int64)
    given = ProgramInput(bag, "/points", "", stamps, None)
    odometry, _ = drive(29_000, lambda: given, play="bag", rate=1.0)
    assert CURE in caplog.text
    if "nothing was published" in caplog.text:  # every cloud was lost, so there is nothing to count
        return
    (lacking,) = re.findall(r"(\d+) of 40 scans have no pose at rate 1", caplog.text)
    for fault in odometry.faults:  # none where poses between those that came cover most scans
        assert CURE in fault
        assert f"it gave poses for {40 - int(lacking)} of 40 scans; the first pose" in fault
        own = odometry._T_own_sensor
        assert sum(np.isnan(T).any() for T in own.values()) == int(lacking)
