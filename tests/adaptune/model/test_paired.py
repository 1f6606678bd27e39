"""Selection by the paired expected ratio."""

import math
import statistics

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptune.model import RULES, PairedExpectedRatio, TrainingData

modest = settings(max_examples=30, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def random_data(seed, n_frames, n_sets, n_sequences=3, n_features=3, n_parameters=2):
    rng = np.random.default_rng(seed)
    errors = rng.gamma(1.0, 2.0, (n_frames, n_sets)).astype(np.float32)
    errors[rng.random(errors.shape) < 0.05] = np.inf
    sequence = np.concatenate(
        [np.arange(n_sequences), rng.integers(0, n_sequences, n_frames - n_sequences)]
    )
    return TrainingData(
        rng.normal(size=(n_frames, n_features)),
        sequence,
        errors,
        rng.random((n_sets, n_parameters)),
        int(rng.integers(n_sets)),
    )


def plain_ratios(data, feature, m, h, tau):
    """Expected ratio of every set, and the fixed set's expected error, in plain loops."""
    n_sets = len(data.sets)

    def error(i, j):
        return min(float(data.errors[i, j]), 30.0)

    distances, ratios, fixed = [], [], []
    for s in sorted(set(data.sequence.tolist())):
        frames = [i for i in range(len(data.features)) if data.sequence[i] == s]
        frames.sort(key=lambda i: (math.dist(data.features[i], feature), i))
        frames = frames[:m]
        n = len(frames)
        distances.append(sum(math.dist(data.features[i], feature) ** 2 for i in frames) / n)
        ratios.append(
            [
                sum((error(i, j) + 0.02) / (error(i, data.fixed) + 0.02) for i in frames) / n
                for j in range(n_sets)
            ]
        )
        fixed.append(sum(error(i, data.fixed) for i in frames) / n)
    middle = statistics.median(distances)
    weights = [math.exp(-tau * (a - min(distances)) / middle) for a in distances]
    weights = [w / sum(weights) for w in weights]
    mixed = [sum(w * r[j] for w, r in zip(weights, ratios, strict=True)) for j in range(n_sets)]
    smooth = []
    for j in range(n_sets):
        kernel = [
            math.exp(-0.5 * math.dist(data.sets[j], data.sets[l]) ** 2 / h**2)
            for l in range(n_sets)  # noqa: E741
        ]
        smooth.append(sum(k * r for k, r in zip(kernel, mixed, strict=True)) / sum(kernel))
    return smooth, sum(w * f for w, f in zip(weights, fixed, strict=True))


@modest
@given(
    seeds,
    st.integers(4, 60),
    st.integers(1, 8),
    st.integers(1, 4),
    st.sampled_from([(30, 0.12, 3.0), (5, 0.5, 1.0), (1, 0.01, 10.0)]),
)
def test_it_follows_its_definition(seed, n_frames, n_sets, n_sequences, constants):
    data = random_data(seed, n_frames, n_sets, n_sequences)
    rule = PairedExpectedRatio(*constants).fit(data)
    for feature in np.random.default_rng(seed).normal(size=(3, 3)):
        ratio, fixed = plain_ratios(data, feature, *constants)
        np.testing.assert_allclose(rule.predict(feature), np.multiply(ratio, fixed), rtol=1e-6)
        best = int(np.argmin(ratio))
        selection = rule.select(feature)
        assert selection.predicted_fixed == pytest.approx(fixed, rel=1e-6)
        if math.log(ratio[best]) < -0.1:
            assert selection.set_index == best
            assert selection.predicted_error == pytest.approx(ratio[best] * fixed, rel=1e-6)
        else:
            assert selection.set_index == data.fixed
            assert selection.predicted_error == pytest.approx(fixed, rel=1e-6)


def test_its_constants():
    rule = PairedExpectedRatio()
    assert (rule.n_frames, rule.width, rule.sharpness, rule.threshold) == (30, 0.12, 3.0, -0.1)
    assert next(iter(RULES)) == "paired"
    assert RULES["paired"] is PairedExpectedRatio


def two_sets(fixed, other, n=40):
    """One sequence on which a set far from the fixed one has these errors."""
    errors = np.tile(np.array([[fixed, other]], np.float32), (n, 1))
    return TrainingData(
        np.random.default_rng(0).normal(size=(n, 2)),
        np.zeros(n, int),
        errors,
        np.array([[0.0, 0.0], [1.0, 1.0]]),
        0,
    )


@pytest.mark.parametrize(
    ("fixed", "other", "chosen"),
    [
        (1.0, 0.5, 1),
        (1.0, 0.9, 1),  # ln((0.9 + 0.02) / (1 + 0.02)) = -0.103
        (1.0, 0.91, 0),  # -0.092
        (1.0, 2.0, 0),
        (0.05, 0.0, 1),
        (0.001, 0.0, 0),
        (np.inf, 29.0, 0),
        (np.inf, 20.0, 1),
        (np.inf, np.inf, 0),
        (0.0, 0.0, 0),
    ],
)
def test_a_set_must_promise_enough(fixed, other, chosen):
    selection = PairedExpectedRatio().fit(two_sets(fixed, other)).select(np.zeros(2))
    assert selection.set_index == chosen
    assert selection.predicted_fixed == pytest.approx(min(fixed, 30.0), rel=1e-6)


def test_a_rare_failure_weighs_as_much_as_it_costs():
    data = two_sets(1.0, 0.5, n=30)
    assert PairedExpectedRatio().fit(data).select(np.zeros(2)).set_index == 1
    data.errors[4, 1] = np.inf
    # One of 30 fails: (29 * 0.52 + 30.02) / 30 / 1.02 = 1.47.
    assert PairedExpectedRatio().fit(data).select(np.zeros(2)).set_index == 0


def test_what_is_hard_for_all_cancels_out():
    data = two_sets(1.0, 0.5, n=30)
    data.errors[:10] = [29.0, 28.0]
    # By their means over the frames, the sets would differ by 4 %.
    assert PairedExpectedRatio().fit(data).select(np.zeros(2)).set_index == 1


def test_near_sequences_count_more():
    n = 40
    rng = np.random.default_rng(0)
    near, far = rng.normal(0, 0.1, (n, 2)), rng.normal(6, 0.1, (n, 2))
    errors = np.ones((2 * n, 2), np.float32)
    errors[:n, 1], errors[n:, 1] = 0.5, 3.0
    data = TrainingData(
        np.concatenate([near, far]),
        np.repeat([0, 1], n),
        errors,
        np.array([[0.0, 0.0], [1.0, 1.0]]),
        0,
    )
    rule = PairedExpectedRatio().fit(data)
    assert rule.select(np.zeros(2)).set_index == 1
    assert rule.select(np.full(2, 6.0)).set_index == 0


def test_neighbouring_sets_share_their_evidence():
    errors = np.tile(np.array([[1.0, 0.4, 5.0, 0.5, 0.5, 0.5]], np.float32), (30, 1))
    sets = np.array([[0.0, 0.0], [0.5, 0.5], [0.55, 0.5], [0.9, 0.9], [0.9, 0.95], [0.95, 0.9]])
    data = TrainingData(np.zeros((30, 2)), np.zeros(30, int), errors, sets, 0)
    # Set 1 is the best by itself, but next to a cliff.
    assert PairedExpectedRatio().fit(data).select(np.zeros(2)).set_index in {3, 4, 5}


def test_a_scan_from_nowhere_gets_an_answer():
    data = random_data(1, 60, 5)
    selection = PairedExpectedRatio().fit(data).select(np.full(3, 1e6))
    assert 0 <= selection.set_index < 5
    assert np.isfinite(selection.predicted_error)


def test_all_frames_at_one_place():
    data = two_sets(1.0, 0.5)
    data.features[:] = 0.0
    assert PairedExpectedRatio().fit(data).select(np.zeros(2)).set_index == 1
