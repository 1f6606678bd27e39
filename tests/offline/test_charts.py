import json
from dataclasses import replace

import numpy as np
import pytest
from made_trials import made_table, write_trials
from random_models import SPACE

from adaptune._system import yaml12
from adaptune.errors import AdaptuneError
from adaptune.report.charts import Band, Line, Points, Words
from adaptune.runs.archive import TrialSummary
from offline.bank_choice import figures
from offline.charts import (
    charts_of_trials,
    charts_of_validation,
    front_chart,
    iteration_chart,
    scatter_chart,
    segment_chart,
)
from offline.config import OfflineConfig, load_study
from offline.objective import JudgedSet
from offline.trial_table import TrialTable, importances, read_trials, trial_table


def error(name, parameters):
    """Small distances do well on `one`, large ones on `two`."""
    best = 2.0 if name == "one" else 8.0
    return 0.5 + abs(np.log(parameters["distance"] / best))


def of_kind(panel, kind, name=None):
    return [d for d in panel.drawn if isinstance(d, kind) and (name is None or d.name == name)]


def test_a_scatter_has_a_panel_for_each_sequence_and_the_mean():
    table = made_table(error, fixed=3)
    chart = scatter_chart(table, ["distance", "points"], "gicp")
    assert (chart.key, chart.title[:5]) == ("parameter-scatter-gicp", "gicp:")
    assert [panel.title for panel in chart.panels] == ["one", "two", "mean over all sequences"]
    for panel, values in zip(
        chart.panels, [table.on("one"), table.on("two"), table.values], strict=True
    ):
        (best,) = of_kind(panel, Points, "best trial here")
        assert best.x[0] == table.column("distance")[int(np.argmin(values))]
        (fixed,) = of_kind(panel, Points, "fixed")
        assert list(fixed.x) == [table.column("distance")[3]]
        (trials,) = of_kind(panel, Points, "trial")
        assert min(trials.colour) == values.min()
        # Where colours end below the worst, the colour bar says so.
        ends = np.max(trials.colour) < np.max(values)
        top = f"\ntop: ≥ {4.0 * values.min():.3g}" if ends else ""
        assert trials.colour_label == table.objective + top
        assert ends == (panel.title != "mean over all sequences")
    assert scatter_chart(table, ["distance"], "") is None


def test_a_trial_that_failed_is_no_best():
    runs = {
        i: TrialSummary(
            SPACE.baseline | {"points": i + 1},
            1.0 - 0.1 * i,
            0,
            0,
            1.0,
            failure="no pose" * (i == 2),
        )
        for i in range(4)
    }
    (panel,) = iteration_chart(trial_table(OfflineConfig(), SPACE, {"one": runs})).panels
    np.testing.assert_allclose(of_kind(panel, Line)[0].y, [1.0, 0.9, 0.9, 0.7])


def tried(*trials, fixed=None):
    """A table of trials, each with its cost and its error."""
    made = {n: JudgedSet({}, value, cost=cost) for n, (cost, value) in enumerate(trials)}
    return TrialTable(SPACE, ["one"], made, fixed=fixed)


def test_the_front_has_less_error_for_more_time():
    table = tried(
        *((5.0, 3.0), (1.0, 9.0), (1.0, 8.0), (4.0, 4.0), (7.0, 3.0)),
        *((np.nan, 0.1), (0.1, np.nan), (9.0, 1.0)),
        fixed=3,
    )
    (panel,) = front_chart(table).panels
    (front,) = of_kind(panel, Line)
    assert [*zip(front.x, front.y, strict=True)] == [(1.0, 8.0), (4.0, 4.0), (5.0, 3.0), (9.0, 1.0)]
    points = {d.name: list(d.x) for d in of_kind(panel, Points)}
    assert len(points.pop("tried")) == 6
    assert points == {"fixed": [4.0], "baseline": [5.0]}
    (words,) = of_kind(panel, Words)
    assert list(words.words) == ["fixed", "baseline"]
    assert (list(words.x), list(words.y)) == ([4.0, 5.0], [4.0, 3.0])


@pytest.mark.parametrize("more", [[], [(np.nan, 2.0)], [(1.0, 0.0)]])
def test_one_known_point_is_no_front(more):
    assert front_chart(tried((5.0, 3.0), *more)) is None


def test_trials_that_may_be_chosen_are_on_the_front():
    table = made_table(error)
    failed = table.trials[5]._replace(failure="no pose")
    table = replace(table, trials={**table.trials, 5: failed})
    (panel,) = front_chart(table).panels
    points = of_kind(panel, Points, "tried")[0].texts
    assert list(points[:6]) == ["baseline", *(f"trial {i}" for i in (1, 2, 3, 4, 6))]
    assert len(points) == len(table) - 1


