import numpy as np
import pytest
from random_models import random_model

from adaptune.odometry.base import Motions
from adaptune.recording.scan import Scan
from online.modes import EvenSelector, RandomSelector, random_seed

SETS = random_model().sets
MEMBERS = (4, 10, 2)


def chosen(selector, n=200):
    made = []
    for stamp in range(n):
        selector.observe(stamp, Scan(stamp, np.ones((5, 3), np.float32)), Motions(np.eye(4), {}))
        made.append(selector.select())
        selector.measure()
    return made


def test_random_sets_are_those_of_the_seed_and_all_are_chosen():
    seed = random_seed("hall")
    made = chosen(RandomSelector(SETS, MEMBERS, 4, seed))
    trials = [selection.trial for selection in made]
    assert [trials.count(member) for member in MEMBERS] == pytest.approx([67] * 3, abs=25)
    assert all(s.parameters == SETS[s.trial] and s.weights is None for s in made)
    again = RandomSelector(SETS, MEMBERS, 4, seed)
    assert [s.trial for s in chosen(again)] == trials
    # A new recording begins with the same choices.
    again.reset()
    assert [s.trial for s in chosen(again)] == trials
    for other in (random_seed("hall", 2), random_seed("cave")):
        assert [s.trial for s in chosen(RandomSelector(SETS, MEMBERS, 4, other))] != trials
    assert again.fall_back()[:3] == (4, SETS[4], None)


def test_even_weights_stay_even():
    selector = EvenSelector(SETS, MEMBERS)
    for selection in (*chosen(selector, 3), selector.fall_back()):
        assert selection.weights == dict.fromkeys(MEMBERS, 1 / 3)
        assert selection.trial == 4
        assert np.isnan(selection.estimated_error)
        assert not selection.lost
