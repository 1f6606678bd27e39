import numpy as np
from tables import table

from adaptune.model.rules import TrainingData, complementary


def chosen(errors, sequence, size):
    errors, sequence = np.array(errors, np.float32), np.array(sequence)
    sets = table(np.zeros((errors.shape[1], 1)))
    return complementary(TrainingData(np.zeros((len(errors), 1)), sequence, errors, sets, 0), size)


def test_the_next_set_is_good_where_those_before_are_not():
    errors = [
        # fixed, as good elsewhere, good where fixed is bad, a little better everywhere
        [1.0, 1.0, 9.0, 0.9],
        [1.0, 1.0, 9.0, 0.9],
        [8.0, 8.0, 1.0, 7.5],
        [np.inf, np.inf, 1.0, np.inf],
    ]
    sequence = [0, 0, 0, 1]
    assert chosen(errors, sequence, 2) == [0, 2]
    assert chosen(errors, sequence, 3) == [0, 2, 3]
    # The second one adds nothing at all.
    assert chosen(errors, sequence, 4) == [0, 2, 3]


def test_sequences_weigh_the_same_however_long():
    errors = [[5.0, 4.0, 5.0]] * 9 + [[5.0, 5.0, 3.0]]
    assert chosen(errors, [0] * 9 + [1], 2) == [0, 2]


def test_a_set_that_was_not_run_everywhere_is_not_chosen():
    nan = np.nan
    errors = [[5.0, 1.0, 4.0, 0.5], [5.0, nan, 4.0, 0.6], [9.0, 1.0, 9.0, nan]]
    assert chosen(errors, [0, 0, 1], 4) == [0, 1, 2]
