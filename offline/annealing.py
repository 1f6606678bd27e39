"""Simulated annealing, as a sampler for any Optuna study.

After F. C. Tavares, *Automated Parameter Tuning for Evaluation of SLAM Methods*, University of
Coimbra, 2026 (RUSTLE), and Kirkpatrick, Gelatt and Vecchi, *Optimization by Simulated Annealing*,
Science, 1983. It differs from RUSTLE: steps beyond a bound are reflected instead of cut off, errors
are divided by `energy_scale`, and there are log scales, categories and several chains.
"""

import math
from collections.abc import Mapping
from operator import itemgetter
from typing import Any

import numpy as np
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.samplers import BaseSampler, RandomSampler
from optuna.search_space import IntersectionSearchSpace
from optuna.study import Study, StudyDirection
from optuna.trial import FrozenTrial, TrialState

from offline.config import AnnealingSettings, Step

SIGMA = 0.05
"""Standard deviation of a step, as a share of the range."""
DELTA_MAX = 0.5
"""Longest step of a whole number at temperature 1, as a share of the range."""
CHANGE = 0.3
"""Probability that a category changes."""


class Chain:
    """One chain of annealing."""

    def __init__(self, settings: AnnealingSettings):
        self.settings = settings
        self.params: dict[str, Any] | None = None  # it steps from; None before its first trial
        self.energy = self.best = math.inf  # error of that set, and the least error so far
        self.temperature = settings.initial_temperature
        self._n_steps = 0
        # Numbers of the steps with the last acceptance, the last new best, and the last heating.
        self._accepted = self._new_best = self._heated = 0

    def start(self, params: Mapping[str, Any], energy: float) -> None:
        """Begin with a trial."""
        self.params, self.energy, self.best = dict(params), energy, energy

    def step(self, params: Mapping[str, Any], energy: float, scale: float, u: float) -> None:
        """Accept or reject a trial, and cool down or heat up.

        Differences of energy are divided by `scale`; `u` is drawn uniformly from [0, 1).
        """
        if self.params is None:
            self.start(params, energy)
            return
        self._n_steps += 1
        if energy < self.best:
            self.best, self._new_best = energy, self._n_steps
        worse = energy - self.energy
        if energy <= self.energy or u < math.exp(-worse / scale / self.temperature):
            self.params, self.energy, self._accepted = dict(params), energy, self._n_steps
        s, heated = self.settings, self._heated
        if (
            self._since(heated, s.reanneal_fixed)
            or self._since(max(heated, self._accepted), s.reanneal_accepted)
            or self._since(max(heated, self._new_best), s.reanneal_best)
        ):
            self.temperature, self._heated = s.initial_temperature, self._n_steps
        else:
            self.temperature *= s.alpha

    def _since(self, step: int, limit: int | None) -> bool:
        return limit is not None and self._n_steps - step >= limit

    @property
    def stalled(self) -> bool:
        """Whether it has made enough steps without an acceptance or a new best."""
        accepted, best = self.settings.stall_accepted, self.settings.stall_best
        return self._since(self._accepted, accepted) or self._since(self._new_best, best)


