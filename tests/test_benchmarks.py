"""Benchmarks that run with nothing but their argument."""

import importlib.util
import json
import os
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from adaptune import files
from adaptune.geometry import invert
from adaptune.odometry.docker import rustle
from adaptune.recording import SequenceError
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import open_sequence
from adaptune.simulation.record import Drive
from adaptune.strict import ConfigurationError
from adaptune.study.references import to_estimate
from offline.config import OfflineStudy, load_study
from online.statistics import ComparisonRow

pytestmark = pytest.mark.services


def benchmark(name):
    """A benchmark's module."""
    path = Path(__file__).parents[1] / f"benchmarks/{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_stages_needs_its_argument_only(recorded, monkeypatch):
    stages = benchmark("stages")
    measured: list[OfflineStudy] = []
    monkeypatch.setenv("ADAPTUNE_TEST_DATA", "to be restored")
    os.environ.pop("ADAPTUNE_TEST_DATA")
    monkeypatch.setattr(stages.processes, "pin", lambda _: None)
    monkeypatch.setattr(stages, "trial", measured.append)
    monkeypatch.setattr(stages, "train", lambda _: SimpleNamespace(model=None))
    monkeypatch.setattr(stages, "adaptive_replay", lambda study, _: measured.append(study))
    monkeypatch.chdir(recorded.parent)
    stages.main(Path(recorded.name))
    bags = {sequence.bag for study in measured for sequence in study.config.sequences.values()}
    assert {Path(bag).resolve() for bag in bags} == {
        (recorded / name).resolve() for name in ("hall.bag", "street.bag")
    }


def test_directions_of_recorded_data_are_studies(recorded, tmp_path, monkeypatch):
    module = benchmark("recorded")
    monkeypatch.setenv("ADAPTUNE_TEST_DATA", str(recorded))
    roles = {"training": set(), "test": set()}
    for name, direction in module.DIRECTIONS.items():
        path = tmp_path / f"{name}.yaml"
        path.write_text(files.dump(module.definition(direction, "gicp", 3, 0)))
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


def test_without_reference_only_the_test_knows_poses(recorded, tmp_path, monkeypatch):
    module = benchmark("recorded")
    monkeypatch.setenv("ADAPTUNE_TEST_DATA", str(recorded))
    for name in ("hall_1", "cars", "campus"):
        path = tmp_path / f"{name}.yaml"
        given = module.definition(module.DIRECTIONS[name], "ndt", 3, 0, no_reference=True)
        path.write_text(files.dump(given))
        study = load_study(path, folder=tmp_path / name)
        assert to_estimate(study.sequences, study.config.training) == list(study.config.training)
        assert to_estimate(study.sequences, study.config.test) == ["street"] * (name == "cars")


def test_rows_of_all_studies_are_collected(tmp_path):
    module = benchmark("recorded")
    for name, extra in (("a", {}), ("b", {"real_time": {"rate": 2.0}})):
        row = ComparisonRow("town", "fixed", float("nan"), 1.0, 0, 0, 0, **extra)
        module.keep(tmp_path / name, {"odometry": name}, [row])
    module.collect(tmp_path)
    rows = json.loads((tmp_path / "recorded.json").read_text())
    assert [(row["odometry"], row["mode"], row["rate"]) for row in rows] == [
        ("a", "fixed", None),
        ("b", "fixed", 2.0),
    ]
    assert rows[0]["RTE [%]"] is None
    assert len((tmp_path / "recorded.csv").read_text().splitlines()) == 3


