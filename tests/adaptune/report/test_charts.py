"""Each kind of item is drawn, and read back from the SVG."""

import csv
from xml.etree import ElementTree

import numpy as np
import pytest
from sample_charts import comparison, empty, from_above, over_time, samples, trials

from adaptune.report.charts import (
    Axis,
    Band,
    Chart,
    Line,
    Panel,
    Points,
    Spans,
    Words,
    chart_rows,
    shares,
)
from adaptune.report.drawing import draw_chart, spec, thinned
from adaptune.report.looks import MODES, looks
from adaptune.report.tables import csv_text


def drawn(chart, folder):
    draw_chart(chart, folder / "chart.png", folder / "chart.svg")
    assert (folder / "chart.png").read_bytes().startswith(b"\x89PNG")
    text = (folder / "chart.svg").read_text("utf-8")
    root = ElementTree.fromstring(text)
    return [" ".join(e.itertext()) for e in root.iter("{http://www.w3.org/2000/svg}text")], text


def test_data_of_a_chart_are_a_table_and_it_is_drawn_as_pdf(tmp_path):
    chart = from_above()
    draw_chart(chart, tmp_path / "chart.pdf", tmp_path / "chart.csv")
    assert (tmp_path / "chart.pdf").read_bytes().startswith(b"%PDF")
    with (tmp_path / "chart.csv").open() as file:
        rows = list(csv.DictReader(file))
    for item in chart.panels[0].drawn:
        mine = [row for row in rows if row["name"] == item.name]
        if isinstance(item, Line):
            assert [float(row["x"]) for row in mine] == pytest.approx(list(item.x), nan_ok=True)
            assert [float(row["y"]) for row in mine] == pytest.approx(list(item.y), nan_ok=True)
    for other in samples():
        assert csv_text(chart_rows(other)).startswith("panel,name,x,y,low,high,")


def test_a_share_that_is_a_line_elsewhere_has_its_square_in_the_legend():
    x, y = np.arange(3.0), np.ones((1, 3))
    line = Panel(Axis("x"), Axis("y"), (Line(x, x, "fixed", dashed=True),))
    share = Panel(Axis("x"), Axis("y"), tuple(shares(x, y, ["fixed"])))
    legend = spec(Chart("a", "A", (line, share)))["vconcat"][0]
    assert legend["encoding"]["shape"]["scale"]["range"] == ("square",)


def chart_of(*items, **panel):
    axes = {"x": Axis("x [m]"), "y": Axis("y [m]")} | panel
    return Chart("one", "A chart", (Panel(drawn=items, **axes),))


def mark(at):
    return Line([at, at], [1, 2], "", dashed=True)


@pytest.mark.parametrize(
    "item",
    [
        Line([0, 1, 2], [1, np.nan, 2], "fixed"),
        Line([0, 1], [1, 2], "fixed", steps=True, dashed=True),
        Points([0, 1], [1, 2], "fixed", texts=["a", "b"]),
        Band([0, 1], [1, 2], [2, 3], "fixed"),
        shares([0, 1, 2], np.full((2, 3), 50.0), ("fixed", "b"))[0],
    ],
    ids=lambda item: type(item).__name__,
)
def test_an_item_has_its_colour_in_the_panel_and_in_the_legend(tmp_path, item):
    texts, svg = drawn(chart_of(item), tmp_path)
    assert {"A chart", "x [m]", "y [m]", "fixed"} <= set(texts)
    assert svg.count(MODES["fixed"].colour) >= 2


def test_colours_of_points_are_on_a_bar(tmp_path):
    points = Points([0, 1], [1, 2], "trial", [0.1, 1.0], "size [m]")
    texts, _ = drawn(chart_of(points), tmp_path)
    assert {"size [m]", "0.2", "0.5", "trial"} <= set(texts)


def test_spans_are_named_above_and_marks_widen_the_axis(tmp_path):
    spans = Spans([0, 10, 11, 50, 100], ("cave", "street", "", "garden"))
    items = spans, Line([0, 100], [1, 2], "fixed"), mark(60.0)
    texts, svg = drawn(chart_of(*items), tmp_path)
    assert {"cave", "garden"} <= set(texts)
    assert texts.count("street") == 0  # too short for its name
    texts, wider = drawn(chart_of(*items, mark(190.0)), tmp_path)
    assert "180" in texts
    assert wider.count("stroke-dasharray") == svg.count("stroke-dasharray") + 1


def test_names_stand_along_an_axis_also_long_ones(tmp_path):
    names = tuple(f"a_long_name_of_a_drive_{i}" for i in range(12))
    points = Points(np.arange(12.0), np.arange(1.0, 13.0), "")
    texts, _ = drawn(chart_of(points, x=Axis("", names=names)), tmp_path)
    assert set(names) <= {text.replace(" ", "") for text in texts}
    narrow = tuple(f"sequence{i:02d}" for i in range(20))
    points = Points(np.arange(20.0), np.arange(1.0, 21.0), "")
    texts, svg = drawn(chart_of(points, x=Axis("", names=narrow)), tmp_path)
    assert set(narrow) <= set(texts)
    assert svg.count("rotate(325") >= 20
    texts, _ = drawn(
        chart_of(Points(np.ones(12), np.arange(12.0), ""), y=Axis("", names=names)), tmp_path
    )
    assert set(names) <= {text.replace(" ", "") for text in texts}


