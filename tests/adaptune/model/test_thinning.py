import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptune.model import ErrorModel, thin
from adaptune.model.thinning import _cover
from adaptune.space import Float, ParameterSpace

SPACE = ParameterSpace({"x": Float(low=0.0, high=10.0, baseline=1.0)})


def model(descriptors, sequence):
    n = len(descriptors)
    return ErrorModel(
        odometry={},
        space=SPACE,
        sets=[{"x": 1.0}, {"x": 2.0}],
        fixed=0,
        length=10.0,
        sequences=["a", "b"],
        blocks={"mine": np.shape(descriptors)[1]},
        window=1,
        descriptors=np.asarray(descriptors, np.float32),
        sequence=np.asarray(sequence, np.intp),
        errors=np.arange(2 * n, dtype=np.float32).reshape(n, 2),
        provenance={},
    )


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.integers(1, 40))
def test_each_next_frame_is_the_farthest_from_those_before(seed, n, k):
    k = min(k, n)
    X = np.random.default_rng(seed).normal(size=(n, 3))
    chosen = _cover(X, k)
    assert chosen[0] == np.argmin(((X - X.mean(axis=0)) ** 2).sum(axis=1))
    for i in range(1, k):
        before = ((X[:, None] - X[chosen[:i]]) ** 2).sum(axis=2).min(axis=1)
        assert before[chosen[i]] == pytest.approx(before.max())
    assert len(set(chosen.tolist())) == k


def test_what_looks_rare_is_kept():
    descriptors = np.random.default_rng(0).normal(0.0, 0.01, (200, 4))
    descriptors[70] += 5.0
    descriptors[150] -= 5.0
    few = thin(model(descriptors, [0] * 100 + [1] * 100), 6)
    few.check()
    assert len(few.sequence) == 6
    assert few.sequence.tolist() == [0] * 3 + [1] * 3
    kept = few.errors[:, 0] / 2
    assert {70, 150} < set(kept.tolist())
    np.testing.assert_array_equal(few.descriptors, descriptors[kept.astype(int)].astype(np.float32))


def test_a_short_sequence_keeps_a_frame():
    few = thin(model(np.random.default_rng(1).normal(size=(101, 4)), [0] * 100 + [1]), 10)
    assert few.sequence.tolist() == [0] * 9 + [1]


def test_few_frames_are_left_alone():
    whole = model(np.zeros((5, 2)), [0] * 5)
    assert thin(whole, 5) is whole
