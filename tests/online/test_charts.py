import csv
import shutil
from dataclasses import replace

import numpy as np
import pytest
from made_replays import SCENES, SECONDS, bank, kept, replay, sequence
from rooms import along_x

from adaptune.report.charts import Band, Line, Mark, Points, Shares, Spans, Words
from adaptune.trajectory import Trajectory
from offline.config import load_study
from online.charts import (
    charts_of_comparison,
    charts_of_replays,
    choice_chart,
    comparison_chart,
    error_chart,
    familiarity_chart,
    histograms,
    latency_chart,
    overview_chart,
    read_replays,
    scene_spans,
    scenes_along,
    switches,
)
from online.modes import run_replays
from online.record import StoredReplayError
from online.statistics import ComparisonRow


def of_kind(panel, kind):
    return [d for d in panel.drawn if isinstance(d, kind)]


def test_errors_of_all_modes_are_drawn_with_their_switches():
    modes = {"fixed": kept(), "paper": replay(), "another": bank()}
    (panel,) = error_chart(sequence(**modes)).panels
    assert [line.name for line in of_kind(panel, Line)] == list(modes)
    # A bank changes its weights, and no parameters.
    (marks,) = of_kind(panel, Points)
    assert marks.name == "paper"
    np.testing.assert_allclose(marks.x, [8.0, 9.0])
    assert of_kind(panel, Spans) == [SCENES]


def test_only_changes_are_switches():
    nan = {"distance": [0.7, 0.7, 0.9], "resolution": [np.nan, np.nan, np.nan]}
    np.testing.assert_array_equal(switches(replay(choices=nan)), [9.0])
    assert not len(switches(kept()))
    assert not len(switches(bank()))


def test_restarts_are_marked():
    restarted = np.zeros(len(SECONDS), bool)
    restarted[50] = True
    (panel,) = error_chart(sequence(fixed=kept(), paper=replay(restarted=restarted))).panels
    last = of_kind(panel, Points)[-1]
    assert (last.name, list(last.x)) == ("restarted by the health check", [SECONDS[50]])


def test_what_a_mode_measured_of_itself_has_a_panel():
    estimated = np.array([[np.nan] * 3, [0.7, 0.4, 1.2], [0.8, 0.5, 1.3]])
    lost = np.array([True, False, True])
    behind = np.where(SECONDS > 5.0, 0.7, np.nan)
    made = bank(estimated=estimated, lost=lost, errors_behind=behind)
    _, own = error_chart(sequence(fixed=kept(), adaptive=made)).panels
    assert "adaptive" in own.title
    (spans,) = of_kind(own, Spans)
    assert list(spans.edges) == [0.0, 8.0, 9.0, SECONDS[-1]]
    assert spans.names == ("lost", "", "lost")
    (band,) = of_kind(own, Band)
    np.testing.assert_array_equal(band.high, estimated[:, 2])
    assert [line.name for line in of_kind(own, Line)] == ["true", "measured while driving"]
    # Without a reference, that is all there is.
    blind = {"errors": np.full(len(SECONDS), np.nan)}
    (alone,) = error_chart(sequence(adaptive=bank(estimated=estimated, lost=lost, **blind))).panels
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
    (shares,) = of_kind(weights, Shares)
    np.testing.assert_allclose(shares.shares.sum(axis=0), 100.0)
    np.testing.assert_allclose(shares.shares[:, -1], [60.0, 10.0, 30.0])
    assert shares.names == ("trial 4", "trial 17", "trial 2")
    # Shares hide what is shaded: a line shows where a scene ends.
    assert [mark.at for mark in of_kind(weights, Mark)] == [8.0]


def test_weights_that_never_change_are_not_drawn():
    even = replay(weights={"trial 4": [0.5] * 3, "trial 17": [0.5] * 3})
    assert choice_chart(sequence(adaptive=even)) is None


