from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from tables import table

from adaptune.live.hops import HopSquares
from adaptune.metrics import FAILURE
from adaptune.model import BankRule, BankSettings, TrainingData
from adaptune.model.weights import (
    EVEN_SHARE,
    UNFAMILIAR_PRIOR_SHARE,
    bank_weights,
    choose_members,
    clip_errors,
    measured_weights,
    minimum_variance_weights,
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
    np.testing.assert_allclose(weights, [0.0, 0.5, 0.5, 0.0], atol=0.2)
    assert selection.trial in (1, 2)
    assert selection.predicted_error < 0.3 * selection.predicted_fixed


def test_weights_are_of_the_places_that_are_near():
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
    ("of", "kept"),
    [
        (BankSettings(min_fixed_share=0.5), 0.5),
        (BankSettings(min_fixed_share=1.0), 1.0),
    ],
)
def test_the_fixed_set_keeps_its_minimum_share(of, kept, monkeypatch):
    monkeypatch.setattr("adaptune.model.weights.EVEN_SHARE", 0.05)
    data = places(np.random.default_rng(2))
    rule = BankRule(of).fit(data)
    weights = rule.select(data.features[0]).weights
    assert sum(weights.values()) == pytest.approx(1.0)
    assert weights[0] == pytest.approx(kept, abs=0.05)
    # What is measured takes its place: 9 windows next to the prior's 3.
    hops = HopSquares(np.diag([100.0, 1.0, 1.0, 100.0]), 0.0, 9.0)
    weights = rule.weigh(rule.near(data.features[0][None]), hops).weights
    assert weights[0] == pytest.approx(kept / 4.0, abs=0.05)


def test_in_a_place_unlike_all_others_what_is_measured_counts_for_more(monkeypatch):
    monkeypatch.setattr("adaptune.model.weights.EVEN_SHARE", 0.05)
    data = places(np.random.default_rng(3))
    rule = BankRule().fit(data)
    # The training says 1 and 2; driving says 0.
    hops = HopSquares(np.diag([1.0, 4.0, 4.0, 4.0]), 0.0, 3.0)
    known, new = data.features[5], np.array([500.0, 0.0])
    (near,) = rule.near(new[None]).frames.trust
    assert near == 0.0
    assert rule.select(new).similarity == 0.0
    assert (
        rule.weigh(rule.near(new[None]), hops).weights[0]
        > rule.weigh(rule.near(known[None]), hops).weights[0] + 0.1
    )
    # Without measurements, the fixed set is the best guess.
    assert rule.select(known).weights[0] < 0.1
    assert max(rule.select(new).weights.items(), key=lambda item: item[1])[0] == 0
    # As many windows as the prior has there: half and half.
    few = hops._replace(windows=UNFAMILIAR_PRIOR_SHARE * rule.settings.prior_windows)
    (found,), _ = bank_weights(rule.near(new[None]), rule.settings, [few])
    assert found[0] == pytest.approx(rule.weigh(rule.near(new[None]), few).weights[0])


def test_many_windows_overrule_the_training(monkeypatch):
    monkeypatch.setattr("adaptune.model.weights.EVEN_SHARE", 0.0)
    data = places(np.random.default_rng(6))
    rule = BankRule().fit(data)
    hops = HopSquares(np.diag([100.0, 100.0, 100.0, 1.0]), 0.0, 1e4)
    assert rule.weigh(rule.near(data.features[0][None]), hops).weights[3] > 0.9
    assert (
        rule.weigh(rule.near(data.features[0][None]), hops._replace(windows=1e-3)).weights[3] < 0.1
    )
    # The registrations' own part, which all share, changes nothing.
    shifted = hops._replace(products=hops.products + 0.2, noise=0.2)
    found, plain = (
        rule.weigh(rule.near(data.features[0][None]), one).weights for one in (shifted, hops)
    )
    np.testing.assert_allclose(list(found.values()), list(plain.values()), atol=1e-5)


def test_without_training_the_first_member_has_the_weight_until_others_are_confirmed():
    assert measured_weights(3, None).tolist() == [1.0, 0.0, 0.0]
    alike = measured_weights(3, HopSquares(np.eye(3), 0.0, 3.0))
    assert alike[0] > alike[1] == pytest.approx(alike[2])
    many = measured_weights(3, HopSquares(np.diag([100.0, 1.0, 1.0]), 0.0, 30.0))
    assert many[0] < 0.1


@settings(deadline=None)
@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_the_least_mean_square_of_all_weights(n, seed):
    errors = np.random.default_rng(seed).normal(size=(n, 7))
    squares = errors @ errors.T
    weights = minimum_variance_weights(squares)
    assert weights.sum() == pytest.approx(1.0)
    assert weights.min() >= 0.0
    harmonic = 1.0 / (1.0 / squares.diagonal()).mean()
    ridged = squares + np.eye(n) * EVEN_SHARE * harmonic
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
    kept, lost = clip_errors(vectors, 6.0)
    limit = 6.0 * np.sqrt(1.0 + 0.02**2)
    np.testing.assert_allclose(kept[:, 0], vectors[:, 0])
    expected = [0.5, 5.0, limit, limit, 0.0, 0.0, 0.0, 0.0, 6.0, 1.0]
    np.testing.assert_allclose(kept[:, 1, 1], expected, rtol=1e-6)
    np.testing.assert_allclose(lost[:, 1], [0, 0, 0, 0, limit, limit, limit, 0, 0, 0], rtol=1e-6)
    kept, lost = clip_errors(vectors, 18.0)
    expected = [0.5, 5.0, 7.0, 3.0 * limit, 0.0, 0.0, 0.0, 0.0, 6.0, 1.0]
    np.testing.assert_allclose(kept[:, 1, 1], expected, rtol=1e-6)
    assert lost.max() == pytest.approx(3.0 * limit)
    # A fixed set that fails itself allows others more.
    vectors[:5, 0] = np.inf
    _, lost = clip_errors(vectors, 6.0)
    assert lost[0, 0] == pytest.approx(6.0 * np.sqrt((5 * FAILURE**2 + 5) / 10), rel=1e-5)


def test_a_bank_is_of_sets_whose_errors_cancel():
    data = places(np.random.default_rng(5))
    vectors = data.vectors[:, [1, 0, 2, 3]]
    assert choose_members(vectors, data.sequence, [1, 0, 2, 3], 2) == [1, 2]
    assert len(choose_members(vectors, data.sequence, [1, 0, 2, 3], 9)) == 4


def test_members_that_rest_have_no_weight_and_change_nothing():
    rng = np.random.default_rng(3)
    data = places(rng)
    few = replace(data, candidates=(0, 1), vectors=data.vectors[:, :2])
    rule, of_two = BankRule().fit(data), BankRule().fit(few)
    near = rule.near(data.features[:1])
    some = rule.weigh(near.of((0, 1)), None)
    alone = of_two.weigh(of_two.near(data.features[:1]), None)
    assert list(some.weights) == list(data.candidates)
    assert list(some.weights.values())[:2] == pytest.approx(list(alone.weights.values()))
    assert list(some.weights.values())[2:] == [0.0, 0.0]
    assert some.predicted_error == pytest.approx(alone.predicted_error)
    assert some.predicted_fixed == pytest.approx(rule.predicted_fixed(near))
