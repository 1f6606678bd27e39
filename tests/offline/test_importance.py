import numpy as np
import pytest
from made_trials import made_table

from offline.charts import importances


def error(_, parameters):
    slow = 1.0 if parameters["kernel"] == "none" else 1.3
    return slow * (0.2 + abs(np.log(parameters["distance"] / 3.0)))


def test_what_changes_the_error_matters_most():
    found = importances(made_table(error, 120))
    assert list(found) == ["distance", "kernel", "points"]
    assert sum(found.values()) == pytest.approx(1.0)
    assert found["distance"] > 0.9
    assert importances(made_table(error, 120)) == found


def test_few_trials_and_equal_errors_say_nothing():
    assert importances(made_table(error, 7)) == {}
    assert importances(made_table(lambda *_: 1.0, 40)) == {}
