import math
import warnings

import numpy as np
import optuna
import pytest
from hypothesis import given
from hypothesis import strategies as st
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.testing import pytest_samplers
from scipy import stats

from offline.annealing import AnnealingSampler, Chain, reflected, step_from
from offline.config import AnnealingSettings, Step

SPACE = {
    "x": FloatDistribution(-5.0, 5.0),
    "y": FloatDistribution(0.01, 100.0, log=True),
    "n": IntDistribution(0, 20),
    "m": IntDistribution(1, 1000, log=True),
    "q": FloatDistribution(0.0, 1.0, step=0.25),
    "c": CategoricalDistribution(("red", "green", "blue")),
}


def settings(**given):
    return AnnealingSettings.model_validate(given)


def objective(trial):
    x = trial.suggest_float("x", -5.0, 5.0)
    n = trial.suggest_int("n", 0, 20)
    c = trial.suggest_categorical("c", ("red", "green", "blue"))
    return x**2 + abs(n - 7) + (c != "blue")


# As a sampler of Optuna's.


class TestSampler(
    pytest_samplers.BasicSamplerTestCase,
    pytest_samplers.RelativeSamplerTestCase,
    pytest_samplers.SingleOnlySamplerTestCase,
):
    @pytest.fixture
    def sampler(self):
        return AnnealingSampler


def test_failed_and_infinite_trials_do_no_harm():
    def shaky(trial):
        value = objective(trial)
        if trial.number % 5 == 1:
            raise ArithmeticError
        return math.inf if trial.number % 5 == 2 or trial.number == 0 else value

    study = optuna.create_study(sampler=AnnealingSampler(seed=4))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study.optimize(shaky, n_trials=100, catch=ArithmeticError)
    assert study.best_value < 3.0


# One chain.


def walk(energies, **given):
    """Temperatures after each step of a chain whose trials have these energies."""
    chain = Chain(settings(initial_temperature=1.0, alpha=0.5, **given))
    chain.start({}, 1.0)
    temperatures = []
    for energy in energies:
        chain.step({}, energy, 1.0, 0.999)
        temperatures.append(chain.temperature)
    return chain, temperatures


@pytest.mark.parametrize(
    ("energies", "trigger", "temperatures"),
    [
        ([2.0] * 7, {"reanneal_fixed": 3}, [0.5, 0.25, 1.0, 0.5, 0.25, 1.0, 0.5]),
        ([9.0, 0.9, 9.0, 9.0, 9.0], {"reanneal_accepted": 2}, [0.5, 0.25, 0.125, 1.0, 0.5]),
        # The same energy is accepted, but it is no new best one.
        ([1.0, 0.9, 0.9, 0.9, 0.8], {"reanneal_best": 2}, [0.5, 0.25, 0.125, 1.0, 0.5]),
    ],
)
def test_is_heated_again(energies, trigger, temperatures):
    assert walk(energies, **trigger)[1] == temperatures


def test_stalls():
    assert walk([9.0] * 3, stall_accepted=3)[0].stalled
    assert not walk([9.0, 9.0, 1.0], stall_accepted=3)[0].stalled
    assert walk([1.0] * 3, stall_best=3)[0].stalled
    assert not walk([9.0, 9.0, 0.5], stall_best=3)[0].stalled
    # Heating does not hide it.
    assert walk([9.0] * 4, stall_accepted=4, reanneal_accepted=2)[0].stalled


@pytest.mark.parametrize(("temperature", "scale"), [(1.0, 1.0), (0.1, 4.0), (0.5, 0.2)])
def test_accepts_worse_ones_with_the_probability_of_metropolis(temperature, scale):
    rng = np.random.default_rng(0)
    accepted = 0
    for _ in range(4000):
        chain = Chain(settings(initial_temperature=temperature))
        chain.start({"x": 0}, 1.0)
        chain.step({"x": 1}, 1.2, scale, rng.random())
        accepted += chain.params["x"]
    expected = math.exp(-0.2 / scale / temperature)
    assert stats.binomtest(accepted, 4000, expected).pvalue > 1e-4


def test_energies_are_divided_by_that_of_the_first_trial():
    def spread(scale):
        study = optuna.create_study(
            sampler=AnnealingSampler(settings(energy_scale=scale, initial_temperature=1.0), seed=1)
        )
        study.optimize(lambda t: 1e3 * (1.0 + objective(t)), n_trials=60)
        return [(trial.params, trial.value) for trial in study.trials]

    first = spread(None)
    assert first == spread(first[0][1])
    assert first != spread(1.0)


# One step.


