"""Replays that an estimated reference judges."""

import json
import os

import estimates
import pytest

from adaptune._system.machine import shared_cores
from adaptune.paired import Ratio
from adaptune.reference.estimated import EstimateError
from offline.config import load_study
from online import modes
from online.compare import NONE, compare
from online.modes import run_untrained
from online.tables import tables
from online.verdict import remarks

BOTH = ["baseline", "untrained"]


@pytest.fixture
def load(study_file, tmp_path):
    return lambda *given: load_study(study_file, ["sequences.three.reference=", *given], tmp_path)


def test_it_is_estimated_and_said_to_judge(load, monkeypatch):
    estimates.install(monkeypatch)
    study = load()
    assert run_untrained(study) == 2
    rows = compare(study).rows
    assert [(row.reference, row.mode) for row in rows] == [("estimated", mode) for mode in BOTH]
    assert rows[0].rte is not None
    assert rows[0].reference_error == pytest.approx(0.312, abs=1e-3)
    written = json.loads((study.folder / "comparison/comparison.json").read_text())
    assert written[1]["reference"] == "estimated"
    assert written[1]["reference_error"] == rows[1].reference_error
    (table, *_) = tables(rows, 3.0)
    assert "reference" in table.rows[0]
    assert "is wrong itself" in table.caption
    assert "On three an estimated reference judged: its own error is about 0.31 %." in remarks(rows)
    assert run_untrained(study) == 0
    # As if it were long enough for intervals.
    asked = []
    monkeypatch.setattr("online.statistics.interval_of_mean", lambda *_: (0, 2))
    monkeypatch.setattr("online.statistics.ratio", lambda of: asked.extend(of) or Ratio(1, (0, 2)))
    rows = compare(study).rows
    assert rows[1].ratio_interval == (0, 2)
    assert {pair.reference_error for pair in asked} == {rows[1].reference_error}
    assert any(said.endswith("about 0.31 %, is in the intervals.") for said in remarks(rows))


def test_it_is_estimated_on_all_cores_and_replayed_on_one(load, monkeypatch):
    estimator, seen = estimates.install(monkeypatch), []

    def noting(function):
        def noted(*given, **more):
            seen.append((os.sched_getaffinity(0), shared_cores()))
            return function(*given, **more)

        return noted

    monkeypatch.setattr("adaptune.reference.estimate.estimate_reference", noting(estimator))
    monkeypatch.setattr("online.modes.replay", noting(modes.replay))
    before = os.sched_getaffinity(0)
    run_untrained(load())
    (estimated, *replayed) = seen
    assert estimated == (before, before)
    assert [(len(own), shared) for own, shared in replayed] == [(1, before)] * 2
    assert os.sched_getaffinity(0) == before


def test_another_estimate_replays_nothing(load, monkeypatch):
    study = load()
    estimator = estimates.install(monkeypatch)
    run_untrained(study)
    before = compare(study).rows[0].rte
    estimator.factor = 1.1
    monkeypatch.setattr("adaptune.reference.estimate.VERSION", 0)
    assert run_untrained(study) == 0
    found = compare(study)
    assert abs(found.rows[0].rte - before) > 1.0
    # Both are far from this reference: nothing is advised.
    lost, none = found.verdict
    assert lost.startswith("Even with the odometry's own parameters track is lost on three: ")
    assert none == "Until then, rely on none."
    assert {row["mode"] for row in found.front} == {"baseline", "untrained"}
    assert found.advised == NONE


def test_where_none_can_be_estimated_it_is_replayed_all_the_same(load, monkeypatch, caplog):
    estimator = estimates.install(monkeypatch)
    estimator.refusal = EstimateError("nothing can be registered")
    study = load()
    assert run_untrained(study) == 2
    assert "sequences.three: " in caplog.text
    assert "nothing can be registered; it is replayed without a reference" in caplog.text
    rows = compare(study).rows
    assert [(row.reference, row.rte, row.reference_error) for row in rows] == [
        ("none", None, None)
    ] * 2
    (table, *_) = tables(rows, 3.0)
    assert "reference" in table.rows[0]
    assert "pulls ratios" not in table.caption
