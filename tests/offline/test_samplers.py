import collections
import math

import numpy as np
import pytest

from adaptune.space import Categorical, Float, Integer, ParameterSpace
from offline.config import OfflineConfig, SamplerError
from offline.samplers import make_sampler, sobol_points

SPACE = ParameterSpace(
    {
        "distance": Float(low=0.01, high=100.0, baseline=3.0, log=True),
        "gain": Float(low=-1.0, high=1.0, baseline=0.25),
        "rings": Integer(low=1, high=64, baseline=16, log=True),
        "passes": Integer(low=0, high=9, baseline=2),
        # Python takes 1 and True for equal.
        "kernel": Categorical(choices=("huber", "none", 1, True), baseline="huber"),
    }
)
GRID = {
    "distance": {"low": 0.1, "high": 10.0, "count": 5},
    "gain": [-1.0, 0.5, 5],
    "rings": {"low": 1, "high": 64, "count": 7},
    "passes": [0, 3, 4],
}
FINITE = ParameterSpace(
    {
        "passes": Integer(low=1, high=6, baseline=2),
        "kernel": Categorical(choices=("huber", "none", True), baseline="none"),
    }
)
SAMPLERS = {
    "random": {},
    "random, of a grid": {"grid": GRID},
    "grid": {"grid": GRID},
    "tpe": {},
    "annealing": {"chains": 4},
    "annealing, one chain": {"reanneal_best": 5, "steps": {"gain": {"mu": 0.1, "sigma": 0.3}}},
    "optuna.samplers:CmaEsSampler": {},
    "optuna.samplers:NSGAIISampler": {"population_size": 8},
    "optuna.samplers:QMCSampler": {"qmc_type": "halton"},
    "optuna.samplers:RandomSampler": {},
}


def bowl(parameters):
    return (
        abs(math.log10(parameters["distance"]))
        + abs(parameters["gain"])
        + parameters["rings"] / 64
        + abs(parameters["passes"] - 5) / 9
        + (parameters["kernel"] is not True)
    )


@pytest.fixture(params=SAMPLERS)
def config(request):
    settings, name = SAMPLERS[request.param], request.param.partition(",")[0]
    return OfflineConfig(sampler=name, sampler_settings=settings, batch=8, initial=12, seed=5)


def run(config, n, space=SPACE, error=bowl, sampler=None):
    """Sets and values of `n` trials, or of as many as there are."""
    sampler, sets, history = sampler or make_sampler(space, config), [], []
    while len(sets) < n:
        history = [(s, error(s)) for s in sets[: max(0, len(sets) - config.batch + 1)]]
        if (proposed := sampler.propose(history, sets[len(history) :])) is None:
            break
        sets.append(proposed.parameters)
    return [(s, error(s)) for s in sets]


def test_sets_are_of_the_space_and_differ(config):
    history = run(config, 64)
    assert len({repr(parameters) for parameters, _ in history}) == len(history) == 64
    for parameters, _ in history:
        SPACE.check(parameters)
        types = [type(value) for value in parameters.values()]
        assert types[:4] == [float, float, int, int]
        if config.sampler_settings.get("grid") is None:
            assert all(value == float(f"{value:.4g}") for value in [*parameters.values()][:2])
        assert list(parameters) == list(SPACE.names)


@pytest.mark.parametrize("known", [0, 1, 11, 13, 32])
def test_resumes_exactly(config, known):
    history = run(config, 40)
    sets, resumed = [s for s, _ in history], make_sampler(SPACE, config)
    for n in range(known, 40):
        seen = max(0, n - config.batch + 1)
        assert resumed.propose(history[:seen], sets[seen:n]).parameters == sets[n]


@pytest.mark.parametrize("config", [name for name in SAMPLERS if name != "grid"], indirect=True)
def test_heeds_the_log_scale(config):
    config = config.model_copy(update={"initial": 48})
    sets = [s for s, _ in run(config, 96, error=lambda _: 1.0)]
    # Every second set of TPE keeps about half of the baseline's values.
    drawn = sets[1::2] if config.sampler == "tpe" else sets
    assert 0.2 < np.mean([s["distance"] < 1.0 for s in drawn]) < 0.8
    assert 0.2 < np.mean([s["rings"] < 8 for s in drawn]) < 0.8


def test_tpe_tries_what_is_like_the_baseline():
    sets = [s for s, _ in run(OfflineConfig(initial=24, seed=3), 48)]
    base = SPACE.baseline
    kept = [np.mean([s[name] == base[name] for name in base]) for s in sets]
    for part in (slice(2, 24), slice(24, 48)):
        assert 0.35 < np.mean(kept[part][::2]) < 0.75
        assert np.mean(kept[part][1::2]) < 0.35


