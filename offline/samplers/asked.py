"""Optuna's samplers, through its ask-and-tell interface."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import optuna

from adaptune.space import Categorical, Float, Integer, ParameterSet, ParameterSpace
from offline.config import OfflineConfig
from offline.objective import SamplerResult
from offline.samplers.annealing import AnnealingSampler
from offline.samplers.base import Sampler, Tried, key
from offline.samplers.points import sobol_points
from offline.samplers.settings import (
    FORGETFUL,
    AnnealingSettings,
    SamplerError,
    optuna_sampler,
)
from offline.storage import distribution

optuna.logging.set_verbosity(optuna.logging.WARNING)

CONSTRAINED = (
    optuna.samplers.TPESampler,
    optuna.samplers.GPSampler,
    optuna.samplers.NSGAIISampler,
    optuna.samplers.NSGAIIISampler,
)
"""Samplers that take constraints."""
_ATTEMPTS = 32
_ROUNDED = 1e-6
"""By how much a proposal may exceed its range."""


class AskedSampler(Sampler):
    """Begins with points of a Sobol sequence, and then asks an Optuna sampler.

    Many Optuna samplers keep notes on the trials that they proposed: a generation, a population,
    the state of their random numbers. A resumed search therefore asks again for the earlier
    proposals, and answers from the history. Samplers without notes receive the history instead,
    and begin every batch with a seed of its own; so do those that no longer propose what they did,
    because sequences were added or removed, or another version is installed. Nothing is kept on
    disk.

    If the sampler proposes a set that was tried before, it receives the known value at once and is
    asked again. After many attempts, a random set is taken.
    """

    def __init__(self, space: ParameterSpace, config: OfflineConfig):
        super().__init__(space, config)
        self._distributions = {name: _distribution(p) for name, p in space.parameters.items()}
        self._forgetful = config.sampler in FORGETFUL
        self._begin(0, ())
        self.constrained = isinstance(self._study.sampler, CONSTRAINED)

    def _begin(self, seed: int, history: Sequence[SamplerResult]) -> None:
        self._study = optuna.create_study(
            sampler=self._sampler(seed), directions=["minimize"] * len(self.config.objective)
        )
        self._study.add_trials(
            optuna.trial.create_trial(
                params=self._encode(result.parameters),
                distributions=self._distributions,
                values=np.atleast_1d(result.value).tolist(),
                constraints=_named(result.constraints),
            )
            for result in history
        )
        self._history = list(history)
        self._known = {key(result.parameters): result for result in history}
        self._waiting: dict[str, tuple[ParameterSet, list[Any]]] = {}

    def _sampler(self, batch: int) -> Any:
        config = self.config
        if config.sampler == "annealing":
            settings = AnnealingSettings.model_validate(config.sampler_settings)
            return AnnealingSampler(settings, n_startup_trials=config.initial, seed=config.seed)
        all_usual: dict[str, dict[str, Any]] = {
            "cmaes": {"n_startup_trials": config.initial, "warn_independent_sampling": False},
            "gp": {"n_startup_trials": 1, "warn_independent_sampling": False},
            "nsga2": {"population_size": max(config.batch, 2)},
            "qmc": {"scramble": True, "warn_independent_sampling": False},
            # The initial points are the start-up; TPE needs no random points of its own.
            "tpe": {"n_startup_trials": 1},
        }
        usual = all_usual.get(config.sampler, {})
        seed = int(np.random.SeedSequence((config.seed, batch)).generate_state(1)[0])
        return optuna_sampler(config.sampler, usual | config.sampler_settings, seed)

    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]:
        if self._history != list(history[: len(self._history)]):
            self._begin(0, ())
        while len(self._history) < numbers.start and not self._forgetful:
            first = len(self._history)
            batch = range(first, first + self.config.batch)
            self._ask(batch)
            self._answer(history[batch.start : batch.stop])
        if self._forgetful:
            self._begin(numbers.start // self.config.batch, history)
        return self._ask(numbers)

    def _ask(self, numbers: range) -> list[ParameterSet]:
        """Sets of the next batch; the same sets until they are answered."""
        if not self._waiting and not self._stalled():
            tried = Tried(result.parameters for result in self._history)
            n_initial = self._n_initial(numbers)
            given = [self.space.baseline] if numbers.start == 0 else []
            given += sobol_points(
                self.space, self.config.seed, range(numbers.start + len(given), n_initial)
            )
            for number in numbers:
                first = given[number - numbers.start] if number < n_initial else None
                if not self._ask_once(number, first, tried):
                    break
        return [parameters for parameters, _ in self._waiting.values()]

    def _stalled(self) -> bool:
        sampler = self._study.sampler
        if isinstance(sampler, AnnealingSampler) and sampler.stalled(self._study):
            self.end = "all chains have stalled"
            return True
        return False

    def reannealed(self, history: Sequence[tuple[Any, ...]]) -> list[int]:
        """Which results of a history were followed by reannealing, see `propose`; by their index.

        There are none where the sampler does not anneal.
        """
        self.propose(history)
        sampler, found = self._study.sampler, []
        heated = sampler.reannealed(self._study) if isinstance(sampler, AnnealingSampler) else []
        # Sets that were proposed twice have several trials here.
        seen: set[str] = set()
        for trial in self._study.get_trials(deepcopy=False):
            seen.add(key(self._decode(trial.params)))
            found += [len(seen) - 1] if trial.number in heated else []
        return found

    def _n_initial(self, numbers: range) -> int:
        n = 1 if self.config.sampler == "qmc" else self.config.initial
        return max(numbers.start, min(numbers.stop, n))

    def _ask_once(self, number: int, given: ParameterSet | None, tried: Tried) -> bool:
        for attempt in range(_ATTEMPTS):
            if attempt == _ATTEMPTS - 1:
                rng = np.random.default_rng((self.config.seed, number, 1))
                given = tried.another(self.space, rng)
                if given is None:
                    return False
            if given is not None:
                self._study.enqueue_trial(self._encode(given))
            trial = self._study.ask(self._distributions)
            parameters, given = given or self._decode(trial.params), None
            name = key(parameters)
            if name in self._known:
                self._tell(trial, self._known[name])
            elif name in self._waiting:
                self._waiting[name][1].append(trial)
            else:
                self._waiting[name] = (parameters, [trial])
                tried.add(parameters)
                return True
        raise AssertionError

    def _answer(self, results: Sequence[SamplerResult]) -> None:
        asked = [parameters for parameters, _ in self._waiting.values()]
        if asked != [result.parameters for result in results]:
            self._forgetful = True
            return
        for (_, trials), result in zip(self._waiting.values(), results, strict=True):
            for trial in trials:
                self._tell(trial, result)
            self._known[key(result.parameters)] = result
        self._history += results
        self._waiting = {}

    def _tell(self, trial: optuna.Trial, result: SamplerResult) -> None:
        for name, by in _named(result.constraints).items():
            trial.set_constraint(name, by)
        self._study.tell(trial, result.value)

    # For Optuna, as for Python, the choices 1 and True are equal: it receives their index.

    def _encode(self, parameters: ParameterSet) -> dict[str, Any]:
        return {
            name: p.index(parameters[name]) if isinstance(p, Categorical) else parameters[name]
            for name, p in self.space.parameters.items()
        }

    def _decode(self, params: dict[str, Any]) -> ParameterSet:
        decoded: ParameterSet = {}
        for name, p in self.space.parameters.items():
            value = params[name]
            if isinstance(p, Categorical):
                decoded[name] = p.choices[value]
                continue
            inside = min(max(value, p.low), p.high)
            if not math.isclose(value, inside, rel_tol=_ROUNDED, abs_tol=_ROUNDED):
                what = f"{self.config.sampler} proposed {value!r} for {name}"
                raise SamplerError(f"{what}, which is not between {p.low:g} and {p.high:g}")
            decoded[name] = float(inside) if isinstance(p, Float) else int(inside)
        return decoded


def _named(constraints: Sequence[float]) -> dict[str, float]:
    return {str(i): by for i, by in enumerate(constraints)}


def _distribution(parameter: Float | Integer | Categorical) -> Any:
    if isinstance(parameter, Categorical):
        return optuna.distributions.CategoricalDistribution(range(len(parameter.choices)))
    return distribution(parameter)
