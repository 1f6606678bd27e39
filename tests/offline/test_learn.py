"""Learning from another drive, and what is said of it."""

import shutil

import commands
import drives
import pytest
import yaml

from adaptune.archive import Archive
from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from adaptune.study.new_drive import NewDrive
from adaptune.study.study import BANK, ONE_SET
from offline.config import load_study
from offline.learn import Known, LearnError, changes, learn, runs_in_words

FIGURES = {
    "loss": -0.2,
    "geometric": 0.8,
    "low": 0.7,
    "high": 0.9,
    "worst_tenth": 1.0,
    "worst": 1.1,
    "n_stretches": 8,
    "n_recordings": 2,
}
SETS = {0: {"resolution": 4.0, "kernel": "none"}, 3: {"resolution": 2.25, "kernel": "none"}}


def known(fixed=0, way=None, members=(), **geometric):
    names = {"bank": BANK, "one_set": ONE_SET}
    expected = {
        names[way]: FIGURES | {"geometric": of, "loss": of} for way, of in geometric.items()
    }
    return Known(fixed, SETS[fixed], way, list(members), expected)


def test_nothing_has_changed():
    same = known(3, BANK, [3, 1, 2], bank=0.8)
    fixed, what, gain = changes(same, same)
    assert fixed == "Fixed set: still trial 3: resolution 2.25, kernel none."
    assert what == "Driven: still the bank of trials 3, 1, 2."
    assert gain.startswith("Expected: still expected gain 20 % (95 % interval 10 to 30 %), ")


def test_all_has_changed():
    before = known(0, None, [0, 1, 2], bank=0.99, one_set=1.1)
    fixed, what, was, now = changes(before, known(3, BANK, [3, 1, 2], bank=0.8))
    assert fixed == ("Fixed set: was trial 0, the baseline, is trial 3; resolution was 4, is 2.25.")
    assert what == "Driven: was the fixed set, is the bank of trials 3, 1, 2."
    assert (
        "no gain, the fixed set is driven (the best alternative is a bank: expected gain 1 %" in was
    )
    assert now.startswith("Expected now: expected gain 20 %")


def test_other_members():
    before, after = known(0, BANK, [0, 1, 2], bank=0.8), known(0, BANK, [0, 2, 5], bank=0.8)
    assert changes(before, after)[1] == (
        "Driven: was the bank of trials 0, 1, 2, is the bank of trials 0, 2, 5; new: 5; no longer "
        "a member: 1."
    )


def test_fewer_sets_than_before_are_told_of():
    before = known(3, BANK, [3, 1], bank=0.8)._replace(n_sets=24)
    *_, last = changes(before, before._replace(n_sets=16))
    assert last.startswith("16 parameter sets were compared, and 24 before: ")
    assert len(changes(before, before._replace(n_sets=32))) == 3


def test_what_is_new_without_a_model_before():
    fixed, what, gain = changes(None, known(3, ONE_SET))
    assert fixed == "Fixed set: trial 3: resolution 2.25, kernel none."
    assert what == "Driven: one set at a time."
    assert gain == "Expected: unknown, there is too little to compare ways to adapt."


def test_runs_are_counted():
    before = {("one", "00000"), ("one", "00000-whole")}
    new = {("two", "00000"), ("two", "00001"), ("two", "00000-whole"), ("one", "00001-whole")}
    assert runs_in_words(before, before | new) == (
        "Run: 1 whole run on one; 2 trials and 1 whole run on two; 2 runs were there already."
    )
    assert runs_in_words(before, before) == "Nothing was run: 2 runs were there already."


@pytest.fixture
def trained(study_file, trained_folder, tmp_path, monkeypatch):
    """A trained study that may be changed, in the working directory."""
    shutil.copytree(trained_folder, tmp_path / "runs/small")
    text = study_file.read_text().replace("bag: ", f"bag: {study_file.parent}/")
    (tmp_path / "small.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def mtimes(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*.npz")}


