"""Histograms of NDT cells in scikit-learn."""

import numpy as np
from sklearn.base import clone
from sklearn.pipeline import make_pipeline

from adaptune.descriptor.ndt_histogram import ndt_histogram
from adaptune.descriptor.pca import ScaledPCA
from adaptune.descriptor.transformer import NdtHistogram


def cloud(seed, n=4000):
    return np.random.default_rng(seed).normal(0.0, [6.0, 6.0, 0.5], (n, 3)).astype(np.float32)


def test_histograms_of_many_scans():
    scans = [cloud(seed) for seed in range(3)] + [np.empty((0, 3), np.float32)]
    histograms = NdtHistogram().fit_transform(scans)
    np.testing.assert_array_equal(histograms, [ndt_histogram(points) for points in scans])
    assert histograms[:3].any(axis=1).all()
    assert NdtHistogram().transform(iter(())).shape == (0, 90)


def test_they_are_sklearn_estimators():
    pca = clone(ScaledPCA(n_components=4))
    assert pca.get_params() == {"n_components": 4, "blocks": None}
    scans = [cloud(seed, 1500) for seed in range(8)]
    assert make_pipeline(NdtHistogram(), pca).fit_transform(scans).shape == (8, 4)
