import numpy as np
import pytest
from pictures import is_white, share_of, texts

from adaptune.report.paper import LINES, POINTS
from offline.objective import label
from offline.pictures import (
    CANCELLING,
    THRIFTY,
    LeftOutResults,
    Point,
    draw_front,
    draw_frontier,
    draw_validation,
)

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


def results(modes, **changed):
    made = LeftOutResults(
        ratios={mode: np.full(6, 1.0) for mode in modes},
        sequences=[f"drive_{i}" for i in range(6)],
        familiarity=np.linspace(0.0, 1.0, 50),
        gain=np.linspace(0.9, 1.1, 50),
        portfolio=np.full(6, 1.0),
        learning=[],
        banks=[],
    )
    return made._replace(**changed)


def rows(name, numbers):
    return [{name: n, "geometric": 1.0, "low": 0.8, "high": 1.2} for n in numbers]


def test_modes_with_equal_errors_are_all_seen(tmp_path):
    modes = [
        "baseline",
        "fixed",
        "adaptive",
        "paper",
        "one set",
        "oracle, sequence",
        "oracle, period",
    ]
    path = tmp_path / "validation.png"
    draw_validation(path, "study", results(modes))
    said = texts(path)
    for mode in set(modes) - {"fixed"}:
        assert mode in said
        assert share_of(path, POINTS[mode]["color"], above=0.6) > 0.003, mode
    assert share_of(path, LINES["fixed"]["color"], above=0.6) > 0.05
    assert is_white(path)
    assert said.count("error over the fixed set's [-]") == 3
    assert "number of sets [-]" in said
    assert not [text for text in said if "interval" in text or "so many members" in text]


def test_curves_are_explained_where_they_are_drawn(tmp_path):
    path = tmp_path / "validation.png"
    found = results(["fixed", "adaptive"], familiarity=np.full(50, np.nan))
    found = found._replace(banks=rows("instances", (2, 3)), learning=rows("stretches", (3, 5)))
    draw_validation(path, "study", found)
    said = texts(path)
    assert "number of sets, or members, or training stretches [-]" in said
    assert {"bank of so many members", "adaptive, trained on so many"} <= set(said)
    assert not [text for text in said if "familiarity" in text]


def test_familiarity_is_not_drawn_where_nothing_adapts(tmp_path):
    path = tmp_path / "validation.png"
    for gain, drawn in ((np.full(50, 1.0), 0), (np.full(50, 0.9), 1)):
        draw_validation(path, "study", results(["fixed", "adaptive"], gain=gain))
        assert texts(path).count("where scans are known and new") == drawn


def test_wide_intervals_do_not_shrink_the_rest(tmp_path):
    wide = [row | {"low": 1e-6, "high": 1e6} for row in rows("stretches", (1, 2))]
    draw_validation(tmp_path / "v.png", "study", results(["fixed", "adaptive"], learning=wide))
    assert max(float(t) for t in texts(tmp_path / "v.png") if t.replace(".", "").isdigit()) < 100


@pytest.mark.parametrize("n", [2, 40])
def test_every_sequence_is_named(tmp_path, n):
    names = [f"a_long_name_of_a_drive_{i}" for i in range(n)]
    found = results(["fixed", "adaptive"], ratios={"adaptive": np.linspace(0.5, 2.0, n)})
    draw_validation(tmp_path / "v.png", "study", found._replace(sequences=names))
    assert set(names) <= set(texts(tmp_path / "v.png"))


def points():
    rng = np.random.default_rng(0)
    sets = [
        Point(what, str(i), cost * rng.uniform(0.8, 1.2), rng.uniform(0.8, 2.5))
        for what, cost in (("gicp", 6.0), ("kiss_icp", 40.0))
        for i in range(12)
    ]
    banks = [
        Point(what, str(n), share * 20.0 * n, 0.9 / np.sqrt(n))
        for what, share in ((CANCELLING, 1.0), (THRIFTY, 0.7))
        for n in (2, 3, 4)
    ]
    modes = (("baseline", 6.0, 2.1), ("best_default", 38.0, 1.6), ("equal_cost", 45.0, 0.95))
    modes = (*modes, ("fixed", 40.0, 1.0), ("adaptive", 60.0, 0.52))
    return [*sets, *banks, *(Point(mode, mode, cost, ratio) for mode, cost, ratio in modes)]


def test_error_against_cost_is_drawn(tmp_path):
    path = tmp_path / "costs.png"
    draw_frontier(path, "six", points(), 70.0)
    said = texts(path)
    labels = ["gicp", "kiss_icp", "front of the sets", "budget", *MARKED, "adaptive"]
    labels += ["best_default", "equal_cost", f"{CANCELLING}: 2, 3, ...", f"{THRIFTY}: 2, 3, ..."]
    for text in ("CPU time a scan [ms]", "six: error against cost", *labels):
        assert said.count(text) == 1, text
    assert {"1", "10", "50"} <= set(said)
    assert is_white(path)
    for mode in ("baseline", "best_default", "equal_cost", "fixed", "adaptive"):
        assert share_of(path, POINTS[mode]["color"]) > 0.01, mode


def test_what_there_is_not_is_not_in_the_legend(tmp_path):
    path = tmp_path / "costs.png"
    few = [p for p in points() if p.what in ("gicp", "fixed")]
    draw_frontier(path, "six", [*few, Point("gicp", "99", 5.0, 80.0)], None)
    said = texts(path)
    assert {"gicp", "fixed"} <= set(said)
    assert not {"budget", "adaptive", "bank: 2, 3, ..."} & set(said)
    assert "50" not in said  # a set that fails
    draw_frontier(path, "six", [p for p in points() if p.what in POINTS], None)
    assert "gicp" not in texts(path)
