"""The shipped studies of simulated courses: complete, and alike where they say so."""

from pathlib import Path

import pytest
from needs import needs_evalio

from offline.config import load_study

CONFIGS = Path(__file__).parents[2] / "configs"
THIRD_PARTY = sorted(path.stem for path in CONFIGS.glob("third_party_*.yaml"))


def test_studies_of_third_party_odometries_differ_in_their_odometry_only() -> None:
    texts = [(CONFIGS / f"{name}.yaml").read_text(encoding="utf-8") for name in THIRD_PARTY]
    rests = {text[text.index("courses:") :] for text in texts}
    assert len(THIRD_PARTY) == 4
    assert len(rests) == 1


def test_the_study_of_all_four_has_the_same_drives(tmp_path: Path) -> None:
    needs_evalio()
    every, alone = (
        load_study(CONFIGS / f"{name}.yaml", folder=tmp_path / name).config
        for name in ("third_party", THIRD_PARTY[0])
    )
    assert {f"third_party_{one}" for one in every.odometries} == set(THIRD_PARTY)
    assert (every.courses, every.test) == (alone.courses, alone.test)


@pytest.mark.parametrize("name", THIRD_PARTY)
def test_studies_of_third_party_odometries_load(name: str, tmp_path: Path) -> None:
    if name != "third_party_kiss_icp":
        needs_evalio()
    study = load_study(CONFIGS / f"{name}.yaml", folder=tmp_path)
    assert name == f"third_party_{study.odometry.name}"
    assert f"configs/{name}.yaml" in (CONFIGS / f"{name}.yaml").read_text(encoding="utf-8")
    tuned = study.config.odometry.parameters  # type: ignore[union-attr]
    assert set(tuned or {}) <= set(study.odometry.space.parameters)
    assert study.odometry.description.live == (name == "third_party_kiss_icp")
