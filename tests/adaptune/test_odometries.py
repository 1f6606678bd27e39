"""Studies of several odometries: what is read, and what is refused."""

import pickle

import pytest
from drives import STUDY
from needs import needs_evalio

from adaptune.odometry.keyframe import KeyframeGicp, KeyframeVgicp
from adaptune.odometry.registry import OdometryPool
from adaptune.space import ODOMETRY
from adaptune.strict import ConfigurationError
from offline.config import load_study

TWO = """
  - gicp
  - name: vgicp
    parameters: {resolution: {low: 1.0}}
"""


@pytest.fixture
def study_of(study_file, tmp_path):
    """Load the study with other odometries, which are given as YAML."""
    rest = STUDY[STUDY.index("sequences:") :].replace("bag: ", f"bag: {study_file.parent}/")

    def load(odometry, *overrides):
        path = tmp_path / "several.yaml"
        path.write_text(f"odometry:{odometry}\n{rest}")
        return load_study(path, list(overrides), runs=tmp_path)

    return load


def refused(study_of, odometry, *overrides):
    with pytest.raises(ConfigurationError) as caught:
        study_of(odometry, *overrides)
    return str(caught.value)


def test_a_study_of_two(study_of):
    study = study_of(TWO)
    pool = study.odometry
    assert isinstance(pool, OdometryPool)
    assert pool.name == "gicp, vgicp"
    assert pool.space.baseline[ODOMETRY] == "gicp"
    assert pool.space.spaces["vgicp"].parameters["resolution"].low == 1.0
    assert not pool.description.live
    assert isinstance(pool().odometry, KeyframeGicp)
    made = pool({ODOMETRY: "vgicp", "resolution": 2.0}).odometry
    assert isinstance(made, KeyframeVgicp)
    assert made.parameters["resolution"] == 2.0
    assert pickle.loads(pickle.dumps(pool)).identity == pool.identity
    assert pool.identity["settings"]["vgicp"]["name"] == "vgicp"
    assert study.mechanism in ("bank", None)


def test_one_in_a_list_is_one(study_of):
    assert study_of(" [gicp]").odometry.name == "gicp"


def test_the_same_odometry_with_other_settings_or_ranges(study_of):
    text = "\n  - gicp\n  - {name: gicp, label: coarse, settings: {downsampling: 1.0}}"
    assert study_of(text).odometry.name == "gicp, coarse"
    near = "{name: gicp, label: near, parameters: {max_correspondence_distance: {high: 4.0}}}"
    far = "{name: gicp, label: far, parameters: {max_correspondence_distance: {low: 5.0, "
    text = f"\n  - {near}\n  - {far}baseline: 6.0}}}}}}"
    assert study_of(text).odometry.name == "near, far"


@pytest.mark.parametrize(
    ("odometry", "said"),
    [
        (
            "\n  - gicp\n  - {name: gicp, label: again}",
            "odometry.1: gicp is there already (odometry.0) with the same settings",
        ),
        (
            "\n  - gicp\n  - {name: gicp, settings: {downsampling: 1.0}}",
            "odometry.1.label: 'gicp' is what odometry.0 is called",
        ),
        ("\n  - gicp\n  - gipc", "did you mean 'gicp'"),
        ("\n  - gicp\n  - {name: vgicp, parameters: {resolutoin: {}}}", "odometry.1.parameters"),
        (
            "\n  - gicp\n  - {name: ndt, settings: {iterations: 5}, parameters: {iterations: {}}}",
            "odometry.1.parameters.iterations: iterations is fixed by settings",
        ),
        (
            "\n  - gicp\n  - {name: command, parameters: {x: {type: float, low: 0, high: 1, "
            "baseline: 0}}, settings: {command: [cat, '{input}', '{output}', '{x}']}}",
            "odometry.1.name: command runs whole recordings, and must be the only one",
        ),
        (" []", "odometry: give at least one, not none"),
    ],
)
def test_lists_that_are_refused(study_of, odometry, said):
    assert said in refused(study_of, odometry)


def test_mistakes_have_the_line_of_their_odometry(study_of):
    text = refused(study_of, "\n  - gicp\n  - vgicp\n  - {name: ndt, settings: {iteration: 3}}")
    assert "line 4: odometry.2.settings.iteration: unknown key" in text


def test_an_odometry_of_several_needs_an_imu(study_of):
    text = refused(study_of, "\n  - gicp\n  - inertial:Inertial")
    assert "inertial:Inertial needs an IMU; name its topic" in text


def test_sets_of_a_bank_say_which_odometry_they_are_for(study_of):
    sets = "online.switching.sets=[{resolution: 2.0}, {odometry: gicp}]"
    text = refused(study_of, TWO, sets)
    assert "online.switching.sets.0: say which odometry it is for (odometry: gicp)" in text


def test_none_of_several_is_changed_live(study_of):
    text = refused(study_of, TWO, "online.switching.mechanism=live")
    assert "gicp, vgicp cannot change parameters between scans" in text


def test_what_is_not_installed_is_named_first(study_of, monkeypatch):
    needs_evalio()
    from adaptune.errors import NotInstalledError
    from adaptune.odometry import evalio

    def missing():
        raise NotInstalledError("evalio cannot be imported (no); run `pip install`")

    monkeypatch.setattr(evalio, "evalio_modules", missing)
    text = refused(study_of, "\n  - gicp\n  - mad_icp")
    assert "line 3: odometry.1.name: evalio cannot be imported" in text
