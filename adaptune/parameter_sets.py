"""The parameter sets of a study: the one table that numbers them."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adaptune.space import ParameterSet, ParameterSpace, Value


@dataclass(frozen=True, eq=False)
class ParameterSets:
    """Parameter sets by the numbers of their trials.

    A set is known by its trial's number everywhere. Arrays with one column for each set have their
    columns in the order of this table; `columns` finds them.

    Attributes
    ----------
    space : ParameterSpace
    trials : tuple of int
        Numbers of the trials, each of them once.
    parameters : tuple of dict
        The sets, in the same order.
    """

    space: ParameterSpace
    trials: tuple[int, ...]
    parameters: tuple[ParameterSet, ...]

    def __post_init__(self) -> None:
        if not len(set(self.trials)) == len(self.trials) == len(self.parameters):
            raise ValueError("each parameter set needs a trial number of its own")

    def __len__(self) -> int:
        return len(self.trials)

    def __iter__(self) -> Iterator[int]:
        return iter(self.trials)

    def __contains__(self, trial: object) -> bool:
        return trial in self._columns

    def __getitem__(self, trial: int) -> ParameterSet:
        return self.parameters[self._columns[trial]]

    @cached_property
    def _columns(self) -> dict[int, int]:
        return {trial: column for column, trial in enumerate(self.trials)}

    @cached_property
    def unit(self) -> NDArray[np.float64]:
        """The sets in the unit cube, of shape (n_sets, n_parameters)."""
        return self.space.to_unit(self.parameters)

    def column(self, trial: int) -> int:
        """Column of a set in arrays that go with this table."""
        return self._columns[trial]

    def columns(self, trials: Iterable[int]) -> NDArray[np.intp]:
        """Columns of several sets."""
        return np.array([self._columns[trial] for trial in trials], np.intp)

    @property
    def defaults(self) -> list[int]:
        """Trial numbers of the sets that are the baseline of an odometry."""
        return [trial for trial in self.trials if self[trial] in self.space.baselines]

    def find(self, parameters: ParameterSet) -> int | None:
        """Trial number of the first set with these values, the others at their baseline."""
        whole = self.space.complete(parameters)
        return next((t for t in self.trials if self[t] == whole), None)

    def subset(self, trials: Sequence[int]) -> "ParameterSets":
        """A table of some of the sets."""
        return ParameterSets(self.space, tuple(trials), tuple(self[trial] for trial in trials))


def in_words(parameters: Mapping[str, Value]) -> str:
    """A set in a few words, with three digits of each number."""
    return ", ".join(
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in parameters.items()
    )
