import numpy as np
import pytest

from adaptune.report.charts import Line, Points
from online.charts import comparison_chart
from online.statistics import ComparisonRow


def row(sequence, mode, ratio, low=None, high=None, other="fixed"):
    ends = None if low is None else (low, high)
    return ComparisonRow(sequence, mode, 1.0, ratio, ratio_interval=ends, yardstick=other)


ROWS = [
    row("one", "baseline", 1.4),
    row("one", "fixed", 1.0, 1.0, 1.0),
    row("one", "new_mode", 0.7),
    row("one", "adaptive", 0.8, 0.7, 0.9),
    row("two", "baseline", 1.2),
    row("two", "fixed", 1.0),
    row("two", "adaptive", 0.9),
    row("two", "new_mode", None),
    row("all", "baseline", 1.3),
    row("all", "adaptive", 0.85, 0.8, 0.95),
    row("all", "oracle, sequence", 0.6),
]


def drawn(rows, kind):
    (panel,) = comparison_chart(rows).panels
    return {d.name: d for d in panel.drawn if isinstance(d, kind)}


def test_modes_stand_below_each_other_from_the_least_error():
    (panel,) = comparison_chart(ROWS).panels
    assert panel.y.names == ("baseline", "adaptive", "oracle, sequence")  # from below
    points = drawn(ROWS, Points)
    assert list(points) == ["geometric mean over all sequences", "each sequence"]
    means = points["geometric mean over all sequences"]
    assert list(zip(means.x, means.y, strict=True)) == [(1.3, 0.0), (0.85, 1.0), (0.6, 2.0)]
    mark, interval = drawn(ROWS, Line).values()
    assert (list(mark.x), list(mark.y)) == ([1.0, 1.0], [-0.6, 2.6])
    np.testing.assert_array_equal(interval.x, [0.8, 0.95, np.nan])
    assert list(interval.y) == [1.0] * 3
    # What lies lower still belongs to the line.
    each = points["each sequence"]
    assert list(each.x) == [1.4, 0.8, 1.2, 0.9]
    assert np.ceil(each.y).tolist() == [0.0, 1.0, 0.0, 1.0]
    assert each.texts == ["baseline, one", "adaptive, one", "baseline, two", "adaptive, two"]
    assert each.faint


def test_of_one_sequence_there_is_nothing_below():
    rows = [row("one", "fixed", 1.0), row("one", "adaptive", 0.8), row("one", "paper", 2.0)]
    (points,) = drawn(rows, Points).values()
    assert (points.name, list(points.x)) == ("one", [2.0, 0.8])
    assert list(drawn(rows, Line)) == [""]
    assert "Below each mean" not in comparison_chart(rows).caption


def test_the_baseline_may_be_what_others_are_compared_with():
    rows = [row("one", "baseline", 1.0, other="baseline")]
    assert comparison_chart(rows) is None
    rows.append(row("one", "untrained", 0.7, other="baseline"))
    assert "baseline" in comparison_chart(rows).title


@pytest.mark.parametrize("rows", [[], [row("one", "adaptive", None)]])
def test_without_ratios_there_is_no_chart(rows):
    assert comparison_chart(rows) is None
