"""What all samplers have in common: batches, and no set twice."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from adaptune.sampling import Grid
from adaptune.space import ParameterSet, ParameterSpace
from adaptune.study import OfflineConfig
from offline.objective import Result, penalised

_ENUMERABLE = 4096
_DRAWS = 1000


class Sampler(ABC):
    """Proposes trials in batches.

    What is proposed depends on the seed and on the results of the batches before, and on nothing
    else: not on how many trials there will be, nor on who runs them. Trial 0 is the baseline, and
    no set is proposed twice. Those that know nothing of constraints are told of broken limits as of
    bad values.

    Parameters
    ----------
    space
        The parameters.
    config
        Seed, sizes and settings.
    """

    constrained = False
    """Whether it knows of constraints."""
    end = "there is nothing else to try"
    """Why it proposes fewer sets than it is asked for."""

    def __init__(self, space: ParameterSpace, config: OfflineConfig):
        self.space = space
        self.config = config

    def propose(self, history: Sequence[tuple[Any, ...]]) -> list[ParameterSet]:
        """Propose the parameter sets of the next batch.

        Parameters
        ----------
        history
            Results of all trials of the batches before, in their order: `Result`, or tuples of its
            first values.

        Returns
        -------
        list of dict
            ``config.batch`` parameter sets; fewer where nothing else is left to try, which is the
            end of the search.
        """
        first = len(history)
        if first % self.config.batch:
            raise ValueError(f"batches have {self.config.batch} trials; {first} are no whole ones")
        results = [Result(*result) for result in history]
        if not self.constrained:
            results = penalised(results)
        return self._propose(range(first, first + self.config.batch), results)

    @abstractmethod
    def _propose(self, numbers: range, history: Sequence[Result]) -> list[ParameterSet]: ...


class Tried:
    """Parameter sets that were proposed before.

    Parameters
    ----------
    sets
        The first of them.
    """

    def __init__(self, sets: Iterable[ParameterSet] = ()):
        self._keys = set(map(key, sets))

    def add(self, parameters: ParameterSet) -> None:
        """Count one more."""
        self._keys.add(key(parameters))

    def __contains__(self, parameters: ParameterSet) -> bool:
        return key(parameters) in self._keys

    def another(self, space: ParameterSpace, rng: np.random.Generator) -> ParameterSet | None:
        """Draw a set that is not among them; none if there is none."""
        everything = Grid.of(space)
        if everything is not None and everything.size <= _ENUMERABLE:
            left = [s for s in map(everything.__getitem__, range(everything.size)) if s not in self]
            return left[rng.integers(len(left))] if left else None
        for _ in range(_DRAWS):
            (drawn,) = space.from_unit(rng.random((1, len(space))))
            if drawn not in self:
                return drawn
        return None


def key(parameters: ParameterSet) -> str:
    """Text that equal sets share, and no others: True is not 1."""
    return repr(sorted(parameters.items()))
