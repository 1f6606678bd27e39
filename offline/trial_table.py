"""The finished trials of a study as columns, for charts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import yaml
from adaptune.archive import OF_SLOT, Archive, Summary
from adaptune.pooled_space import ODOMETRY
from adaptune.space import ParameterSet, ParameterSpace
from adaptune.study.study import Study
from offline.config import OfflineConfig
from offline.objective import judge, label, weighted
from offline.offline_study import OfflineStudy


@dataclass(frozen=True, eq=False)
class TrialTable:
    """Trials, in the order of their numbers."""

    space: ParameterSpace
    numbers: NDArray[np.int64]  # (n,)
    sets: Sequence[ParameterSet]
    # By training sequence (n,): the first objective, NaN where a trial was not run.
    by_sequence: Mapping[str, NDArray[np.float64]]
    values: NDArray[np.float64]  # (n,): its mean over all sequences, NaN if not run on all
    feasible: NDArray[np.bool_]  # (n,): whether the trial keeps all limits
    costs: NDArray[np.float64]  # (n,): milliseconds of CPU time a scan, NaN if unknown
    objective: str = "RTE [%]"  # name of the first objective, with its unit
    fixed: int | None = None  # trial number of the fixed set, once it is chosen

    def __len__(self) -> int:
        return len(self.numbers)

    def column(self, name: str) -> list[Any]:
        """Values of one of `space.parameters`; None where a set has none."""
        return [self.space.flat(of_set).get(name) for of_set in self.sets]

    def on(self, sequence: str) -> NDArray[np.float64]:
        """First objective on a sequence, of shape (n,)."""
        return self.by_sequence[sequence]

    def some(self, kept: NDArray[np.bool_]) -> "TrialTable":
        """The same of some of the trials."""
        return replace(
            self,
            numbers=self.numbers[kept],
            sets=[own for own, its in zip(self.sets, kept, strict=True) if its],
            by_sequence={name: of[kept] for name, of in self.by_sequence.items()},
            values=self.values[kept],
            feasible=self.feasible[kept],
            costs=self.costs[kept],
        )

    def shared(self) -> "TrialTable":
        """The same of the trials whose sets all sequences share."""
        return self.some(self.numbers < OF_SLOT)

    def odometries(self) -> dict[str, "TrialTable"]:
        """By the name of an odometry its trials; of the only one by no name."""
        names = [str(of_set.get(ODOMETRY, "")) for of_set in self.sets]
        return {name: self.some(np.array(names) == name) for name in dict.fromkeys(names)}


def read_trials(study: OfflineStudy) -> TrialTable:
    """Read the finished trials of a study on its training sequences; there may be none."""
    archive = Archive(study.folder / "trials")
    finished = {name: archive.finished(name) for name in study.training}
    return trial_table(study.config.offline, study.odometry.space, finished, fixed_set(study))


def trial_table(
    config: OfflineConfig,
    space: ParameterSpace,
    finished: Mapping[str, Mapping[int, Summary]],
    fixed: ParameterSet | None = None,
) -> TrialTable:
    """Finished trials as columns.

    Parameters
    ----------
    config
        Its first objective and its limits count.
    space
        The parameters.
    finished
        By training sequence the finished trials by their numbers.
    fixed
        The fixed set, if it is chosen.
    """
    numbers = sorted({number for trials in finished.values() for number in trials})
    n, objective = len(numbers), config.objective[0]
    values, costs, feasible = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, bool)
    by_sequence = {name: np.full(n, np.nan) for name in finished}
    sets: list[ParameterSet] = []
    for i, number in enumerate(numbers):
        runs = {name: trials[number] for name, trials in finished.items() if number in trials}
        verdict = judge(config, list(runs.values()))
        sets.append(verdict.parameters)
        costs[i] = np.mean([run.cost for run in runs.values()])
        feasible[i] = verdict.feasible
        for name, run in runs.items():
            by_sequence[name][i] = weighted(objective, run.metrics)
        if len(runs) == len(finished):
            values[i] = verdict.values[0]
    named = "RTE [%]" if objective == {"rte": 1.0} else label(objective, units=True)
    chosen = next((k for k, own in zip(numbers, sets, strict=True) if own == fixed), None)
    return TrialTable(
        space, np.array(numbers, int), sets, by_sequence, values, feasible, costs, named, chosen
    )


def fixed_set(study: Study) -> ParameterSet | None:
    """The fixed set that the offline stage has chosen; None before."""
    path = study.folder / "fixed.yaml"
    return yaml.Document.of_file(path).data if path.exists() else None
