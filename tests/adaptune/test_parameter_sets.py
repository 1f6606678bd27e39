import numpy as np
from tables import table


def test_sets_are_known_by_their_trials():
    sets = table([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]], (0, 4, 7))
    assert list(sets) == [0, 4, 7]
    assert len(sets) == 3
    assert sets[4] == {"p0": 0.3, "p1": 0.4}
    assert 7 in sets
    assert 1 not in sets
    assert sets.column(7) == 2
    assert sets.columns([7, 0]).tolist() == [2, 0]
    np.testing.assert_allclose(sets.unit, [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    few = sets.subset([7, 0])
    assert (few.trials, few[0]) == ((7, 0), {"p0": 0.1, "p1": 0.2})
    np.testing.assert_allclose(few.unit, sets.unit[[2, 0]])


def test_a_set_is_found_by_what_differs_from_the_baseline():
    sets = table([[0.5, 0.2], [0.3, 0.5], [0.3, 0.5]], (1, 2, 3))
    assert sets.find({"p1": 0.2}) == 1
    assert sets.find({"p0": 0.3}) == 2
    assert sets.find({"p0": 0.4}) is None