def test_a_new_bag_is_learned_and_only_what_is_missing_runs(trained):
    drives.write_bag(trained / "my drive.bag", drives.scans(5, 40))
    study, folder = (trained / "small.yaml").read_text(), trained / "runs/small"
    written, sets = mtimes(folder / "trials"), Archive(folder / "trials").sets()
    done = commands.call("learn", "small.yaml", "my drive.bag")
    assert done.exit_code == 0, done.stderr
    assert "my_drive becomes a training sequence: points /points, reference /truth." in done.stdout
    for said in ("Fixed set: ", "Driven: ", "Expected", "Run: ", "10 trials and ", "Next: "):
        assert said in done.stdout
    assert (trained / "small.yaml").read_text() == study
    # No set is proposed, and no trial on another sequence is run again.
    assert {path: mtimes(folder / "trials")[path] for path in written} == written
    assert Archive(folder / "trials").sets() == sets
    assert len(Archive(folder / "trials").finished("my_drive")) == 10
    assert ErrorModel.load(folder / "model.safetensors").sequences == ["one", "two", "my_drive"]
    learned = yaml.safe_load((folder / "learned.yaml").read_text())
    assert learned["training"] == ["my_drive"]
    assert learned["sequences"]["my_drive"] == {
        "bag": str(trained / "my drive.bag"),
        "points": "/points",
        "reference": "/truth",
    }
    again = commands.call("learn", "small.yaml", "my drive.bag")
    assert again.exit_code == 2
    assert "my_drive is a training sequence of the study already: there is nothing" in again.stderr
    commands.call("offline", "small.yaml")
    assert {path: mtimes(folder / "trials")[path] for path in written} == written


@pytest.mark.usefixtures("trained")
def test_a_test_sequence_is_learned_and_is_none_any_more():
    done = commands.call("learn", "small.yaml", "three", "-o", "offline.trials=4")
    assert done.exit_code == 0, done.stderr
    assert "three was a test sequence. What is trained on proves nothing" in done.stdout
    study = load_study("small.yaml")
    assert study.training == ["one", "two", "three"]
    assert study.config.test == ()


def test_a_drive_that_is_refused_leaves_the_study_as_it_was(trained):
    drives.write_bag(trained / "short.bag", drives.scans(5, 5))
    learned = trained / "runs/small/learned.yaml"
    for drive in ("short.bag", "three"):
        overrides = []
        if drive == "three":
            overrides = ["-o", "training=[one, two]"]
        done = commands.call("learn", "small.yaml", drive, *overrides)
        assert done.exit_code == 2
        assert "Nothing was learned from " in done.stderr
        assert not learned.exists()
    model = ErrorModel.load(trained / "runs/small/model.safetensors")
    assert model.sequences == ["one", "two"]


@pytest.mark.usefixtures("trained")
def test_an_interrupted_lesson_goes_on(monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    overrides = ("-o", "offline.trials=4")
    with monkeypatch.context() as patch:
        patch.setattr("offline.learn.train", interrupt)
        assert commands.call("learn", "small.yaml", "three", *overrides).exit_code == 130
    assert load_study("small.yaml").training == ["one", "two", "three"]
    done = commands.call("learn", "small.yaml", "three", *overrides)
    assert done.exit_code == 0, done.stderr
    assert "Going on with three." in done.stdout
    assert load_study("small.yaml").training == ["one", "two", "three"]


@pytest.mark.parametrize(
    ("error", "fitted", "begun", "stays"),
    [
        (RuntimeError("a bug"), False, False, False),
        (OSError("no room"), False, False, False),
        (OSError("no room"), True, False, True),
        (OSError("no room"), False, True, True),
        (RuntimeError("a bug"), False, True, True),
        (AdaptuneError("is damaged"), False, True, False),
    ],
)
def test_what_an_error_leaves_of_a_drive(
    study_file, tmp_path, monkeypatch, error, fitted, begun, stays
):
    def fail(study, _):
        if fitted:
            study.model_path.write_bytes(b"new")
        raise error

    def load():
        return load_study(study_file, [], tmp_path / "run")

    if begun:
        (tmp_path / "run").mkdir()
        (tmp_path / "run/learned.yaml").write_text("training: [three]")
    monkeypatch.setattr("offline.learn.train", fail)
    expected = RuntimeError if isinstance(error, RuntimeError) else LearnError
    with pytest.raises(expected, match=str(error)):
        learn(load(), NewDrive("three", "three", {}, begun=begun), load)
    assert ("three" in load().training) == stays
