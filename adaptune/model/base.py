"""What selection rules learn from, and what they have in common."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import cap
from adaptune.model.costs import Spending
from adaptune.parameter_sets import ParameterSets
from adaptune.selection import Selection


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Errors of parameter sets on the frames of several sequences.

    Attributes
    ----------
    features : ndarray of shape (n_frames, n_features)
        Descriptors of the frames' scans, scaled.
    sequence : ndarray of shape (n_frames,)
        Number of each frame's sequence. Views of a sequence share its number, for they show the
        same place.
    errors : ndarray of shape (n_frames, n_sets)
        Sub-trajectory RTE in percent: infinite where the track was lost, NaN where the set was not
        run (usually on all frames of a sequence, or on none). Every frame has a sub-trajectory.
    sets : ParameterSets
        The columns of `errors`.
    fixed : int
        Trial number of the fixed set.
    candidates : tuple of int, optional
        Trial numbers of the sets to choose among, the fixed one included; the rule finds them if
        None.
    allowed : tuple of int, optional
        Trial numbers of the sets that a budget allows, the fixed one included; all sets if None.
    vectors : ndarray of shape (n_frames, n_candidates, 3), optional
        Errors of the candidates as vectors in the frame of the sub-trajectory's start; not finite
        where the track was lost. See `adaptune.metrics.sub_trajectory_vectors`.
    """

    features: NDArray[np.float64]
    sequence: NDArray[np.intp]
    errors: NDArray[np.float32]
    sets: ParameterSets
    fixed: int
    candidates: tuple[int, ...] | None = None
    vectors: NDArray[np.float32] | None = None
    allowed: tuple[int, ...] | None = None

    def allows(self) -> NDArray[np.bool_]:
        """Which sets may be chosen, of shape (n_sets,)."""
        if self.allowed is None:
            return np.ones(len(self.sets), np.bool_)
        return np.isin(self.sets.trials, self.allowed)

    @property
    def fixed_errors(self) -> NDArray[np.float64]:
        """Capped errors of the fixed set, of shape (n_frames,)."""
        return cap(self.errors[:, self.sets.column(self.fixed)])


def mean_errors(errors: NDArray[np.floating], sequence: NDArray[np.intp]) -> NDArray[np.float64]:
    """Mean capped error of every set; each sequence has the same weight.

    Parameters
    ----------
    errors
        Percent, of shape (n_frames, n_sets); NaN where a set was not run.
    sequence
        Number of each frame's sequence, of shape (n_frames,).

    Returns
    -------
    ndarray of shape (n_sets,)
        Percent. Frames without an error do not count. Where a set has no error on a whole sequence,
        its mean is infinite: sequences differ more than sets do, so means over different sequences
        cannot be compared.
    """
    capped = cap(errors)
    means = []
    for s in np.unique(sequence):
        of_sequence = capped[sequence == s]
        known = ~np.isnan(of_sequence)
        if known.all():
            means.append(of_sequence.mean(axis=0))
            continue
        number = known.sum(axis=0)
        total = np.where(known, of_sequence, 0.0).sum(axis=0)
        means.append(np.where(number > 0, total / np.maximum(number, 1), np.inf))
    return np.asarray(np.mean(means, axis=0))


def complementary(data: TrainingData, size: int, spending: Spending | None = None) -> list[int]:
    """Choose sets so that at every training frame one of them does well.

    The search is greedy and begins with the fixed set. Each next set is the one that lowers the
    mean error most if the best of the chosen sets were known at every frame.

    Parameters
    ----------
    data
        A set that was not run on every sequence is not chosen.
    size
        Number of sets; fewer where another one would lower nothing.
    spending
        What a bank of them may cost; anything when left out.

    Returns
    -------
    list of int
        Trial numbers, the fixed set's first.
    """
    everywhere = np.isfinite(mean_errors(data.errors, data.sequence)) & data.allows()
    capped = np.where(np.isnan(data.errors) | ~everywhere, np.inf, cap(data.errors))
    chosen = [data.fixed]
    least = data.fixed_errors
    while len(chosen) < size:
        means = mean_errors(np.minimum(capped, least[:, None]), data.sequence)
        now = means[data.sets.column(data.fixed)]
        if spending is not None:
            means = np.where([spending.allows([*chosen, t]) for t in data.sets], means, np.inf)
        best = int(np.argmin(means))
        # A set that is chosen already lowers nothing.
        if not means[best] < now:
            break
        chosen.append(data.sets.trials[best])
        least = np.minimum(least, capped[:, best])
    return chosen


class Rule(ABC):
    """A way to choose a parameter set for a scan.

    Attributes
    ----------
    gated : bool
        Whether the fixed set is kept for scans of another sensor than in training; class
        attribute.
    """

    gated: ClassVar[bool] = False

    @abstractmethod
    def fit(self, data: TrainingData) -> Self:
        """Learn, and compute whatever does not depend on the scan."""

    @abstractmethod
    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predict the error of every set for one scan.

        Parameters
        ----------
        feature
            The scan's scaled descriptor, of shape (n_features,).

        Returns
        -------
        ndarray of shape (n_sets,)
            Percent; infinite for sets that are not candidates.
        """

    @abstractmethod
    def select(self, feature: NDArray[np.float64], current: int | None = None) -> Selection:
        """Choose a set, or weights, for one scan.

        Parameters
        ----------
        feature
            The scan's scaled descriptor, of shape (n_features,).
        current
            Trial number of the set that the odometry has now, for rules with a switch cost.
        """
