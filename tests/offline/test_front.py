"""What CPU time buys, and what it costs here."""

import json
import shutil
from types import SimpleNamespace

import pytest

from adaptune.errors import AdaptuneError
from offline.config import load_study
from offline.front import COST, left_out_in_words, measured_front, recommended


@pytest.fixture
def study(study_file, trained_folder, tmp_path):
    return load_study(study_file, [], shutil.copytree(trained_folder, tmp_path / "study"))


def test_the_front_begins_with_what_is_recommended(study):
    rows = json.loads((study.folder / "front.json").read_text("utf-8"))
    assert [row["recommended"] for row in rows] == [True] + [False] * (len(rows) - 1)
    assert rows[0]["trial"] == study.model().fixed
    (base,) = (row for row in rows if row["trial"] == 0)
    assert base["vs baseline"] == pytest.approx(1.0)
    costs = [row[COST] for row in rows[1:]]
    assert costs == sorted(costs)
    for row in rows:
        assert row["error [%]"] == pytest.approx(base["error [%]"] * row["vs baseline"])


def test_the_front_is_measured_on_another_recording(study):
    scans = study.sequences.open("two")
    rows = measured_front(study, scans)
    assert sum(row["recommended"] for row in rows) == 1
    assert all(row["99 % [ms]"] > 0.0 and row["memory [MB]"] > 0.0 for row in rows)
    assert [row[COST] for row in rows] == sorted(row[COST] for row in rows)
    assert {row["trial"] for row in rows} >= {0, study.model().fixed}
    (study.folder / "front.json").unlink()
    with pytest.raises(AdaptuneError, match=r"front.json: there is no such file; run .* offline"):
        measured_front(study, scans)


def test_more_data_are_not_asked_for_in_the_name_of_a_command():
    blocks = SimpleNamespace(errors=[])
    said = left_out_in_words(SimpleNamespace(blocks=lambda: blocks, budget=None))
    assert said.endswith("on other drives, train on longer recordings, or more.")
    assert "record" not in said.split()


def test_a_budget_decides_also_below_what_the_baseline_costs():
    rows = [
        {"trial": trial, COST: cost, "99 % [ms]": 2.0 * cost, "error [%]": error}
        for trial, cost, error in ((0, 10.0, 1.0), (1, 9.0, 0.5), (2, 4.0, 2.0), (3, 30.0, 0.1))
    ]
    for budget, period, trial in (
        (None, 100.0, 1),
        (40.0, 200.0, 3),
        (40.0, 100.0, 1),  # the dearest may come too late
        (5.0, 100.0, 2),
        (1.0, 100.0, 2),
    ):
        assert recommended(rows, budget, period)["trial"] == trial
