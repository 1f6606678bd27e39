from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from tables import table

from adaptune.metrics import FAILURE
from adaptune.model import BankRule, BankSettings, TrainingData
from adaptune.model.bank_weights import (
    RIDGE,
    SMOOTHING,
    choose_members,
    clip_errors,
    minimum_variance_weights,
    smooth_weights,
)


def places(rng, n_places=6, n=40, n_sets=4):
    """Sets 1 and 2 err in opposite directions, set 3 loses track; places look alike."""
    errors = rng.normal(0.0, 1.0, (n_places * n, n_sets, 3)).astype(np.float32)
    common = rng.normal(0.0, 1.0, (n_places * n, 3))
    errors[:, 1] = common
    errors[:, 2] = -common
    errors[:, 3] = np.inf
    return TrainingData(
        rng.normal(size=(n_places * n, 2)),
        np.repeat(np.arange(n_places), n),
        np.linalg.norm(errors, axis=-1),
        table(np.linspace(0.0, 1.0, n_sets)[:, None]),
        0,
        tuple(range(n_sets)),
        errors,
    )


def test_errors_that_cancel_get_the_weight():
    data = places(np.random.default_rng(0))
    rule = BankRule().fit(data)
    selection = rule.select(data.features[5])
    assert list(selection.weights) == [0, 1, 2, 3]
    weights = list(selection.weights.values())
    np.testing.assert_allclose(weights, [0.0, 0.5, 0.5, 0.0], atol=0.1)
    assert selection.trial in (1, 2)
    assert selection.predicted_error < 0.3 * selection.predicted_fixed
    alone = rule.predict(data.features[5])
    np.testing.assert_allclose(alone[:3], np.sqrt(3.0), rtol=0.1)
    assert alone[3] > 5.0


def test_weights_are_of_the_places_that_are_near():
    """In one kind of place set 1 is right, in the other set 2."""
    rng = np.random.default_rng(1)
    data = places(rng)
    kind = data.sequence % 2
    features = data.features + 20.0 * kind[:, None]
    vectors = data.vectors.copy()
    vectors[kind == 0, 1] *= 0.05
    vectors[kind == 1, 2] *= 0.05
    rule = BankRule(BankSettings(sharpness=24.0)).fit(
        replace(data, features=features, vectors=vectors)
    )
    for k, best in ((0, 1), (1, 2)):
        weights = rule.select(np.array([20.0 * k, 20.0 * k])).weights
        assert weights[best] > 0.85


@pytest.mark.parametrize(
    ("settings", "kept"),
    [
        (BankSettings(min_fixed_share=0.5), 0.5),
        (BankSettings(min_fixed_share=1.0), 1.0),
        (BankSettings(adapt=False), 1.0),
    ],
)
def test_the_fixed_set_keeps_its_minimum_share(settings, kept):
    data = places(np.random.default_rng(2))
    weights = BankRule(settings).fit(data).select(data.features[0]).weights
    assert sum(weights.values()) == pytest.approx(1.0)
    assert weights[0] == pytest.approx(kept, abs=0.05)


def test_in_a_place_unlike_all_others_the_fixed_set_is_kept():
    data = places(np.random.default_rng(3))
    selection = BankRule().fit(data).select(np.array([500.0, 0.0]))
    assert selection.familiarity == 0.0
    assert selection.weights == {0: 1.0, 1: 0.0, 2: 0.0, 3: 0.0}
    assert selection.predicted_error == pytest.approx(selection.predicted_fixed)


def test_a_bank_needs_members():
    data = places(np.random.default_rng(4))
    for lacking in ({"candidates": None}, {"vectors": None}, {"candidates": (1, 0, 2, 3)}):
        with pytest.raises(ValueError, match="needs members, the fixed set first"):
            BankRule().fit(replace(data, **lacking))


@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_the_least_mean_square_of_all_weights(n, seed):
    errors = np.random.default_rng(seed).normal(size=(n, 7))
    squares = errors @ errors.T
    weights = minimum_variance_weights(squares)
    assert weights.sum() == pytest.approx(1.0)
    assert weights.min() >= 0.0
    ridged = squares + np.eye(n) * RIDGE * squares[0, 0]
    found = minimize(
        lambda w: w @ ridged @ w,
        np.full(n, 1.0 / n),
        bounds=[(0.0, 1.0)] * n,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0},
    )
    assert weights @ ridged @ weights <= found.fun * (1.0 + 1e-6)


