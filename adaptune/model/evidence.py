"""The evidence about a scene: the training frames that look like it."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

NOVEL = 0.1
"""Familiarity below which evidence counts less and less."""
_QUANTILES = 10
"""Of the distances of each training sequence's frames from the other sequences."""


class Evidence(NamedTuple):
    """The training frames nearest to some scans."""

    # (n_scans, n_near): for each training sequence, numbers of its frames that are nearest to each
    # scan.
    frames: tuple[NDArray[np.intp], ...]
    squared: NDArray[np.float64]  # (n_scans, n_sequences): mean squared distance of these frames
    # (n_scans,): share of the training frames that are farther from the other sequences than each
    # scan is from all of them; NaN of a single sequence, which has no others.
    familiarity: NDArray[np.float64]

    @property
    def trust(self) -> NDArray[np.float64]:
        """See `trust_in`."""
        return trust_in(self.familiarity)

    def weights(self, sharpness: float) -> NDArray[np.float64]:
        """Weights of the training sequences: the nearer their frames, the larger.

        Returns
        -------
        ndarray of shape (n_scans, n_sequences)
            Each row adds up to 1.
        """
        # Where the median is zero, every sequence has the very same place in it.
        spread = np.median(self.squared, axis=1, keepdims=True)
        spread[spread == 0.0] = 1.0
        least = self.squared.min(axis=1, keepdims=True)
        weights = np.exp(-sharpness * (self.squared - least) / spread)
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def means(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Mean over the near frames of every sequence.

        Parameters
        ----------
        values
            One entry for each training frame, of shape (n_frames, ...).

        Returns
        -------
        ndarray of shape (n_scans, n_sequences, ...)
        """
        means = np.empty((*self.squared.shape, *values.shape[1:]))
        for s, frames in enumerate(self.frames):
            # All frames are near to every scan: the mean is the same.
            same = frames.strides[0] == 0
            of = values[frames[:1]] if same else values[frames]
            means[:, s] = of.mean(axis=1, dtype=np.float64)
        return means


def trust_in(familiarity: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far evidence counts, from 0 to 1: fully where familiarity is unknown."""
    return np.asarray(np.fmin(1.0, familiarity / NOVEL))


class NearestFrames:
    """Finds the evidence about scenes.

    Parameters
    ----------
    n_frames
        Near frames of each sequence.
    """

    def __init__(self, n_frames: int):
        self.n_frames = n_frames

    def fit(self, features: NDArray[np.float64], sequence: NDArray[np.intp]) -> Self:
        """Learn from the training frames.

        Parameters
        ----------
        features
            Of shape (n_frames, n_features).
        sequence
            Number of each frame's sequence, of shape (n_frames,).
        """
        self.members_ = [np.flatnonzero(sequence == s) for s in np.unique(sequence)]
        self.features_ = [features[members] for members in self.members_]
        self.distances_ = self._distances_between_sequences()
        return self

    def about(self, features: NDArray[np.float64]) -> Evidence:
        """Find the evidence about scans.

        Parameters
        ----------
        features
            Of shape (n_scans, n_features).
        """
        squared = np.empty((len(features), len(self.members_)))
        frames = []
        for s, (members, own) in enumerate(zip(self.members_, self.features_, strict=True)):
            squared[:, s], nearest = _nearest(own, features, self.n_frames)
            frames.append(members[nearest])
        return Evidence(tuple(frames), squared, self._familiarity(squared.min(axis=1)))

    def _familiarity(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        if not len(self.distances_):
            return np.full(len(squared), np.nan)
        below = np.searchsorted(self.distances_, squared, side="left")
        return np.asarray(1.0 - below / len(self.distances_))

    def _distances_between_sequences(self) -> NDArray[np.float64]:
        """Sorted distances of training frames from the other sequences, as many of each."""
        if len(self.members_) < 2:
            return np.empty(0)
        some = [features[:: max(1, len(features) // _QUANTILES)] for features in self.features_]
        number = np.repeat(np.arange(len(some)), [len(features) for features in some])
        queries = np.concatenate(some)
        squared = np.full(len(queries), np.inf)
        for s, features in enumerate(self.features_):
            others = number != s
            found, _ = _nearest(features, queries[others], self.n_frames)
            squared[others] = np.minimum(squared[others], found)
        at = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
        quantiles: Sequence[NDArray[np.float64]] = [
            np.quantile(squared[number == s], at) for s in range(len(some))
        ]
        return np.sort(np.concatenate(quantiles))


def _nearest(
    features: NDArray[np.float64], queries: NDArray[np.float64], n: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Mean squared distance of the `n` frames nearest to each query, and their numbers."""
    from scipy.spatial.distance import cdist  # not needed to load a model

    squared = cdist(queries, features, "sqeuclidean")
    if n >= len(features):
        everything = np.broadcast_to(np.arange(len(features)), squared.shape)
        return squared.mean(axis=1), everything
    nearest = np.argpartition(squared, n - 1, axis=1)[:, :n]
    return np.take_along_axis(squared, nearest, axis=1).mean(axis=1), nearest
