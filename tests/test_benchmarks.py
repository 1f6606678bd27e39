"""Benchmarks that run with nothing but their argument."""

import importlib.util
import os
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

from adaptune import yaml
from adaptune.sequence import SequenceError
from offline.offline_study import OfflineStudy, load_study


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
    monkeypatch.setattr(stages.cores, "pin", lambda _: None)
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
        path.write_text(yaml.dump(module.definition(direction, "gicp", 3, 0)))
        config = load_study(path, folder=tmp_path / name).config
        for role, names in roles.items():
            names.update(getattr(config, role))
        for sequence in config.sequences.values():
            assert Path(sequence.bag).exists()
        assert config.health.max_speed == (5.0 if "campus" in name else 40.0)
    # Each recording is tuned on once and tested on once.
    assert roles["training"] == roles["test"]
    assert len(roles["test"]) == 7
    assert "compensate" in module.recording("town", "ndt")
    assert "compensate" not in module.recording("town", "kiss_icp")


def test_recorded_prints_every_mode_and_resumes(
    study_file, trained_folder, tmp_path, monkeypatch, capsys
):
    module = benchmark("recorded")
    shutil.copytree(trained_folder, tmp_path / "gicp-small-10-3")
    text = study_file.read_text().replace("bag: ", f"bag: {study_file.parent}/")
    online = {"rules": ["paired"], "switching": {"mechanism": "bank"}}
    given = {**yaml.Document(text).data, "online": online}
    monkeypatch.setattr(module, "DIRECTIONS", {"small": None, "other": None})
    monkeypatch.setattr(module, "definition", lambda *_: given)
    monkeypatch.setattr(module.cores, "pin", lambda _: None)
    monkeypatch.setenv("ADAPTUNE_TEST_DATA", str(tmp_path))
    words = ["--odometries", "gicp", "--directions", "small", "--sets", "10", "--seed", "3"]
    monkeypatch.setattr(sys, "argv", ["recorded.py", str(tmp_path), *words])
    module.main()
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line[2:].startswith("three")]
    assert all(f"{mode} 0." in row or f"{mode} 1." in row for mode in module.MODES)
    replays = tmp_path / "gicp-small-10-3/replays/three"
    made = {path: path.stat().st_mtime_ns for path in replays.rglob("*.tum")}
    assert len(made) == 5
    module.main()
    assert row in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in made} == made


def test_recorded_goes_on_after_a_study_that_is_not_possible(tmp_path, monkeypatch, capsys):
    module = benchmark("recorded")

    def run(study):
        raise SequenceError(f"{study}: too short")

    monkeypatch.setattr(module, "load_study", lambda path, **_: path.stem)
    monkeypatch.setattr(module, "run", run)
    monkeypatch.setattr(module.cores, "pin", lambda _: None)
    monkeypatch.setenv("ADAPTUNE_TEST_DATA", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["recorded.py", str(tmp_path), "--odometries", "ndt"])
    module.main()
    said = capsys.readouterr().out
    assert said.count("not possible: ndt-") == len(module.DIRECTIONS)
