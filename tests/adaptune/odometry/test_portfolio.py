import numpy as np
import pytest

from adaptune._system import yaml12
from adaptune.errors import AdaptuneError
from adaptune.odometry.portfolio import (
    FOLDER,
    Portfolio,
    PortfolioError,
    ScanKind,
    path_of,
    portfolios_of,
    read_portfolio,
)
from adaptune.odometry.registry import ODOMETRIES, odometry_class
from adaptune.recording.scan import Scan
from adaptune.space import Categorical, Float, Integer, ParameterSpace

SPACE = ParameterSpace.of(
    distance=Float(low=1.0, high=10.0, baseline=4.0),
    passes=Integer(low=1, high=9, baseline=2),
    kernel=Categorical(choices=("none", "huber"), baseline="none"),
)
BASE = {"distance": 4.0, "passes": 2, "kernel": "none"}


def made(*sets, **more):
    return {"odometry": "icp", "sets": [{"parameters": s} for s in (BASE, *sets)], **more}


def fitting(data, space=SPACE, known=SPACE.names):
    return Portfolio.model_validate(data).fitting(space, known)


def test_sets_are_those_of_the_space_without_the_baseline():
    sets, said = fitting(made({"distance": 2.0}, BASE, {**BASE, "kernel": "huber"}))
    assert sets == [{**BASE, "distance": 2.0}, {**BASE, "kernel": "huber"}]
    assert said == []


def test_what_does_not_fit_the_space_is_left_out_and_told():
    few = ParameterSpace.of(distance=Float(low=2.0, high=10.0, baseline=3.0))
    data = made({**BASE, "distance": 1.5}, {**BASE, "passes": 3}, {**BASE, "distance": 5.0})
    sets, said = fitting(data, few)
    assert sets == [{"distance": 5.0}]
    assert said[0].startswith("left out: set 1 (distance); set 2 (passes), because")
    assert said[1] == "was chosen with another baseline (distance)"


def test_a_parameter_that_the_odometry_does_not_have_is_an_error():
    with pytest.raises(PortfolioError, match=r"sets\.1\.parameters\.distanc: icp .* 'distance'"):
        fitting(made({"distanc": 2.0}))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("odometry: icp", "sets: this key is missing"),
        ("odometry: icp\nsets: [{parameters: {a: 1}}]", "line 2: sets: give at least 2, not 1"),
        ("odometry: 3\nsets: 1", "line 1: odometry: give text, not 3"),
        ("odometry: icp\nset: []", "line 2: set: unknown key; did you mean 'sets'?"),
        ("- 1", "give keys with values, not a list"),
        ("", "give keys with values, not nothing"),
        ("a: [", "line 1"),
        (None, "there is no such file"),
    ],
)
def test_a_damaged_file_names_itself_the_line_and_the_key(tmp_path, text, said):
    path = tmp_path / "mine.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(AdaptuneError) as caught:
        read_portfolio(str(path))
    assert str(caught.value).startswith(str(path))
    assert said in str(caught.value)


def test_a_file_takes_the_place_of_the_one_that_adaptune_brings(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml12.dump(made({"distance": 2.0})))
    digest = read_portfolio(str(path)).digest
    assert portfolios_of(["icp"], str(path)) == {str(path): digest}
    assert portfolios_of(["icp"]) == {}
    assert portfolios_of([*ODOMETRIES], "none") == {}
    path.write_text(yaml12.dump(made({"distance": 3.0})))
    assert read_portfolio(str(path)).digest != digest


def test_scans_unlike_those_that_it_was_chosen_on_are_told():
    scans = {"rate": [2.0, 10.0], "points": [3000, 60000], "view": [360, 360]}
    portfolio = Portfolio.model_validate(made({"passes": 3}, scans=scans))
    assert portfolio.unlike(ScanKind(10.0, 30_000, 360)) == ""
    assert portfolio.unlike(ScanKind(1.0, 30_000, 70)) == (
        "rate 1 (it was chosen on 2 to 10), view 70 (it was chosen on 360 to 360)"
    )
    azimuth = np.radians(np.arange(-34.5, 35.0))
    points = np.stack([np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth], axis=1)
    narrow = ScanKind.of(Scan(0, points.astype(np.float32)), 10.0)
    assert narrow == (10.0, 70, 80)
    assert ScanKind.of(Scan(0, -points.astype(np.float32)), 10.0).view == 80


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.yaml")))
def test_what_adaptune_brings_fits_its_odometry(name):
    space = odometry_class(name).space
    portfolio = read_portfolio(name)
    assert portfolio.odometry == name == path_of(name).stem
    sets, said = portfolio.fitting(space, space.names)
    assert portfolio.sets[0].parameters == space.baseline
    assert len(sets) == len(portfolio.sets) - 1
    assert said == []
    assert all(len(row) == len(portfolio.sets) for row in portfolio.ratios.values())
    assert set(portfolio.ratios) == {*portfolio.courses, *portfolio.recordings}
    assert portfolios_of([name]) == {name: portfolio.digest}
