import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptune.report.chart import Axis, Band, Bars, Chart, Line, Mark, Panel, Points, Shares, Spans
from adaptune.report.paper import (
    LINES,
    MOST,
    band_edges,
    is_empty,
    layered,
    looks,
    marks,
    numbers,
    positive_extent,
    rows,
    span_tints,
    thinned,
    wrapped,
)

X, Y = Axis("x [m]"), Axis("y [m]")


def chart_of(*drawn, **of_panel):
    return Chart("a", "A", (Panel(X, Y, drawn, **of_panel),))


def test_modes_have_their_looks_and_other_names_differ_from_them_and_each_other():
    names = ["one set", "fixed", "a", "b", "c"]
    found = looks(chart_of(*(Line([0], [0], name) for name in names), Points([0], [0], "a")))
    assert list(found) == names
    assert found["fixed"].colour == LINES["fixed"]["color"]
    assert found["fixed"].width == LINES["fixed"]["lw"]
    assert len({look.colour for look in found.values()}) == len(names)
    for of in ("dash", "marker", "hatch"):
        assert len({getattr(found[name], of) for name in "abc"}) == 3


def test_many_names_differ_in_something():
    found = looks(chart_of(*(Line([0], [0], f"{i}") for i in range(20))))
    assert len({(look.colour, look.dash) for look in found.values()}) == 20
    assert len({(look.colour, look.marker) for look in found.values()}) == 20


def test_the_wide_lines_of_modes_lie_below_the_narrow_ones_and_a_cloud_below_all():
    cloud = Points(np.zeros(5000), np.zeros(5000), "trials")
    lines = [Line([0], [0], mode) for mode in reversed(LINES)]
    faint, spans, mark = Line([0], [0], "b", faint=True), Spans((0, 1), ("a",)), Mark(1.0)
    order = layered(Panel(X, Y, (cloud, *lines, faint, mark, spans)))
    assert order[0] is spans
    assert [item.name for item in order[-len(LINES) :]] == list(LINES)
    assert order.index(faint) < order.index(cloud)


def test_rows_are_as_high_as_their_highest_panel():
    panels = tuple(Panel(X, Y, (), height=height) for height in (1.0, 2.0, 0.5))
    assert [h for h, _ in rows(Chart("a", "A", panels), 2)] == [2.0, 0.5]
    many = Axis("sequence", names=tuple(f"drive {i}" for i in range(30)))
    assert rows(Chart("a", "A", (Panel(X, many, ()),)), 1)[0][0] > 2.5


def test_values_may_be_names_none_or_infinite():
    axis = Axis("scene", names=("room", "street"))
    np.testing.assert_equal(numbers(["street", "room", 0.5], axis), [1.0, 0.0, 0.5])
    np.testing.assert_equal(numbers([1, None, np.inf, True], X), [1.0, np.nan, np.nan, 1.0])
    with pytest.raises(KeyError, match="lake"):
        numbers(["lake"], axis)


def test_equal_names_of_spans_have_equal_tints_and_those_without_a_name_none():
    tinted = span_tints(Spans((0, 1, 2, 3, 4), ("a", "b", "", "a")))
    assert [(begin, end, name) for begin, end, name, _ in tinted] == [
        (0, 1, "a"),
        (1, 2, "b"),
        (3, 4, "a"),
    ]
    assert tinted[0][3] == tinted[2][3] != tinted[1][3]
    with pytest.raises(ValueError, match="shorter"):
        span_tints(Spans((0, 1, 2), ("a",)))


def test_a_band_stays_above_zero_on_a_logarithmic_axis():
    band = Band([0, 1], [-1.0, 0.5], [1.0, 2.0], "a")
    _, low, _ = band_edges(band, Panel(X, Axis("y", log=True), (band,)))
    np.testing.assert_allclose(low, [0.1, 0.5])
    assert band_edges(band, Panel(X, Y, (band,)))[1][0] == -1.0


@pytest.mark.parametrize(
    ("item", "empty"),
    [
        (Line([], [], "a"), True),
        (Line([0.0, np.nan], [np.nan, 1.0], "a"), True),
        (Line([0.0], [1.0], "a"), False),
        (Band([0.0], [np.nan], [1.0], "a"), False),
        (Bars(["b"], [2.0], "a", flat=True), False),
        (Shares([0.0], np.ones((2, 1)), ("a", "b")), False),
        (Shares([], np.ones((2, 0)), ("a", "b")), True),
        (Spans((0, 1), ("a",)), True),
        (Mark(1.0), True),
    ],
)
def test_what_is_empty(item, empty):
    assert is_empty(Panel(X, Axis("y", names=("b",)), (item,))) == empty


def test_marks_that_lie_on_no_axis_are_left_out():
    drawn = Mark(0.0), Mark(2.0), Mark(9.0), Mark(0.0, axis="x")
    panel = Panel(X, Axis("y", log=True, limits=(5.0, 1.0)), drawn)
    assert marks(panel) == [Mark(2.0), Mark(0.0, axis="x")]


def test_extents_are_of_what_lies_above_zero():
    drawn = (Line([0.0, 2.0], [-1.0, np.nan], "a"), Bars([3.0], [0.5], "b"), Mark(7.0))
    panel = Panel(X, Y, drawn)
    assert positive_extent(panel, "x") == (2.0, 3.0)
    assert positive_extent(panel, "y") == (0.5, 7.0)
    assert positive_extent(Panel(X, Y, ()), "y") is None


@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 4 * MOST),
    st.sampled_from([0.0, 0.001, 0.3, 1.0]),
    st.booleans(),
)
def test_thinning_keeps_extremes_ends_and_gaps(seed, n, missing, faint):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=n), rng.normal(size=n)
    y[rng.random(n) < missing] = np.nan
    kept = thinned(x, y, faint=faint)
    assert len(kept) <= min(n, 1.5 * MOST)
    assert (np.diff(kept) > 0).all()
    known = np.isfinite(y)
    if n:
        assert kept[0] == 0
        assert kept[-1] == n - 1
        assert np.isnan(y[kept]).any() == (not known.all())
    if known.any():
        for values in (x, y):
            left = values[kept][known[kept]]
            assert (left.min(), left.max()) == (values[known].min(), values[known].max())


def test_words_are_folded_between_words_only():
    assert wrapped("a long name of something", 10) == "a long\nname of\nsomething"
    assert wrapped("two\nlines", 40) == "two\nlines"
    assert wrapped("", 40) == ""
    assert wrapped("max_correspondence_distance [m]", 24) == "max_correspondence_\ndistance [m]"
    assert wrapped("lio/voxel_size", 9) == "lio/\nvoxel_\nsize"
    assert wrapped("a" * 20, 12) == "a" * 12 + "\n" + "a" * 8
