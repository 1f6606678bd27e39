"""The published selection: k nearest neighbours over descriptors, by their principal components."""

from collections.abc import Iterable
from typing import Self

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import PCA

from adaptune.compiled import compiled
from adaptune.metrics import FAILURE
from adaptune.model.rules import NOTHING, Live, Rule, TrainingData
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
        self._errors = np.ascontiguousarray(np.minimum(data.errors, np.float32(FAILURE)))
        # Frames that have seen the same sets lie together, usually those of a sequence, each
        # group's in their order.
        seen = ~np.isnan(self._errors)
        patterns: dict[bytes, list[int]] = {}
        for frame, pattern in enumerate(np.packbits(seen, axis=1)):
            patterns.setdefault(pattern.tobytes(), []).append(frame)
        groups = [frames for frames in patterns.values() if seen[frames[0]].any()]
        self._frames = np.concatenate(groups)
        self._bounds = np.cumsum([0, *map(len, groups)])
        self._features = data.features[self._frames]
        seen_sets = [np.flatnonzero(seen[frames[0]]) for frames in groups]
        self._near_squared, self._near_sets = _nearest_sets(sets, seen_sets, self.k)
        return self

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predicted error of every set in percent; infinite for those that may not be chosen."""
        near = _nearest_of_groups(self._features, self._bounds, feature, self.k)
        squared, frames, group = near[0], self._frames[near[1]], near[2]
        # Of equally near frames the earlier one first, whatever group it is of.
        order = np.lexsort((frames, squared))
        predicted = _mean_of_nearest(
            squared[order],
            frames[order],
            group[order],
            self._near_squared,
            self._near_sets,
            self._errors,
            self.k,
        )
        return np.where(self._allowed, predicted, np.inf)

    def select(self, feature: NDArray[np.float64], live: Live = NOTHING) -> Selection:  # noqa: ARG002
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


def _nearest_sets(
    sets: NDArray[np.float64], seen: list[NDArray[np.intp]], k: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """For each group of frames and each set, the nearest of the sets that the group has seen.

    Squared distances, infinite where it has seen fewer, and sets; of shape (n_groups, n_sets, k).
    """
    squared = np.zeros((len(sets), len(sets)))
    for p in range(sets.shape[1]):
        squared += (sets[:, p, None] - sets[:, p]) ** 2
    near_squared = np.full((len(seen), len(sets), min(k, len(sets))), np.inf)
    near_sets = np.zeros(near_squared.shape, np.intp)
    for g, of_group in enumerate(seen):
        order = np.argsort(squared[:, of_group], axis=1, kind="stable")[:, :k]
        n = order.shape[1]
        near_squared[g, :, :n] = np.take_along_axis(squared[:, of_group], order, axis=1)
        near_sets[g, :, :n] = of_group[order]
    return near_squared, near_sets


@compiled
def _nearest_of_groups(
    X: NDArray[np.float64], bounds: NDArray[np.intp], x: NDArray[np.float64], k: int
) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
    """The `k` rows of every group that are nearest to `x`: their squared distances, and groups.

    Group g is rows bounds[g] to bounds[g + 1]. In each, distances rise, and of equal ones the
    earlier row comes first.
    """
    n_groups = len(bounds) - 1
    squared = np.empty(n_groups * k)
    rows = np.empty(n_groups * k, np.intp)
    group = np.empty(n_groups * k, np.intp)
    first = 0
    for g in range(n_groups):
        last = first + min(k, bounds[g + 1] - bounds[g])
        end = first
        for row in range(bounds[g], bounds[g + 1]):
            distance = 0.0
            for f in range(X.shape[1]):
                difference = X[row, f] - x[f]
                distance += difference * difference
            if end == last:
                if not distance < squared[last - 1]:
                    continue
            else:
                end += 1
            at = end - 1
            while at > first and distance < squared[at - 1]:
                squared[at], rows[at] = squared[at - 1], rows[at - 1]
                at -= 1
            squared[at], rows[at] = distance, row
        group[first:last] = g
        first = last
    return squared[:first], rows[:first], group[:first]


@compiled
def _mean_of_nearest(
    squared: NDArray[np.float64],
    frames: NDArray[np.intp],
    group: NDArray[np.intp],
    near_squared: NDArray[np.float64],
    near_sets: NDArray[np.intp],
    y: NDArray[np.floating],
    k: int,
) -> NDArray[np.float64]:
    """Mean target of the `k` nearest pairs, for every candidate.

    Near frames (n,) and near sets (n_groups, n_candidates, n_near) come by rising distance; `y` is
    of shape (n_frames, n_sets).
    """
    n_candidates, n_near = near_sets.shape[1:]
    means = np.empty(n_candidates)
    best = np.empty(k)
    target = np.empty(k)
    for c in range(n_candidates):
        n = 0
        for i in range(len(frames)):
            if n == k and squared[i] >= best[k - 1]:
                break
            g = group[i]
            for j in range(n_near):
                distance = squared[i] + near_squared[g, c, j]
                # Neither is there anything nearer with this frame.
                if distance == np.inf or (n == k and distance >= best[k - 1]):
                    break
                if n < k:
                    n += 1
                at = n - 1
                while at > 0 and distance < best[at - 1]:
                    best[at], target[at] = best[at - 1], target[at - 1]
                    at -= 1
                best[at], target[at] = distance, y[frames[i], near_sets[g, c, j]]
        means[c] = target[:n].sum() / n
    return means
