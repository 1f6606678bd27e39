"""Finished trials as columns, and which parameters matter."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive, Summary
from adaptune.space import ODOMETRY, ParameterSet, ParameterSpace
from offline.config import OfflineConfig, OfflineStudy, distribution
from offline.objective import judge, label, weighted


class TriedSet(NamedTuple):
    """A parameter set, and how it did in its trials."""

    number: int
    parameters: ParameterSet
    by_sequence: Mapping[str, float]  # the objective on the sequences on which it was run
    value: float  # its mean over all training sequences, NaN if not run on all
    usable: bool  # whether it may be chosen
    cost: float  # milliseconds of CPU time a scan, NaN if unknown


@dataclass(frozen=True, eq=False)
class TrialTable:
    """Trials, in the order of their numbers."""

    space: ParameterSpace
    names: Sequence[str]  # of the training sequences
    trials: Sequence[TriedSet]
    objective: str = "RTE [%]"  # name of the objective, with its unit
    fixed: int | None = None  # trial number of the fixed set, once it is chosen

    def __len__(self) -> int:
        return len(self.trials)

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """Their numbers, of shape (n,)."""
        return np.array([trial.number for trial in self.trials], int)

    @cached_property
    def values(self) -> NDArray[np.float64]:
        """See `TriedSet`, of shape (n,)."""
        return np.array([trial.value for trial in self.trials])

    def on(self, name: str) -> NDArray[np.float64]:
        """The objective on a sequence, of shape (n,); NaN where a trial was not run."""
        return np.array([trial.by_sequence.get(name, np.nan) for trial in self.trials])

    def column(self, name: str) -> list[Any]:
        """Values of one of `space.parameters`; None where a set has none."""
        return [self.space.flat(trial.parameters).get(name) for trial in self.trials]

    def some(self, kept: Iterable[bool | np.bool_]) -> "TrialTable":
        """The same of some of the trials."""
        few = [trial for trial, its in zip(self.trials, kept, strict=True) if its]
        return replace(self, trials=few)

    def odometries(self) -> dict[str, "TrialTable"]:
        """By the name of an odometry its trials; of the only one by no name."""
        names = [str(trial.parameters.get(ODOMETRY, "")) for trial in self.trials]
        return {name: self.some(own == name for own in names) for name in dict.fromkeys(names)}


def read_trials(study: OfflineStudy) -> TrialTable:
    """Read the finished trials of a study on its training sequences; there may be none."""
    archive = Archive(study.folder / "trials")
    finished = {name: archive.finished(name) for name in study.training}
    return trial_table(study.config.offline, study.odometry.space, finished, study.fixed)


def trial_table(
    config: OfflineConfig,
    space: ParameterSpace,
    finished: Mapping[str, Mapping[int, Summary]],
    fixed: ParameterSet | None = None,
) -> TrialTable:
    """Finished trials as columns: by training sequence, `finished` has them by their numbers.

    Of `config`, the objective counts; `fixed` is the fixed set, once chosen.
    """
    objective, trials = config.objective, []
    for number in sorted({number for of_sequence in finished.values() for number in of_sequence}):
        runs = {name: of[number] for name, of in finished.items() if number in of}
        verdict = judge(config, list(runs.values()))
        by_sequence = {name: weighted(objective, run.metrics) for name, run in runs.items()}
        value = verdict.value if len(runs) == len(finished) else np.nan
        cost = float(np.mean([run.cost for run in runs.values()]))
        about = (number, verdict.parameters, by_sequence, value, not verdict.failure, cost)
        trials.append(TriedSet(*about))
    named = "RTE [%]" if objective == {"rte": 1.0} else label(objective, units=True)
    chosen = next((trial.number for trial in trials if trial.parameters == fixed), None)
    return TrialTable(space, list(finished), trials, named, chosen)


FEW = 8
"""With fewer trials, importances mean nothing."""


def importances(table: TrialTable) -> dict[str, float]:
    """Share of each parameter in the variance of the error's logarithm, by falling share.

    It is functional ANOVA, Optuna's default, on a small forest: Optuna's own takes minutes for some
    thousand trials, and gives the same shares. The trials are of one odometry. There is none with
    fewer than `FEW` finished trials, one parameter, or equal errors.
    """
    known = table.some(np.isfinite(table.values) & (table.values > 0.0))
    columns = {name: known.column(name) for name in table.space.parameters}
    columns = {
        name: values
        for name, values in columns.items()
        if None not in values and len(set(map(repr, values))) > 1
    }
    logs = np.log(known.values)
    if len(known) < FEW or len(columns) < 2 or np.ptp(logs) < 1e-9:
        return {}
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    distributions = {name: distribution(table.space.parameters[name]) for name in columns}
    study = optuna.create_study()
    study.add_trials(
        optuna.trial.create_trial(
            params={name: column[i] for name, column in columns.items()},
            distributions=distributions,
            value=float(log),
        )
        for i, log in enumerate(logs)
    )
    # The size of the forest bounds the time that it takes.
    evaluator = optuna.importance.FanovaImportanceEvaluator(n_trees=16, max_depth=8, seed=0)
    shares = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {name: float(share) for name, share in shares.items()}
