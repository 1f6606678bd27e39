import numpy as np
import pytest
from made_trials import made_table

from offline.charts import importance_chart, importances


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


def test_the_most_important_is_at_the_top():
    (panel,) = importance_chart({"": {"a": 0.7, "b": 0.3}}).panels
    assert panel.y.names == ("b", "a")
    (bars,) = panel.drawn
    np.testing.assert_allclose(bars.values, [30.0, 70.0])
    assert importance_chart({"gicp": {}}) is None
