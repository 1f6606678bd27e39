from dataclasses import replace

import numpy as np
import pytest
from made_replays import SCENES, SECONDS, bank, kept, replay, sequence

from adaptune.report.charts import Band, Line, Points, Spans, Words
from online.charts import charts_of_comparison, overview_chart
from online.statistics import ComparisonRow


def rows(yardstick="fixed", **errors):
    """Rows of sequences `a` and `new`, on which the modes differ more, and of both."""
    return [
        ComparisonRow(name, mode, 0.7 + share * (rte - 0.7), 1.0, yardstick=yardstick)
        for name, share in (("a", 0.5), ("new", 1.0), ("all", 2.0))
        for mode, rte in errors.items()
    ]


TRAINED = rows(baseline=1.4, fixed=0.7, adaptive=0.6, paper=9.0)


def overview(replayed, of=TRAINED):
    asked = []
    chart = overview_chart(of, lambda name: asked.append(name) or replayed)
    assert asked == ["new"]
    return chart


def of_kind(panel, kind):
    return [d for d in panel.drawn if isinstance(d, kind)]


def modes(**changed):
    return {"baseline": replay(), "fixed": kept(), "adaptive": bank(), "paper": replay()} | changed


def test_the_sequence_is_shown_on_which_the_main_modes_differ_most():
    chart = overview(sequence(**modes()))
    assert chart.title == "new: error of baseline (1.4 %), fixed (0.7 %) and adaptive (0.6 %)"
    path, errors, chosen = chart.panels
    assert [line.name for line in of_kind(path, Line)] == ["cave", "open"]
    assert of_kind(path, Words)[0].words == ["start", "cave", "open"]
    assert [line.name for line in of_kind(errors, Line)] == ["baseline", "fixed", "adaptive"]
    assert of_kind(errors, Spans) == of_kind(chosen, Spans) == [SCENES]
    assert len(of_kind(chosen, Band)) == 3
    assert len(of_kind(chosen, Line)) == 1


def test_nothing_is_shown_where_a_mode_is_hidden():
    assert overview(sequence(baseline=replay(), paper=replay())) is None


def test_the_path_lies_along_x():
    steep = np.column_stack([-SECONDS, 2.0 * SECONDS])
    cave, _ = of_kind(overview(sequence(**modes(adaptive=bank(places=steep)))).panels[0], Line)
    np.testing.assert_allclose(cave.y, 0.0, atol=0.1 * SECONDS[-1])
    assert cave.x[0] == 0.0 < cave.x[-1]


def test_where_no_places_are_known_the_path_shows_the_error():
    path, errors, _ = overview(replace(sequence(**modes()), scenes=None)).panels
    (dots,) = of_kind(path, Points)
    assert len(dots.x) == len(dots.colour)
    assert np.isfinite(dots.colour).all()
    assert not of_kind(errors, Spans)


def test_of_one_set_at_a_time_what_changes_most_is_shown():
    choices = {"distance": [0.7, 0.9, 0.8], "kernel": ["none", "none", "huber"]}
    *_, chosen = overview(sequence(**modes(adaptive=replay(choices=choices)))).panels
    assert chosen.title == "what adaptive chose: distance"
    assert [line.name for line in of_kind(chosen, Line)] == ["baseline", "fixed", "adaptive"]


@pytest.mark.parametrize("choices", [{"distance": [0.7] * 3}, None])
def test_what_kept_the_fixed_set_has_no_panel_and_hides_no_line(choices):
    same = kept() if choices is None else replay(choices=choices)
    _, errors = overview(sequence(**modes(adaptive=same, baseline=replay(errors=SECONDS)))).panels
    dashed = {line.name: line.dashed for line in of_kind(errors, Line)}
    assert dashed == {"baseline": False, "fixed": False, "adaptive": True}


def test_without_a_model_there_are_two_modes():
    of = rows("baseline", baseline=1.4, untrained=0.7)
    chart = overview(sequence(baseline=kept(), untrained=bank()), of)
    assert chart.title == "new: error of baseline (1.4 %) and untrained (0.7 %)"


def test_without_errors_there_is_no_picture():
    unknown = [replace(row, rte=None, ratio=None) for row in TRAINED]
    assert [*charts_of_comparison(unknown, sequence)] == [
        *(None, "No ratios of errors: no sequence has a reference.")
    ]
