import pickle

import pytest
from drives import study_with
from setups import failure

from adaptune.odometry.factory import OdometryPool
from adaptune.odometry.keyframe import KeyframeGicp, KeyframeVgicp
from adaptune.space import ODOMETRY
from offline.config import load_study

TWO = """
  - gicp
  - name: vgicp
    parameters: {resolution: {low: 1.0}}
"""


@pytest.fixture
def study_of(study_file, tmp_path):
    """The study with other odometries, which are given as YAML."""

    def write(odometry):
        path = tmp_path / "several.yaml"
        path.write_text(study_with(f"odometry:{odometry}\n", study_file.parent))
        return path

    return write


def test_a_study_of_two(study_of, tmp_path):
    study = load_study(study_of(TWO), folder=tmp_path)
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


@pytest.mark.parametrize(
    ("odometry", "said"),
    [
        (
            "\n  - gicp\n  - {name: gicp, settings: {downsampling: 1.0}}",
            "odometry.1.label: 'gicp' is what odometry.0 is called",
        ),
        (
            "\n  - gicp\n  - {name: command, parameters: {x: {type: float, low: 0, high: 1, "
            "baseline: 0}}, settings: {command: [cat, '{input}', '{output}', '{x}']}}",
            "odometry.1.name: command runs whole recordings, and must be the only one",
        ),
    ],
)
def test_lists_that_are_refused(study_of, odometry, said):
    assert said in failure(study_of(odometry))


def test_mistakes_have_the_line_of_their_odometry(study_of):
    text = failure(study_of("\n  - gicp\n  - vgicp\n  - {name: ndt, settings: {iteration: 3}}"))
    assert "line 4: odometry.2.settings.iteration: unknown key" in text


def test_none_of_several_is_changed_live(study_of):
    text = failure(study_of(TWO), "online.switching.mechanism=live")
    assert "gicp, vgicp cannot change parameters between scans" in text
