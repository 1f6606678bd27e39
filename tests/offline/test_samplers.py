import numpy as np
import pytest

from adaptune.space import Categorical, Float, Integer, ParameterSpace
from adaptune.study import OfflineConfig
from offline.samplers import propose

SPACE = ParameterSpace(
    {
        "distance": Float(low=0.01, high=100.0, baseline=3.0, log=True),
        "gain": Float(low=-1.0, high=1.0, baseline=0.25),
        "rings": Integer(low=1, high=64, baseline=16, log=True),
        "kernel": Categorical(choices=("cauchy", "huber", "none"), baseline="huber"),
    }
)


def bowl(parameters):
    return (
        abs(np.log10(parameters["distance"])) + abs(parameters["gain"]) + parameters["rings"] / 64
    )


def run(config, n_batches):
    history = []
    for batch in range(n_batches):
        sets = propose(SPACE, config, batch, history)
        assert len(sets) == config.batch
        history += [(s, bowl(s)) for s in sets]
    return history


@pytest.fixture(params=["random", "sobol", "tpe"])
def config(request):
    return OfflineConfig(sampler=request.param, batch=8, initial=12, seed=5)


def test_sets_are_of_the_space(config):
    for parameters, _ in run(config, 4):
        SPACE.check(parameters)


def test_trial_0_is_the_baseline(config):
    assert run(config, 1)[0][0] == SPACE.baseline


def test_sets_differ(config):
    sets = [tuple(s.values()) for s, _ in run(config, 6)]
    assert len(set(sets)) == len(sets)


def test_same_seed_and_results_give_the_same_sets(config):
    assert run(config, 4) == run(config, 4)
    other = config.model_copy(update={"seed": 6})
    assert run(config, 2)[1:] != run(other, 2)[1:]


def test_a_batch_depends_on_earlier_results_only(config):
    history = run(config, 3)
    again = propose(SPACE, config, 2, history[:16])
    assert again == [s for s, _ in history[16:]]


def test_refuses_a_history_that_is_not_all_before(config):
    with pytest.raises(ValueError, match="batch 2 follows 16 trials, not 15"):
        propose(SPACE, config, 2, run(config, 2)[:15])


def test_tpe_begins_with_the_sobol_points_and_learns():
    tpe = OfflineConfig(sampler="tpe", batch=8, initial=12, seed=5)
    sobol = OfflineConfig(sampler="sobol", batch=8, initial=12, seed=5)
    a, b = run(tpe, 8), run(sobol, 8)
    assert a[:12] == b[:12]
    assert a[12:] != b[12:]
    # Both halves have 32 trials: the later one of TPE is the better for what it was told.
    assert np.mean([v for _, v in a[32:]]) < 0.7 * np.mean([v for _, v in b[32:]])


def test_tpe_heeds_the_results():
    config = OfflineConfig(sampler="tpe", batch=8, initial=8, seed=5)
    sets = propose(SPACE, config, 0, [])
    up = propose(SPACE, config, 1, [(s, s["gain"]) for s in sets])
    down = propose(SPACE, config, 1, [(s, -s["gain"]) for s in sets])
    assert np.mean([s["gain"] for s in up]) < np.mean([s["gain"] for s in down])


def test_sobol_spreads_evenly_in_ratio():
    config = OfflineConfig(sampler="sobol", batch=64, seed=1)
    distances = [s["distance"] for s, _ in run(config, 1)[1:]]
    counts, _ = np.histogram(np.log10(distances), bins=4, range=(-2, 2))
    assert counts.min() >= 14
