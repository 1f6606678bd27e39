import numpy as np
from made_trials import SPACE, made_table

from adaptune.archive import OF_SLOT, Summary
from adaptune.report.charts import Axis, Line, Points
from adaptune.space import Categorical, Float, Integer
from offline.charts import (
    cost_chart,
    iteration_chart,
    on_axis,
    parameter_axis,
    pareto_chart,
    scatter_chart,
    sensitivity_chart,
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


def test_iterations_show_the_best_so_far():
    table = made_table(error, fixed=3)
    (panel,) = iteration_chart(table).panels
    (line,) = of_kind(panel, Line)
    np.testing.assert_array_equal(line.y, np.minimum.accumulate(table.values))


def test_a_trial_beyond_a_limit_is_no_best():
    config = OfflineConfig.model_validate({"limits": {"ms_per_scan": {"max": 5.0}}})
    runs = {
        i: Summary(SPACE.baseline | {"points": i + 1}, 1.0 - 0.1 * i, 0, 0, 9.0 if i == 2 else 1.0)
        for i in range(4)
    }
    (panel,) = iteration_chart(trial_table(config, SPACE, {"one": runs})).panels
    np.testing.assert_allclose(of_kind(panel, Line)[0].y, [1.0, 0.9, 0.9, 0.7])


def test_each_search_of_its_own_has_a_panel():
    table = made_table(error, 10)
    runs = {
        name: {0: Summary(SPACE.baseline, 1.0, 0, 0, 1.0)}
        | {
            OF_SLOT * slot + i: Summary(own, error(name, own), 0, 0, 1.0)
            for i, own in enumerate(table.sets[1:], start=1)
        }
        for slot, name in ((1, "one"), (2, "two"))
    }
    own = trial_table(OfflineConfig(), SPACE, runs)
    one, two = iteration_chart(own).panels
    assert (one.title, two.title) == ("one alone", "two alone")
    assert list(of_kind(one, Line)[0].x) == list(range(1, 10))
    # They were not run on all sequences.
    assert cost_chart(own) is None


def test_sensitivity_and_cost_show_all_trials():
    table = made_table(error)
    assert len(sensitivity_chart(table).panels) == 3
    (panel,) = cost_chart(table).panels
    (front,) = of_kind(panel, Line)
    values = np.column_stack([table.costs, table.values])
    for x, y in zip(front.x, front.y, strict=True):
        assert not ((values <= [x, y]).all(axis=1) & (values < [x, y]).any(axis=1)).any()
    assert cost_chart(table.some(table.numbers < 1)) is None


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


def test_parameters_have_the_scale_of_their_range_or_names():
    kernel = Categorical(choices=("none", 1, True), baseline=1)
    distance = Float(low=1.0, high=10.0, baseline=4.0, log=True)
    assert parameter_axis("distance", distance) == Axis("distance", log=True)
    assert parameter_axis("points", Integer(low=1, high=9, baseline=4)) == Axis("points")
    assert parameter_axis("kernel", kernel).names == ("none", "1", "True")
    np.testing.assert_array_equal(on_axis([True, None, "none"], kernel), [2.0, np.nan, 0.0])
