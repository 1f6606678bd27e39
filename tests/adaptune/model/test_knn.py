"""The published selection."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.neighbors import KNeighborsRegressor

from adaptune.model import NearestNeighbours, TrainingData
from adaptune.model.base import mean_errors
from adaptune.model.knn import nearest_frames

modest = settings(max_examples=30, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def random_data(seed, n_frames, n_sets, n_features=4, n_parameters=2):
    rng = np.random.default_rng(seed)
    errors = rng.gamma(1.0, 8.0, (n_frames, n_sets)).astype(np.float32)
    errors[rng.random(errors.shape) < 0.1] = np.inf
    return TrainingData(
        rng.normal(size=(n_frames, n_features)),
        rng.integers(0, 3, n_frames),
        errors,
        rng.random((n_sets, n_parameters)),
        int(rng.integers(n_sets)),
    )


def regressor(data, k):
    """The same on rows for all pairs of a frame and a set; returns its prediction."""
    n_frames, n_sets = data.errors.shape
    scale = data.sets.std(axis=0).mean()
    rows = np.hstack(
        [np.repeat(data.features, n_sets, axis=0), np.tile(data.sets / scale, (n_frames, 1))]
    )
    targets = np.minimum(data.errors.astype(float), 30.0).ravel()
    fitted = KNeighborsRegressor(k, algorithm="brute").fit(rows, targets)

    def predict(feature):
        return fitted.predict(np.hstack([np.tile(feature, (n_sets, 1)), data.sets / scale]))

    return predict


@modest
@given(seeds, st.integers(1, 30), st.integers(2, 12), st.integers(1, 8))
def test_predictions_are_those_of_a_regressor_on_all_pairs(seed, n_frames, n_sets, k):
    k = min(k, n_frames * n_sets)
    data = random_data(seed, n_frames, n_sets)
    rule, want = NearestNeighbours(k).fit(data), regressor(data, k)
    for feature in np.random.default_rng(seed).normal(size=(3, 4)):
        np.testing.assert_allclose(rule.predict(feature), want(feature), rtol=1e-6)


def test_five_neighbours_unless_told_otherwise():
    data = random_data(1, 20, 6)
    feature = np.zeros(4)
    np.testing.assert_array_equal(
        NearestNeighbours().fit(data).predict(feature),
        NearestNeighbours(5).fit(data).predict(feature),
    )


@modest
@given(seeds)
def test_the_least_prediction_is_chosen(seed):
    data = random_data(seed, 25, 9)
    rule = NearestNeighbours().fit(data)
    feature = np.random.default_rng(seed).normal(size=4)
    predicted = rule.predict(feature)
    selection = rule.select(feature)
    assert selection == (predicted.argmin(), predicted.min(), predicted[data.fixed])
    assert isinstance(selection.set_index, int)


def test_a_lost_track_counts_as_30():
    data = TrainingData(
        np.zeros((2, 1)),
        np.zeros(2, int),
        np.array([[np.inf, 50.0], [1.0, 2.0]], np.float32),
        np.array([[0.0], [1.0]]),
        0,
    )
    # Two pairs of the set itself, at the same place.
    np.testing.assert_allclose(
        NearestNeighbours(2).fit(data).predict(np.zeros(1)), [15.5, 16.0], rtol=1e-6
    )


def test_fewer_pairs_than_neighbours():
    data = random_data(2, 2, 2)
    want = np.full(2, np.minimum(data.errors, 30.0).mean())
    np.testing.assert_allclose(NearestNeighbours(5).fit(data).predict(np.zeros(4)), want, rtol=1e-6)


def test_a_single_set_and_frame():
    data = TrainingData(
        np.zeros((1, 3)),
        np.zeros(1, int),
        np.full((1, 1), 2.5, np.float32),
        np.full((1, 2), 0.4),
        0,
    )
    assert NearestNeighbours().fit(data).select(np.ones(3)) == (0, 2.5, 2.5)


@modest
@given(seeds, st.integers(1, 40), st.integers(1, 45))
def test_nearest_frames(seed, n_frames, k):
    rng = np.random.default_rng(seed)
    # Few places, so that distances are often the same.
    features = rng.integers(0, 3, (n_frames, 2)).astype(float)
    feature = rng.integers(0, 3, 2).astype(float)
    want = sorted((float(((f - feature) ** 2).sum()), i) for i, f in enumerate(features))[:k]
    squared, frames = nearest_frames(features, feature, k)
    assert list(zip(squared.tolist(), frames.tolist(), strict=True)) == want


def test_mean_errors_weigh_sequences_alike():
    errors = np.array([[1, 4], [3, np.inf], [50, 10], [2, 6], [2, 0]], np.float32)
    sequence = np.array([7, 7, 2, 7, 7])
    want = [(30.0 + 8.0 / 4) / 2, (10.0 + 40.0 / 4) / 2]
    np.testing.assert_allclose(mean_errors(errors, sequence), want)


@pytest.mark.parametrize("n_frames", [1, 50])
def test_the_same_scan_again_finds_its_own_frame(n_frames):
    data = random_data(5, n_frames, 5)
    rule = NearestNeighbours(1).fit(data)
    for i in range(0, n_frames, 7):
        np.testing.assert_allclose(
            rule.predict(data.features[i]), np.minimum(data.errors[i], 30.0), rtol=1e-6
        )
