from random_models import random_model

from online.modes import EvenSelector

MEMBERS = (4, 10, 2)


def test_even_weights_stay_even():
    selector = EvenSelector(random_model().sets, MEMBERS)
    selector.measure()
    for selection in (selector.select(), selector.select(), selector.fall_back()):
        assert selection.weights == dict.fromkeys(MEMBERS, 1 / 3)
        assert selection.trial == 4
