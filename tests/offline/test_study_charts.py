import json

import pytest
from made_trials import write_trials

from adaptune.errors import AdaptuneError
from offline.charts import charts_of_trials, charts_of_validation
from offline.config import load_study

BOTH = """\
odometry: [{name: gicp}, {name: ndt}]
courses: {a: {scenes: [cave]}}
training: [a]
"""


@pytest.fixture
def study(study_file, tmp_path):
    return load_study(study_file, [], tmp_path / "study")


def test_trials_have_their_charts(study):
    assert charts_of_trials(study) == ([], ["No trials: run `adaptune offline`."])
    write_trials(study, lambda _, p: p["keyframe_interval"], 20)
    charts, notes = charts_of_trials(study)
    assert [chart.key for chart in charts] == [
        "iterations",
        "importance",
        "sensitivity",
        "parameter-scatter",
    ]
    assert [note.split(":")[0] for note in notes] == ["No costs of trials"]
    # The most important one comes first.
    assert charts[-1].panels[0].x.label == "keyframe_interval [m]"


def test_each_of_several_odometries_has_a_scatter(tmp_path):
    (tmp_path / "both.yaml").write_text(BOTH, "utf-8")
    study = load_study(tmp_path / "both.yaml", [], tmp_path / "study")
    write_trials(study, lambda _, p: p.get("keyframe_interval", 1.0), 40)
    charts, notes = charts_of_trials(study)
    assert any(note.startswith("No costs") for note in notes)
    keys = [chart.key for chart in charts]
    assert keys.count("parameter-scatter-gicp") == keys.count("parameter-scatter-ndt") == 1
    assert len(set(keys)) == len(keys)
    importance = charts[keys.index("importance")]
    assert {panel.title for panel in importance.panels} <= {"gicp", "ndt"}


def test_validation_is_read_or_missed(study):
    assert charts_of_validation(study) == ([], ["No validation: run `adaptune validate`."])
    study.folder.mkdir()
    row = {"recording": "one", "fixed [%]": 0.5}
    rows = [row | {"stretch": i, "adaptive": 0.8 + 0.01 * i} for i in range(4)]
    (study.folder / "stretches.json").write_text(json.dumps(rows), "utf-8")
    charts, notes = charts_of_validation(study)
    assert [chart.key for chart in charts] == ["stretches"]
    assert notes == []


@pytest.mark.parametrize(
    "text",
    [
        "[{",
        '[{"a": 1}]',
    ],
)
def test_a_damaged_validation_is_named(study, text):
    (study.folder).mkdir(exist_ok=True)
    (study.folder / "stretches.json").write_text(text, "utf-8")
    with pytest.raises(AdaptuneError, match=r"stretches\.json: is damaged .*adaptune validate"):
        charts_of_validation(study)
