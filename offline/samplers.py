"""Where the next parameter sets come from."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import optuna
from scipy.stats import qmc

from adaptune.space import Categorical, Float, Integer, ParameterSet, ParameterSpace
from adaptune.study import OfflineConfig
from offline.objective import Value

optuna.logging.set_verbosity(optuna.logging.WARNING)


def propose(
    space: ParameterSpace,
    config: OfflineConfig,
    batch: int,
    history: Sequence[tuple[ParameterSet, Value]],
) -> list[ParameterSet]:
    """Propose the parameter sets of one batch of trials.

    They depend on the seed, their numbers and the results of the batches before, and on nothing
    else: not on how many trials there will be, nor on who runs them.

    Parameters
    ----------
    space
        The parameters.
    config
        Sampler, seed, and sizes.
    batch
        Number of the batch, from 0; trial 0 is the baseline.
    history
        Parameters and value, or values where there are several objectives, of all trials of the
        batches before, in their order.

    Returns
    -------
    list of dict
        ``config.batch`` parameter sets.
    """
    first = batch * config.batch
    if len(history) != first:
        raise ValueError(f"batch {batch} follows {first} trials, not {len(history)}")
    numbers = range(first, first + config.batch)
    if config.sampler == "random":
        drawn = [np.random.default_rng((config.seed, n)).random(len(space)) for n in numbers]
        sets = space.from_unit(np.array(drawn))
    else:
        sets = space.from_unit(_sobol(len(space), config.seed, numbers))
    if batch == 0:
        sets[0] = space.baseline
    if config.sampler == "tpe" and numbers[-1] >= config.initial:
        n_initial = max(0, config.initial - first)
        sets[n_initial:] = _tpe(space, config, batch, history, sets[:n_initial])
    return sets


def _sobol(dimensions: int, seed: int, numbers: range) -> Any:
    """Points `numbers` of a scrambled Sobol sequence, of shape (len(numbers), dimensions)."""
    sobol = qmc.Sobol(dimensions, rng=np.random.default_rng((seed, 0)))
    if numbers.start:
        sobol.fast_forward(numbers.start)
    # Drawn one by one: scipy warns of numbers of points that are not a power of two.
    return np.concatenate([sobol.random(1) for _ in numbers])


def _tpe(
    space: ParameterSpace,
    config: OfflineConfig,
    batch: int,
    history: Sequence[tuple[ParameterSet, Value]],
    pending: Sequence[ParameterSet],
) -> list[ParameterSet]:
    """The rest of a batch that begins with `pending`, by a tree-structured Parzen estimator.

    Optuna is told all earlier batches; what the batch has proposed already counts as running, so
    that it does not propose the same place twice.
    """
    distributions = {name: _distribution(p) for name, p in space.parameters.items()}
    seed = int(np.random.SeedSequence((config.seed, batch)).generate_state(1)[0])
    # The initial points are the start-up: Optuna needs no random ones of its own.
    study = optuna.create_study(
        sampler=optuna.samplers.TPESampler(seed=seed, n_startup_trials=1),
        directions=["minimize"] * len(config.objective),
    )
    study.add_trials(
        optuna.trial.create_trial(
            params=params, distributions=distributions, values=np.atleast_1d(values).tolist()
        )
        for params, values in history
    )
    for params in pending:
        study.enqueue_trial(params)
        study.ask(distributions)
    n_free = config.batch - len(pending)
    return [dict(study.ask(distributions).params) for _ in range(n_free)]


def _distribution(parameter: Float | Integer | Categorical) -> Any:
    if isinstance(parameter, Categorical):
        return optuna.distributions.CategoricalDistribution(parameter.choices)
    if isinstance(parameter, Integer):
        return optuna.distributions.IntDistribution(
            parameter.low, parameter.high, log=parameter.log
        )
    return optuna.distributions.FloatDistribution(parameter.low, parameter.high, log=parameter.log)
