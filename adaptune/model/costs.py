"""What parameter sets cost: CPU time a scan, alone and together."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np

ROUNDING = 1e-9
"""By how much a sum of costs may exceed a budget."""


class SetCost(NamedTuple):
    """Milliseconds of CPU time a scan."""

    register: float
    prepare: float
    preparation: int  # sets with the same number share prepared scans

    @property
    def alone(self) -> float:
        """Of one instance."""
        return self.register + self.prepare


@dataclass(frozen=True)
class Costs:
    """What sets cost, as it was measured in the trials.

    Attributes
    ----------
    sets : dict
        By trial number, its `SetCost`.
    evidence : float
        Milliseconds of CPU time a scan that live evidence takes.
    """

    sets: Mapping[int, SetCost]
    evidence: float

    def __contains__(self, trial: object) -> bool:
        return trial in self.sets

    def alone(self, trial: int) -> float:
        """Milliseconds of CPU time a scan of one instance, no live evidence; NaN if unknown."""
        return self.sets[trial].alone if trial in self.sets else np.nan

    def adaptive(self, trials: Iterable[int]) -> float:
        """Milliseconds of CPU time a scan of several instances together, with live evidence.

        Instances with the same preparation share prepared scans.
        """
        known = [self.sets.get(trial, SetCost(np.nan, np.nan, -1)) for trial in trials]
        prepare: dict[int, float] = {}
        for one in known:
            prepare[one.preparation] = max(one.prepare, prepare.get(one.preparation, 0.0))
        return sum(one.register for one in known) + sum(prepare.values()) + self.evidence

    def dump(self) -> dict[str, Any]:
        """Plain data, for files."""
        return {
            "evidence": self.evidence,
            "sets": [[trial, *cost] for trial, cost in self.sets.items()],
        }

    @classmethod
    def load(cls, data: Mapping[str, Any]) -> Self:
        """Read what `dump` returned; a ValueError, TypeError or KeyError if it is no such thing."""
        sets = {
            int(trial): SetCost(float(register), float(prepare), int(preparation))
            for trial, register, prepare, preparation in data["sets"]
        }
        return cls(sets, float(data["evidence"]))


class Spending(NamedTuple):
    """How a bank may spend a budget.

    Attributes
    ----------
    costs : Costs
    budget : float
        Milliseconds of CPU time a scan, all members and live evidence together.
    thrifty : bool
        Whether the next member is the one that lowers the error most for its cost.
    """

    costs: Costs
    budget: float = np.inf
    thrifty: bool = False

    def allows(self, members: Sequence[int]) -> bool:
        """Whether a bank of these trials stays within the budget; of unknown cost, none does."""
        return self.costs.adaptive(members) <= self.budget + ROUNDING

    def price(self, members: Sequence[int], more: int) -> float:
        """What another member adds to the cost of a bank, one microsecond at least."""
        together = self.costs.adaptive([*members, more]) - self.costs.adaptive(members)
        return max(together, 1e-3)