def test_errors_are_clipped():
    vectors = np.zeros((10, 2, 3), np.float32)
    vectors[:, 0, 0] = 1.0
    vectors[:, 1, 1] = [0.5, 5.0, 7.0, 29.0, 31.0, np.inf, np.nan, 0.0, 6.0, 1.0]
    kept, lost = clip_errors(vectors, 0)
    limit = 6.0 * np.sqrt(1.0 + 0.02**2)
    np.testing.assert_allclose(kept[:, 0], vectors[:, 0])
    expected = [0.5, 5.0, limit, limit, 0.0, 0.0, 0.0, 0.0, 6.0, 1.0]
    np.testing.assert_allclose(kept[:, 1, 1], expected, rtol=1e-6)
    np.testing.assert_allclose(lost[:, 1], [0, 0, 0, 0, limit, limit, limit, 0, 0, 0], rtol=1e-6)
    kept, lost = clip_errors(vectors, 0, 18.0)
    expected = [0.5, 5.0, 7.0, 3.0 * limit, 0.0, 0.0, 0.0, 0.0, 6.0, 1.0]
    np.testing.assert_allclose(kept[:, 1, 1], expected, rtol=1e-6)
    assert lost.max() == pytest.approx(3.0 * limit)
    # A fixed set that fails itself allows others more.
    vectors[:5, 0] = np.inf
    _, lost = clip_errors(vectors, 0)
    assert lost[0, 0] == pytest.approx(6.0 * np.sqrt((5 * FAILURE**2 + 5) / 10), rel=1e-5)


def test_a_bank_is_of_sets_whose_errors_cancel():
    data = places(np.random.default_rng(5))
    vectors = [
        dict(enumerate(np.moveaxis(data.vectors[data.sequence == s], 1, 0))) for s in range(6)
    ]
    errors = [data.errors[data.sequence == s] for s in range(6)]
    sets = data.sets
    assert sorted(choose_members(vectors, errors, sets, 1, 2)) == [1, 2]
    assert len(choose_members(vectors, errors, sets, 1, 9)) == 4
    # What was not run everywhere is no member.
    errors[3][:, 2] = np.nan
    assert sorted(choose_members(vectors, errors, sets, 1, 4)) == [0, 1, 3]


@given(st.integers(1, 20), st.integers(0, 100))
def test_smoothed_weights_are_means_of_the_last(n, seed):
    weights = np.random.default_rng(seed).dirichlet(np.ones(3), n)
    found = smooth_weights(weights, np.ones(n))
    for i in range(n):
        np.testing.assert_allclose(
            found[i], weights[max(0, i + 1 - SMOOTHING) : i + 1].mean(axis=0)
        )
    assert (smooth_weights(np.eye(2)[[0] * n], np.ones(n)) == [1.0, 0.0]).all()


def test_doubt_does_not_wait():
    weights = np.array([[0.0, 0.6, 0.4]] * 4)
    # As they are found there: the more is kept by the fixed set, the less is familiar.
    weights[2], weights[3] = [0.5, 0.3, 0.2], [1.0, 0.0, 0.0]
    found = smooth_weights(weights, np.array([1.0, 0.1, 0.05, 0.0]))
    np.testing.assert_allclose(found[:2], weights[:2])
    np.testing.assert_allclose(found[2], [0.5, 0.3, 0.2])
    np.testing.assert_allclose(found[3], [1.0, 0.0, 0.0], atol=1e-12)


def test_a_lost_track_costs_as_much_as_the_clip():
    data = places(np.random.default_rng(9))
    of = {
        clip: BankRule(BankSettings(clip=clip)).fit(data).predict(data.features[0])
        for clip in (6.0, 18.0)
    }
    np.testing.assert_allclose(of[18.0][3], 3.0 * of[6.0][3], rtol=1e-6)
    np.testing.assert_allclose(of[18.0][:3], of[6.0][:3])
