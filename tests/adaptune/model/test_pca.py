import numpy as np
import pytest
from sklearn.decomposition import PCA
from sklearn.utils.estimator_checks import parametrize_with_checks

from adaptune.model.pca import ScaledPCA


def counts(seed, n=60):
    """Histograms of a random mixture of places, of shape (n, 90)."""
    rng = np.random.default_rng(seed)
    places = rng.gamma(0.3, 40.0, (4, 90))
    return rng.poisson(rng.dirichlet(np.ones(4), n) @ places).astype(float)


def test_components_are_those_of_sklearn_divided_by_one_number():
    X = counts(0)
    scaled = ScaledPCA().fit(X)
    want = PCA(10, svd_solver="full").fit(X)
    deviations = want.transform(X).std(axis=0)
    np.testing.assert_allclose(scaled.scale_, deviations.mean())
    fresh = counts(1, 20)
    np.testing.assert_allclose(scaled.transform(fresh), want.transform(fresh) / deviations.mean())
    assert scaled.transform(X).std(axis=0).mean() == pytest.approx(1.0)


@pytest.mark.parametrize(("n", "components"), [(60, 10), (10, 10), (7, 7), (2, 2), (1, 1)])
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_few_scans_have_few_components(n, components):
    X = counts(3, n)
    transformed = ScaledPCA().fit(X).transform(X)
    assert transformed.shape == (n, components)
    assert np.isfinite(transformed).all()


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_scans_that_are_all_the_same():
    X = np.tile(counts(4, 1), (8, 1))
    scaled = ScaledPCA().fit(X)
    np.testing.assert_allclose(scaled.transform(X), 0.0, atol=1e-9)
    assert np.abs(scaled.transform(X + 1.0)).max() < 100


def test_each_block_has_components_of_its_own():
    rng = np.random.default_rng(0)
    a, b = rng.gamma(1.0, 100.0, (40, 20)), rng.normal(size=(40, 3))
    both = ScaledPCA((20, 3)).fit(np.hstack([a, b]))
    fresh = np.hstack([a, b])[:7] + 0.1
    want = [ScaledPCA().fit(x) for x in (a, b)]
    assert both.components_.shape == (13, 23)
    np.testing.assert_allclose(
        both.transform(fresh),
        np.hstack([want[0].transform(fresh[:, :20]), want[1].transform(fresh[:, 20:])]),
        atol=1e-9,
    )


@parametrize_with_checks([ScaledPCA()])
def test_it_is_a_transformer_of_scikit_learn(estimator, check):
    check(estimator)
