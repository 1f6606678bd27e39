import re

import pytest

from adaptune._system.strict import ConfigurationError
from adaptune.space import Categorical, Float, Integer, ParameterSpace
from offline.config import OfflineConfig, SamplerError, load_study
from offline.samplers import make_sampler

MINE = """
import optuna

class Fine(optuna.samplers.RandomSampler):
    pass

class Picky(optuna.samplers.RandomSampler):
    def __init__(self, mode=0, seed=None):
        raise ValueError("no such mode")

class Raises(optuna.samplers.BaseSampler):
    def infer_relative_search_space(self, study, trial):
        return {}
    def sample_relative(self, study, trial, search_space):
        return {}
    def sample_independent(self, study, trial, name, distribution):
        raise ValueError("no idea")
"""

SPACE = ParameterSpace(
    {
        "voxel": Float(low=0.1, high=2.0, baseline=0.5, log=True),
        "count": Integer(low=1, high=9, baseline=3),
        "kernel": Categorical(choices=("huber", 1, True), baseline=True),
    }
)


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    (tmp_path / "users_samplers.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(tmp_path))


def make(name):
    return make_sampler(SPACE, OfflineConfig(sampler=name, initial=2, batch=2, seed=3))


def propose_all(sampler):
    sets = []
    for n in range(8):
        history = [(s, s["voxel"] + (s["kernel"] is True)) for s in sets[: max(0, n - 1)]]
        sets.append(sampler.propose(history, sets[len(history) :]).parameters)
    return sets


def test_it_proposes_as_optuna_s_own_would():
    found = propose_all(make("users_samplers:Fine"))
    assert repr(found) == repr(propose_all(make("optuna.samplers:RandomSampler")))
    assert len(found) == 8


def test_one_that_goes_wrong_is_named_before_anything_is_run():
    words = r"users_samplers:Raises: ValueError: no idea \(.*, line"
    with pytest.raises(SamplerError, match=f"^offline.sampler.*{words}"):
        make("users_samplers:Raises")


def test_one_that_cannot_be_imported(tmp_path, study_file):
    (tmp_path / "broken_samplers.py").write_text("1 / 0")
    words = "broken_samplers:It: cannot be imported: ZeroDivisionError: division by zero"
    with pytest.raises(ConfigurationError, match=words):
        load_study(study_file, ["offline.sampler=broken_samplers:It"])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("{mode: 1}", "users_samplers:Picky does not take its settings: no such mode"),
        ("{moode: 3}", "moode: users_samplers:Picky has no such setting; did you mean 'mode'"),
    ],
)
def test_settings_that_do_not_do(study_file, settings, words):
    given = ["offline.sampler=users_samplers:Picky", f"offline.sampler_settings={settings}"]
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        load_study(study_file, given)
