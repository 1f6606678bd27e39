import numpy as np
from pictures import is_white, share_of, texts

from adaptune.report.paper import POINTS
from offline.objective import label
from offline.pictures import draw_front

VALUES = np.array([[0.5, 9.0], [0.7, 5.0], [4.0, 2.0], [30.0, 7.0]])
MARKED = {"baseline": (4.0, 2.0), "fixed": (0.5, 9.0)}


def test_objectives_have_units():
    assert label({"rte": 1.0, "ape": 0.5}) == "rte + 0.5 ape"
    assert label({"rte": 1.0, "ape": 0.5}, units=True) == "rte [%] + 0.5 ape [m]"
    assert label({"ms_per_scan": 1.0}, units=True) == "ms_per_scan [ms]"


def test_baseline_and_fixed_are_marked_on_the_front(tmp_path):
    path = tmp_path / "pareto.png"
    draw_front(path, ["rte [%]", "memory [MB]"], VALUES, VALUES[:3], MARKED)
    said = texts(path)
    for text in ("rte [%]", "memory [MB]", "tried", "Pareto front", "baseline", "fixed"):
        assert said.count(text) == 1, text
    assert {"0.5", "1", "20"} <= set(said)  # from 0.5 to 30: logarithmic
    assert is_white(path)
    for mode in MARKED:
        assert share_of(path, POINTS[mode]["color"], above=0.9) > 0.01, mode


def test_a_front_of_three_objectives_has_two_panels_and_no_line(tmp_path):
    values = np.column_stack([VALUES, [1.0, 2.0, 3.0, 4.0]])
    marked = {name: (*of_set, 2.0) for name, of_set in MARKED.items()}
    path = tmp_path / "pareto.png"
    draw_front(path, ["rte [%]", "ape [m]", "cpu [% of a core]"], values, values, marked)
    assert [texts(path).count(t) for t in ("rte [%]", "ape [m]", "cpu [% of a core]")] == [1, 2, 1]
    assert share_of(path, "#d55e00") < 0.5  # markers only
