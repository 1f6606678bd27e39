"""What CPU time buys, and what it costs here."""

import json
import shutil

import pytest

from adaptune.errors import AdaptuneError
from offline.config import load_study
from offline.front import COST, OWN, elsewhere_in_words, measured_front, recommended


@pytest.fixture
def study(study_file, trained_folder, tmp_path):
    return load_study(study_file, [], shutil.copytree(trained_folder, tmp_path / "study"))


def test_the_front_rises_in_cost_and_marks_what_is_recommended(study):
    rows, model = json.loads((study.folder / "front.json").read_text("utf-8")), study.model()
    (chosen,) = (row for row in rows if row["recommended"])
    assert chosen["trial"] == (None if model.recommended == "adaptive" else model.fixed)
    assert [row[COST] for row in rows] == sorted(row[COST] for row in rows)
    (base,) = (row for row in rows if OWN in row["what"])
    assert (base["trial"], base["vs baseline"]) == (0, 1.0)
    for row in rows:
        assert row["low"] <= row["vs baseline"] <= row["high"]
    ends = f"{chosen['low']:.2f} to {chosen['high']:.2f}"
    assert chosen["trial"] is None or ends in elsewhere_in_words(rows)


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


def test_a_budget_decides_also_below_what_the_baseline_costs():
    rows = [
        {"what": what, "trial": trial, COST: cost, "99 % [ms]": 2.0 * cost, "bound": bound}
        for what, trial, cost, bound in (
            (OWN, 0, 10.0, 1.0),
            ("", 1, 19.0, 0.5),
            ("", 2, 4.0, 2.0),
            ("", 3, 30.0, 0.1),
        )
    ]
    for budget, period, trial in (
        (None, 100.0, 1),
        (40.0, 200.0, 3),
        (40.0, 100.0, 1),  # the dearest may come too late
        (5.0, 100.0, 2),
        (1.0, 100.0, 2),
    ):
        assert recommended(rows, budget, period)["trial"] == trial
