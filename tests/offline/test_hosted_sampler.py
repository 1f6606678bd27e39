import re

import optuna
import pytest

from adaptune import processes
from adaptune.space import Categorical, Float, Integer, ParameterSpace
from adaptune.strict import ConfigurationError
from offline.config import OfflineConfig, SamplerError, check_class, load_study
from offline.samplers import AskedSampler, HostedSampler, make_sampler

MINE = """
import os, time
import optuna

class Fine(optuna.samplers.RandomSampler):
    pass

class Picky(optuna.samplers.RandomSampler):
    def __init__(self, mode=0, seed=None):
        super().__init__(seed)
        if mode == 1:
            raise ValueError("no such mode")
        if mode == 2:
            os._exit(3)
        if mode == 3:
            time.sleep(1e9)

class Wrong(optuna.samplers.BaseSampler):
    def infer_relative_search_space(self, study, trial):
        return {}
    def sample_relative(self, study, trial, search_space):
        return {}
    def sample_independent(self, study, trial, name, distribution):
        return self.of(name)

class Raises(Wrong):
    def of(self, name):
        raise ValueError("no idea")

class Beyond(Wrong):
    def of(self, name):
        return 0 if name == 'kernel' else 1e9

class Words(Wrong):
    def of(self, name):
        return "much"
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
    processes.server.cache_clear()
    (tmp_path / "users_samplers.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(tmp_path))


def config(name, **rest):
    return OfflineConfig(sampler=f"users_samplers:{name}", initial=2, batch=2, seed=3, **rest)


def propose_all(sampler, batches):
    history = []
    for _ in range(batches):
        sets = sampler.propose(history)
        history += [(s, s["voxel"] + (s["kernel"] is True)) for s in sets]
    return [parameters for parameters, _ in history]


def test_it_proposes_what_it_would_propose_here(monkeypatch):
    hosted = make_sampler(SPACE, config("Fine"))
    assert isinstance(hosted, HostedSampler)
    found = propose_all(hosted, 4)
    monkeypatch.setattr(
        "offline.samplers.optuna_sampler",
        lambda _n, s, seed: optuna.samplers.RandomSampler(seed=seed, **s),
    )
    here = propose_all(AskedSampler(SPACE, config("Fine")), 4)
    assert repr(found) == repr(here)
    assert len(found) == 8
    # Another instance goes on from any history.
    assert repr(propose_all(make_sampler(SPACE, config("Fine")), 4)) == repr(found)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Raises", "ended with code 1: .*ValueError: no idea"),
        ("Beyond", r"users_samplers:Beyond proposed 1000000000\.0 for voxel, .*between 0\.1 and 2"),
        ("Words", "ended with code 1: .*ValueError: .much. is not"),
    ],
)
def test_one_that_goes_wrong_is_named(name, words):
    sampler = make_sampler(SPACE, config(name))
    first = [(s, 1.0) for s in sampler.propose([])]
    with pytest.raises(SamplerError, match=f"(?s)trials 2 to 3: .*{words}") as caught:
        sampler.propose(first)
    assert f"users_samplers:{name}" in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ("{mode: 1}", "users_samplers:Picky does not take its settings: no such mode"),
        ("{mode: 2}", "users_samplers:Picky: its process ended with code 3"),
        ("{mode: 3}", "users_samplers:Picky: it took longer than 2 s to begin"),
        ("{moode: 3}", "moode: users_samplers:Picky has no such setting; did you mean 'mode'"),
    ],
)
def test_settings_that_do_not_do(monkeypatch, study_file, settings, words):
    if settings == "{mode: 3}":
        check_class("users_samplers:Picky")  # which takes its time to import
        monkeypatch.setattr(processes, "IMPORT_SECONDS", 2.0)
    given = ["offline.sampler=users_samplers:Picky", f"offline.sampler_settings={settings}"]
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        load_study(study_file, given)