def test_tries_all_there_is_and_ends(config):
    if "grid" in config.sampler_settings:
        settings = {"grid": {"passes": [1, 1, 6]}}
        config = config.model_copy(update={"sampler_settings": settings})
    if "steps" in config.sampler_settings:
        config = config.model_copy(update={"sampler_settings": {}})
    history = run(config, 30, FINITE, lambda s: s["passes"] / 6 + (s["kernel"] == "none"))
    assert len(history) == 18
    assert max(collections.Counter(repr(s) for s, _ in history).values()) == 1


LEARNING = ["tpe", "annealing", "optuna.samplers:CmaEsSampler"]


@pytest.mark.parametrize("name", LEARNING)
def test_learns(name):
    config = OfflineConfig(sampler=name, batch=8, initial=16, seed=5)
    errors = [error for _, error in run(config, 112)]
    assert np.mean(errors[64:]) < 0.7 * np.mean(errors[1:16])


@pytest.mark.parametrize("name", LEARNING)
def test_begins_with_points_that_spread_evenly_in_ratio(name):
    config = OfflineConfig(sampler=name, batch=64, initial=64, seed=1)
    sets, points = [s for s, _ in run(config, 64)], sobol_points(SPACE, 1, range(1, 64))
    if name == "tpe":
        assert sets[1::2] == points[::2]
        return
    assert sets[1:] == points
    counts, _ = np.histogram(np.log10([s["distance"] for s in sets[1:]]), bins=4, range=(-2, 2))
    assert counts.min() >= 14


def test_ends_when_all_chains_have_stalled():
    settings = {"chains": 2, "stall_accepted": 4}
    config = OfflineConfig(
        sampler="annealing", sampler_settings=settings, batch=4, initial=4, seed=5
    )
    sampler, errors = make_sampler(SPACE, config), {}
    history = run(
        config, 500, error=lambda s: errors.setdefault(repr(s), float(len(errors))), sampler=sampler
    )
    assert len(history) < 500
    assert sampler.end == "all chains have stalled"
    assert make_sampler(SPACE, config).propose(history) is None
    assert make_sampler(SPACE, config).propose(history[:-8]) is not None


RAISING = """
import optuna

class Raising(optuna.samplers.RandomSampler):
    def __init__(self, after):
        super().__init__(0)
        self.after = after

    def {hook}(self, study, *given):
        if len(study.trials) > self.after:
            raise ValueError("no more")
        return super().{hook}(study, *given)
"""


@pytest.mark.parametrize(
    "hook", ["after_trial", "before_trial", "infer_relative_search_space", "sample_independent"]
)
def test_a_sampler_that_raises_is_named(tmp_path, monkeypatch, hook):
    (tmp_path / f"raising_{hook}.py").write_text(RAISING.replace("{hook}", hook))
    monkeypatch.syspath_prepend(tmp_path)

    def config(after):
        given = {"after": after}
        name = f"raising_{hook}:Raising"
        return OfflineConfig(sampler=name, sampler_settings=given, batch=2, initial=2)

    words = rf"offline\.sampler: raising_{hook}:Raising: ValueError: no more \(.*line"
    with pytest.raises(SamplerError, match=words):
        make_sampler(SPACE, config(1))  # before anything is run
    with pytest.raises(SamplerError, match=words):
        run(config(8), 16)


def test_a_sampler_that_cannot_sample_the_parameters_is_refused_at_once():
    config = OfflineConfig(sampler="optuna.samplers:BruteForceSampler", batch=2)
    with pytest.raises(SamplerError, match="step must be given"):
        make_sampler(SPACE, config)
    assert len(run(config, 4, FINITE, lambda _: 1.0)) == 4


@pytest.mark.parametrize("name", ["tpe", "annealing", "optuna.samplers:CmaEsSampler"])
def test_sets_of_a_portfolio_follow_the_baseline_and_count_as_initial(name):
    config = OfflineConfig(sampler=name, batch=4, initial=6, seed=5)
    first = [{**SPACE.baseline, "passes": n} for n in (5, 7)]
    sampler, sets, sources = make_sampler(SPACE, config, first), [], []
    for n in range(12):
        history = [(s, bowl(s)) for s in sets[: max(0, n - 3)]]
        found = sampler.propose(history, sets[len(history) :])
        sets.append(found.parameters)
        sources.append(found.source)
    assert sets[:3] == [SPACE.baseline, *first]
    assert sources[:6] == ["baseline", "portfolio", "portfolio", "sobol", "sobol", "sobol"]
    assert set(sources[6:]) == {name}
    many = [{**SPACE.baseline, "rings": n} for n in range(1, 9)]
    sampler = make_sampler(SPACE, config, many)
    history = [(s, bowl(s)) for s in [SPACE.baseline, *many[:7]]]
    assert sampler.propose(history) == (many[7], "portfolio")
