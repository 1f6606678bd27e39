"""What selection rules learn from, and what they answer."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import cap


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Errors of parameter sets on the frames of several sequences.

    Attributes
    ----------
    features : ndarray of shape (n_frames, n_features)
        What the scan of each frame looks like, scaled.
    sequence : ndarray of shape (n_frames,)
        Number of the sequence that each frame belongs to; that of a view of it is the same, for it
        is the same place.
    errors : ndarray of shape (n_frames, n_sets)
        Sub-trajectory RTE in percent, infinite where the track was lost, NaN where the set was
        never run: usually on all frames of a sequence, or on none. Frames without a
        sub-trajectory are left out.
    sets : ndarray of shape (n_sets, n_parameters)
        The parameter sets in the unit cube.
    fixed : int
        The one set that is best over all sequences.
    candidates : list of int, optional
        The sets to choose among, the fixed one among them; all when left out.
    vectors : ndarray of shape (n_frames, n_candidates, 3), optional
        Of the candidates, the errors as vectors in the frame of the sub-trajectory's start; not
        finite where the track was lost. See `adaptune.metrics.sub_trajectory_vectors`.
    """

    features: NDArray[np.float64]
    sequence: NDArray[np.intp]
    errors: NDArray[np.float32]
    sets: NDArray[np.float64]
    fixed: int
    candidates: list[int] | None = None
    vectors: NDArray[np.float32] | None = None


def mean_errors(errors: NDArray[np.floating], sequence: NDArray[np.intp]) -> NDArray[np.float64]:
    """Mean capped error of every set, each sequence weighing the same.

    Parameters
    ----------
    errors
        Percent, of shape (n_frames, n_sets); NaN where a set was never run.
    sequence
        Number of the sequence of each frame, of shape (n_frames,).

    Returns
    -------
    ndarray of shape (n_sets,)
        Percent. Where nothing else is judged by, the *fixed* set is where this is least; of equal
        ones, the first. A set's frames
        without an error do not count. If a whole sequence is without, the mean is infinite, for
        sequences differ more than sets, and means over different ones cannot be compared: such a
        set cannot be the fixed one.
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


def complementary(
    errors: NDArray[np.floating], sequence: NDArray[np.intp], fixed: int, size: int
) -> list[int]:
    """Choose sets so that at every training frame one of them does well.

    Greedily, beginning with the fixed set: each next one lowers the mean error most if the best of
    the chosen ones could be known at every frame.

    Parameters
    ----------
    errors
        Percent, of shape (n_frames, n_sets); NaN where a set was never run. One that was not run
        on every sequence is not chosen.
    sequence
        Number of each frame's sequence, of shape (n_frames,).
    fixed
        The fixed set.
    size
        How many to choose; fewer where more would lower nothing.

    Returns
    -------
    list of int
        Numbers of the sets, the fixed one first.
    """
    everywhere = np.isfinite(mean_errors(errors, sequence))
    capped = np.where(np.isnan(errors) | ~everywhere, np.inf, cap(errors))
    chosen = [fixed]
    least = cap(errors[:, fixed])
    while len(chosen) < size:
        means = mean_errors(np.minimum(capped, least[:, None]), sequence)
        best = int(np.argmin(means))
        # A set that is chosen already, as the fixed one, lowers nothing.
        if not means[best] < means[fixed]:
            break
        chosen.append(best)
        least = np.minimum(least, capped[:, best])
    return chosen


class Selection(NamedTuple):
    """The set chosen for a scan.

    Attributes
    ----------
    set_index : int
        Of the parameter set.
    predicted_error : float
        Percent. In a bank, with the weights that are found at this scan alone.
    predicted_fixed : float
        Percent, what the fixed set is predicted to have here.
    familiarity : float
        Share of the training frames that are farther from the other training sequences than the
        scan is from all of them; NaN where the rule does not ask.
    sequences : float
        How many training sequences this rests on: one over the sum of their squared weights; NaN
        where they have none.
    weights : tuple of float, optional
        Of the members of a bank, which are all driven; the set chosen is then the heaviest. What is
        driven with is their mean over the last selections, see `adaptune.model.fusion.steady`.
    """

    set_index: int
    predicted_error: float
    predicted_fixed: float
    familiarity: float = math.nan
    sequences: float = math.nan
    weights: tuple[float, ...] | None = None


class Rule(ABC):
    """A way to choose a parameter set for a scan.

    Attributes
    ----------
    gated : bool
        Whether the fixed set is to be kept where scans come from another sensor than in training;
        class attribute.
    """

    gated: ClassVar[bool] = False

    @abstractmethod
    def fit(self, data: TrainingData) -> Self:
        """Learn; whatever does not depend on the scan is computed here."""

    @abstractmethod
    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predict the error of every set for one scan, infinite of those not chosen among.

        Parameters
        ----------
        feature
            What the scan looks like, of shape (n_features,).

        Returns
        -------
        ndarray of shape (n_sets,)
            Percent.
        """

    @abstractmethod
    def select(self, feature: NDArray[np.float64], current: int | None = None) -> Selection:
        """Choose a set for one scan.

        Parameters
        ----------
        feature
            What the scan looks like, of shape (n_features,).
        current
            Index of the set that the odometry has now, for rules that weigh what a switch costs.
        """
