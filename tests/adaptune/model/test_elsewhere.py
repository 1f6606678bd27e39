import numpy as np
import pytest
import turns
from made_drives import Tasks
from setups import setup_of

from adaptune._system import processes as hosting
from adaptune.errors import AdaptuneError
from adaptune.model import descriptor
from adaptune.model.descriptor import Describer, DescriptorError
from adaptune.recording import Imu, Scan
from adaptune.recording.scan import ImuNoise
from offline.config import load_study
from offline.workers import Task, Workers, run

MINE = """
import ctypes, sys, time
import numpy as np

def everything(scan):
    imu = np.zeros(0) if scan.imu is None else np.r_[scan.imu.stamps, scan.imu.acceleration.ravel()]
    rings = 0.0 if scan.rings is None else scan.rings.sum()
    light = 0.0 if scan.intensities is None else np.sin(scan.intensities).sum()
    times = 0.0 if scan.times is None else scan.times.sum()
    moments = np.sin(scan.points).sum(axis=0) / 3
    return np.r_[moments, rings, light, times, imu.sum(), scan.stamp % 1000, len(scan)]

def raises(scan):
    if len(scan):
        raise ValueError("no planes here")
    return [0.0]

def crashes(scan):
    print("about to go wrong", flush=True)
    ctypes.string_at(0) if len(scan) else None
    return [0.0]

def hangs(scan):
    time.sleep(60 if len(scan) else 0)
    return [0.0]

def leaves(scan):
    sys.exit(0) if len(scan) else None
    return [0.0]
"""

SAID = {
    "raises": "ended with code 1: .*ValueError: no planes here",
    "crashes": "ended by SIGSEGV: about to go wrong",
    "hangs": r"a scan took longer than 0\.3 s",
    "leaves": "ended with code 1: .*SystemExit",
}


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    hosting.servers.clear()
    (tmp_path / "descriptors_elsewhere.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(tmp_path))


def test_the_numbers_are_the_same_to_the_last_bit():
    namespace = {}
    exec(MINE, namespace)
    n = 1000
    points = np.random.default_rng(1).normal(size=(n, 3)).astype(np.float32)
    imu = Imu(np.arange(3), np.ones((3, 3)), np.eye(3) / 3, np.eye(4), ImuNoise(1.0, 2.0, 3.0, 4.0))
    whole = Scan(
        123_456_789_123,
        points,
        np.linspace(0, 0.1, n, dtype=np.float32),
        np.arange(n, dtype=np.uint16),
        imu,
        points[:, 0] / 3,
    )
    describe = Describer(["descriptors_elsewhere:everything"])
    for scan in (whole, turns.turn(3), Scan(0, np.empty((0, 3), np.float32))):
        want = np.asarray(namespace["everything"](scan), np.float32)
        np.testing.assert_array_equal(describe(scan), want)


@pytest.mark.parametrize("name", SAID)
def test_one_that_goes_wrong_is_named(monkeypatch, name):
    monkeypatch.setattr(descriptor, "_SECONDS", 0.3)
    describe = Describer([f"descriptors_elsewhere:{name}"])
    with pytest.raises(
        DescriptorError, match=f"elsewhere:{name}: .*{SAID[name]}.*scan {5 * 10**8}"
    ):
        describe(turns.turn(5))
    with pytest.raises(DescriptorError, match=SAID[name]):
        describe(turns.turn(5))


def test_a_campaign_names_the_descriptor_and_the_sequence(study_file, tmp_path):
    overrides = ["descriptor=descriptors_elsewhere:crashes"]
    study = load_study(study_file, overrides, tmp_path / "study")
    words = r"sequences\.one: descriptors_elsewhere:crashes: its process was ended by SIGSEGV"
    with Workers(setup_of(study), 1, 1e9) as workers, pytest.raises(AdaptuneError, match=words):
        list(run(workers, Tasks(Task("one"))))
