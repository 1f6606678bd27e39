import estimates
import pytest

from adaptune.errors import AdaptuneError
from offline.config import load_study
from offline.train import train
from offline.validate import validate

BLIND = ("sequences.one.reference=", "sequences.two.reference=estimated", "offline.trials=4")


@pytest.fixture
def load(study_file, tmp_path):
    return lambda *given: load_study(study_file, [*BLIND, *given], tmp_path / "run")


def test_trials_model_and_validation_say_what_judged(load, monkeypatch, caplog):
    estimator = estimates.install(monkeypatch, untrusted=[38])
    training = train(load())
    assert estimator.names == ["one.bag", "two.bag"]
    assert training.words[0].startswith("Judged by an estimated reference: one (its own error is ")
    assert training.words[0].endswith("Intervals do not include its error.")
    said = validate(load()).verdicts
    assert said[-1] == training.words[0]
    # Nothing is left to do.
    train(load())
    assert len(estimator.asked) == 2
    # Another estimate is another reference.
    estimator.factor = 1.01
    monkeypatch.setattr("adaptune.reference.estimate.VERSION", 0)
    train(load())
    assert len(estimator.asked) == 4
    assert "one.tum has other content" in caplog.text


def test_a_sequence_without_reference_is_refused_before_trials_are_removed(load, monkeypatch):
    estimates.install(monkeypatch)
    study = load()
    train(study)
    trials = sorted(study.folder.glob("trials/*/*.npz"))
    changed = load("sequences.two.reference=none")
    with pytest.raises(AdaptuneError, match=r"sequences\.two: training needs a reference"):
        train(changed)
    assert sorted(study.folder.glob("trials/*/*.npz")) == trials
