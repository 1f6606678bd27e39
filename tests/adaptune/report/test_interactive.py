import json

import numpy as np
import plotly.graph_objects as go
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sample_charts import comparison, empty, from_above, over_time, samples, trials

from adaptune.report.chart import Axis, Band, Bars, Chart, Line, Mark, Panel, Points, Shares
from adaptune.report.interactive import figure
from adaptune.report.paper import LINES, MOST, POINTS, looks


def all_figures():
    return [pytest.param(figure(chart), id=chart.key) for chart in samples()]


def traces_of(chart, name):
    return [trace for trace in figure(chart)["data"] if trace["name"] == name]


@pytest.mark.parametrize("made", all_figures())
def test_plotly_knows_every_property_and_json_every_value(made):
    for layout in made["layouts"]:
        go.Figure({"data": made["data"], "layout": layout["layout"]})
    assert json.loads(json.dumps(made, allow_nan=False)) == made


def test_a_drawing_is_small():
    assert max(len(json.dumps(figure(chart))) for chart in samples()) < 200_000
    lines = [t for t in figure(over_time())["data"] if t["mode"] == "lines" and "fill" not in t]
    assert max(len(trace["x"]) for trace in lines) <= MOST


def test_each_name_is_in_the_legend_once_and_a_click_on_it_reaches_all_panels():
    for chart in (over_time(), trials(), comparison(), from_above()):
        data = figure(chart)["data"]
        shown = [trace["legendgroup"] for trace in data if trace["showlegend"]]
        assert sorted(shown) == sorted(name for name in looks(chart) if name)
        assert all(
            trace["legendgroup"] == trace["name"] for trace in data if "&" not in trace["name"]
        )


def test_lines_look_as_on_paper():
    (wide,) = traces_of(from_above(), "baseline")
    assert wide["line"]["color"] == LINES["baseline"]["color"]
    assert wide["line"]["width"] == pytest.approx(LINES["baseline"]["lw"] * 4 / 3, abs=0.01)
    (limit,) = traces_of(over_time(), "limit")
    assert "dash" in limit["line"]
    assert "dash" not in wide["line"]
    assert traces_of(over_time(), "adaptive")[1]["line"]["shape"] == "hv"


def test_a_gap_is_a_gap():
    gaps = traces_of(over_time(), "adaptive")[0]
    assert None in gaps["y"]
    assert gaps["connectgaps"] is False


def test_names_are_literal():
    chart = Chart("a", "A", (Panel(Axis("x %{y}"), Axis("<b>y"), (Line([0], [1], "$a$ & %{x}"),)),))
    made = figure(chart)
    (trace,) = made["data"]
    assert trace["name"] == "&#36;a&#36; &amp; %&#123;x}"
    assert trace["hovertemplate"].startswith("x %&#123;y}: %{x}<br>&lt;b&gt;y: %{y}")
    assert made["layouts"][0]["layout"]["yaxis"]["title"]["text"] == "&lt;b&gt;y"


def test_colours_of_points_are_logarithms_and_points_without_are_grey():
    chart = trials(1200)
    key, grey, coloured = traces_of(chart, "trials")[:3]
    points = chart.panels[0].drawn[0]
    known = np.isfinite(points.colour)
    assert len(grey["x"]) == (~known).sum() > 0
    np.testing.assert_allclose(
        coloured["marker"]["color"], np.log10(points.colour[known]), rtol=1e-4, atol=1e-5
    )
    assert [t["showlegend"] for t in (key, grey, coloured)] == [True, False, False]
    assert coloured["text"] == [
        text for text, kept in zip(points.texts, known, strict=True) if kept
    ]


def test_bars_end_at_their_heights_and_tell_their_names():
    (ratio,) = traces_of(comparison(), "ratio")
    np.testing.assert_allclose(np.add(ratio["x"], ratio["base"]), [1.4, 0.8, 1.05])
    (fixed,) = traces_of(comparison(), "fixed")
    assert fixed["hovertext"][0] == "campus, morning: 1 (0.8 to 1.3)"
    assert fixed["hovertext"][2].startswith("tunnel &lt;b&gt;north")
    np.testing.assert_allclose(fixed["error_y"]["array"][:3], 0.3, rtol=1e-5)


def test_a_band_leaves_out_what_is_not_known():
    band = Band([0, 1, 2, 3], [0, 0, np.nan, 0], [1, 1, 1, 1], "a")
    (trace,) = figure(Chart("a", "A", (Panel(Axis("x"), Axis("y"), (band,)),)))["data"]
    assert trace["x"] == [0, 1, 1, 0, None, 3, 3, None]
    assert trace["y"] == [1, 1, 0, 0, None, 1, 0, None]


def test_what_is_empty_has_no_traces():
    made = figure(empty())
    assert made["data"] == []
    notes = made["layouts"][0]["layout"]["annotations"]
    assert [note["text"] for note in notes] == ["no data"]


NUMBERS = st.floats(-1e9, 1e9) | st.sampled_from([np.nan, np.inf])


@settings(max_examples=50, deadline=None)
@given(arrays(float, (3, 4), elements=NUMBERS), st.booleans(), st.booleans())
def test_any_numbers_are_drawn(values, log, flat):
    x, y, z = values
    drawn = (
        *(Line(x, y, "a", steps=flat), Points(x, y, "b", z, "c", log_colour=log)),
        *(Band(x, y, z, "d"), Bars(x, y, "e", y, z, flat=flat)),
        *(Shares(x, values, ("h", "i", "j")), Mark(0.0, "f"), Mark(1.0, "g", "x")),
    )
    panel = Panel(Axis("x", log=log), Axis("y", log=log), drawn)
    json.dumps(figure(Chart("a", "A", (panel,))), allow_nan=False)


def test_every_mode_has_a_line_and_a_marker_in_the_browser():
    names = {**LINES, **POINTS}
    drawn = tuple(
        kind([0.0, 1.0], [i, i + 1.0], name)
        for i, name in enumerate(names)
        for kind in (Line, Points)
    )
    axis = Axis("x [m]")
    made = figure(Chart("all", "All modes", (Panel(axis, axis, drawn),)))
    assert len(made["data"]) >= 2 * len(names)
    assert set(LINES) <= set(POINTS)
