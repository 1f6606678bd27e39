"""The published selection: k nearest neighbours over descriptors and parameters."""

from typing import Self

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import cap
from adaptune.model.base import Rule, Selection, TrainingData


class NearestNeighbours(Rule):
    """Mean error of the k nearest pairs of a frame and a parameter set, least over the sets.

    After Koide et al., IROS 2021: a k-nearest-neighbour regressor on the concatenation of
    descriptor and parameters, here with the parameters in the unit cube, divided by the mean of
    their standard deviations as the descriptor's components are.

    All frames have seen all sets, so the k nearest pairs are among the k nearest frames and the
    k nearest sets: rows for frames x sets need not exist. Of pairs at the same distance, those
    with the nearer frame come first.

    Parameters
    ----------
    k
        Number of neighbours.
    """

    def __init__(self, k: int = 5):
        self.k = k

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`."""
        self.data_ = data
        self.errors_ = cap(data.errors)
        sets = data.sets / (float(data.sets.std(axis=0).mean()) or 1.0)
        squared = ((sets[:, None, :] - sets[None, :, :]) ** 2).sum(axis=2)
        k = min(self.k, len(sets))
        self.near_sets_ = np.argsort(squared, axis=1, kind="stable")[:, :k]
        self.near_squared_ = np.take_along_axis(squared, self.near_sets_, axis=1)
        return self

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Rule.predict`."""
        squared, frames = nearest_frames(self.data_.features, feature, self.k)
        # (n_sets, frames, near sets), flattened: a handful of pairs for every candidate.
        pairs = squared[None, :, None] + self.near_squared_[:, None, :]
        errors = self.errors_[frames[None, :, None], self.near_sets_[:, None, :]]
        pairs = pairs.reshape(len(pairs), -1)
        k = min(self.k, pairs.shape[1])
        order = np.argsort(pairs, axis=1, kind="stable")[:, :k]
        near = np.take_along_axis(errors.reshape(len(pairs), -1), order, axis=1)
        return np.asarray(near.mean(axis=1))

    def select(self, feature: NDArray[np.float64]) -> Selection:
        """See `Rule.select`."""
        predicted = self.predict(feature)
        index = int(np.argmin(predicted))
        return Selection(index, float(predicted[index]), float(predicted[self.data_.fixed]))


def nearest_frames(
    features: NDArray[np.float64], feature: NDArray[np.float64], k: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """The `k` frames nearest to a scan.

    Parameters
    ----------
    features
        Of shape (n_frames, n_features).
    feature
        Of shape (n_features,).
    k
        At most; fewer where there are fewer frames.

    Returns
    -------
    squared : ndarray of shape (k,)
        Squared distances, rising; of equal ones, the earlier frame comes first.
    frames : ndarray of shape (k,)
    """
    difference = features - feature
    squared = np.einsum("ij,ij->i", difference, difference)
    if k < len(squared):
        # Partitioning is linear; ties at the border are settled among all who share it.
        border = np.partition(squared, k - 1)[k - 1]
        frames = np.flatnonzero(squared <= border)
    else:
        frames = np.arange(len(squared))
    frames = frames[np.argsort(squared[frames], kind="stable")[:k]]
    return squared[frames], frames