def steps_from(value, distribution, step, temperature=1.0, n=4000):
    rng = np.random.default_rng(0)
    return [step_from(value, distribution, step, temperature, rng) for _ in range(n)]


@pytest.mark.parametrize(("mu", "sigma"), [(0.0, 0.5), (0.3, 0.2), (-0.5, 0.4)])
def test_real_numbers_step_by_a_normal_distribution(mu, sigma):
    xs = np.array(steps_from(0.0, FloatDistribution(-50.0, 50.0), Step(mu=mu, sigma=sigma)))
    assert stats.kstest(xs, "norm", (mu, sigma)).pvalue > 1e-4
    ys = steps_from(1.0, FloatDistribution(1e-9, 1e9, log=True), Step(mu=mu, sigma=sigma))
    assert stats.kstest(np.log(ys), "norm", (mu, sigma)).pvalue > 1e-4


@pytest.mark.parametrize("temperature", [1.0, 0.5, 0.26, 0.01])
def test_whole_numbers_step_as_far_as_the_temperature_lets_them(temperature):
    counts = np.bincount(
        steps_from(50, IntDistribution(0, 100), Step(delta_max=6), temperature), minlength=101
    )
    longest = math.ceil(6 * temperature)
    reached = np.flatnonzero(counts)
    assert (reached[0], reached[-1]) == (50 - longest, 50 + longest)
    assert stats.chisquare(counts[reached]).pvalue > 1e-4


def test_categories_change_as_often_as_they_are_told():
    cs = steps_from("red", SPACE["c"], Step(change=0.4))
    share = {c: cs.count(c) / len(cs) for c in ("red", "green", "blue")}
    assert share == pytest.approx({"red": 0.6, "green": 0.2, "blue": 0.2}, abs=0.04)


@given(
    st.sampled_from(sorted(SPACE)),
    st.integers(0, 1000),
    st.floats(-100.0, 100.0),
    st.floats(0.0, 100.0),
    st.floats(1e-6, 10.0),
)
def test_steps_stay_in_range(name, seed, mu, sigma, temperature):
    distribution, rng = SPACE[name], np.random.default_rng(seed)
    value = optuna.samplers.RandomSampler(seed).sample_independent(
        optuna.create_study(), None, name, distribution
    )
    step = Step() if seed % 2 else Step(mu=mu, sigma=sigma, delta_max=int(sigma), change=0.5)
    made = step_from(value, distribution, step, temperature, rng)
    assert type(made) is type(value)
    assert distribution._contains(distribution.to_internal_repr(made))


@pytest.mark.parametrize(
    ("x", "inside"), [(3.0, 3.0), (11.0, 9.0), (-2.0, 2.0), (25.0, 5.0), (-13.0, 7.0), (20, 0)]
)
def test_reflects_at_both_bounds(x, inside):
    assert reflected(x, 10) == inside


# Bounds and starts of the walk.


def test_the_walk_begins_where_it_is_told_and_keeps_its_bounds():
    given = settings(
        chains=1,
        start={"x": 3.0, "n": 18},
        steps={"x": {"sigma": 2.0, "low": 2.0, "high": 4.0}, "n": {"low": 15}},
    )
    sampler = AnnealingSampler(given, seed=1)
    study = optuna.create_study(sampler=sampler)
    study.enqueue_trial({"x": -5.0, "n": 0, "c": "blue"})  # outside of the bounds, and the best
    study.optimize(lambda t: objective(t) + 1e6 * t.number, n_trials=1)
    (chain,) = sampler.chains(study)
    assert chain.params == {"x": 3.0, "n": 18, "c": "blue"}
    study.optimize(lambda t: objective(t) + 1e6, n_trials=1)
    (chain,) = sampler.chains(study)
    assert chain.params == study.trials[1].params  # however bad it is
    study.optimize(objective, n_trials=60)
    walked = [trial.params for trial in study.trials[1:]]
    assert all(2.0 <= params["x"] <= 4.0 and 15 <= params["n"] <= 20 for params in walked)
    assert len({params["x"] for params in walked}) > 50


@pytest.mark.parametrize("name", ["x", "y", "n", "m", "q"])
def test_a_step_from_outside_the_bounds_leads_inside(name):
    distribution = SPACE[name]
    low, high = {"q": (0.25, 0.75)}.get(name, (2, 5))
    rng = np.random.default_rng(1)
    for value in (distribution.low, distribution.high, low):
        made = step_from(value, distribution, Step(low=low, high=high), 1.0, rng)
        assert low <= made <= high
        assert type(made) is type(distribution.low)