def test_a_study_is_read(study_file, tmp_path):
    study = load_study(study_file, [], tmp_path / "study")
    assert not len(read_trials(study))
    write_trials(study, lambda _, p: p["keyframe_interval"], 5)
    table = read_trials(study)
    intervals = table.column("keyframe_interval")
    np.testing.assert_allclose(table.values, intervals, rtol=1e-6)
    assert table.fixed is None
    (study.folder / "fixed.yaml").write_text(yaml12.dump(table.trials[2].parameters), "utf-8")
    assert read_trials(study).fixed == 2


def error_of_kernels(_, parameters):
    slow = 1.0 if parameters["kernel"] == "none" else 1.3
    return slow * (0.2 + abs(np.log(parameters["distance"] / 3.0)))


def test_what_changes_the_error_matters_most():
    found = importances(made_table(error_of_kernels, 120))
    assert list(found) == ["distance", "kernel", "points"]
    assert sum(found.values()) == pytest.approx(1.0)
    assert found["distance"] > 0.9
    assert importances(made_table(error_of_kernels, 120)) == found


def test_few_trials_and_equal_errors_say_nothing():
    assert importances(made_table(error_of_kernels, 7)) == {}
    assert importances(made_table(lambda *_: 1.0, 40)) == {}


BOTH = """\
odometry: [{name: gicp}, {name: ndt}]
courses: {a: {scenes: [cave]}}
training: [a]
"""


@pytest.fixture
def study(study_file, tmp_path):
    return load_study(study_file, [], tmp_path / "study")


def test_trials_have_their_charts(study):
    assert [*charts_of_trials(study)] == ["No trials: run `adaptune offline`."]
    cost = {"register_ms": 2.0, "prepare_ms": 1.0}
    write_trials(study, lambda _, p: p["keyframe_interval"], 20, others=cost)
    charts = [*charts_of_trials(study)]
    assert [chart.key for chart in charts] == [
        *("iterations", "importance", "parameter-scatter", "front")
    ]
    # The most important one comes first.
    assert charts[2].panels[0].x.label == "keyframe_interval [m]"


def test_each_of_several_odometries_has_a_scatter(tmp_path):
    (tmp_path / "both.yaml").write_text(BOTH, "utf-8")
    study = load_study(tmp_path / "both.yaml", [], tmp_path / "study")
    write_trials(study, lambda _, p: p.get("keyframe_interval", 1.0), 40)
    charts = [chart for chart in charts_of_trials(study) if chart]  # there are no costs
    keys = [chart.key for chart in charts]
    assert keys.count("parameter-scatter-gicp") == keys.count("parameter-scatter-ndt") == 1
    assert len(set(keys)) == len(keys)
    importance = charts[keys.index("importance")]
    assert {panel.title for panel in importance.panels} <= {"gicp", "ndt"}


def test_validation_is_read_or_missed(study):
    assert [*charts_of_validation(study.folder)] == ["No validation: run `adaptune validate`."]
    study.folder.mkdir()
    row = {"recording": "one", "fixed [%]": 0.5}
    rows = [row | {"segment": i, "adaptive": 0.8 + 0.01 * i} for i in range(4)]
    (study.folder / "segments.json").write_text(json.dumps(rows), "utf-8")
    assert [chart.key for chart in charts_of_validation(study.folder)] == ["segments"]


@pytest.mark.parametrize("text", ["[{", '[{"a": 1}]'])
def test_a_damaged_validation_is_named(study, text):
    (study.folder).mkdir(exist_ok=True)
    (study.folder / "segments.json").write_text(text, "utf-8")
    with pytest.raises(AdaptuneError, match=r"segments\.json: is damaged .*adaptune validate"):
        list(charts_of_validation(study.folder))


def test_segments_are_sorted_and_have_the_interval_of_their_mean():
    ratio = np.exp(np.random.default_rng(0).normal(-0.2, 0.1, 12))
    of_drives = [{"recording": f"drive_{i // 6}", "segment": i % 6} for i in range(12)]
    rows = [
        row | {"fixed [%]": 0.5, "one set": 1.0, "adaptive": float(adaptive)}
        for row, adaptive in zip(of_drives, ratio, strict=True)
    ]
    (panel,) = segment_chart(rows).panels  # one set is the fixed set
    (points,) = of_kind(panel, Points)
    assert list(points.texts) == [row["recording"] for row in rows]
    np.testing.assert_array_equal(np.argsort(points.x), np.argsort(points.y))
    of = figures(np.log([r["adaptive"] for r in rows]), [r["recording"] for r in rows])
    (band,) = (d for d in panel.drawn if isinstance(d, Band))
    assert (band.low[0], band.high[0]) == (of.low, of.high)
    mean = next(d for d in panel.drawn if isinstance(d, Line))
    assert mean.y[0] == pytest.approx(np.exp(np.log(points.y).mean()))
    assert panel.title == f"adaptive: {of.geometric:.2f} ({of.low:.2f}-{of.high:.2f})"
