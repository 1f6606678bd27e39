import pytest

import adaptune
from adaptune.errors import AdaptuneError


@pytest.mark.parametrize("study", ["p2.yaml", "runs/p2"])
@pytest.mark.parametrize("options", [{}, {"odometry": "gicp"}])
def test_a_study_takes_no_recordings(tmp_path, monkeypatch, study, options):
    monkeypatch.chdir(tmp_path)
    text = "odometry: {name: gicp}\nsequences: {a: {bag: a.bag}}\ntraining: [a]\n"
    (tmp_path / "runs/p2").mkdir(parents=True)
    for name in ("p2.yaml", "runs/p2/study.yaml"):
        (tmp_path / name).write_text(text)
    (tmp_path / "good.yaml").write_text("keyframe_interval: 1.0\n")
    what = f"{study}: a study has its own recordings; leave t.bag, u.bag out"
    for sides in ((study, "good.yaml"), ("good.yaml", study)):
        with pytest.raises(AdaptuneError, match=what):
            adaptune.compare(*sides, ["t.bag", "u.bag"], **options)


def test_a_file_of_parameters_is_no_study(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.yaml").write_text("voxel: {{size}}\n")
    with pytest.raises(AdaptuneError, match=r"t\.bag: there is no such"):
        adaptune.compare("good.yaml", "gicp", "t.bag", odometry="gicp")
