"""A bank without a model: parameter sets that nobody has tried, and weights for them."""

import numpy as np

from adaptune.live.live_evidence import LiveEvidence
from adaptune.model.bank_weights import among, measured_weights, weighted_selection
from adaptune.odometry.base import Motions
from adaptune.parameter_sets import ParameterSets
from adaptune.pooled_space import ODOMETRY, PooledSpace
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSpace

CANDIDATES = 16
"""Sets that the members of a bank are chosen from; a power of two, as Sobol's points want it."""


def untrained_sets(space: ParameterSpace, n: int = 4) -> ParameterSets:
    """The baseline, and sets around it that are far from each other.

    Of several odometries, the baselines of all come first, then sets of the first one. The
    candidates are points of a scrambled Sobol sequence, moved half-way to the baseline: what
    the odometry's authors chose is the best guess there is. Each next set is the one that is
    farthest from those chosen before.

    Parameters
    ----------
    space
        The parameters.
    n
        How many sets.

    Returns
    -------
    ParameterSets
        Numbered from 0, the baseline; fewer than `n` if the candidates have fewer values.
    """
    chosen = space.baselines[:n]
    if isinstance(space, PooledSpace):
        first = next(iter(space.spaces.items()))
        around = untrained_sets(first[1], n - len(chosen) + 1).parameters[1:]
        chosen += [{ODOMETRY: first[0], **own} for own in around]
    elif len(space):
        from scipy.stats import qmc  # slow to import

        sobol = qmc.Sobol(len(space), rng=np.random.default_rng(0))
        centre = space.to_unit(chosen)
        candidates = space.from_unit(0.5 * (centre + sobol.random(CANDIDATES)))
        # Rounded, so that sets are apart by what they are, not by what they were drawn as.
        unit = space.to_unit(candidates)
        apart = np.linalg.norm(unit - centre, axis=1)
        while len(chosen) < n and apart.max() > 0.0:
            farthest = int(apart.argmax())
            chosen.append(candidates[farthest])
            apart = np.minimum(apart, np.linalg.norm(unit - unit[farthest], axis=1))
    return ParameterSets(space, tuple(range(len(chosen))), tuple(chosen))


class UntrainedSelector:
    """Weighs the members of a bank of which nothing is known in advance.

    It has the methods of `adaptune.selector.Selector`, and needs no model. The baseline has all the
    weight until live evidence confirms other members.

    Parameters
    ----------
    sets
        Of the members, the baseline first; see `untrained_sets`.
    length
        Metres of a sub-trajectory: what the estimated error stands for.

    Attributes
    ----------
    fixed : int
        Number of the set to begin with.
    members : tuple of int
        Numbers of the bank's members.
    """

    def __init__(self, sets: ParameterSets, length: float):
        self.members = sets.trials
        self.fixed = self.members[0]
        self._sets = sets
        self._live = LiveEvidence(self.members, length)

    def reset(self) -> None:
        """Forget all scans and selections, as before a new recording."""
        self._live.reset()

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """See a scan, before it is registered; see `adaptune.selector.Selector.observe`."""
        self._live.observe(stamp, scan, motions)

    def select(self) -> Selection:
        """Choose the weights to apply before the newest scan is registered."""
        weights = measured_weights(len(self.members), self._live.squares())
        weights = among(weights, self._live.present())
        of_members = dict(zip(self.members, weights.tolist(), strict=True))
        return self._live.estimated(weighted_selection(self._sets, of_members))

    def fall_back(self) -> Selection:
        """See `adaptune.selector.Selector.fall_back`."""
        weights = {member: float(member == self.fixed) for member in self.members}
        return Selection(self.fixed, self._sets[self.fixed], weights)

    def measure(self) -> None:
        """See `adaptune.selector.Selector.measure`."""
        self._live.measure()
