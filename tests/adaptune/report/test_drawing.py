import itertools

import matplotlib
import pytest
from matplotlib.colors import to_rgb
from pictures import is_white, share_of, texts

from adaptune.report.paper import LINES, OTHERS, POINTS, as_png_and_svg, log_scale, picture, plain
from adaptune.study.config import ALSO

DASHED = [mode for mode in ALSO if mode != "untrained"]


def draw(path, drawn=lambda axes: axes.plot([0, 1], [0, 1])):
    with picture(as_png_and_svg(path), 4.0, 3.0) as figure:
        drawn(figure.subplots())
    return path


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.6, "0.6"),
        (6, "6"),
        (0.00002, "0.00002"),
        (3e5, "300000"),
        (0.1 + 0.2, "0.3"),
        (-2.0, "-2"),
    ],
)
def test_numbers_are_plain(value, text):
    assert plain(value) == text


@pytest.mark.parametrize(
    ("low", "high"),
    [(0.55, 0.9), (0.02, 0.021), (0.3, 5.0), (1.0, 10.0), (0.004, 70.0), (1e-4, 1e5)],
)
def test_logarithmic_axes_have_plain_ticks(tmp_path, low, high):
    def drawn(axes):
        axes.plot([low, high], [low, high])
        log_scale(axes)
        log_scale(axes, "x")

    labels = [float(text) for text in texts(draw(tmp_path / "a.png", drawn))]
    # Of both axes; an e as in 1e-5 is not plain.
    assert not any("e" in text for text in texts(tmp_path / "a.png"))
    assert len([label for label in labels if low * 0.8 < label < high * 1.25]) >= 4
    assert len(labels) <= 30


def test_a_picture_is_white_and_the_same_again_whatever_the_users_style(tmp_path):
    first = draw(tmp_path / "a.png")
    assert is_white(first)
    with matplotlib.style.context("dark_background"):
        again = draw(tmp_path / "b.png")
        assert matplotlib.rcParams["figure.facecolor"] == "black"  # the user's style is left alone
    for a, b in zip(as_png_and_svg(first), as_png_and_svg(again), strict=True):
        assert a.read_bytes() == b.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "a.svg", "b.png", "b.svg"]


def test_names_are_drawn_as_they_are(tmp_path, recwarn):
    names = ["my_$x_2$", "$\\frac{1$", "[/b] :x:", "会議室"]
    path = draw(tmp_path / "a.png", lambda axes: axes.set(title="; ".join(names)))
    assert "; ".join(names) in texts(path)
    assert not recwarn.list


def test_nothing_is_left_of_a_picture_that_fails(tmp_path):
    with pytest.raises(ZeroDivisionError):
        draw(tmp_path / "a.png", lambda _: 1 / 0)
    assert not list(tmp_path.iterdir())


def test_each_of_several_equal_lines_is_seen(tmp_path):
    usual = {mode: line for mode, line in LINES.items() if mode not in DASHED}
    # Of modes on demand, hardly two are the same.
    for one in DASHED:
        lines = {mode: line for mode, line in LINES.items() if mode in usual or mode == one}

        def drawn(axes, lines=lines):
            for line in lines.values():
                axes.plot([0.0, 1.0, 2.0], [0.0, 1.0, 0.5], **line)

        path = draw(tmp_path / "a.png", drawn)
        for mode, line in lines.items():
            assert share_of(path, line["color"]) > 0.03, (one, mode)
    assert len({LINES[mode]["ls"] for mode in DASHED}) == len(DASHED)
    assert len({line["color"] for line in LINES.values()}) == len(LINES)


def grey(colour):
    return sum(w * c for w, c in zip((0.299, 0.587, 0.114), to_rgb(colour), strict=True))


def test_lines_on_each_other_differ_in_grey_too():
    greys = [1.0, *(grey(line["color"]) for line in LINES.values())]
    assert min(abs(a - b) for a, b in itertools.pairwise(greys)) > 0.2


def test_modes_have_markers_of_their_own_and_other_things_colours():
    assert len({look["marker"] for look in POINTS.values()}) == len(POINTS)
    assert len(set(OTHERS)) == len(OTHERS)
