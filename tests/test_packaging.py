"""The wheel serves without the repository, and packages of others add to it."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import drives
import numpy as np
import pytest
import yaml
from made_drives import trials_of
from setups import setup_of

from adaptune.model.descriptor import Describer
from offline.config import load_study

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def test_the_version_is_everywhere_the_same():
    changes = re.findall(r"^## ([\d.]+)", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert [changes[0], citation["version"]] == [PROJECT["version"]] * 2


def test_the_tests_run_on_a_python_that_the_package_names():
    named = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if ":: 3." in c]
    assert PROJECT["requires-python"] == f">={named[0]}"
    assert f"{sys.version_info[0]}.{sys.version_info[1]}" in named


def test_extras_are_named_as_every_pip_reads_them():
    # An older pip finds no extra under a name that was normalised when the package was built.
    extras = PROJECT["optional-dependencies"]
    assert [e for e in extras if e != re.sub(r"[-_.]+", "-", e).lower()] == []
    for file in [*(ROOT / "docs").glob("*.md"), *(ROOT / "adaptune").rglob("*.py")]:
        text = file.read_text("utf-8")
        for names in re.findall(r"adaptune\[([\w,-]+)\]|import_extra\(\"([^\"]+)\"", text):
            assert set("".join(names).split(",")) <= set(extras), file


def built(project: Path, folder: Path) -> Path:
    """The wheel of a project, built without a network."""
    pytest.importorskip("hatchling", reason="pip install 'adaptune[dev]'")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder]
    subprocess.run(command, cwd=project, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.mark.services
def test_the_wheel_tunes_a_bag_without_the_repository(tmp_path):
    wheel = built(ROOT, tmp_path / "dist")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "installed")
    assert "adaptune/odometry/portfolios/gicp.yaml" in names
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {
        *("adaptune", "offline", "online")
    }
    drives.write_bag(tmp_path / "drive.bag", drives.scans(n_scans=60))
    command = [sys.executable, "-P", "-m", "adaptune", "tune", "drive.bag", "--trials", "2"]
    alone = os.environ | {"PYTHONPATH": str(tmp_path / "installed")}
    said = subprocess.check_output(command, cwd=tmp_path, env=alone, text=True)
    assert "runs/drive/report/report.html" in said
    assert (tmp_path / "runs/drive/report/report.html").stat().st_size > 100_000


def test_a_package_of_others_adds_an_odometry_and_a_descriptor(tmp_path, monkeypatch):
    wheel = built(ROOT / "tests/support/plugin", tmp_path / "dist")
    target = tmp_path / "installed"
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--target"]
    subprocess.run([*command, target, wheel], check=True, capture_output=True)
    monkeypatch.setenv("PYTHONPATH", str(target), prepend=os.pathsep)
    monkeypatch.syspath_prepend(target)
    study = drives.write_study(tmp_path)
    text = "odometry: {name: scan_to_scan}\ndescriptor: [range_deciles]\n"
    study.write_text(drives.study_with(text, tmp_path))
    setup = setup_of(load_study(study))
    (trial,) = trials_of(setup, [{"voxel": 0.4}])
    assert np.nanmean(trial.errors) < 5.0
    assert Describer(["range_deciles"]).blocks == {"range_deciles": 9}
    assert setup.odometry.content["version of adaptune-example"] == "1.2.3"