def test_recorded_prints_every_mode_and_resumes(
    study_file, trained_folder, tmp_path, monkeypatch, capsys
):
    module = benchmark("recorded")
    shutil.copytree(trained_folder, tmp_path / "gicp-small-10-3")
    text = study_file.read_text().replace("bag: ", f"bag: {study_file.parent}/")
    online = {"rules": ["adaptive"], "switching": {"mechanism": "bank"}}
    given = {**files.Document(text).data, "online": online}
    monkeypatch.setattr(module, "DIRECTIONS", {"small": None, "other": None})
    monkeypatch.setattr(module, "definition", lambda *_, **__: given)
    monkeypatch.setattr(module.processes, "pin", lambda _: None)
    monkeypatch.setenv("ADAPTUNE_TEST_DATA", str(tmp_path))
    words = ["--odometries", "gicp", "--directions", "small", "--sets", "10", "--seed", "3"]
    monkeypatch.setattr(sys, "argv", ["recorded.py", str(tmp_path), *words])
    module.main()
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line[2:].startswith("three")]
    assert all(f"{mode} 0." in row or f"{mode} 1." in row for mode in module.MODES)
    replays = tmp_path / "gicp-small-10-3/replays/three"
    made = {path: path.stat().st_mtime_ns for path in replays.rglob("*.tum")}
    assert len(made) == 5
    rows = json.loads((tmp_path / "recorded.json").read_text())
    assert [(row["tuned_on"], row["mode"]) for row in rows] == [("small", m) for m in module.MODES]
    module.main()
    assert row in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in made} == made


def test_recorded_goes_on_after_a_study_that_is_not_possible(tmp_path, monkeypatch, capsys):
    module = benchmark("recorded")

    def run(study, _):
        raise SequenceError(f"{study}: too short")

    monkeypatch.setattr(module, "load_study", lambda path, **_: path.stem)
    monkeypatch.setattr(module, "run", run)
    monkeypatch.setattr(module.processes, "pin", lambda _: None)
    monkeypatch.setenv("ADAPTUNE_TEST_DATA", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["recorded.py", str(tmp_path), "--odometries", "ndt"])
    module.main()
    said = capsys.readouterr().out
    assert said.count("not possible: ndt-") == len(module.DIRECTIONS)


def test_simulated_kitti_is_read_as_it_was_driven(tmp_path, monkeypatch):
    module = benchmark("protocols")
    monkeypatch.setattr(module, "ROADS", {"07": ["street"]})
    module.simulate_kitti(tmp_path, metres=10.0)
    sequence = open_sequence(SequenceConfig(kitti=str(tmp_path / "sequences" / "07")))
    drive = Drive(module.courses(10.0)["07"])
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


def test_gardens_have_what_the_study_names(tmp_path, monkeypatch):
    module = benchmark("protocols")
    monkeypatch.setattr(module, "GARDENS", ("1005_00",))
    module.simulate_gardens(tmp_path, metres=10.0)
    entry = files.Document.of_file(module.CONFIGS / "botanic_garden_gicp.yaml").data["sequences"]
    monkeypatch.setenv("BOTANIC_GARDEN", str(tmp_path))
    sequence = open_sequence(SequenceConfig.model_validate(entry["1005_00"]))
    assert sequence.reference() is not None
    assert len(next(iter(sequence))) > 5000


@pytest.mark.parametrize("name", ["kitti", "drives", "garden", "docker"])
def test_commands_of_a_protocol_lack_nothing_but_their_data(name, tmp_path, monkeypatch):
    module = benchmark("protocols")
    monkeypatch.setattr(rustle, "image_digest", lambda _: "as if it were here")
    protocol = module.PROTOCOLS[name]
    if protocol.variable:
        monkeypatch.setenv(protocol.variable, str(tmp_path))
    *stages, (_, compare, *folders) = module.commands(name, tmp_path, 32)
    assert compare == "compare"
    assert len(set(folders)) == len(protocol.variants)
    for _, stage, path, _, folder, *options in stages:
        assert stage in ("simulate", "offline", "online")
        assert folder in folders
        assert "offline.trials=32" in options
        mistakes = mistakes_of(Path(path), options[1::2], Path(folder))
        assert all("there is no such" in line for line in mistakes)
        assert bool(mistakes) == bool(protocol.variable)


def mistakes_of(path, overrides, folder):
    """The lines of what is wrong with a study."""
    try:
        load_study(path, overrides, folder)
    except ConfigurationError as error:
        return str(error).splitlines()
    return []


def test_grids_fill_the_searches_that_they_are_compared_with():
    module = benchmark("protocols")
    for grid, points in ((module.GICP_GRID, 30), (module.DOCKER_GRID, 18)):
        counts = [axis["count"] for axis in files.scalar(grid).values()]
        assert np.prod(counts) == points