def test_sets_of_several_odometries_leave_gaps():
    mixed = {"odometry": ["gicp", "ndt", "ndt"], "resolution": [np.nan, 2.0, 2.0]}
    mixed["kernel"] = ["huber", "", ""]
    panels = choice_chart(sequence(paper=replay(choices=mixed))).panels
    by_name = {panel.title: of_kind(panel, Line)[0] for panel in panels}
    np.testing.assert_array_equal(by_name["kernel"].y, [0.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(by_name["resolution"].y, [np.nan, 2.0, 2.0, 2.0])


def test_a_sequence_without_replays_says_so(study_file, tmp_path):
    study = load_study(study_file, [], tmp_path / "study")
    missing = ["No replays of three: run `adaptune online`."]
    assert charts_of_replays(read_replays(study, "three")) == ([], missing)


def test_familiarity_is_shown_of_those_that_know_it():
    known = bank()._replace(familiarity=np.array([0.2, np.nan, 0.9]))
    (panel,) = familiarity_chart(sequence(fixed=kept(), paper=replay(), adaptive=known)).panels
    assert [d.name for d in panel.drawn if isinstance(d, Line)] == ["adaptive"]
    assert familiarity_chart(sequence(paper=replay())) is None


def test_shares_of_times_add_up():
    times = {"fixed": np.array([1.0, 1.0, 4.0]), "paper": np.array([2.0, 30.0])}
    for line in histograms(times):
        assert sum(line.y) == pytest.approx(100.0)
        assert len(line.x) == len(line.y)
    fixed, paper = histograms(times)
    assert list(fixed.x) == list(paper.x)
    assert fixed.y[0] == pytest.approx(200.0 / 3.0)


def test_a_replay_in_real_time_has_a_delay_of_its_poses():
    lockstep = latency_chart(sequence(fixed=kept(), paper=replay()))
    assert len(lockstep.panels) == 2
    late = replay()._replace(late_ms=np.full(len(SECONDS), 12.0))
    select, _, pose = latency_chart(sequence(fixed=kept(), paper=late)).panels
    assert not [d for d in select.drawn if isinstance(d, Mark)]
    (mark,) = (d for d in pose.drawn if isinstance(d, Mark))
    assert mark.at == pytest.approx(100.0)
    assert [d.name for d in pose.drawn if isinstance(d, Line)] == ["paper"]


LEGS = [("cave", 20.0), ("open", 30.0), ("street", 10.0)]
START = 1_600_000_000_000_000_000


def drive(stretched=1.0):
    """Two metres a second in the cave, then three; the path may be longer than the road."""
    seconds = np.linspace(0.0, 10.0 + 40.0 / 3.0, 2000)
    x = np.where(seconds < 10.0, 2.0 * seconds, 20.0 + 3.0 * (seconds - 10.0))
    stamps = START + np.rint(seconds * 1e9).astype(np.int64)
    return Trajectory(stamps, along_x(stretched * x))


@pytest.mark.parametrize("stretched", [1.0, 1.1])
def test_metres_of_the_road_become_seconds(stretched):
    driven = drive(stretched)
    spans = scene_spans(LEGS, driven, driven.stamps)
    assert spans.names == ("cave", "open", "street")
    np.testing.assert_allclose(spans.edges, [0.0, 10.0, 20.0, 70.0 / 3.0], atol=0.02)


def test_of_a_part_its_own_scenes_are_shown():
    driven = drive()
    part = driven.stamps[(driven.stamps >= START + 15e9) & (driven.stamps <= START + 21e9)]
    spans = scene_spans(LEGS, driven, part)
    assert spans.names == ("open", "street")
    np.testing.assert_allclose(spans.edges, [0.0, 5.0, 6.0], atol=0.03)


LOOP = 20.0 * np.column_stack([np.sin(SECONDS / 3.5), 1.0 - np.cos(SECONDS / 3.5)])


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
    assert len(of_kind(chosen, Shares)) == len(of_kind(chosen, Mark)) == 1


def test_the_path_lies_along_x_or_stands_upright_beside_the_errors():
    steep = np.column_stack([-SECONDS, 2.0 * SECONDS])
    (cave, _), long = line_of(steep)
    np.testing.assert_allclose(cave.y, 0.0, atol=0.1 * SECONDS[-1])
    assert cave.x[0] == 0.0 < cave.x[-1]
    assert not long.aside
    legs, loop = line_of(LOOP * (1.5, 1.0))
    x, y = (np.concatenate([getattr(leg, axis) for leg in legs]) for axis in "xy")
    assert loop.aside
    assert np.ptp(x) < np.ptp(y)


def line_of(places):
    chart = overview(sequence(**modes(adaptive=bank(places=places))))
    return of_kind(chart.panels[0], Line), chart


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


def test_the_axis_is_logarithmic_where_a_mode_is_lost():
    lost = replay(errors_around=np.where(SECONDS < 10.0, 0.7, 80.0))
    plain, wide = (overview(sequence(**modes(baseline=of))).panels[1].y for of in (replay(), lost))
    assert (plain.log, plain.limits[0], wide.log) == (False, 0.0, True)


def test_without_a_model_there_are_two_modes():
    of = rows("baseline", baseline=1.4, untrained=0.7)
    chart = overview(sequence(baseline=kept(), untrained=bank()), of)
    assert chart.title == "new: error of baseline (1.4 %) and untrained (0.7 %)"


def test_without_errors_there_is_no_picture():
    unknown = [replace(row, rte=None, ratio=None) for row in TRAINED]
    charts, notes = charts_of_comparison(unknown, sequence)
    assert charts == []
    assert notes == ["No ratios of errors: no sequence has a reference."]


def row(sequence, mode, ratio, low=None, high=None, other="fixed"):
    ends = None if low is None else (low, high)
    return ComparisonRow(sequence, mode, 1.0, ratio, 0, 0, 0, ratio_interval=ends, yardstick=other)


ROWS = [
    row("one", "baseline", 1.4),
    row("one", "fixed", 1.0, 1.0, 1.0),
    row("one", "new_mode", 0.7),
    row("one", "adaptive", 0.8, 0.7, 0.9),
    row("two", "baseline", 1.2),
    row("two", "fixed", 1.0),
    row("two", "adaptive", 0.9),
    row("two", "new_mode", None),
    row("all", "baseline", 1.3),
    row("all", "adaptive", 0.85, 0.8, 0.95),
    row("all", "oracle, sequence", 0.6),
]


def drawn(rows, kind):
    (panel,) = comparison_chart(rows).panels
    return {d.name: d for d in panel.drawn if isinstance(d, kind)}


def test_modes_stand_below_each_other_from_the_least_error():
    (panel,) = comparison_chart(ROWS).panels
    assert panel.y.names == ("baseline", "adaptive", "oracle, sequence")  # from below
    points = drawn(ROWS, Points)
    assert list(points) == ["geometric mean over all sequences", "one", "two"]
    means = points["geometric mean over all sequences"]
    assert list(zip(means.x, means.y, strict=True)) == [(1.3, 0.0), (0.85, 1.0), (0.6, 2.0)]
    (interval,) = drawn(ROWS, Line).values()
    np.testing.assert_array_equal(interval.x, [0.8, 0.95, np.nan])
    assert list(interval.y) == [1.0] * 3
    # What lies lower still belongs to the line.
    one = points["one"]
    assert list(one.x) == [1.4, 0.8]
    assert np.ceil(one.y).tolist() == [0.0, 1.0]
    assert one.texts == ["baseline, one", "adaptive, one"]


def test_many_sequences_have_one_look():
    few, many = ([row(f"s{i}", "adaptive", 0.8) for i in range(n)] for n in (6, 7))
    last = [row("all", "adaptive", 0.8)]
    assert len(drawn(few + last, Points)) == 7
    points = drawn(many + last, Points)
    assert len(points) == 2
    assert len(points["each sequence"].x) == 7
    assert points["each sequence"].faint


def test_of_one_sequence_there_is_nothing_below():
    rows = [row("one", "fixed", 1.0), row("one", "adaptive", 0.8), row("one", "paper", 2.0)]
    (points,) = drawn(rows, Points).values()
    assert (points.name, list(points.x)) == ("one", [2.0, 0.8])
    assert not drawn(rows, Line)
    assert "Below each mean" not in comparison_chart(rows).caption


def test_the_baseline_may_be_what_others_are_compared_with():
    rows = [row("one", "baseline", 1.0, other="baseline")]
    assert comparison_chart(rows) is None
    rows.append(row("one", "untrained", 0.7, other="baseline"))
    assert "baseline" in comparison_chart(rows).title


@pytest.mark.parametrize("rows", [[], [row("one", "adaptive", None)]])
def test_without_ratios_there_is_no_chart(rows):
    assert comparison_chart(rows) is None


COURSE = """\
odometry: {name: gicp}
courses:
  a: {scenes: [cave, street], length: 20}
  b: {scenes: [cave]}
training: [b]
test: [a: 50-100%]
"""


@pytest.fixture(scope="module")
def study(study_file, trained_folder, tmp_path_factory):
    folder = shutil.copytree(trained_folder, tmp_path_factory.mktemp("run") / "study")
    made = load_study(study_file, [], folder)
    run_replays(made, made.folder / "model.safetensors")
    return made


def test_replays_are_read_with_what_was_measured(study):
    replayed = read_replays(study, "three")
    assert list(replayed.modes) == ["baseline", "fixed", "adaptive", "paper"]
    assert replayed.scenes is None
    for mode, of in replayed.modes.items():
        n, m = len(of.seconds), len(of.choice_seconds)
        assert of.places.shape == (n, 2)
        assert of.scan_ms.shape == (n,)
        assert of.familiarity.shape == (m,)
        assert len(of.selection_ms) == m
        assert np.isfinite(of.selection_ms).all() == of.adapts
        assert of.adapts == (mode in ("adaptive", "paper"))
        # The reference goes straight on; the odometry nearly so.
        assert abs(of.places[:, 1]).max() < 1e-6
        assert (np.isfinite(of.errors_around) >= np.isfinite(of.errors)).all()
    with (study.folder / "replays/three/paper/selections.csv").open() as file:
        told = [float(row["ms"]) for row in csv.DictReader(file)]
    np.testing.assert_array_equal(replayed.modes["paper"].selection_ms, told)
    assert read_replays(study, "one").modes == {}


def test_all_charts_are_made(study):
    charts, notes = charts_of_replays(read_replays(study, "three"))
    keys = {chart.key for chart in charts}
    assert {"three-errors", "three-choices", "three-latency", "three-familiarity"} <= keys
    assert all(chart.caption and chart.title.startswith("three: ") for chart in charts)
    assert notes == []


def test_a_damaged_table_is_refused(study, study_file, tmp_path):
    own = load_study(study_file, [], shutil.copytree(study.folder, tmp_path / "study"))
    path = own.folder / "replays/three/paper/selections.csv"
    header, first, *rest = path.read_text("utf-8").splitlines()
    column = header.split(",").index("familiarity")
    cells = first.split(",")
    cells[column] = "x"
    path.write_text("\n".join([header, ",".join(cells), *rest]), "utf-8")
    with pytest.raises(StoredReplayError, match="paper"):
        read_replays(own, "three")


def test_scenes_of_a_part_of_a_course_are_those_of_that_part(tmp_path):
    (tmp_path / "course.yaml").write_text(COURSE, "utf-8")
    study = load_study(tmp_path / "course.yaml", [], tmp_path / "study")
    (name,) = study.config.test
    recording = study.sequences.recording(name).with_suffix(".tum")
    stamps = 10**9 * np.arange(41)
    assert scenes_along(study.sequences, name, stamps) is None  # it is not recorded yet
    recording.parent.mkdir(parents=True)
    recording.write_text("".join(f"{i}.000000000 {i}.0 0 0 0 0 0 1\n" for i in range(41)), "utf-8")
    spans = scenes_along(study.sequences, name, stamps[15:])
    assert spans.names == ("cave", "street")
    np.testing.assert_allclose(spans.edges, [0.0, 5.0, 25.0])
    assert scenes_along(study.sequences, "unknown", stamps) is None
