import numpy as np
import pytest
from fake_odometry import SPEED, Fake

from adaptune.odometry import Registration
from adaptune.runs.archive import Archive
from offline.choice import BlockErrors
from offline.config import load_study
from offline.train import train
from offline.whole import worse_without

BEGIN, FAR = 4, 3.0
"""Scan at which a set runs away, and `keyframe_interval` above which it does."""


def start(self, prepared, T_odom_sensor, _motion=None):
    self.begun, self.n = getattr(self, "begun", 0) + 1, 0
    self._stamp, self._T = prepared.stamp, T_odom_sensor


def register(self, prepared):
    """With the baseline's interval, two jumps; with a long one, no error, but it runs away once."""
    self.n += 1
    seconds = (prepared.stamp - self._stamp) / 1e9
    self._stamp, self._T = prepared.stamp, self._T.copy()
    jumps = self.parameters["keyframe_interval"] == 1.0
    helped = self.parameters["keyframe_interval"] > FAR
    factor = 1.0 if helped else 1.05 if jumps else 1.02
    if (helped and self.begun == 1 and self.n >= BEGIN) or (jumps and self.n in (10, 20)):
        factor = 20.0
    self._T[0, 3] += factor * SPEED * seconds
    return Registration(self._T, registered=True)


@pytest.fixture(scope="module")
def helped(study_file, tmp_path_factory):
    """A study whose best sets are good with the health check alone, and what it says."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Fake, "start", start)
        patch.setattr(Fake, "register", register)
        study = load_study(study_file, [], tmp_path_factory.mktemp("helped") / "study")
        training = train(study)
        before = {path: path.stat().st_mtime_ns for path in study.folder.glob("trials/*/*.npz")}
        again = train(study)
        after = {path: path.stat().st_mtime_ns for path in study.folder.glob("trials/*/*.npz")}
    assert before == after
    assert again.words == training.words
    return study, training


def test_what_needs_the_health_check_more_than_the_baseline_is_not_recommended(helped):
    _, training = helped
    sets, means = training.model.sets, {row["trial"]: row["mean"] for row in training.trials}
    best = min(means, key=means.__getitem__)
    assert sets[best]["keyframe_interval"] > FAR
    assert 1.0 != sets[training.model.fixed]["keyframe_interval"] < FAR
    (said,) = [words for words in training.words if "health check" in words]
    assert said.startswith("Without the health check, as in your launch file, the baseline has ")
    assert "not recommended: trial" in said
    assert str(best) in said
    assert best not in {row["trial"] for row in training.front}


def test_bare_drives_are_those_of_helped_sets_and_of_the_baseline(helped):
    study, _ = helped
    archive = Archive(study.folder / "trials")
    found = {int(path.name[:5]) for path in archive.folder.glob("one-*/*-bare.npz")}
    assert 0 in found
    helped_sets = {n for n, run in archive.finished("one").items() if run.restarts}
    assert found <= helped_sets
    for number in found:
        bare = archive.read("one", number, kind="bare")
        assert not bare.restarted.any()
        way = np.diff(bare.T_odom_sensor[:, 0, 3])
        jumps = int((way > 1.0).sum())
        runs_away = bare.parameters["keyframe_interval"] > FAR
        assert jumps > 20 if runs_away else jumps == 2
    assert list(archive.finished("one")) == list(range(10))


def test_there_are_none_where_the_health_check_does_nothing(trained_folder):
    assert not list(trained_folder.glob("trials/*/*-bare.npz"))


def test_a_set_that_is_lost_more_often_is_worse_however_good_it_is_elsewhere():
    errors = np.ones((8, 4))
    errors[:, 1] = 0.5
    errors[-1, 1:3] = 30.0
    errors[0, 3] = 14.0
    number, none = np.zeros(8, np.intp), np.zeros(4)
    blocks = BlockErrors([0, 1, 2, 3], errors, number, none, none)
    assert worse_without(blocks).tolist() == [False, True, True, False]
    # As often as the baseline is no reason.
    errors[0, 0] = 30.0
    assert not worse_without(blocks)[1]