class AnnealingSampler(BaseSampler):
    """Sampler using simulated annealing.

    The first `n_startup_trials` are random unless enqueued; the chains begin with the best of them.
    The state follows from the finished trials, and every trial has random numbers of its own: a
    loaded study continues exactly as if it had never stopped. Trials that run at the same time step
    from their chain's set at their beginning.

    Parameters
    ----------
    settings
        Temperatures, triggers and steps.
    n_startup_trials
        Trials before the chains begin.
    seed
        Seed of all random numbers.
    """

    def __init__(
        self,
        settings: AnnealingSettings | None = None,
        *,
        n_startup_trials: int = 1,
        seed: int = 0,
    ):
        self.settings = settings or AnnealingSettings()
        self.n_startup_trials = n_startup_trials
        self.seed = seed
        self._space = IntersectionSearchSpace()

    def infer_relative_search_space(
        self,
        study: Study,
        trial: FrozenTrial,  # noqa: ARG002
    ) -> dict[str, BaseDistribution]:
        """Return the parameters that all finished trials have."""
        space: dict[str, BaseDistribution] = self._space.calculate(study)
        return space

    def sample_relative(
        self, study: Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Step from the set of the trial's chain."""
        self._raise_error_if_multi_objective(study)
        if not search_space or trial.number < self.n_startup_trials:
            return {}
        chain = self.chains(study)[trial.number % self.settings.chains]
        if chain.params is None:
            return {}
        rng = self._rng(trial.number)
        rng.random()  # the acceptance uses it
        return {
            name: step_from(
                chain.params[name],
                distribution,
                self.settings.steps.get(name, Step()),
                chain.temperature,
                rng,
            )
            for name, distribution in search_space.items()
        }

    def sample_independent(
        self,
        study: Study,
        trial: FrozenTrial,
        param_name: str,
        param_distribution: BaseDistribution,
    ) -> Any:
        """Draw uniformly."""
        self._raise_error_if_multi_objective(study)
        word = np.random.SeedSequence((self.seed, trial.number, *param_name.encode()))
        sampler = RandomSampler(seed=int(word.generate_state(1)[0]))
        return sampler.sample_independent(study, trial, param_name, param_distribution)

    def stalled(self, study: Study) -> bool:
        """Whether all chains have stalled."""
        return all(chain.stalled for chain in self.chains(study))

    def chains(self, study: Study) -> list[Chain]:
        """The chains after the study's finished trials."""
        sign = -1.0 if study.direction == StudyDirection.MAXIMIZE else 1.0
        finished = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        trials = [
            (t.number, t.params, sign * (t.value or 0.0))
            for t in sorted(finished, key=lambda t: t.number)
        ]
        startup = [trial for trial in trials if trial[0] < self.n_startup_trials]
        chains = [Chain(self.settings) for _ in range(self.settings.chains)]
        best, given = sorted(startup, key=itemgetter(2))[: len(chains)], self.settings.start
        for k, chain in enumerate(chains):
            if best:
                _, params, energy = best[k % len(best)]
                # The error at a given start is unknown: the first step from it is accepted.
                chain.start(params | (given or {}), energy if given is None else math.inf)
        scale = self.settings.energy_scale or next(
            (abs(energy) for *_, energy in trials if energy and math.isfinite(energy)), 1.0
        )
        for number, params, energy in trials[len(startup) :]:
            u = self._rng(number).random()
            chains[number % len(chains)].step(params, energy, scale, u)
        return chains

    def _rng(self, number: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, number))


def step_from(
    value: Any,
    distribution: BaseDistribution,
    step: Step,
    temperature: float,
    rng: np.random.Generator,
) -> Any:
    """Draw a neighbour of a parameter's value."""
    if isinstance(distribution, CategoricalDistribution):
        others = [c for c in distribution.choices if type(c) is not type(value) or c != value]
        if not others or rng.random() >= (CHANGE if step.change is None else step.change):
            return value
        return others[rng.integers(len(others))]
    assert isinstance(distribution, FloatDistribution | IntDistribution)
    low = distribution.low if step.low is None else max(step.low, distribution.low)
    high = distribution.high if step.high is None else min(step.high, distribution.high)
    if low == high:
        return low
    value = min(max(value, low), high)
    if distribution.step is not None and not distribution.log:
        # Counted in steps of the distribution.
        n = round((high - low) / distribution.step)
        delta_max = math.ceil(DELTA_MAX * n) if step.delta_max is None else step.delta_max
        longest = math.ceil(temperature * delta_max)
        i = round((value - low) / distribution.step) + int(rng.integers(-longest, longest + 1))
        made = low + reflected(i, n) * distribution.step
        return int(made) if isinstance(distribution, IntDistribution) else min(made, high)
    first, last, x = low, high, value
    if distribution.log:
        low, high, x = map(math.log, (low, high, value))
    sigma = SIGMA * (high - low) if step.sigma is None else step.sigma
    x += rng.normal(step.mu or 0.0, sigma)
    x = low + reflected(x - low, high - low)
    made = math.exp(x) if distribution.log else x
    if isinstance(distribution, IntDistribution):
        made = round(made)
        if made == value:  # a step of less than one whole number is one
            up = value == first or (x > math.log(value) and value < last)
            made += 1 if up else -1
        return int(made)
    return min(max(made, first), last)


def reflected(x: Any, length: Any) -> Any:
    """Reflect `x` at 0 and `length` until it lies between them."""
    x %= 2 * length
    return 2 * length - x if x > length else x
