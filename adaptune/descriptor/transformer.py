"""Descriptors as transformers of scikit-learn."""

from collections.abc import Iterable
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin

from adaptune.descriptor.ndt_histogram import N_FEATURES, ndt_histogram


class NdtHistogram(TransformerMixin, BaseEstimator):  # type: ignore[misc]
    """`ndt_histogram` of many scans, as a scikit-learn transformer without state."""

    def fit(self, X: Any = None, y: Any = None) -> Self:  # noqa: ARG002
        """Do nothing: there is nothing to learn."""
        return self

    def transform(self, X: Iterable[NDArray[np.float32]]) -> NDArray[np.float64]:
        """Describe scans.

        Parameters
        ----------
        X
            Point clouds of shape (n_points, 3).

        Returns
        -------
        ndarray of shape (n_scans, 90)
        """
        return np.array([ndt_histogram(points) for points in X]).reshape(-1, N_FEATURES)

    def __sklearn_is_fitted__(self) -> bool:
        return True
