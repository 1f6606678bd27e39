"""Selection by the paired expected ratio."""

from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
)

from adaptune.metrics import FAILURE
from adaptune.model.base import Rule, Selection, TrainingData, complementary
from adaptune.model.knn import nearest_frames

ERROR_FLOOR = 0.02
"""Percent, added to both errors of a ratio so that none is divided by zero."""
NOVEL = 0.1
"""What is farther from all training than this share of it is from the rest counts less and less."""
_QUANTILES = 25
"""By which each training sequence tells how far its frames are from the other sequences."""


class Settings(BaseModel):
    """Settings of the paired rule.

    Attributes
    ----------
    n_sets : int, optional
        It chooses among so many complementary sets, the fixed one first; among all if None. With
        one it always takes the fixed set.
    sharpness : float
        How fast a sequence's weight falls with the distance of its nearest frames.
    width : float
        Standard deviation of the Gaussian over parameter sets, in the unit cube.
    n_frames : int
        Nearest frames of each sequence.
    threshold : float
        Logarithm of the ratio that a set must stay below to be taken.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    n_sets: PositiveInt | None = 2
    sharpness: NonNegativeFloat = 6.0
    width: PositiveFloat = 0.05
    n_frames: PositiveInt = 30
    threshold: Annotated[float, Field(le=0.0)] = -0.1


class Evidence(NamedTuple):
    """What each training sequence says about a scan.

    Attributes
    ----------
    squared : ndarray of shape (n_sequences,)
        Mean squared distance of the sequence's frames that are nearest to the scan.
    ratios : ndarray of shape (n_sequences, n_sets)
        Mean over these frames of a set's error divided by the fixed set's; NaN where the set was
        never run there.
    fixed : ndarray of shape (n_sequences,)
        Mean error of the fixed set on these frames, in percent.
    """

    squared: NDArray[np.float64]
    ratios: NDArray[np.float64]
    fixed: NDArray[np.float64]


class PairedExpectedRatio(Rule):
    """Compare every set with the fixed one on the same frames, and choose on the mean ratio.

    For each training sequence, the mean over the frames nearest to the scan of a set's error
    divided by the fixed set's on that frame; sequences are weighted by how near those frames are,
    neighbouring sets share their evidence, and a set must promise enough to be taken instead of
    the fixed one. A rare failure weighs as much as it costs, and what makes a place hard for all
    sets cancels out.

    A sequence that has not seen a set, nor one close to it, says nothing for it: its ratio
    counts as 1. The farther a scan is from all training sequences, compared with how far these
    are from each other, the more is every ratio drawn to 1, and beyond all of them the fixed set
    is taken.

    Parameters
    ----------
    settings
        `tune` in `offline.validation` chooses them on the training sequences.
    price
        What a switch must promise besides, as a share of the fixed set's error.
    """

    def __init__(self, settings: Settings | None = None, price: float = 0.0):
        self.settings = settings or Settings()
        self.price = price

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`."""
        self.data_ = data
        # Ratios of all frames would take twice the memory, and seconds.
        self.errors_ = np.minimum(data.errors, np.float32(FAILURE))
        self.fixed_errors_ = self.errors_[:, data.fixed].astype(np.float64)
        self.complete_ = not np.isnan(self.errors_).any()
        self.sequences_ = [np.flatnonzero(data.sequence == s) for s in np.unique(data.sequence)]
        self.features_ = [data.features[members] for members in self.sequences_]
        self.novelty_ = self._calibrate()
        return self.configure(self.settings)

    def configure(self, settings: Settings) -> Self:
        """Change the settings of a fitted rule, but for `n_frames`, which `evidence` rests on."""
        self.settings = settings
        data = self.data_
        n_sets = len(data.sets) if settings.n_sets is None else settings.n_sets
        self.candidates_ = np.arange(len(data.sets))
        if n_sets < len(data.sets):
            chosen = complementary(data.errors, data.sequence, data.fixed, n_sets)
            self.candidates_ = np.array(chosen)
        candidates = data.sets[self.candidates_]
        squared = ((candidates[:, None, :] - data.sets[None, :, :]) ** 2).sum(axis=2)
        kernel = np.exp(-0.5 * squared / settings.width**2)
        self.kernel_ = kernel / kernel.sum(axis=1, keepdims=True)
        return self

    def evidence(self, feature: NDArray[np.float64]) -> Evidence:
        """What each training sequence says about a scan of shape (n_features,)."""
        squared, ratios, fixed = [], [], []
        for members, features in zip(self.sequences_, self.features_, strict=True):
            distances, near = nearest_frames(features, feature, self.settings.n_frames)
            frames = members[near]
            of_fixed = self.fixed_errors_[frames]
            paired = self.errors_[frames].astype(np.float64) + ERROR_FLOOR
            weights = 1.0 / (of_fixed + ERROR_FLOOR)
            if self.complete_:
                ratios.append(weights @ paired / len(frames))
            else:
                known = ~np.isnan(paired)
                number = known.sum(axis=0)
                total = weights @ np.where(known, paired, 0.0)
                ratios.append(np.where(number > 0, total / np.maximum(number, 1), np.nan))
            squared.append(distances.mean())
            fixed.append(of_fixed.mean())
        return Evidence(np.array(squared), np.array(ratios), np.array(fixed))

    def ratios(self, evidence: Evidence) -> NDArray[np.float64]:
        """Expected ratio of every candidate to the fixed set, of shape (n_candidates,)."""
        weights = self._weights(evidence.squared)
        if self.complete_:
            ratio = self.kernel_ @ (weights @ evidence.ratios)
        else:
            known = ~np.isnan(evidence.ratios)
            share = known @ self.kernel_.T
            said = np.where(known, evidence.ratios, 0.0) @ self.kernel_.T + (1.0 - share)
            ratio = weights @ said
        return np.asarray(1.0 + self._familiar(evidence) * (ratio - 1.0))

    def _weights(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        # With the median at zero every sequence has the very same place in it.
        spread = float(np.median(squared)) or 1.0
        weights = np.exp(-self.settings.sharpness * (squared - squared.min()) / spread)
        return np.asarray(weights / weights.sum())

    def _familiar(self, evidence: Evidence) -> float:
        """From 1, as near to training as its sequences to each other, to 0, beyond all of them."""
        return min(1.0, self._novelty(evidence) / NOVEL)

    def _novelty(self, evidence: Evidence) -> float:
        """Share of training that is farther from the other sequences than this scan is."""
        if not len(self.novelty_):
            return 1.0
        below = np.searchsorted(self.novelty_, evidence.squared.min(), side="left")
        return float(1.0 - below / len(self.novelty_))

    def _calibrate(self) -> NDArray[np.float64]:
        """Sorted distances of training frames from the other sequences, as many of each."""
        if len(self.sequences_) < 2:
            return np.empty(0)
        distances = []
        for s, features in enumerate(self.features_):
            some = features[:: max(1, len(features) // _QUANTILES)]
            others = self.features_[:s] + self.features_[s + 1 :]
            n = self.settings.n_frames
            near = [[nearest_frames(o, x, n)[0].mean() for o in others] for x in some]
            distances.append(
                np.quantile(np.min(near, axis=1), (np.arange(_QUANTILES) + 0.5) / _QUANTILES)
            )
        return np.sort(np.concatenate(distances))

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Rule.predict`.

        Sets that are not chosen among have an infinite error. For the fixed set too this is the
        smoothed ratio times its error; `select` tells the error itself.
        """
        evidence = self.evidence(feature)
        fixed = self._weights(evidence.squared) @ evidence.fixed
        predicted = np.full(len(self.data_.sets), np.inf)
        predicted[self.candidates_] = self.ratios(evidence) * fixed
        return predicted

    def select(self, feature: NDArray[np.float64], current: int | None = None) -> Selection:
        """See `Rule.select`."""
        return self.choose(self.evidence(feature), current)

    def choose(self, evidence: Evidence, current: int | None = None) -> Selection:
        """Choose a set on the evidence about a scan."""
        ratio = self.ratios(evidence)
        # Smoothing is not for the one that all are compared with.
        ratio = np.where(self.candidates_ == self.data_.fixed, 1.0, ratio)
        best = int(np.argmin(ratio))
        if not np.log(ratio[best]) < self.settings.threshold:
            best = int(np.flatnonzero(self.candidates_ == self.data_.fixed)[0])
        if self.price and current is not None:
            at = np.flatnonzero(self.candidates_ == current)
            if len(at) and ratio[at[0]] - ratio[best] <= self.price:
                best = int(at[0])
        weights = self._weights(evidence.squared)
        fixed = float(weights @ evidence.fixed)
        return Selection(
            int(self.candidates_[best]),
            float(ratio[best] * fixed),
            fixed,
            self._novelty(evidence),
            float(1.0 / (weights @ weights)),
        )
