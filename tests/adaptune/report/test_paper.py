import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.image import imread
from pictures import share_of, texts
from sample_charts import comparison, empty, from_above, over_time, samples, trials

from adaptune.report.chart import Axis, Band, Bars, Chart, Line, Mark, Panel, Points, Shares
from adaptune.report.paper import LINES, as_png_and_svg, draw_chart, looks

_NUMBERS = st.floats(1e-3, 1e6) | st.sampled_from([np.nan, np.inf, 0.0, -2.0])


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    folder = tmp_path_factory.mktemp("figures")
    for chart in samples():
        draw_chart(folder / f"{chart.key}.png", chart)
    return folder


@pytest.mark.parametrize("chart", samples(), ids=lambda chart: chart.key)
def test_every_chart_is_a_white_picture_with_its_words(chart, drawn):
    path = drawn / f"{chart.key}.png"
    corners = imread(path)[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert (corners == 1.0).all()
    said = " ".join(texts(path)).split()
    for panel in chart.panels:
        assert set(panel.y.label.split()) <= set(said)
        assert set(panel.title.split()) <= set(said)
    assert all(file.stat().st_size < 300_000 for file in as_png_and_svg(path))


def test_everything_has_one_entry_in_the_legend(drawn):
    for chart in (over_time(), trials(), from_above()):
        said = texts(drawn / f"{chart.key}.png")
        counts = {name: said.count(name) for name in looks(chart) if name}
        assert set(counts.values()) == {1}, counts


def test_spans_and_marks_are_named_where_they_are_and_once(drawn):
    said = texts(drawn / "over-time.png")
    assert said.count("corridor") == 1
    assert said.count("room") == 2  # there are two
    assert said.count("goal") == 1
    assert said.count("door opens") == 1


def test_names_are_literal(drawn):
    said = " ".join(texts(drawn / "comparison.png"))
    assert "<b>north</b>" in said
    assert "forest_$x_1$" in said
    assert "kiss & tell" in said


def test_modes_have_their_colours(drawn):
    for mode in ("baseline", "fixed", "adaptive"):
        assert share_of(drawn / "from-above.png", LINES[mode]["color"]) > 0.3


def test_many_points_are_pixels_in_an_svg_and_few_are_not(drawn):
    assert "<image" in (drawn / "trials.svg").read_text()
    assert "<image" not in (drawn / "comparison.svg").read_text()


def test_what_is_empty_says_so_and_has_no_legend(drawn):
    assert set(texts(drawn / "empty.png")) == {"Nothing was measured", "no data", "x [-]", "y [-]"}


def test_the_same_chart_has_the_same_bytes(drawn, tmp_path):
    again = tmp_path / "again.png"
    draw_chart(again, comparison())
    first = drawn / "comparison.png"
    for one, other in zip(as_png_and_svg(first), as_png_and_svg(again), strict=True):
        assert one.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("columns", [1, 2, 3])
def test_a_row_need_not_be_full(columns, tmp_path, recwarn):
    panel = empty().panels[0]
    for shared in (False, True):
        chart = Chart("a", "A", (panel,) * 4, columns=columns, shared_x=shared)
        draw_chart(tmp_path / "a.png", chart)
        assert texts(tmp_path / "a.png").count("x [-]") == (columns if shared else 4)
    assert not recwarn.list


@pytest.mark.filterwarnings("error")
@settings(max_examples=5, deadline=None)
@given(
    arrays(float, (3, 4), elements=_NUMBERS),
    st.booleans(),
    st.booleans(),
)
def test_any_numbers_are_drawn(tmp_path_factory, values, log, flat):
    x, y, z = values
    drawn = (
        *(Line(x, y, "a", steps=flat), Points(x, y, "b", z, "c", log_colour=log)),
        *(
            Band(x, y, z, "d"),
            Bars(x, y, "e", y, z, flat=flat),
            Mark(0.0, "f"),
            Mark(1.0, "g", "x"),
        ),
        *([] if log else [Shares(np.arange(4), np.ones((2, 4)), ("h", "i"))]),
    )
    panel = Panel(Axis("x", log=log), Axis("y", log=log), drawn)
    draw_chart(tmp_path_factory.mktemp("any") / "a.png", Chart("a", "A", (panel,)))
