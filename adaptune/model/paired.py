"""Selection by the paired expected ratio."""

from typing import Self

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import FAILURE
from adaptune.model.base import Rule, Selection, TrainingData
from adaptune.model.knn import nearest_frames

ERROR_FLOOR = 0.02
"""Percent, added to both errors of a ratio so that none is divided by zero."""


class PairedExpectedRatio(Rule):
    """Compare every set with the fixed one on the same frames, and choose on the mean ratio.

    For each training sequence, the mean over the frames nearest to the scan of a set's error
    divided by the fixed set's on that frame; sequences are weighted by how near those frames are,
    neighbouring sets share their evidence, and a set must promise enough to be taken instead of
    the fixed one. A rare failure weighs as much as it costs, and what makes a place hard for all
    sets cancels out.

    Parameters
    ----------
    n_frames
        Nearest frames of each sequence.
    width
        Standard deviation of the Gaussian over parameter sets, in the unit cube.
    sharpness
        How fast a sequence's weight falls with the distance of its nearest frames.
    threshold
        Logarithm of the ratio that a set must stay below to be taken.
    """

    def __init__(
        self,
        n_frames: int = 30,
        width: float = 0.12,
        sharpness: float = 3.0,
        threshold: float = -0.1,
    ):
        self.n_frames = n_frames
        self.width = width
        self.sharpness = sharpness
        self.threshold = threshold

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`."""
        self.data_ = data
        # Ratios of all frames would take twice the memory, and seconds.
        self.errors_ = np.minimum(data.errors, np.float32(FAILURE))
        self.fixed_errors_ = self.errors_[:, data.fixed].astype(np.float64)
        self.sequences_ = [np.flatnonzero(data.sequence == s) for s in np.unique(data.sequence)]
        self.features_ = [data.features[members] for members in self.sequences_]
        squared = ((data.sets[:, None, :] - data.sets[None, :, :]) ** 2).sum(axis=2)
        kernel = np.exp(-0.5 * squared / self.width**2)
        self.kernel_ = kernel / kernel.sum(axis=1, keepdims=True)
        return self

    def _compare(self, feature: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Expected ratio of every set, of shape (n_sets,), and the fixed set's error in percent."""
        distances, ratios, fixed = [], [], []
        for members, features in zip(self.sequences_, self.features_, strict=True):
            squared, near = nearest_frames(features, feature, self.n_frames)
            frames = members[near]
            distances.append(squared.mean())
            of_fixed = self.fixed_errors_[frames]
            errors = self.errors_[frames].astype(np.float64)
            ratios.append((1.0 / (of_fixed + ERROR_FLOOR)) @ (errors + ERROR_FLOOR) / len(frames))
            fixed.append(of_fixed.mean())
        a = np.array(distances)
        # With the median at zero every sequence has the very same place in it.
        spread = float(np.median(a)) or 1.0
        weights = np.exp(-self.sharpness * (a - a.min()) / spread)
        weights /= weights.sum()
        return self.kernel_ @ (weights @ np.array(ratios)), float(weights @ np.array(fixed))

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Rule.predict`.

        For the fixed set too this is the smoothed ratio times its error; `select` tells the error
        itself.
        """
        ratio, fixed = self._compare(feature)
        return ratio * fixed

    def select(self, feature: NDArray[np.float64]) -> Selection:
        """See `Rule.select`."""
        ratio, fixed = self._compare(feature)
        index = int(np.argmin(ratio))
        if np.log(ratio[index]) < self.threshold:
            return Selection(index, float(ratio[index] * fixed), fixed)
        return Selection(self.data_.fixed, fixed, fixed)
