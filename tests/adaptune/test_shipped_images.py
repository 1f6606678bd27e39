"""The shipped studies of systems in images and of programs: complete but for images and data."""

from pathlib import Path
from typing import Any

import pytest

from adaptune import files
from adaptune.odometry.docker import rustle
from adaptune.odometry.program import Template
from adaptune.space import ParameterSpace
from adaptune.strict import ConfigurationError
from offline.config import OfflineConfig, load_study
from offline.samplers import AskedSampler

CONFIGS = Path(__file__).parents[2] / "configs"
IMAGES = ("faster_lio_botanic_garden", "fast_livo2_botanic_garden", "lego_loam_kitti")


def read(name: str) -> Any:
    return files.Document((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8")).data


@pytest.fixture
def data_folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("BOTANIC_GARDEN", str(tmp_path))
    monkeypatch.setenv("KITTI", str(tmp_path))


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.usefixtures("data_folders")
def test_shipped_studies_of_images_lack_nothing_but_their_data(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rustle, "image_digest", lambda _: "as if it were here")
    with pytest.raises(ConfigurationError) as caught:
        load_study(CONFIGS / f"{name}.yaml")
    assert all("there is no such" in line for line in str(caught.value).splitlines())


@pytest.mark.usefixtures("data_folders")
def test_the_shipped_study_of_a_program_lacks_nothing_but_it_and_its_data(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program = tmp_path / "suma_kitti"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    with pytest.raises(ConfigurationError) as caught:
        load_study(CONFIGS / "suma_kitti.yaml")
    assert all("there is no such" in line for line in str(caught.value).splitlines())


@pytest.mark.parametrize("name", IMAGES)
def test_templates_hold_the_baseline(name: str) -> None:
    odometry = read(name)["odometry"]
    template = CONFIGS / odometry["settings"]["template"]
    baseline = {key: p["baseline"] for key, p in odometry["parameters"].items()}
    unchanged = files.Document(Template(template).fill({})).data
    assert files.Document(Template(template).fill(baseline)).data == unchanged


@pytest.mark.parametrize("name", IMAGES[:2])
def test_the_walk_of_the_thesis_begins_at_its_start_and_keeps_its_bounds(name: str) -> None:
    study = read(name)
    defined = study["odometry"]["parameters"]
    space = ParameterSpace.load(defined)
    config = OfflineConfig.model_validate(study["offline"])
    assert not list(config.mistakes(space))
    sampler = AskedSampler(space, config)
    history: list[tuple[Any, ...]] = []
    for i in range(25):
        (proposed,) = sampler.propose(history)
        history.append((proposed, 0.04 + 0.001 * i))
    sets = [parameters for parameters, _ in history]
    assert sets[0] == space.baseline
    settings = study["offline"]["sampler_settings"]
    for key, step in settings["steps"].items():
        low, high = step.get("low", defined[key]["low"]), defined[key]["high"]
        assert all(low <= float(one[key]) <= high for one in sets[1:])
        longest = step.get("delta_max", abs(step.get("mu", 0.0)) + 5 * step.get("sigma", 0.0))
        assert abs(float(sets[1][key]) - settings["start"][key]) <= longest
