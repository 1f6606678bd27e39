import numpy as np
from made_trials import SPACE, made_table

from adaptune.archive import Summary
from adaptune.report.charts import Axis, Line, Points
from offline.charts import (
    iteration_chart,
    pareto_chart,
    scatter_chart,
    trial_table,
)
from offline.config import OfflineConfig


def error(name, parameters):
    """Small distances do well on `one`, large ones on `two`."""
    best = 2.0 if name == "one" else 8.0
    return 0.5 + abs(np.log(parameters["distance"] / best))


def of_kind(panel, kind, name=None):
    return [d for d in panel.drawn if isinstance(d, kind) and (name is None or d.name == name)]


def test_a_scatter_has_a_panel_for_each_sequence_and_the_mean():
    table = made_table(error, fixed=3)
    chart = scatter_chart(table, ["distance", "points"], ["one", "two"])
    assert [panel.title for panel in chart.panels] == ["one", "two", "mean over all sequences"]
    for panel, values in zip(
        chart.panels, [*table.by_sequence.values(), table.values], strict=True
    ):
        (best,) = of_kind(panel, Points, "best trial here")
        assert best.x[0] == table.column("distance")[int(np.argmin(values))]
        (fixed,) = of_kind(panel, Points, "fixed")
        assert list(fixed.x) == [table.column("distance")[3]]
        (trials,) = of_kind(panel, Points, "trial")
        assert trials.log_colour
        assert min(trials.colour) == values.min()
    assert scatter_chart(table, ["distance"], ["one"]) is None


def test_a_trial_beyond_a_limit_is_no_best():
    config = OfflineConfig.model_validate({"limits": {"ms_per_scan": {"max": 5.0}}})
    runs = {
        i: Summary(SPACE.baseline | {"points": i + 1}, 1.0 - 0.1 * i, 0, 0, 9.0 if i == 2 else 1.0)
        for i in range(4)
    }
    (panel,) = iteration_chart(trial_table(config, SPACE, {"one": runs})).panels
    np.testing.assert_allclose(of_kind(panel, Line)[0].y, [1.0, 0.9, 0.9, 0.7])


def test_a_front_is_a_line_of_two_objectives_and_none_of_three():
    values = np.array([[0.5, 9.0, 1.0], [0.7, 5.0, 2.0], [4.0, 2.0, 3.0], [30.0, 7.0, 4.0]])
    names, marked = ["rte [%]", "memory [MB]", "cpu [% of a core]"], {"fixed": (0.5, 9.0, 1.0)}
    (panel,) = pareto_chart(names[:2], values[:, :2], values[:3, :2], {"fixed": (0.5, 9.0)}).panels
    named = [d.name for d in panel.drawn]
    assert named == ["tried", "Pareto front", "Pareto front", "fixed"]
    assert (panel.x, panel.y) == (Axis("rte [%]", log=True), Axis("memory [MB]"))
    first, second = pareto_chart(names, values, values[:3], marked).panels
    assert (first.x.label, first.y.label, second.y.label) == tuple(names)
    assert not any(isinstance(d, Line) for panel in (first, second) for d in panel.drawn)
