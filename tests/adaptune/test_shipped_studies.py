"""The shipped studies: complete but for images and data, and alike where they say so."""

from pathlib import Path

import numpy as np
import pytest
import rec
from drives import FIRST_STAMP, cloud
from needs import needs_evalio

from adaptune._system import yaml12
from adaptune._system.strict import ConfigurationError
from adaptune.odometry.systems import rustle
from adaptune.odometry.template import Template
from offline.config import load_study

CONFIGS = Path(__file__).parents[2] / "configs"
IMAGES = ("faster_lio_botanic_garden", "fast_livo2_botanic_garden", "lego_loam_kitti")
THIRD_PARTY = sorted(path.stem for path in CONFIGS.glob("third_party_*.yaml"))


@pytest.mark.parametrize(
    "name", [*IMAGES, "suma_kitti", "botanic_garden_gicp", "botanic_garden_evening", "kitti_gicp"]
)
def test_shipped_studies_lack_nothing_but_their_data(name, monkeypatch, tmp_path):
    monkeypatch.setattr(rustle, "image_digest", lambda _: "as if it were here")
    program = tmp_path / "suma_kitti"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setenv("BOTANIC_GARDEN", str(tmp_path))
    monkeypatch.setenv("KITTI", str(tmp_path))
    with pytest.raises(ConfigurationError) as caught:
        load_study(CONFIGS / f"{name}.yaml")
    assert all("there is no such" in line for line in str(caught.value).splitlines())


def test_the_study_of_an_evening_splits_its_recording(monkeypatch, tmp_path):
    messages = []
    for i in range(200):
        stamp = FIRST_STAMP + i * 100_000_000
        points = np.full((50, 3), 1.0 + 0.01 * i, np.float32)
        messages.append(("/velodyne_points", stamp, cloud(stamp, points)))
        pose = rec.pose(stamp, (0.1 * i, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), rec.ROS1)
        messages.append(("/gt_poses", stamp, pose))
    rec.write_bag(tmp_path / "1018_00.bag", messages)
    monkeypatch.setenv("BOTANIC_GARDEN", str(tmp_path))
    study = load_study(CONFIGS / "botanic_garden_evening.yaml", folder=tmp_path)
    assert study.config.training == ("1018_00_0-60",)
    assert study.config.test == ("1018_00_60-100",)
    n = {name: len(list(study.sequences.open(name))) for name in ("1018_00_0-60", "1018_00_60-100")}
    assert n == {"1018_00_0-60": 120, "1018_00_60-100": 80}


def test_templates_of_parameters_are_no_studies():
    for path in (CONFIGS / "templates").iterdir():
        with pytest.raises(ConfigurationError, match=r"is no study, .* as --config"):
            load_study(path)
    for path in CONFIGS.glob("*.yaml"):
        assert "odometry" in yaml12.Document.of_file(path).data


@pytest.mark.parametrize("name", IMAGES)
def test_templates_hold_the_baseline(name):
    odometry = yaml12.Document((CONFIGS / f"{name}.yaml").read_text()).data["odometry"]
    template = CONFIGS / odometry["settings"]["template"]
    baseline = {key: p["baseline"] for key, p in odometry["parameters"].items()}
    unchanged = yaml12.Document(Template(template).fill({})).data
    assert yaml12.Document(Template(template).fill(baseline)).data == unchanged


def test_studies_of_third_party_odometries_differ_in_their_odometry_only():
    texts = [(CONFIGS / f"{name}.yaml").read_text() for name in THIRD_PARTY]
    assert len(THIRD_PARTY) == 4
    assert len({text[text.index("courses:") :] for text in texts}) == 1


@pytest.mark.parametrize("name", THIRD_PARTY)
def test_studies_of_third_party_odometries_load(name, tmp_path):
    if name != "third_party_kiss_icp":
        needs_evalio()
    study = load_study(CONFIGS / f"{name}.yaml", folder=tmp_path)
    assert name == f"third_party_{study.odometry.name}"
    assert set(study.config.odometry.parameters or {}) <= set(study.odometry.space.parameters)
    assert study.odometry.description.live == (name == "third_party_kiss_icp")
