"""Selection by the paired expected ratio."""

from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat, PositiveInt
from scipy.spatial.distance import cdist

from adaptune.metrics import FAILURE, cap
from adaptune.model.base import Rule, Selection, TrainingData, complementary, mean_errors

ERROR_FLOOR = 0.02
"""Percent, added to both errors of a ratio so that none is divided by zero."""
NOVEL = 0.1
"""What is farther from all training than this share of it is from the rest counts less and less."""
_QUANTILES = 10
"""By which each training sequence tells how far its frames are from the other sequences."""


class Settings(BaseModel):
    """Settings of the paired rule.

    Attributes
    ----------
    n_sets : int, optional
        It chooses among so many complementary sets, the fixed one first; among all if None, and
        among those that the data names if it does. With one it always takes the fixed set.
    sharpness : float
        How fast a sequence's weight falls with the distance of its nearest frames.
    width : float
        Standard deviation of the Gaussian over parameter sets, in the unit cube.
    n_frames : int
        Nearest frames of each sequence.
    threshold : float
        Logarithm of the ratio that a set must stay below to be taken.
    caution : float
        How many standard errors, by how much the sequences differ, are added to a ratio first.
    hedge : float
        In a bank, share of the weight that the fixed set keeps; with 1 it always has all.
    limit : float
        In a bank, errors count up to so many times the fixed set's root mean square in the
        sequence: who has lost track is left out of the mean, and does not cost what it would alone.
    """

    # A file of a later version may say more.
    model_config = ConfigDict(extra="ignore", frozen=True)

    n_sets: PositiveInt | None = 3
    sharpness: Annotated[NonNegativeFloat, Field(allow_inf_nan=False)] = 6.0
    width: Annotated[PositiveFloat, Field(allow_inf_nan=False)] = 0.12
    n_frames: PositiveInt = 300
    threshold: Annotated[float, Field(le=0.0, allow_inf_nan=False)] = -0.1
    caution: Annotated[NonNegativeFloat, Field(allow_inf_nan=False)] = 0.5
    hedge: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    limit: Annotated[PositiveFloat, Field(allow_inf_nan=False)] = 6.0


class Near(NamedTuple):
    """What is known of the training frames that are nearest to some scans.

    Attributes
    ----------
    squared : ndarray of shape (n_scans, n_sequences)
        Mean squared distance of those of each sequence.
    errors : ndarray of shape (n_scans, n_sequences, n_candidates)
        Mean error of every candidate on them, in percent, mixed with its neighbours'.
    fixed : ndarray of shape (n_scans, n_sequences)
        Mean error of the fixed set on them.
    familiarity : ndarray of shape (n_scans,)
        Share of training that is farther from the other sequences than each scan is.
    """

    squared: NDArray[np.float64]
    errors: NDArray[np.float64]
    fixed: NDArray[np.float64]
    familiarity: NDArray[np.float64]


class Ratios(NamedTuple):
    """Ratios of errors to the fixed set's.

    Attributes
    ----------
    expected, cautious : ndarray of shape (n_scans, n_candidates)
        What is expected, and the same with `caution` standard errors added.
    weights : ndarray of shape (n_scans, n_sequences)
        Of the training sequences, adding up to 1.
    """

    expected: NDArray[np.float64]
    cautious: NDArray[np.float64]
    weights: NDArray[np.float64]


