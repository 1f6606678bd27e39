import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample_charts import comparison, empty, over_time, samples, trials

from adaptune.report.chart import Axis, Bars, Chart, Line, Panel, Points, Spans
from adaptune.report.interactive import NARROW, PRINTED, WIDE, layout, ticks

WIDTHS = (WIDE, PRINTED, NARROW)


def boxes(made):
    """Panels in pixels: left, right, bottom, top."""
    margin = made["margin"]
    whole = made["height"] - margin["t"] - margin["b"]
    for key, axis in made.items():
        if key.startswith("xaxis"):
            x, y = axis["domain"], made[key.replace("x", "y", 1)]["domain"]
            yield (*x, y[0] * whole, y[1] * whole)


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("chart", samples(), ids=lambda chart: chart.key)
def test_panels_lie_inside_and_apart(chart, width):
    found = list(boxes(layout(chart, width)))
    assert len(found) == len(chart.panels)
    for left, right, bottom, top in found:
        assert 0.0 <= left < right <= 1.0 + 1e-9
        assert bottom >= -1e-6
        assert top - bottom > 100.0
    for a, b in itertools.combinations(found, 2):
        # A label has room between them.
        assert a[1] < b[0] or b[1] < a[0] or a[2] > b[3] + 15.0 or b[2] > a[3] + 15.0


def test_panels_lie_below_each_other_on_a_telephone():
    assert len({box[0] for box in boxes(layout(trials(), WIDE))}) == 2
    assert len({box[0] for box in boxes(layout(trials(), NARROW))}) == 1
    made = layout(trials(), NARROW)
    assert made["dragmode"] is False  # a finger scrolls


def test_panels_with_colour_bars_are_not_too_narrow_on_paper():
    coloured = Points([1.0, 2.0], [1.0, 2.0], "a", [1.0, 2.0], "error [%]")
    panel = Panel(Axis("x"), Axis("y"), (coloured,))
    made = {w: layout(Chart("a", "A", (panel,) * 3, columns=3), w) for w in WIDTHS}
    columns = {w: len({round(box[0], 3) for box in boxes(of)}) for w, of in made.items()}
    assert columns == {WIDE: 3, PRINTED: 2, NARROW: 1}


def test_a_shared_axis_is_named_once():
    for width in WIDTHS:
        made = layout(over_time(), width)
        titles = [made[f"xaxis{i}"]["title"]["text"] for i in ("", 2, 3, 4)]
        assert titles == ["", "", "", "time [s]"]
        assert made["xaxis3"]["matches"] == "x"


def test_names_have_room():
    names = layout(comparison(), WIDE)["xaxis"]
    assert names["ticktext"][0] == "campus,<br>morning"
    assert names["tickangle"] == 0
    narrow = layout(comparison(), NARROW)
    assert narrow["xaxis"]["tickangle"] < 0
    assert narrow["margin"]["l"] >= 34 + 7 * len("iterations")


def test_spans_are_named_in_the_highest_panel_only():
    notes = [note["text"] for note in layout(over_time(), WIDE)["annotations"]]
    assert notes.count("room") == 2
    assert notes.count("corridor") == 1


def test_spans_with_one_name_have_an_entry_in_the_legend_and_no_words():
    spans = Spans((0, 1, 2, 3, 4), ("lost", "", "lost", ""), "lost")
    line = Line([0, 4], [0, 1], "a")
    panel = Panel(Axis("time [s]"), Axis("y [-]"), (line, spans))
    made = layout(Chart("a", "A", (panel, panel), shared_x=True), WIDE)
    assert [shape.get("name") for shape in made["shapes"]] == ["lost", None, None, None]
    assert made["annotations"] == []


def test_long_names_beside_an_axis_do_not_lie_on_each_other():
    names = tuple(f"a drive with a long name {i}" for i in range(30))
    panel = Panel(Axis("x"), Axis("", names=names), (Bars(names, range(30), "a", flat=True),))
    (box,) = boxes(layout(Chart("a", "A", (panel,)), NARROW))
    assert (box[3] - box[2]) / len(names) > 15 * 3  # lines of text


def test_a_logarithmic_axis_says_where_words_are():
    made = layout(over_time(), WIDE)
    (goal,) = [note for note in made["annotations"] if note["text"] == "goal"]
    assert goal["y"] == pytest.approx(-0.1549, abs=1e-4)
    assert any(shape.get("y0") == 0.7 for shape in made["shapes"])


def test_nothing_but_its_words_is_said_of_what_is_empty():
    made = layout(empty(), WIDE)
    assert not made["showlegend"]
    assert made["shapes"] == []
    assert "coloraxis" not in made


@given(st.floats(-6.0, 6.0), st.floats(0.0, 8.0))
def test_a_logarithmic_axis_names_some_values_but_not_many(low, decades):
    shown = ticks(10.0**low, 10.0 ** (low + decades))
    inside = [v for v in shown if 0.8 * 10.0**low <= v <= 1.25 * 10.0 ** (low + decades)]
    assert len(inside) >= 2
    assert len(inside) <= 16
    assert shown == sorted(set(shown))


@pytest.mark.filterwarnings("error")
def test_a_logarithmic_axis_may_begin_at_the_least_number():
    assert len(ticks(1e-310, 10.0)) > 2
