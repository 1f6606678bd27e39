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

from adaptune.metrics import FAILURE, cap
from adaptune.model.base import Rule, Selection, TrainingData, complementary

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
    width: PositiveFloat = 0.12
    n_frames: PositiveInt = 300
    threshold: Annotated[float, Field(le=0.0)] = -0.1


class Near(NamedTuple):
    """The frames of each training sequence that are nearest to a scan.

    Attributes
    ----------
    squared : ndarray of shape (n_sequences,)
        Their mean squared distance.
    frames : list of ndarray
        Their numbers.
    fixed : ndarray of shape (n_sequences,)
        Mean error of the fixed set on them, in percent.
    familiarity : float
        Share of training that is farther from the other sequences than this scan is.
    """

    squared: NDArray[np.float64]
    frames: list[NDArray[np.intp]]
    fixed: NDArray[np.float64]
    familiarity: float


class PairedExpectedRatio(Rule):
    """Compare every set with the fixed one on the same frames, and choose on the expected ratio.

    For each training sequence, a set's mean error on the frames nearest to the scan divided by the
    fixed set's on the same frames; sequences are weighted by how near those frames are,
    neighbouring sets share their evidence, and a set must promise enough to be taken instead of
    the fixed one. A rare failure weighs as much as it costs, and what makes a sequence hard for
    all sets cancels out.

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
        self.fixed_errors_ = cap(data.errors[:, data.fixed])
        self.sequences_ = [np.flatnonzero(data.sequence == s) for s in np.unique(data.sequence)]
        self.features_ = [data.features[members] for members in self.sequences_]
        self.novelty_ = self._calibrate()
        self._mix()
        return self

    def configure(self, settings: Settings) -> Self:
        """Change the settings of a fitted rule, but for `n_frames`, which `near` rests on."""
        before, self.settings = self.settings, settings
        if (settings.n_sets, settings.width) != (before.n_sets, before.width):
            self._mix()
        return self

    def _mix(self) -> None:
        """Choose the candidates, and mix each one's errors with its neighbours'."""
        data, settings = self.data_, self.settings
        n_sets = len(data.sets) if settings.n_sets is None else settings.n_sets
        self.candidates_ = np.arange(len(data.sets))
        if n_sets < len(data.sets):
            chosen = complementary(data.errors, data.sequence, data.fixed, n_sets)
            self.candidates_ = np.array(chosen)
        candidates = data.sets[self.candidates_]
        squared = ((candidates[:, None, :] - data.sets[None, :, :]) ** 2).sum(axis=2)
        kernel = np.exp(-0.5 * squared / settings.width**2)
        kernel = (kernel / kernel.sum(axis=1, keepdims=True)).astype(np.float32).T
        # A ratio of means is linear in its numerator, so neighbouring sets can be mixed before.
        errors = np.minimum(data.errors, np.float32(FAILURE))
        known = ~np.isnan(errors)
        if known.all():
            self.errors_ = (errors @ kernel).astype(np.float64)
        else:
            missing = 1.0 - known.astype(np.float32) @ kernel
            self.errors_ = np.where(known, errors, np.float32(0.0)) @ kernel
            self.errors_ = self.errors_ + missing * self.fixed_errors_[:, None]

    def near(self, feature: NDArray[np.float64]) -> Near:
        """The training frames nearest to a scan of shape (n_features,)."""
        squared, frames = [], []
        for members, features in zip(self.sequences_, self.features_, strict=True):
            distance, nearest = _nearest(features, feature, self.settings.n_frames)
            squared.append(distance)
            frames.append(members[nearest])
        fixed = np.array([self.fixed_errors_[some].mean() for some in frames])
        return Near(np.array(squared), frames, fixed, self._familiarity(min(squared)))

    def ratios(self, near: Near) -> NDArray[np.float64]:
        """Expected ratio of every candidate to the fixed set, of shape (n_candidates,)."""
        means = np.array([self.errors_[frames].mean(axis=0) for frames in near.frames])
        ratio = (means + ERROR_FLOOR) / (near.fixed[:, None] + ERROR_FLOOR)
        expected = self._weights(near.squared) @ ratio
        return np.asarray(1.0 + min(1.0, near.familiarity / NOVEL) * (expected - 1.0))

    def _weights(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        # With the median at zero every sequence has the very same place in it.
        spread = float(np.median(squared)) or 1.0
        weights = np.exp(-self.settings.sharpness * (squared - squared.min()) / spread)
        return np.asarray(weights / weights.sum())

    def _familiarity(self, squared: float) -> float:
        """Share of training that is farther from the other sequences than this."""
        if not len(self.novelty_):
            return 1.0
        below = np.searchsorted(self.novelty_, squared, side="left")
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
            near = [[_nearest(o, x, n)[0] for o in others] for x in some]
            distances.append(
                np.quantile(np.min(near, axis=1), (np.arange(_QUANTILES) + 0.5) / _QUANTILES)
            )
        return np.sort(np.concatenate(distances))

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Rule.predict`.

        Sets that are not chosen among have an infinite error. For the fixed set too this is the
        smoothed ratio times its error; `select` tells the error itself.
        """
        near = self.near(feature)
        fixed = self._weights(near.squared) @ near.fixed
        predicted = np.full(len(self.data_.sets), np.inf)
        predicted[self.candidates_] = self.ratios(near) * fixed
        return predicted

    def select(self, feature: NDArray[np.float64], current: int | None = None) -> Selection:
        """See `Rule.select`."""
        return self.choose(self.near(feature), current)

    def choose(self, near: Near, current: int | None = None) -> Selection:
        """Choose a set by the frames near to a scan."""
        ratio = self.ratios(near)
        # Smoothing is not for the one that all are compared with.
        ratio = np.where(self.candidates_ == self.data_.fixed, 1.0, ratio)
        best = int(np.argmin(ratio))
        if not np.log(ratio[best]) < self.settings.threshold:
            best = int(np.flatnonzero(self.candidates_ == self.data_.fixed)[0])
        if self.price and current is not None:
            at = np.flatnonzero(self.candidates_ == current)
            if len(at) and ratio[at[0]] - ratio[best] <= self.price:
                best = int(at[0])
        weights = self._weights(near.squared)
        fixed = float(weights @ near.fixed)
        return Selection(
            int(self.candidates_[best]),
            float(ratio[best] * fixed),
            fixed,
            near.familiarity,
            float(1.0 / (weights @ weights)),
        )


def _nearest(
    features: NDArray[np.float64], feature: NDArray[np.float64], n: int
) -> tuple[float, NDArray[np.intp]]:
    """Mean squared distance of the `n` frames nearest to a scan, and their numbers in any order."""
    apart = features - feature
    squared = np.einsum("ij,ij->i", apart, apart)
    if n >= len(features):
        return float(squared.mean()), np.arange(len(features))
    nearest = np.argpartition(squared, n - 1)[:n]
    return float(squared[nearest].mean()), nearest
