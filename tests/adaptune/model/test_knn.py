import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.decomposition import PCA
from sklearn.neighbors import KNeighborsRegressor
from tables import table

from adaptune.model import TrainingData
from adaptune.model.knn import NearestNeighbours, ScaledPCA

modest = settings(max_examples=30, deadline=None)
shapes = st.tuples(
    st.integers(0, 2**32 - 1),
    st.integers(1, 30),
    st.integers(1, 12),
    st.sampled_from(["none", "pairs", "blocks"]),
)


def drawn(seed, n_frames, n_sets, missing, whole=False):
    """Training of which some pairs are missing, of any frame or of a sequence, and queries."""
    rng = np.random.default_rng(seed)
    errors = rng.gamma(1.0, 8.0, (n_frames, n_sets)).astype(np.float32)
    errors[rng.random(errors.shape) < 0.1] = np.inf
    sequence = rng.integers(0, 3, n_frames)
    if missing == "pairs":
        errors[rng.random(errors.shape) < 0.4] = np.nan
    elif missing == "blocks":
        errors[(rng.random((3, n_sets)) < 0.5)[sequence]] = np.nan
    errors[rng.integers(n_frames), rng.integers(n_sets)] = 1.0

    def draw(n, m):
        # Whole numbers are often at the same distance, which is then exact.
        return rng.integers(0, 3, (n, m)).astype(float) if whole else rng.normal(size=(n, m))

    sets = table(draw(n_sets, 2) / 2.0 if whole else rng.random((n_sets, 2)))
    data = TrainingData(draw(n_frames, 3), sequence, errors, sets, int(rng.integers(n_sets)))
    return data, draw(4, 3)


def scaled(data):
    return data.sets.unit / (data.sets.unit.std(axis=0).mean() or 1.0)


@modest
@given(shapes, st.integers(1, 8))
def test_predictions_are_those_of_a_regressor_on_all_pairs_that_were_run(shape, k):
    data, queries = drawn(*shape)
    sets = scaled(data)
    i, j = np.nonzero(~np.isnan(data.errors))
    targets = np.minimum(data.errors[i, j].astype(float), 30.0)
    want = KNeighborsRegressor(min(k, len(i)), algorithm="brute")
    want.fit(np.hstack([data.features[i], sets[j]]), targets)
    rule = NearestNeighbours(k).fit(data)
    for query in queries:
        asked = np.hstack([np.tile(query, (len(sets), 1)), sets])
        np.testing.assert_allclose(rule.predict(query), want.predict(asked), rtol=1e-6)


@modest
@given(shapes, st.integers(1, 8))
def test_ties_fall_to_the_nearer_frame_then_to_the_earlier_pair(shape, k):
    data, queries = drawn(*shape, whole=True)
    sets, rule = scaled(data), NearestNeighbours(k).fit(data)
    for query in queries:
        near = ((data.features - query) ** 2).sum(axis=1)
        predicted = rule.predict(query)
        for c, s in enumerate(sets):
            known = sorted(
                (near[i] + ((sets[m] - s) ** 2).sum(), near[i], i, m)
                for i, m in zip(*np.nonzero(~np.isnan(data.errors)), strict=True)
            )
            want = np.mean([min(data.errors[i, m], 30.0) for *_, i, m in known[:k]])
            assert predicted[c] == pytest.approx(want, rel=1e-6)


@modest
@given(shapes)
def test_the_least_prediction_is_chosen(shape):
    data, (query, *_) = drawn(*shape)
    rule = NearestNeighbours().fit(data)
    predicted, selection = rule.predict(query), rule.select(query)
    assert selection.trial == predicted.argmin()
    assert selection.predicted_error == predicted.min()
    assert selection.predicted_fixed == predicted[data.fixed]
    assert isinstance(selection.trial, int)


def counts(seed, n=60):
    """Histograms of a random mixture of places, of shape (n, 90)."""
    rng = np.random.default_rng(seed)
    places = rng.gamma(0.3, 40.0, (4, 90))
    return rng.poisson(rng.dirichlet(np.ones(4), n) @ places).astype(float)


def test_the_published_rule_by_hand():
    """Koide et al. (IROS 2021): the mean of the five nearest of 48 pairs, and the least of these.

    Frames lie at 0, 1, ..., 11; sets at 0, 1, 2 and 3 times 0.894: their deviation is 1.
    From a scan at 4.3, frame 4 is away by 0.3, frame 5 by 0.7, and frame 3 by 1.3; with the set
    beside it, frame 4 by 0.94 and frame 5 by 1.14.
    """
    errors = np.array([[1 + frame, 4, 3, 3 + 0.5 * frame] for frame in range(12)], np.float32)
    sets, frames = table(np.arange(4.0)[:, None] / 3.0), np.arange(12.0)[:, None]
    rule = NearestNeighbours().fit(TrainingData(frames, np.zeros(12, int), errors, sets, 0))
    by_hand = [
        (5 + 6 + 4 + 4 + 4) / 5,  # frame and set: (4, 0), (5, 0), (4, 1), (5, 1), (3, 0)
        (4 + 4 + 5 + 3 + 6) / 5,  # (4, 1), (5, 1), (4, 0), (4, 2), (5, 0): of equal ones the first
        (3 + 3 + 4 + 5 + 4) / 5,  # (4, 2), (5, 2), (4, 1), (4, 3), (5, 1)
        (5 + 5.5 + 3 + 3 + 4.5) / 5,  # (4, 3), (5, 3), (4, 2), (5, 2), (3, 3)
    ]
    np.testing.assert_allclose(rule.predict(np.array([4.3])), by_hand, rtol=1e-6)
    found = rule.select(np.array([4.3]))
    assert (found.trial, found.predicted_error) == (2, pytest.approx(3.8))


def test_components_are_those_of_sklearn_divided_by_one_number():
    X = counts(0)
    scaled = ScaledPCA([90]).fit(X)
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
    transformed = ScaledPCA([90]).fit(X).transform(X)
    assert transformed.shape == (n, components)
    assert np.isfinite(transformed).all()


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_scans_that_are_all_the_same():
    X = np.tile(counts(4, 1), (8, 1))
    scaled = ScaledPCA([90]).fit(X)
    np.testing.assert_allclose(scaled.transform(X), 0.0, atol=1e-9)
    assert np.abs(scaled.transform(X + 1.0)).max() < 100


def test_each_block_has_components_of_its_own():
    rng = np.random.default_rng(0)
    a, b = rng.gamma(1.0, 100.0, (40, 20)), rng.normal(size=(40, 3))
    both = ScaledPCA((20, 3)).fit(np.hstack([a, b]))
    fresh = np.hstack([a, b])[:7] + 0.1
    want = [ScaledPCA(x.shape[1:]).fit(x) for x in (a, b)]
    assert both.components_.shape == (13, 23)
    np.testing.assert_allclose(
        both.transform(fresh),
        np.hstack([want[0].transform(fresh[:, :20]), want[1].transform(fresh[:, 20:])]),
        atol=1e-9,
    )
