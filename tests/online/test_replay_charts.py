from dataclasses import replace

import numpy as np
from made_replays import SCENES, SECONDS, bank, kept, replay, sequence

from adaptune.report.charts import Band, Line, Points, Spans
from offline.config import load_study
from online.charts import charts_of_replays, choice_chart, error_chart
from online.replayed import read_replays


def of_kind(panel, kind):
    return [d for d in panel.drawn if isinstance(d, kind)]


def test_errors_of_all_modes_are_drawn():
    modes = {"fixed": kept(), "paper": replay(), "another": bank()}
    (panel,) = error_chart(sequence(**modes)).panels
    assert [line.name for line in of_kind(panel, Line)] == list(modes)
    assert of_kind(panel, Spans) == [SCENES]


def test_restarts_are_marked():
    (panel,) = error_chart(sequence(fixed=kept(), paper=replay(restarted=[50]))).panels
    (last,) = of_kind(panel, Points)
    assert (last.name, list(last.x)) == ("restarted by the health check", [SECONDS[50]])


def test_what_a_mode_measured_of_itself_has_a_panel():
    estimated = np.array([[np.nan] * 3, [0.7, 0.4, 1.2], [0.8, 0.5, 1.3]])
    states = np.array(["lost", "good", "doubtful"])
    behind = np.where(SECONDS > 5.0, 0.7, np.nan)
    made = bank(estimated=estimated, states=states, errors_behind=behind)
    _, own = error_chart(sequence(fixed=kept(), adaptive=made)).panels
    assert "adaptive" in own.title
    (spans,) = of_kind(own, Spans)
    assert list(spans.edges) == [0.0, 8.0, 9.0, SECONDS[-1]]
    assert spans.names == ("lost", "", "doubtful")
    (band,) = of_kind(own, Band)
    np.testing.assert_array_equal(band.high, estimated[:, 2])
    assert [line.name for line in of_kind(own, Line)] == ["true", "measured while driving"]
    # Without a reference, that is all there is.
    blind = {"errors": np.full(len(SECONDS), np.nan)}
    (alone,) = error_chart(
        sequence(adaptive=bank(estimated=estimated, states=states, **blind))
    ).panels
    assert alone.title == own.title
    assert error_chart(sequence(fixed=replay(**blind))) is None


def test_choices_last_until_the_next_one():
    chart = choice_chart(sequence(fixed=kept(), paper=replay(), adaptive=bank()))
    distance, kernel, weights = chart.panels
    constant, steps = of_kind(distance, Line)
    assert steps.steps
    assert (constant.dashed, steps.dashed) == (True, False)
    np.testing.assert_allclose(steps.x, [0.0, 8.0, 9.0, SECONDS[-1]])
    assert list(steps.y) == [0.7, 0.9, 0.9, 0.9]
    assert distance.y.log
    assert kernel.y.names == ("huber", "none")
    assert list(of_kind(kernel, Line)[1].y) == [1.0, 1.0, 0.0, 0.0]
    shares = of_kind(weights, Band)
    np.testing.assert_allclose(shares[-1].high, 100.0)
    np.testing.assert_allclose([one.high[-1] - one.low[-1] for one in shares], [60.0, 10.0, 30.0])
    assert [one.name for one in shares] == ["trial 4", "trial 17", "trial 2"]
    # Shares hide what is shaded: a line shows where a scene ends.
    assert [line.x for line in of_kind(weights, Line)] == [[8.0, 8.0]]


def test_what_no_mode_changes_is_not_drawn_and_members_are_told():
    some = replace(sequence(fixed=kept(), adaptive=bank()), members={"trial 4": "voxel 0.2"})
    chart = choice_chart(some)
    assert [panel.title for panel in chart.panels] == [
        "adaptive applies a bank: weights of its members"
    ]
    assert "Trial 4: voxel 0.2." in chart.caption
    assert choice_chart(sequence(fixed=kept())) is None


def test_it_is_seen_when_members_work_are_lost_or_rest():
    n = len(SECONDS)
    of_17 = ["works"] * 50 + ["lost"] * 5 + ["rests"] * (n - 55)
    weights = {"trial 4": [0.5] * 3, "trial 17": [0.5] * 3}
    made = replay(weights=weights, members={"trial 4": ["works"] * n, "trial 17": of_17})
    (panel,) = choice_chart(sequence(even=made)).panels
    assert panel.y.names == ("trial 4", "trial 17")
    always, at_first = of_kind(panel, Line)
    # Until the next scan.
    assert (np.isfinite(always.y).sum(), np.isfinite(at_first.y).sum()) == (n, 51)
    (lost,) = of_kind(panel, Points)
    np.testing.assert_allclose(lost.x, SECONDS[50:55])
    np.testing.assert_array_equal(lost.y, 1.0)
    made = replay(weights=weights, members={"trial 4": ["works"] * n, "trial 17": ["late"] * n})
    (late,) = of_kind(choice_chart(sequence(even=made)).panels[0], Points)
    assert late.name == "late, or removed"
    np.testing.assert_allclose(late.x, SECONDS)
    unknown = replay(weights=weights, members=dict.fromkeys(weights, [""] * n))
    assert choice_chart(sequence(even=unknown)) is None


def test_weights_that_never_change_are_not_drawn():
    even = replay(weights={"trial 4": [0.5] * 3, "trial 17": [0.5] * 3})
    assert choice_chart(sequence(adaptive=even)) is None


def test_sets_of_several_odometries_leave_gaps():
    mixed = {"odometry": ["gicp", "ndt", "ndt"], "resolution": [None, 2.0, 2.0]}
    mixed["kernel"] = ["huber", "", ""]
    panels = choice_chart(sequence(paper=replay(choices=mixed))).panels
    by_name = {panel.title: of_kind(panel, Line)[0] for panel in panels}
    np.testing.assert_array_equal(by_name["kernel"].y, [0.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(by_name["resolution"].y, [np.nan, 2.0, 2.0, 2.0])


def test_a_sequence_without_replays_says_so(study_file, tmp_path):
    study = load_study(study_file, [], tmp_path / "study")
    missing = ["No replays of three: run `adaptune online`."]
    assert [*charts_of_replays(read_replays(study, "three"))] == missing
