"""Trials of the reference image on a short bag; those that need no other run side by side."""

import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import pytest
import yaml
from contained import (
    FIXED,
    LIMITS,
    N_SCANS,
    VALUES,
    containers,
    drive,
    host_poses,
    recording,
    rustle,
    template,
    truth,
)
from needs import reference_image

from adaptune.odometry import OdometryError
from adaptune.odometry.remote import Limits
from adaptune.odometry.systems import played_bag
from adaptune.odometry.systems.engine import image_digest
from adaptune.odometry.systems.played_bag import PlayedBag
from adaptune.odometry.systems.rustle import Rustle

pytestmark = [
    pytest.mark.services,
    pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning"),
]

SIDE_BY_SIDE = 3

TRIALS = {
    "plain": {"parameters": VALUES | {"other.voxel": 2}},
    "late": {
        "imitate": {"ready_delay": 3.0, "rate": 5000},
        "points": "/velodyne",
        "settings": {"points": "/velodyne"},
    },
    "too slow": {"imitate": {"seconds_per_scan": 60.0}, "limits": Limits(seconds=6.0 / N_SCANS)},
    "node dies": {
        "imitate": {"die_at": 3},
        "settings": {"rate": 0.1, "arguments": ("required:=false",)},
    },
    "silent": {"imitate": {"silent": True}},
}


class Ran(NamedTuple):
    poses: np.ndarray | None
    odometry: PlayedBag
    error: str


def run(folder, imitate=None, parameters=VALUES, limits=LIMITS, points="/points", settings=()):
    folder.mkdir(parents=True)
    given = recording(folder, folder / "logs")
    given.logs.mkdir()
    file = template(folder / "template.yaml", points=points, **(imitate or {}))
    odometry = Rustle.instance(parameters, rustle(file, **dict(settings)), limits, lambda: given)
    poses, error = None, ""
    try:
        poses = drive(odometry)
    except OdometryError as caught:
        error = str(caught)
    return Ran(poses, odometry, error)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("trials")


@pytest.fixture(scope="module")
def ran(folder):
    reference_image()
    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(SIDE_BY_SIDE) as pool:
        patch.setattr(played_bag, "_FIRST_POSE", 2.0)
        trials = {name: pool.submit(run, folder / name, **given) for name, given in TRIALS.items()}
        yield lambda name: trials[name].result()
        for trial in trials.values():
            trial.cancel()
    assert not containers()


def assert_good(trial):
    assert not trial.error
    assert not trial.odometry.faults
    np.testing.assert_allclose(trial.poses, host_poses(), atol=1e-6)


def test_the_poses_are_those_of_the_odometry(ran):
    trial = ran("plain")
    assert_good(trial)
    np.testing.assert_allclose(trial.poses, truth(), atol=0.1)
    assert 0.0 < trial.odometry.usage.cpu < 100.0
    assert 0.0 < trial.odometry.usage.memory < 1000.0


def test_what_is_kept_of_a_trial(ran, folder):
    ran("plain")
    (logs,) = (folder / "plain" / "logs").iterdir()
    held = yaml.safe_load((logs / "params.yaml").read_text())
    assert held["gicp"] == VALUES | FIXED
    assert isinstance(held["gicp"]["iterations"], int)
    assert held["other"] == {"voxel": 2}
    assert "ready for /points" in (logs / "roslaunch.log").read_text()
    note = yaml.safe_load((logs / "trial.yaml").read_text())
    assert note["image"] == "adaptune-reference"
    assert note["digest"] == image_digest("adaptune-reference")
    assert note["parameters"] == VALUES | {"other.voxel": 2}
    assert note["rate"] == 4.0
    assert note["input"].endswith("/plain/drive.bag")


def test_it_waits_for_one_that_is_late_and_sleeps_by_the_clock(ran):
    assert_good(ran("late"))


def test_one_that_is_far_too_slow_is_ended(ran):
    (fault,) = ran("too slow").odometry.faults
    assert fault.startswith("it took longer than isolation.seconds = 0.15 for each scan")


def test_one_that_dies_is_a_fault_at_once(ran):
    trial = ran("node dies")
    (fault,) = trial.odometry.faults
    # The bag goes on for forty seconds, and the fault is not that it ended.
    assert re.match(r"node /gicp died: ", fault), fault
    assert "terminating after 3 scans: the map is corrupt" in fault
    assert np.isnan(trial.poses[-1]).all()


def test_nothing_is_published(ran):
    (fault,) = ran("silent").odometry.faults
    words = "nothing was published on /Odometry until the system had rested .*at rest at"
    assert re.match(words, fault), fault


def test_an_image_without_ros(tmp_path):
    trial = run(tmp_path / "trial", settings={"image": "debian:bookworm-slim"})
    (fault,) = trial.odometry.faults
    assert "no roscore: its process ended with code 127: " in fault
    assert "no Python of the image imports rospy: is it a ROS 1 image?" in fault


KILLED = """
import sys
from pathlib import Path
from contained import LIMITS, VALUES, drive, recording, rustle, template
from adaptune.odometry.systems.played_bag import PlayedBag
from adaptune.odometry.systems.rustle import Rustle
see = PlayedBag._see
def seen(*given):
    print("plays", flush=True)
    return see(*given)
PlayedBag._see = seen
folder = Path(sys.argv[1])
settings = rustle(template(folder / "template.yaml"), rate=0.01)
given = recording(folder / "bag")
drive(Rustle.instance(VALUES, settings, LIMITS, lambda: given))
"""


def test_a_killed_process_leaves_no_container_while_a_bag_plays(tmp_path):
    reference_image()
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, tmp_path],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        text=True,
    )
    with process:
        assert process.stdout.readline() == "plays\n"
        assert containers(process.pid)
        process.kill()
    # The bag would play for minutes.
    end = time.monotonic() + 60.0
    while containers(process.pid):
        assert time.monotonic() < end
        time.sleep(0.1)
