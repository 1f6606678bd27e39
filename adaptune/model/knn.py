"""The published selection: k nearest neighbours over descriptors, by their principal components."""

from collections.abc import Iterable
from operator import itemgetter
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from sklearn.decomposition import PCA

from adaptune.metrics import FAILURE
from adaptune.model.rules import NOTHING, Evidence, Rule, TrainingData
from adaptune.space import Selection

N_COMPONENTS = 10
"""Of each descriptor."""


class ScaledPCA:
    """Principal components, divided by the mean of their standard deviations.

    One divisor for all keeps the components' shares in a distance, and gives distances a size that
    does not depend on the sensor's number of points. Each of the `blocks` of a descriptor has up to
    `N_COMPONENTS` components and a divisor of its own.

    Attributes
    ----------
    mean_ : ndarray of shape (n_features,)
    components_ : ndarray of shape (n_components, n_features)
        Those of each block, zero elsewhere.
    scale_ : ndarray of shape (n_components,)
    """

    def __init__(self, blocks: Iterable[int]):
        self.blocks = tuple(blocks)

    def fit(self, X: NDArray[np.floating]) -> Self:
        """Learn from descriptors of shape (n_scans, n_features)."""
        X = X.astype(np.float64)
        ends = np.cumsum(self.blocks)
        self.mean_ = np.empty(X.shape[1])
        components, scales = [], []
        for begin, end in zip([0, *ends[:-1]], ends, strict=True):
            block = X[:, begin:end]
            # Many scans take a tenth of the time by their covariance; few have none.
            solver = "covariance_eigh" if len(block) > block.shape[1] else "full"
            pca = PCA(min(N_COMPONENTS, *block.shape), svd_solver=solver)
            with np.errstate(invalid="ignore"):  # a block may be constant
                deviations = pca.fit_transform(block).std(axis=0)
            self.mean_[begin:end] = pca.mean_
            components.append(np.zeros((len(deviations), X.shape[1])))
            components[-1][:, begin:end] = pca.components_
            scales.append(np.full(len(deviations), float(deviations.mean()) or 1.0))
        self.components_ = np.concatenate(components)
        self.scale_ = np.concatenate(scales)
        return self

    def transform(self, X: NDArray[np.floating]) -> NDArray[np.float64]:
        """Map descriptors to shape (n_scans, n_components)."""
        return np.asarray((X.astype(np.float64) - self.mean_) @ self.components_.T / self.scale_)


class NearestNeighbours(Rule):
    """Mean error of the k nearest pairs of a frame and a parameter set, least over the sets.

    The parameter-error function ``S(E_i, x_j) ~ y_ij`` of Koide et al., IROS 2021, and their choice
    ``x = argmin_x S(E, x)``: a k-nearest-neighbour regressor on the concatenation ``[E_i, x_j]`` of
    descriptor and parameters, here with the parameters in the unit cube, divided by the mean of
    their standard deviations as the descriptor's components are.

    The prediction is that of `sklearn.neighbors.KNeighborsRegressor` on a row ``[frame, set]`` for
    every pair that was run. Among frames that have seen the same sets, the k nearest pairs are made
    of the k nearest frames and the k nearest sets; frames that have seen others are searched apart.

    Of pairs at the same distance, the one with the nearer frame comes first, then the one with the
    earlier frame, then that with the earlier set. Of fewer than k pairs, all are averaged.
    """

    sentence = "the set with the least expected error, as Koide et al. (IROS 2021) choose it"

    def __init__(self, k: int = 5):
        self.k = k

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`."""
        self.data_ = data
        self._allowed = data.allows()
        unit = data.sets.unit
        sets = unit / (float(unit.std(axis=0).mean()) or 1.0)
        self._errors = np.minimum(data.errors, np.float32(FAILURE))
        # Frames that have seen the same sets are a group, usually those of a sequence.
        seen = ~np.isnan(self._errors)
        patterns: dict[bytes, list[int]] = {}
        for frame, pattern in enumerate(np.packbits(seen, axis=1)):
            patterns.setdefault(pattern.tobytes(), []).append(frame)
        self._groups = [
            _Group(np.array(frames), *_nearest(sets, np.flatnonzero(seen[frames[0]]), self.k))
            for frames in patterns.values()
            if seen[frames[0]].any()
        ]
        return self

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predicted error of every set in percent; infinite for those that may not be chosen."""
        of_frames = cdist(self.data_.features, feature[None], "sqeuclidean")[:, 0]
        near = []
        for group in self._groups:
            frames = group.frames[np.argsort(of_frames[group.frames], kind="stable")[: self.k]]
            near += [(of_frames[frame], frame, group) for frame in frames]
        # Of equally near frames the earlier one first, whatever group it is of.
        near.sort(key=itemgetter(0, 1))
        squared = np.hstack([distance + group.squared for distance, _, group in near])
        errors = np.hstack([self._errors[frame, group.sets] for _, frame, group in near])
        nearest = np.argsort(squared, axis=1, kind="stable")[:, : self.k]
        predicted = np.take_along_axis(errors, nearest, axis=1).mean(axis=1, dtype=np.float64)
        return np.where(self._allowed, predicted, np.inf)

    def select(self, feature: NDArray[np.float64], evidence: Evidence = NOTHING) -> Selection:  # noqa: ARG002
        """See `Rule.select`."""
        sets = self.data_.sets
        predicted = self.predict(feature)
        best = int(np.argmin(predicted))
        return Selection(
            sets.trials[best],
            sets.parameters[best],
            predicted_error=float(predicted[best]),
            predicted_fixed=float(predicted[sets.column(self.data_.fixed)]),
        )


class _Group(NamedTuple):
    """Frames that have seen the same sets, and of these the nearest to each set."""

    frames: NDArray[np.intp]  # (n_frames,)
    squared: NDArray[np.float64]  # (n_sets, n_near): squared distances, rising
    sets: NDArray[np.intp]  # (n_sets, n_near)


def _nearest(
    sets: NDArray[np.float64], seen: NDArray[np.intp], k: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Of the sets that were seen, the `k` nearest to each, and their squared distances."""
    squared = cdist(sets, sets[seen], "sqeuclidean")
    order = np.argsort(squared, axis=1, kind="stable")[:, :k]
    return np.take_along_axis(squared, order, axis=1), seen[order]