class PairedExpectedRatio(Rule):
    """Compare every set with the fixed one on the same frames, and choose on the expected ratio.

    For each training sequence, a set's mean error on the frames nearest to the scan divided by the
    fixed set's on the same frames; sequences are weighted by how near those frames are,
    neighbouring sets share their evidence, and a set must promise enough to be taken instead of
    the fixed one. A rare failure weighs as much as it costs, and what makes a sequence hard for
    all sets cancels out.

    It chooses among sets that were run everywhere, unless others are named; the rest are heeded as
    neighbours. A sequence that has not seen a set, nor one close to it, says nothing for it: its
    ratio counts as 1.

    The farther a scan is from all training sequences, compared with how far these are from each
    other, the more is every ratio drawn to 1, and beyond all of them the fixed set is taken.

    Parameters
    ----------
    settings
        `tune` in `offline.validation` chooses them on the training sequences. Of a fitted rule,
        `sharpness`, `threshold` and `caution` may be changed.
    price
        What a switch must promise besides, as a share of the fixed set's error.
    """

    gated = True

    def __init__(self, settings: Settings | None = None, price: float = 0.0):
        self.settings = settings or Settings()
        self.price = price

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`."""
        self.data_ = data
        self.candidates_ = self._candidates()
        self.fixed_errors_, self.errors_ = self._evidence()
        self.sequences_ = [np.flatnonzero(data.sequence == s) for s in np.unique(data.sequence)]
        self.features_ = [data.features[members] for members in self.sequences_]
        self.novelty_ = self._calibrate()
        return self

    def _candidates(self) -> NDArray[np.intp]:
        """Numbers of the sets to choose among."""
        data, n_sets = self.data_, self.settings.n_sets
        if n_sets == 1:
            return np.array([data.fixed])
        if data.candidates is not None:
            return np.array(data.candidates)
        if n_sets is None:
            everywhere = np.isfinite(mean_errors(data.errors, data.sequence))
            return np.union1d(np.flatnonzero(everywhere), data.fixed)
        return np.array(complementary(data.errors, data.sequence, data.fixed, n_sets))

    def _evidence(self) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Error of the fixed set, and of every candidate, on every frame.

        The candidates' are mixed with their neighbours' before ratios are taken, for a ratio of
        means is linear in its numerator.
        """
        data = self.data_
        fixed_errors = cap(data.errors[:, data.fixed])
        squared = ((data.sets[:, None] - data.sets[self.candidates_]) ** 2).sum(axis=2)
        kernel = np.exp(-0.5 * squared / self.settings.width**2)
        kernel /= kernel.sum(axis=0)
        errors = np.minimum(data.errors, np.float32(FAILURE))
        # Where a set was not run, the fixed one's error makes it neither better nor worse.
        fixed = fixed_errors[:, None].astype(np.float32)
        mixed = np.where(np.isnan(errors), fixed, errors) @ kernel.astype(np.float32)
        return fixed_errors, np.asarray(mixed)

    def near(self, features: NDArray[np.float64]) -> Near:
        """What the training frames nearest to scans say.

        Parameters
        ----------
        features
            Of shape (n_scans, n_features).
        """
        shape = len(features), len(self.sequences_)
        squared, fixed = np.empty(shape), np.empty(shape)
        means = np.empty((*shape, *self.errors_.shape[1:]))
        for s, (members, of_sequence) in enumerate(
            zip(self.sequences_, self.features_, strict=True)
        ):
            squared[:, s], nearest = _nearest(of_sequence, features, self.settings.n_frames)
            frames = members[nearest]
            means[:, s] = self.errors_[frames].mean(axis=1, dtype=np.float64)
            fixed[:, s] = self.fixed_errors_[frames].mean(axis=1)
        return Near(squared, means, fixed, self._familiarity(squared.min(axis=1)))

    def ratios(self, near: Near) -> Ratios:
        """Ratio of every candidate's error to the fixed set's."""
        ratio = (near.errors + ERROR_FLOOR) / (near.fixed[..., None] + ERROR_FLOOR)
        weights = self.weights(near.squared)
        expected = np.einsum("qs,qsc->qc", weights, ratio)
        variance = np.einsum("qs,qsc->qc", weights, (ratio - expected[:, None]) ** 2)
        # One over the number of sequences that this rests on. The fewer they are, the less do they
        # tell how much they differ: as much as all sequences do, where it is one alone.
        share = (weights**2).sum(axis=1)[:, None]
        error = np.sqrt(share * (variance + share * ratio.var(axis=1)))
        trust = np.minimum(1.0, near.familiarity / NOVEL)[:, None]
        expected = 1.0 + trust * (expected - 1.0)
        return Ratios(expected, expected + trust * self.settings.caution * error, weights)

    def weights(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of the training sequences, by the distances in `Near`."""
        # With the median at zero every sequence has the very same place in it.
        spread = np.median(squared, axis=1, keepdims=True)
        spread[spread == 0.0] = 1.0
        least = squared.min(axis=1, keepdims=True)
        weights = np.exp(-self.settings.sharpness * (squared - least) / spread)
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def _familiarity(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        """Share of training that is farther from the other sequences than these."""
        if not len(self.novelty_):
            return np.ones(len(squared))
        below = np.searchsorted(self.novelty_, squared, side="left")
        return np.asarray(1.0 - below / len(self.novelty_))

    def _calibrate(self) -> NDArray[np.float64]:
        """Sorted distances of training frames from the other sequences, as many of each."""
        if len(self.sequences_) < 2:
            return np.empty(0)
        some = [features[:: max(1, len(features) // _QUANTILES)] for features in self.features_]
        number = np.repeat(np.arange(len(some)), [len(features) for features in some])
        queries = np.concatenate(some)
        squared = np.full(len(queries), np.inf)
        for s, features in enumerate(self.features_):
            others = number != s
            found, _ = _nearest(features, queries[others], self.settings.n_frames)
            squared[others] = np.minimum(squared[others], found)
        at = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
        return np.sort(
            np.concatenate([np.quantile(squared[number == s], at) for s in range(len(some))])
        )

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Rule.predict`.

        For the fixed set too this is the smoothed ratio times its error; `select` tells the error
        itself.
        """
        near = self.near(feature[None])
        predicted = np.full(len(self.data_.sets), np.inf)
        expected, _, weights = self.ratios(near)
        predicted[self.candidates_] = expected[0] * float(weights[0] @ near.fixed[0])
        return predicted

    def best(self, near: Near) -> tuple[NDArray[np.intp], Ratios]:
        """Number of the best candidate for each scan, of shape (n_scans,), and `ratios`.

        Those of the fixed set are 1.
        """
        ratios = self.ratios(near)
        expected, cautious, _ = ratios
        # Neither smoothing nor caution is for the one that all are compared with.
        fixed = int(np.flatnonzero(self.candidates_ == self.data_.fixed)[0])
        expected[:, fixed] = cautious[:, fixed] = 1.0
        worth = np.log(cautious.min(axis=1)) < self.settings.threshold
        return np.where(worth, cautious.argmin(axis=1), fixed), ratios

    def select(self, feature: NDArray[np.float64], current: int | None = None) -> Selection:
        """See `Rule.select`."""
        near = self.near(feature[None])
        (best,), ratios = self.best(near)
        (expected,), (cautious,), (weights,) = ratios
        # What takes a set back in a place unlike all training need not pay.
        if self.price and current is not None and near.familiarity[0] >= NOVEL:
            at = np.flatnonzero(self.candidates_ == current)
            # Nor what takes back one that is not expected to be better than the fixed one.
            if len(at) and cautious[best] + self.price >= cautious[at[0]] <= 1.0:
                best = at[0]
        fixed = float(weights @ near.fixed[0])
        return Selection(
            int(self.candidates_[best]),
            float(expected[best]) * fixed,
            fixed,
            float(near.familiarity[0]),
            float(1.0 / (weights @ weights)),
        )


def _nearest(
    features: NDArray[np.float64], queries: NDArray[np.float64], n: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Mean squared distance of the `n` frames nearest to each scan, and their numbers."""
    squared = cdist(queries, features, "sqeuclidean")
    if n >= len(features):
        return squared.mean(axis=1), np.tile(np.arange(len(features)), (len(queries), 1))
    nearest = np.argpartition(squared, n - 1, axis=1)[:, :n]
    return np.take_along_axis(squared, nearest, axis=1).mean(axis=1), nearest
