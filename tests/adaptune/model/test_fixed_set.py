import math
import statistics
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tables import table

from adaptune.model import FixedSet, TrainingData, rules
from adaptune.model.rules import Evidence, complementary

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
        table(rng.random((n_sets, n_parameters))),
        int(rng.integers(n_sets)),
    )


def plain_evidence(data, feature, m, sequences):
    """For each sequence: distance, mean errors of all sets, and of the fixed one, in loops."""

    def error(i, j):
        return min(float(data.errors[i, j]), 30.0)

    distances, means, fixed = [], [], []
    for s in sequences:
        frames = [i for i in range(len(data.features)) if data.sequence[i] == s]
        frames.sort(key=lambda i: (math.dist(data.features[i], feature), i))
        frames = frames[:m]
        n = len(frames)
        distances.append(sum(math.dist(data.features[i], feature) ** 2 for i in frames) / n)
        means.append([sum(error(i, j) for i in frames) / n for j in range(len(data.sets))])
        fixed.append(sum(error(i, data.fixed) for i in frames) / n)
    return distances, means, fixed


def plain_similarity(data, distance, m):
    """Share of training that is farther from other sequences than `distance`, in loops."""
    names = sorted(set(data.sequence.tolist()))
    if len(names) < 2:
        return 1.0
    far = []
    for s in names:
        own = [x for x, of in zip(data.features, data.sequence, strict=True) if of == s]
        others = [o for o in names if o != s]
        some = own[:: max(1, len(own) // 10)]
        nearest = [min(plain_evidence(data, x, m, others)[0]) for x in some]
        far.extend(np.quantile(nearest, [(q + 0.5) / 10 for q in range(10)]))
    return sum(f >= distance for f in far) / len(far)


def plain_predicted(data, feature, m, sharpness):
    """Expected errors of the fixed set and of the baseline, in loops."""
    names = sorted(set(data.sequence.tolist()))
    distances, means, fixed = plain_evidence(data, feature, m, names)
    # In the very same place as most sequences, distances count as they are.
    middle = statistics.median(distances) or 1.0
    weights = [math.exp(-sharpness * (a - min(distances)) / middle) for a in distances]
    expected = sum(w * f for w, f in zip(weights, fixed, strict=True)) / sum(weights)
    baseline = sum(w * of[0] for w, of in zip(weights, means, strict=True)) / sum(weights)
    familiar = min(1.0, plain_similarity(data, min(distances), m) / 0.1)
    return expected, expected + familiar * (baseline - expected)


@modest
@given(
    seeds,
    st.integers(4, 60),
    st.integers(1, 8),
    st.integers(1, 4),
    st.sampled_from([(30, 3.0), (5, 1.0), (1, 10.0)]),
)
def test_it_follows_its_definition(seed, n_frames, n_sets, n_sequences, constants):
    data = random_data(seed, n_frames, n_sets, n_sequences)
    names = sorted(set(data.sequence.tolist()))
    with pytest.MonkeyPatch.context() as patch:
        for name, value in zip(("N_FRAMES", "SHARPNESS"), constants, strict=True):
            patch.setattr(rules, name, value)
        rule = FixedSet().fit(data)
        # Beyond all training, too.
        for feature in (*np.random.default_rng(seed).normal(size=(3, 3)), np.full(3, 50.0)):
            fixed, baseline = plain_predicted(data, feature, *constants)
            selection = rule.select(feature)
            assert selection.trial == data.fixed
            assert selection.predicted_error == selection.predicted_fixed
            assert selection.predicted_fixed == pytest.approx(fixed, rel=1e-5)
            distances, *_ = plain_evidence(data, feature, constants[0], names)
            similarity = plain_similarity(data, min(distances), constants[0])
            # Among one sequence alone it is unknown.
            of_several = similarity if len(names) > 1 else np.nan
            assert selection.similarity == pytest.approx(of_several, nan_ok=True)
            # Nothing is worse than what was measured.
            selection = rule.select(feature, Evidence(lambda: {data.fixed: 31.0}))
            assert selection.trial == 0
            assert selection.predicted_error == pytest.approx(baseline, rel=1e-5)


def test_the_baseline_counts_where_it_was_run_everywhere_and_is_allowed():
    data = replace(random_data(0, 20, 3), fixed=2)
    worse = Evidence(lambda: {2: 31.0})
    assert FixedSet().fit(data).select(np.zeros(3), worse).trial == 0
    assert FixedSet().fit(replace(data, allowed=(1, 2))).select(np.zeros(3), worse).trial == 2
    errors = data.errors.copy()
    errors[data.sequence == 1, 0] = np.nan
    assert FixedSet().fit(replace(data, errors=errors)).select(np.zeros(3), worse).trial == 2


def test_a_set_that_was_not_run_everywhere_is_not_complementary():
    n = 40
    errors = np.ones((2 * n, 3), np.float32)
    errors[:n, 1], errors[n:, 1] = 0.5, np.nan
    errors[:n, 2], errors[n:, 2] = 0.6, 0.6
    data = TrainingData(
        np.zeros((2 * n, 2)),
        np.repeat([0, 1], n),
        errors,
        table([[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
        0,
    )
    assert complementary(data, 3) == [0, 2]
