from dataclasses import replace

import numpy as np

from adaptune.model import ErrorModel, Settings, portfolio, restrict
from adaptune.space import Float, ParameterSpace


def model(errors, sequence, fixed):
    space = ParameterSpace({"x": Float(low=0.0, high=10.0, baseline=1.0)})
    return ErrorModel(
        odometry={},
        space=space,
        sets=[{"x": float(j)} for j in range(len(errors[0]))],
        fixed=fixed,
        length=10.0,
        sequences=["a", "b"],
        blocks={"ndt": 1},
        window=1,
        descriptors=np.zeros((len(errors), 1), np.float32),
        sequence=np.array(sequence, np.intp),
        errors=np.array(errors, np.float32),
        provenance={},
    )


def test_the_next_set_is_good_where_those_before_are_not():
    errors = [
        # fixed, as good elsewhere, good where fixed is bad, a little better everywhere
        [1.0, 1.0, 9.0, 0.9],
        [1.0, 1.0, 9.0, 0.9],
        [8.0, 8.0, 1.0, 7.5],
        [np.inf, np.inf, 1.0, np.inf],
    ]
    of = model(errors, [0, 0, 0, 1], fixed=0)
    assert portfolio(of, 2) == [0, 2]
    assert portfolio(of, 3) == [0, 2, 3]
    # The second one adds nothing at all.
    assert portfolio(of, 4) == [0, 2, 3]


def test_sequences_weigh_the_same_however_long():
    errors = [[5.0, 4.0, 5.0]] * 9 + [[5.0, 5.0, 3.0]]
    assert portfolio(model(errors, [0] * 9 + [1], 0), 2) == [0, 2]


def test_a_failure_counts_as_much_as_everywhere():
    errors = [[40.0, 31.0, 40.0], [5.0, 5.0, 4.5]]
    assert portfolio(model(errors, [0, 1], 0), 2) == [0, 2]


def test_a_model_of_some_sets():
    of = model([[1.0, 2.0, 3.0], [4.0, 5.0, np.inf]], [0, 1], fixed=1)
    few = restrict(of, [1, 2])
    few.check()
    assert few.sets == [{"x": 1.0}, {"x": 2.0}]
    assert few.fixed == 0
    np.testing.assert_array_equal(few.errors, [[2.0, 3.0], [5.0, np.inf]])
    # All of them may be chosen, unless nothing but the fixed one is to be.
    assert few.paired.n_sets is None
    kept = replace(of, paired=Settings(n_sets=1))
    assert restrict(kept, [1, 2]).paired.n_sets == 1
