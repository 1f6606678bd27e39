"""Principal components by which descriptors are compared."""

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.decomposition import PCA
from sklearn.utils.validation import check_is_fitted, validate_data

N_COMPONENTS = 10
"""Of each descriptor."""


class ScaledPCA(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """Principal components, divided by the mean of their standard deviations.

    One divisor for all keeps the components' shares in a distance, and gives distances a size that
    does not depend on the sensor's number of points. Each of the `blocks` of a descriptor (one if
    left out) has up to `N_COMPONENTS` components and a divisor of its own.

    Attributes
    ----------
    mean_ : ndarray of shape (n_features,)
    components_ : ndarray of shape (n_components, n_features)
        Those of each block, zero elsewhere.
    scale_ : ndarray of shape (n_components,)
    """

    def __init__(self, blocks: Sequence[int] | None = None):
        self.blocks = blocks

    def fit(self, X: NDArray[np.floating], y: Any = None) -> Self:  # noqa: ARG002
        """Learn from descriptors of shape (n_scans, n_features)."""
        X = validate_data(self, X, dtype=np.float64)
        ends = np.cumsum(X.shape[1:] if self.blocks is None else self.blocks)
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
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float64, reset=False)
        return np.asarray((X - self.mean_) @ self.components_.T / self.scale_)
