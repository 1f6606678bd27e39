"""Benchmarks that run with nothing but their argument."""

import re
from pathlib import Path

import numpy as np
import pytest
from needs import module_of
from setups import failure

from adaptune._system import yaml12
from adaptune.geometry import invert
from adaptune.odometry.systems import rustle
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import open_sequence
from adaptune.simulation.record import SimulatedDrive
from offline.config import load_study

pytestmark = pytest.mark.services

FOLDER = Path(__file__).parents[1] / "benchmarks"


def benchmark(name):
    return module_of(f"benchmarks/{name}.py")


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.py")))
def test_each_can_be_imported(name, monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    benchmark(name)


def test_directions_of_recorded_data_are_studies(recorded, tmp_path, monkeypatch):
    module = benchmark("recorded")
    monkeypatch.setenv("ADAPTUNE_TEST_DATA", str(recorded))
    roles = {"training": set(), "test": set()}
    for name, direction in module.DIRECTIONS.items():
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml12.dump(module.definition(direction, "gicp", 3, 0)))
        config = load_study(path, folder=tmp_path / name).config
        for role, names in roles.items():
            names.update(getattr(config, role))
        for sequence in config.sequences.values():
            assert Path(sequence.bag).exists()
        assert config.health.max_speed == (5.0 if "campus" in path.read_text() else 40.0)
    # Each recording is tuned on and tested on; street has no poses to tune by.
    assert roles["training"] == roles["test"] - {"street"}
    assert len(roles["test"]) == 10
    assert "compensate" in module.sequence("town", "ndt")[1]
    assert "compensate" not in module.sequence("town", "kiss_icp")[1]


def test_simulated_kitti_is_read_as_it_was_driven(tmp_path, monkeypatch):
    module = benchmark("protocols")
    monkeypatch.setattr(module, "ROADS", {"07": ["street"]})
    module.simulate_kitti(tmp_path, metres=10.0)
    sequence = open_sequence(SequenceConfig(kitti=str(tmp_path / "sequences" / "07")))
    drive = SimulatedDrive(module.courses(10.0)["07"])
    truth = [(module.standing(drive, scan), scan.T_world_sensor) for scan in drive.scans()]
    # What adaptune corrects in KITTI's rays is in the files.
    for read, (scan, _) in zip(sequence, truth, strict=True):
        np.testing.assert_allclose(read.points, scan.points, atol=2e-5)
    T = np.array([pose for _, pose in truth])
    found = sequence.reference().T_world_sensor
    np.testing.assert_allclose(found, invert(T[0]) @ T, atol=1e-6)
    made = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.*")}
    module.simulate_kitti(tmp_path, metres=10.0)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.*")} == made


def test_recorded_drives_are_undistorted_by_their_poses(recorded):
    module = benchmark("protocols")
    given = {"bag": str(recorded / "city.bag"), "points": "/velodyne_points"}
    given |= {"reference": "/gt_poses", "part": "0-5%", "cache": False}
    config = SequenceConfig.model_validate(given)
    raw = {scan.stamp: scan for scan in open_sequence(config)}
    found = list(module.undistorted(config))
    # The first scan begins before the first pose.
    assert {scan.stamp for scan, _ in found} == set(sorted(raw)[1:])
    reference = open_sequence(config).reference()
    for scan, T_world_start in found:
        before = raw[scan.stamp]
        late = before.times > 0.09
        (T_world_late,) = reference.at(np.array([scan.stamp + int(0.095e9)]))
        T = invert(T_world_start) @ T_world_late
        moved = before.points[late] @ T[:3, :3].T + T[:3, 3]
        assert np.abs(scan.points[late] - moved).max() < 0.1
        assert np.abs(scan.points[late] - before.points[late]).max() > 0.5


@pytest.mark.parametrize("name", ["kitti", "drives", "garden", "docker"])
def test_commands_of_a_protocol_lack_nothing_but_their_data(name, tmp_path, monkeypatch):
    module = benchmark("protocols")
    monkeypatch.setattr(rustle, "image_digest", lambda _: "as if it were here")
    protocol = module.PROTOCOLS[name]
    if protocol.variable:
        monkeypatch.setenv(protocol.variable, str(tmp_path))
    made = module.commands(name, tmp_path, 32)
    compared = {folder for _, stage, _, _, folder, *_ in made if stage == "compare"}
    assert len(compared) == len(protocol.variants)
    for _, stage, path, _, folder, *options in made:
        assert stage in ("simulate", "offline", "online", "compare")
        assert folder in compared
        assert "offline.trials=32" in options
        if protocol.variable:
            mistakes = failure(Path(path), *options[1::2]).splitlines()
            assert all("there is no such" in line for line in mistakes)
        else:
            load_study(Path(path), options[1::2], Path(folder))


def test_all_benchmarks_print_their_figures(tmp_path):
    """Those that take seconds on little."""
    module = benchmark("all")
    assert {b.arguments[0] for b in module.BENCHMARKS.values()} <= {
        p.name for p in FOLDER.iterdir()
    }
    names = ["reading", "campaign", "length", "members"]
    module.logs(names, tmp_path, quick=True)
    for name in names:
        log = (tmp_path / f"{name}.log").read_text()
        missing = [f.what for f in module.BENCHMARKS[name].figures if not re.search(f.pattern, log)]
        assert missing == (["memory of a pass over 10 GB"] if name == "reading" else [])
