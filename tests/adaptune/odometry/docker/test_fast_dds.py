"""A node on Fast DDS, whose receive buffer is the kernel's."""

import subprocess
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest
from contained import LIMITS
from needs import ROOT, lacking, needs, needs_program
from ros2_reference import ros2

from adaptune.odometry.docker import lockstep
from adaptune.odometry.docker.ros2_system import Ros2
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


@pytest.fixture
def drive(node, tmp_path, monkeypatch):
    monkeypatch.setattr(lockstep, "_MOST_SILENT", 6)
    made = []

    def begin(n_points):
        settings = ros2(
            tmp_path / "icp.yaml", image=None, command=(node, "{parameters}"), patience=0.5
        )
        odometry = Ros2.instance({}, settings, LIMITS, None)
        made.append(odometry)
        points = np.random.default_rng(0).uniform(-9.0, 9.0, (n_points, 3)).astype(np.float32)
        stamps = range(0, 4 * 10**9, 10**8)
        first, *others = (Scan(10**9 + stamp, points) for stamp in stamps)
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
