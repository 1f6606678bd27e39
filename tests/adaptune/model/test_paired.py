import math
import statistics
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tables import table

from adaptune.model import PairedExpectedRatio, PairedSettings, TrainingData, rules
from adaptune.model.rules import complementary

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


def plain_familiarity(data, distance, m):
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


def plain_ratios(data, feature, m, h, tau, c):
    """Of every set the expected ratio and the cautious one, and the fixed set's expected error."""
    names = sorted(set(data.sequence.tolist()))
    distances, means, fixed = plain_evidence(data, feature, m, names)
    ratios = [[(y + 0.02) / (f + 0.02) for y in of] for of, f in zip(means, fixed, strict=True)]
    # In the very same place as most sequences, distances count as they are.
    middle = statistics.median(distances) or 1.0
    weights = [math.exp(-tau * (a - min(distances)) / middle) for a in distances]
    weights = [w / sum(weights) for w in weights]
    familiar = min(1.0, plain_familiarity(data, min(distances), m) / 0.1)
    expected, cautious = [], []
    for of_set in data.sets.unit:
        kernel = [math.exp(-0.5 * math.dist(of_set, x) ** 2 / h**2) for x in data.sets.unit]
        smooth = [
            sum(k * r for k, r in zip(kernel, of, strict=True)) / sum(kernel) for of in ratios
        ]
        mean = sum(w * r for w, r in zip(weights, smooth, strict=True))
        variance = sum(w * (r - mean) ** 2 for w, r in zip(weights, smooth, strict=True))
        share = sum(w * w for w in weights)
        of_all = statistics.pvariance(smooth)
        error = math.sqrt(share * (variance + share * of_all))
        expected.append(1.0 + familiar * (mean - 1.0))
        cautious.append(1.0 + familiar * (mean + c * error - 1.0))
    return expected, cautious, sum(w * f for w, f in zip(weights, fixed, strict=True))


def among_all(data):
    return replace(data, candidates=data.sets.trials)


def ratios(rule, feature):
    """Expected ratio of each candidate."""
    (expected,), *_ = rule._ratios(rule.near(feature[None]), rule.settings.sharpness)
    return expected[: len(rule.candidates_)]


@modest
@given(
    seeds,
    st.integers(4, 60),
    st.integers(1, 8),
    st.integers(1, 4),
    st.sampled_from([(30, 0.12, 3.0, 0.5), (5, 0.5, 1.0, 2.0), (1, 0.01, 10.0, 0.0)]),
)
def test_it_follows_its_definition(seed, n_frames, n_sets, n_sequences, constants):
    data = random_data(seed, n_frames, n_sets, n_sequences)
    m, h, tau, c = constants
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("N_FRAMES", m), ("WIDTH", h), ("CAUTION", c)):
            patch.setattr(rules, name, value)
        check_definition(data, seed, constants, PairedSettings(sharpness=tau))


def check_definition(data, seed, constants, settings):
    rule = PairedExpectedRatio(settings).fit(among_all(data))
    names = sorted(set(data.sequence.tolist()))
    # Beyond all training, too.
    for feature in (*np.random.default_rng(seed).normal(size=(3, 3)), np.full(3, 50.0)):
        expected, cautious, fixed = plain_ratios(data, feature, *constants)
        expected[data.fixed] = cautious[data.fixed] = 1.0
        np.testing.assert_allclose(ratios(rule, feature), expected, rtol=1e-5)
        best = int(np.argmin(cautious))
        selection = rule.select(feature)
        distances, *_ = plain_evidence(data, feature, constants[0], names)
        familiarity = plain_familiarity(data, min(distances), constants[0])
        # Among one sequence alone it is unknown.
        of_several = familiarity if len(names) > 1 else np.nan
        assert selection.familiarity == pytest.approx(of_several, nan_ok=True)
        assert selection.predicted_fixed == pytest.approx(fixed, rel=1e-6)
        chosen = best if math.log(cautious[best]) < -0.1 else data.fixed
        assert selection.trial == chosen
        assert selection.predicted_error == pytest.approx(expected[chosen] * fixed, rel=1e-5)


@modest
@given(seeds, st.integers(10, 60), st.integers(2, 8), st.integers(1, 4))
def test_it_chooses_among_complementary_sets(seed, n_frames, n_sets, n_sequences):
    data = random_data(seed, n_frames, n_sets, n_sequences)
    few = complementary(data, 2)
    rule = PairedExpectedRatio(PairedSettings(n_sets=2)).fit(data)
    assert rule.candidates_ == tuple(few)
    assert rule.select(np.zeros(3)).trial in few
    fixed = PairedExpectedRatio(PairedSettings(adapt=False)).fit(data)
    assert fixed.select(np.zeros(3)).trial == data.fixed


@modest
@given(seeds, st.integers(10, 60), st.integers(3, 8))
def test_it_chooses_among_those_named_on_the_evidence_of_all(seed, n_frames, n_sets):
    data = random_data(seed, n_frames, n_sets)
    named = (data.fixed, (data.fixed + 2) % n_sets)
    of_all = ratios(PairedExpectedRatio().fit(among_all(data)), np.zeros(3))
    few = PairedExpectedRatio().fit(replace(data, candidates=named))
    # Sets beside them are still heeded.
    np.testing.assert_allclose(ratios(few, np.zeros(3)), of_all[[*named]], rtol=1e-5)
    assert few.select(np.zeros(3)).trial in named


def test_a_sequence_says_nothing_of_sets_it_has_not_seen():
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
    rule = PairedExpectedRatio().fit(replace(data, candidates=(0, 1, 2)))
    # Half of the evidence, of 0.52 / 1.02, and half of 1; against 0.62 / 1.02 on all of it.
    np.testing.assert_allclose(
        ratios(rule, np.zeros(2)), [1.0, 0.5 * (0.52 / 1.02 + 1.0), 0.62 / 1.02], rtol=1e-6
    )
    assert rule.select(np.zeros(2)).trial == 2
