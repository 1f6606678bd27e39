"""What all samplers share: batches, and no set twice."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from adaptune.space import ParameterSet, ParameterSpace
from offline.config import OfflineConfig
from offline.objective import SamplerResult, penalised
from offline.samplers.grid import Grid

_ENUMERABLE = 4096
_DRAWS = 1000


class Sampler(ABC):
    """Proposes trials in batches.

    Proposals depend on the seed and on the results of the batches before, and on nothing else: not
    on the number of trials, nor on who runs them. Trial 0 is the baseline, and no set is proposed
    twice. Samplers without constraints receive bad values for sets that break limits.
    """

    constrained = False
    """Whether the sampler takes constraints."""
    end = "there is nothing else to try"
    """Why the search ends when the sampler proposes fewer sets than a batch."""

    def __init__(self, space: ParameterSpace, config: OfflineConfig):
        self.space = space
        self.config = config

    def propose(self, history: Sequence[tuple[Any, ...]]) -> list[ParameterSet]:
        """Propose the parameter sets of the next batch.

        Parameters
        ----------
        history
            Results of all trials of the batches before, in their order: `SamplerResult`, or tuples
            of its first values.

        Returns
        -------
        list of dict
            ``config.batch`` parameter sets; fewer where nothing is left to try, which ends the
            search.
        """
        first = len(history)
        if first % self.config.batch:
            raise ValueError(f"batches have {self.config.batch} trials; {first} is not a multiple")
        results = [SamplerResult(*result) for result in history]
        if not self.constrained:
            results = penalised(results)
        return self._propose(range(first, first + self.config.batch), results)

    @abstractmethod
    def _propose(self, numbers: range, history: Sequence[SamplerResult]) -> list[ParameterSet]: ...


class Tried:
    """Parameter sets that were proposed before."""

    def __init__(self, sets: Iterable[ParameterSet] = ()):
        self._keys = set(map(key, sets))

    def add(self, parameters: ParameterSet) -> None:
        """Add a set."""
        self._keys.add(key(parameters))

    def __contains__(self, parameters: ParameterSet) -> bool:
        return key(parameters) in self._keys

    def another(self, space: ParameterSpace, rng: np.random.Generator) -> ParameterSet | None:
        """Draw a set that was not proposed before; None if none is left."""
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
    """Text that identifies a set: True is not 1."""
    return repr(sorted(parameters.items()))
