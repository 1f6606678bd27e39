import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.neighbors import KNeighborsRegressor
from sklearn.utils.estimator_checks import parametrize_with_checks
from tables import table

from adaptune.model import TrainingData
from adaptune.model.knn import NearestNeighbours, ProductKNeighborsRegressor

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
        table(rng.random((n_sets, n_parameters))),
        int(rng.integers(n_sets)),
    )


def regressor(data, k):
    """The same on rows for all pairs of a frame and a set; returns its prediction."""
    n_frames, n_sets = data.errors.shape
    scale = data.sets.unit.std(axis=0).mean()
    rows = np.hstack(
        [np.repeat(data.features, n_sets, axis=0), np.tile(data.sets.unit / scale, (n_frames, 1))]
    )
    targets = np.minimum(data.errors.astype(float), 30.0).ravel()
    fitted = KNeighborsRegressor(k, algorithm="brute").fit(rows, targets)

    def predict(feature):
        return fitted.predict(np.hstack([np.tile(feature, (n_sets, 1)), data.sets.unit / scale]))

    return predict


@modest
@given(seeds, st.integers(1, 30), st.integers(2, 12), st.integers(1, 8))
def test_predictions_are_those_of_a_regressor_on_all_pairs(seed, n_frames, n_sets, k):
    k = min(k, n_frames * n_sets)
    data = random_data(seed, n_frames, n_sets)
    rule, want = NearestNeighbours(k).fit(data), regressor(data, k)
    for feature in np.random.default_rng(seed).normal(size=(3, 4)):
        np.testing.assert_allclose(rule.predict(feature), want(feature), rtol=1e-6)


@modest
@given(seeds)
def test_the_least_prediction_is_chosen(seed):
    data = random_data(seed, 25, 9)
    rule = NearestNeighbours().fit(data)
    feature = np.random.default_rng(seed).normal(size=4)
    predicted = rule.predict(feature)
    selection = rule.select(feature)
    assert selection.trial == predicted.argmin()
    assert selection.predicted_error == predicted.min()
    assert selection.predicted_fixed == predicted[data.fixed]
    assert isinstance(selection.trial, int)


@parametrize_with_checks([ProductKNeighborsRegressor()])
def test_it_is_a_regressor_of_scikit_learn(estimator, check):
    check(estimator)


def product(seed, n_frames, n_sets, missing, whole=False):
    """Frames, sets, and targets of which some are missing: of any pair, or sequence by sequence."""
    rng = np.random.default_rng(seed)
    targets = rng.normal(size=(n_frames, n_sets))
    if missing == "pairs":
        targets[rng.random(targets.shape) < 0.4] = np.nan
    elif missing == "blocks":
        sequence = rng.integers(0, 3, n_frames)
        targets[(rng.random((3, n_sets)) < 0.5)[sequence]] = np.nan
    targets[rng.integers(n_frames), rng.integers(n_sets)] = 1.0

    def draw(n, m):
        # Whole numbers are often at the same distance, which is then exact.
        return rng.integers(0, 3, (n, m)).astype(float) if whole else rng.normal(size=(n, m))

    return draw(n_frames, 3), draw(n_sets, 2), targets, draw(4, 3)


def pairs(frames, sets, targets):
    """A row and a target for every pair that was run."""
    i, j = np.nonzero(~np.isnan(targets))
    return np.hstack([frames[i], sets[j]]), targets[i, j]


shapes = st.tuples(
    seeds, st.integers(1, 25), st.integers(1, 9), st.sampled_from(["none", "pairs", "blocks"])
)


@modest
@given(shapes, st.integers(1, 8))
def test_pairs_that_were_never_run_are_no_neighbours(shape, k):
    frames, sets, targets, queries = product(*shape)
    rows, y = pairs(frames, sets, targets)
    want = KNeighborsRegressor(min(k, len(y)), algorithm="kd_tree").fit(rows, y)
    regressor = ProductKNeighborsRegressor(sets, k).fit(frames, targets)
    predicted = regressor.predict(queries)
    assert predicted.shape == (len(queries), len(sets))
    for query, of_query in zip(queries, predicted, strict=True):
        asked = np.hstack([np.tile(query, (len(sets), 1)), sets])
        np.testing.assert_allclose(of_query, want.predict(asked), rtol=1e-9, atol=1e-12)


@modest
@given(shapes, st.integers(1, 8))
def test_ties_fall_to_the_nearer_frame_then_to_the_earlier_pair(shape, k):
    frames, sets, targets, queries = product(*shape, whole=True)
    predicted = ProductKNeighborsRegressor(sets, k).fit(frames, targets).predict(queries)
    for query, of_query in zip(queries, predicted, strict=True):
        near = ((frames - query) ** 2).sum(axis=1)
        for j, s in enumerate(sets):
            known = sorted(
                (near[i] + ((sets[m] - s) ** 2).sum(), near[i], i, m)
                for i, m in zip(*np.nonzero(~np.isnan(targets)), strict=True)
            )
            want = np.mean([targets[i, m] for *_, i, m in known[:k]])
            assert of_query[j] == pytest.approx(want, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("sets", "y", "k", "message"),
    [
        (np.zeros((2, 1)), np.zeros((3, 4)), 5, "2 sets, and targets of 4"),
        (np.zeros((4, 1)), np.zeros((2, 4)), 5, "3 frames, y has 2"),
        (np.zeros((4, 1)), np.full((3, 4), np.nan), 5, "no target"),
        (np.zeros((4, 1)), np.full((3, 4), np.inf), 5, "infinity"),
        (np.full((4, 1), np.nan), np.zeros((3, 4)), 5, "NaN"),
        (np.zeros((4, 1)), np.zeros((3, 4)), 0, "n_neighbors"),
    ],
)
def test_what_does_not_go_together_is_refused(sets, y, k, message):
    with pytest.raises(ValueError, match=message):
        ProductKNeighborsRegressor(sets, k).fit(np.zeros((3, 2)), y)
