"""Portfolios of studies."""

import pytest
from setups import failure

from adaptune._system import yaml12
from adaptune.odometry.portfolio import read_portfolio
from adaptune.space import ODOMETRY
from offline.config import load_study

BASE = {"max_correspondence_distance": 4.0, "keyframe_interval": 4.0}
SHORT = {**BASE, "max_correspondence_distance": 1.5}
FAR = {**BASE, "keyframe_interval": 9.0}


@pytest.fixture
def portfolio(tmp_path):
    def write(odometry="fake_odometry:Fake", sets=(SHORT, FAR), name="mine"):
        path = tmp_path / f"{name}.yaml"
        of = [{"parameters": one} for one in (BASE, *sets)]
        path.write_text(yaml12.dump({"odometry": odometry, "sets": of}))
        return path, f"{path}: {read_portfolio(str(path)).digest}"

    return write


def loaded(study_file, tmp_path, *overrides):
    return load_study(study_file, overrides, tmp_path / "run")


def test_a_study_has_the_sets_of_the_portfolio_that_it_names(study_file, tmp_path, portfolio):
    assert loaded(study_file, tmp_path).portfolio == ()
    assert loaded(study_file, tmp_path, "offline.portfolio=none").portfolio == ()
    override = f"offline.portfolio={{{portfolio()[1]}}}"
    study = loaded(study_file, tmp_path, override)
    assert study.portfolio == (SHORT, FAR)
    assert "portfolio" in study.config.search_inputs
    assert "portfolio" not in loaded(study_file, tmp_path).config.search_inputs
    # Neither repeats what was published with another beginning.
    assert loaded(study_file, tmp_path, override, "offline.sampler=random").portfolio == ()


def test_one_that_has_changed_is_not_used(study_file, tmp_path, portfolio, caplog):
    path, given = portfolio()
    study = loaded(study_file, tmp_path, f"offline.portfolio={{{given}}}")
    portfolio(sets=(FAR,))
    assert study.portfolio == ()
    assert f"{path} is not the one that this study began with, and is not used: " in caplog.text


def test_of_several_odometries_each_has_its_sets_in_turn(study_file, tmp_path, portfolio):
    fake, gicp = portfolio()[1], portfolio("gicp", (SHORT,), "other")[1]
    both = "odometry=[{name: gicp}, {name: 'fake_odometry:Fake', label: fake}]"
    study = loaded(study_file, tmp_path, both, f"offline.portfolio={{{fake}, {gicp}}}")
    labels = [one[ODOMETRY] for one in study.portfolio]
    assert labels == ["fake", "gicp", "fake"]
    for one in study.portfolio:
        study.odometry.space.check(one)


def test_mistakes_name_the_file_and_the_key(study_file, portfolio):
    path, given = portfolio("gicp")
    said = failure(study_file, f"offline.portfolio={{{given}}}")
    assert f"offline.portfolio: {path}: odometry: is of gicp, and tuned is " in said
    path, given = portfolio(sets=({"radius": 1.0},))
    said = failure(study_file, f"offline.portfolio={{{given}}}")
    assert f"{path}: sets.1.parameters.radius: fake_odometry:Fake has no parameter" in said
    assert "no such file" in failure(study_file, "offline.portfolio={no.yaml: abc}")
    assert "offline.portfolio: give keys with values" in failure(study_file, "offline.portfolio=x")