@pytest.mark.parametrize("chart", samples(), ids=lambda chart: chart.key)
def test_samples_are_drawn_as_wide_as_a_page(tmp_path, chart):
    texts, svg = drawn(chart, tmp_path)
    width = float(ElementTree.fromstring(svg).get("width"))
    assert 800 < width < 990
    assert {panel.title for panel in chart.panels} - {""} <= set(texts)
    before = (tmp_path / "chart.svg").read_bytes()
    drawn(chart, tmp_path)
    assert (tmp_path / "chart.svg").read_bytes() == before


def test_names_are_literal(tmp_path):
    texts = drawn(comparison(), tmp_path)[0]
    assert {"tunnel <b>north</b>", "forest_$x_1$", "kiss & tell"} <= set(texts)


def test_an_empty_panel_says_so_and_has_no_legend(tmp_path):
    texts, _ = drawn(empty(), tmp_path)
    assert sorted(texts) == ["Nothing was measured", "no data", "x [-]", "y [-]"]


def test_metres_are_as_long_along_both_axes():
    made = spec(from_above())["vconcat"][-1]["concat"][0]
    domains = [made["layer"][0]["encoding"][which]["scale"]["domain"] for which in "xy"]
    pixels = [
        made[size] / np.ptp(of) for size, of in zip(("width", "height"), domains, strict=True)
    ]
    assert pixels[0] == pytest.approx(pixels[1], rel=0.02)


def test_panels_that_share_an_axis_begin_and_end_alike():
    panels = spec(over_time())["vconcat"][-1]["concat"]
    axes = [panel["layer"][0]["encoding"]["x"] for panel in panels]
    assert len({tuple(x["scale"]["domain"]) for x in axes}) == 1
    assert [x["title"] is not None for x in axes] == [False, False, True]


def test_modes_keep_their_colours_and_others_differ():
    names = ("baseline", "fixed", *(f"drive_{i}" for i in range(20)))
    found = looks(chart_of(*(Points([0], [1], name) for name in names)))
    assert found["fixed"] == MODES["fixed"]
    assert len({(look.colour, look.shape) for look in found.values()}) == len(names)


def test_a_place_has_one_colour_and_its_name_no_second_time_in_the_legend(tmp_path):
    spans = Spans([0, 50, 100], ("cave", "street"))
    path = Panel(
        Axis("[m]"),
        Axis("[m]"),
        (Line([0, 9], [0, 1], "cave"), Words([0, 0.1, 9], [0, 0, 1], ["cave", "nook", "street"])),
        equal=True,
    )
    errors = Panel(Axis("time [s]"), Axis("y"), (spans, Line([0, 100], [1, 2], "fixed")))
    chart = Chart("one", "A chart", (path, errors), shared_x=True)
    texts, svg = drawn(chart, tmp_path)
    # Each word has a white shadow: on the path, and above the segment.
    expected = {"cave": 4, "street": 4, "nook": 0, "fixed": 1}
    assert {name: texts.count(name) for name in expected} == expected
    found = looks(chart)
    assert svg.count(found["cave"].colour) == 2
    assert found["cave"].colour != found["street"].colour
    assert 800 < float(ElementTree.fromstring(svg).get("width")) < 990


def test_long_lines_are_thinned_and_keep_peaks_and_gaps():
    y = np.sin(np.arange(20_000.0))
    y[777], y[12_000:12_100] = 9.0, np.nan
    kept = thinned(np.arange(20_000.0), y)
    assert len(kept) < 2000
    assert 777 in kept
    assert np.isnan(y[kept]).any()
    assert kept[0] == 0
    assert kept[-1] == len(y) - 1
    data = spec(trials())["vconcat"][-1]["concat"][0]["layer"]
    assert max(len(layer["data"]["values"]) for layer in data) <= 2000


def test_within_a_decade_a_logarithmic_axis_names_ticks_on_both_sides_of_1(tmp_path):
    points = Points([0.75, 2.1], [0.02, 10.0], "fixed")
    ratios, errors = Axis("ratio [-]", log=True), Axis("error [%]", log=True)
    assert {"0.8", "1.2", "0.1", "10"} <= set(
        drawn(chart_of(points, x=ratios, y=errors), tmp_path)[0]
    )


def test_names_that_are_apart_on_a_logarithmic_axis_are_all_read(tmp_path):
    x = [1.0, 3.0, 1000.0, 1010.0]
    names = Words(x, [1.0] * 4, ["one", "two", "three", "four"])
    chart = chart_of(Points(x, [1.0] * 4, "fixed"), names, x=Axis("x", log=True))
    texts = drawn(chart, tmp_path)[0]
    assert [name for name in names.words if name in texts] == ["one", "two", "three"]
