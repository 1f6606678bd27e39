import pytest
from drives import study_with

from adaptune._system import yaml12
from adaptune.space import ODOMETRY
from adaptune.study.driven import ANY, EQUAL, FILES
from adaptune.tuning.verdict import front_table
from offline.config import load_study
from offline.train import write_sets

ODOMETRIES = "odometry: [{name: gicp}, {name: kiss_icp}]\n"


@pytest.fixture
def study(study_file, tmp_path):
    """A study of two odometries, one of which has a tool of its own."""
    (tmp_path / "two.yaml").write_text(study_with(ODOMETRIES, study_file.parent))
    return load_study(tmp_path / "two.yaml", [], tmp_path / "study")


def write(study, label, **parameters):
    fixed = study.odometry.space.complete({ODOMETRY: label, **parameters})
    write_sets(study, fixed)
    assert yaml12.Document.of_file(study.folder / "fixed.yaml").data == fixed


def test_the_fixed_set_s_odometry_decides(study):
    own, users = study.folder / "fixed_kiss_icp.yaml", study.folder / "fixed_mine.yaml"
    write(study, "kiss_icp", voxel_size=0.7)
    users.touch()
    assert yaml12.Document.of_file(own).data["mapping"]["voxel_size"] == 0.7
    of_tool = f"For the odometry's own tool: {own.name} (kiss_icp_pipeline --config FILE DATA)."
    assert front_table(study, []).caption.endswith(of_tool)
    # Of a study that was trained before there was such a file.
    own.unlink()
    assert "own tool" not in front_table(study, []).caption
    write(study, "gicp")
    assert sorted(study.folder.glob("fixed*")) == [study.folder / "fixed.yaml", users]
    assert "own tool" not in front_table(study, []).caption


def test_the_best_at_other_costs_are_written_and_go(study):
    fixed, other = study.odometry.space.baseline, {"odometry": "gicp", "downsampling": 0.1}
    paths = [study.folder / FILES[role] for role in (EQUAL, ANY)]
    write_sets(study, fixed, {EQUAL: other, ANY: other})
    for path in paths:
        assert yaml12.Document.of_file(path).data == other
    write_sets(study, fixed, {EQUAL: fixed})
    assert not any(path.exists() for path in paths)
