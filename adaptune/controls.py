"""Controls: selectors that look at nothing, and that adapting has to beat."""

import zlib
from collections.abc import Sequence

import numpy as np

from adaptune.model.bank_weights import weighted_selection
from adaptune.odometry.base import Motions
from adaptune.parameter_sets import ParameterSets
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan

SEED = 0
"""Of random choices, together with the sequence's name and the number of the repeat."""


class _Control:
    """It has the methods of `adaptune.selector.Selector`, and neither sees nor measures."""

    def reset(self) -> None:
        """Forget all selections, as before a new recording."""

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """See a scan; nothing depends on it."""

    def measure(self) -> None:
        """Measure nothing."""


class EvenSelector(_Control):
    """Gives all members of a bank the same weight, always.

    Parameters
    ----------
    sets
        The parameter sets.
    members
        Trial numbers of the bank's members.
    """

    def __init__(self, sets: ParameterSets, members: Sequence[int]):
        even = dict.fromkeys(members, 1.0 / len(members))
        self._selection = weighted_selection(sets, even)

    def select(self) -> Selection:
        """Even weights."""
        return self._selection

    def fall_back(self) -> Selection:
        """Even weights, too."""
        return self._selection


class RandomSelector(_Control):
    """Chooses a random set among a few, at every selection.

    Parameters
    ----------
    sets
        The parameter sets.
    candidates
        Trial numbers of the sets to choose among; all are equally likely.
    fixed
        Trial number of the set to begin with, and to return to where an odometry fails.
    seed
        Of the choices, which are the same with the same seed; see `random_seed`.
    """

    def __init__(
        self, sets: ParameterSets, candidates: Sequence[int], fixed: int, seed: Sequence[int]
    ):
        self._sets, self._candidates, self._fixed = sets, tuple(candidates), fixed
        self._seed = list(seed)
        self.reset()

    def reset(self) -> None:
        """Begin the same choices anew, as before a new recording."""
        self._rng = np.random.default_rng(self._seed)

    def select(self) -> Selection:
        """A random set."""
        trial = self._candidates[int(self._rng.integers(len(self._candidates)))]
        return Selection(trial, self._sets[trial])

    def fall_back(self) -> Selection:
        """The fixed set."""
        return Selection(self._fixed, self._sets[self._fixed])


def random_seed(sequence: str, repeat: int = 1) -> tuple[int, int, int]:
    """The seed of `RandomSelector` on a sequence: the same on every machine."""
    return SEED, zlib.crc32(sequence.encode()), repeat
