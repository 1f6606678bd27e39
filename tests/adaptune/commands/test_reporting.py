import shutil

import pytest
from commands import call

from offline.config import load_study
from offline.train import train
from online.modes import run_replays


@pytest.fixture(scope="module")
def finished(gicp_study_file, tmp_path_factory):
    """The folder of a study that was trained and replayed."""
    study = load_study(gicp_study_file, [], tmp_path_factory.mktemp("run") / "study")
    train(study)
    run_replays(study, study.model_path)
    return study.folder


def test_a_finished_study_has_a_page_of_everything(finished):
    ended = call("compare", finished)
    assert ended.exit_code == 0
    assert "report/report.html" in "".join(ended.output.split())
    page = (finished / "report/report.html").read_text()
    for title in ("What adapting gained", "Along three", "What was tried", "Settings"):
        assert f"{title}</h2>" in page
    assert "No validation: run <code>adaptune validate</code>." in page
    figures = {path.stem for path in (finished / "report/figures").glob("*.svg")}
    assert {"comparison", "three-errors", "three-paths"} <= figures
    assert figures == {path.stem for path in (finished / "report/figures").glob("*.png")}
    for mode in ("baseline", "fixed", "adaptive", "paper"):
        assert f">{mode}</td>" in page


def test_studies_are_compared_side_by_side_by_their_folders(finished, tmp_path):
    other = shutil.copytree(finished, tmp_path / "other")
    ended = call("compare", finished, other, "--to", tmp_path / "both")
    assert ended.exit_code == 0
    text = (tmp_path / "both/tables.md").read_text()
    assert "study: fixed" in text
    assert "other: fixed" in text
    assert (tmp_path / "both/tables.tex").exists()
    ended = call("compare", finished, other, "--folder", tmp_path)
    assert ended.exit_code == 2
    ended = call("compare", finished, other, "-o", "sub_trajectory=2")
    assert ended.exit_code == 2
    ended = call("compare", tmp_path)
    assert "is no study's folder" in ended.output
