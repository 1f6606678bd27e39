"""What CPU time buys, and what it costs here."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from adaptune.errors import AdaptuneError
from adaptune.model.rules import Costs, SetCost
from adaptune.study.driven import COST, FILES, OWN
from offline.choice import BlockErrors
from offline.config import load_study
from offline.front import left_out, measured_front, recommended


@pytest.fixture
def study(study_file, trained_folder, tmp_path):
    return load_study(study_file, [], shutil.copytree(trained_folder, tmp_path / "study"))


def test_the_front_has_the_order_of_budgets_and_marks_what_is_recommended(study):
    rows, model = json.loads((study.folder / "front.json").read_text("utf-8")), study.model()
    (chosen,) = (row for row in rows if row["recommended"])
    assert chosen["trial"] == (None if model.recommended == "adaptive" else model.fixed)
    least = [min(map([*FILES].index, row["what"].split(", "))) for row in rows]
    assert least == sorted({*least})
    assert least[0] == 0
    (base,) = (row for row in rows if OWN in row["what"])
    assert (base["trial"], base["another drive"]) == (0, 1.0)
    for row in rows:
        assert row["low"] <= row["another drive"] <= row["high"]


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


def told_of(**changes):
    """What is told of trial 1, which has half of trial 2's error for half of its cost."""
    errors = np.array([[1.0, 0.4, 0.8], [1.0, 0.4, 0.8]] * 6) * np.linspace(0.9, 1.1, 12)[:, None]
    costs = np.array([10.0, 5.0, 10.0])
    none = np.zeros(12, np.intp), costs, np.zeros(3)
    blocks = BlockErrors([0, 1, 2], errors, *none)._replace(**changes.get("tried", {}))
    driven = changes.get("driven", blocks.some([0, changes.get("fixed", 2)]))
    of = Costs({n: SetCost(cost, 0.0, 0) for n, cost in enumerate(costs.tolist())}, 0.0)
    data = SimpleNamespace(costs=of, beside=None, blocks=lambda: blocks)
    whole = SimpleNamespace(costs=of, beside=None, driven_blocks=lambda: driven)
    bank = {"bank": [0, 2], "reserve": [], "expected": {"geometric": changes.get("bank", 1.0)}}
    mode = "adaptive" if "bank" in changes else "fixed"
    model = SimpleNamespace(fixed=changes.get("fixed", 2), recommended=mode, **bank)
    return left_out(data, whole, model, changes.get("worse", ()))


def test_a_set_that_is_better_and_cheaper_is_named_with_the_reason():
    said = told_of(tried={"restarts": np.array([1.0, 9.0, 0.0])})
    assert said == (
        "Trial 1, with 0.50 times the error for 0.50 times the CPU time in training, is left out: "
        "the health check restarts it more often (9 against 1 of the baseline)."
    )
    turns = np.ones((12, 3))
    turns[:, 1] = np.linspace(2.0, 2.1, 12)
    assert "surely worse than the odometry's own parameters in rotation" in told_of(
        tried={"turns": turns}
    )
    assert "along whole recordings, without the health check, it is surely worse" in told_of(
        worse=[1]
    )
    errors = np.tile([1.0, 1.2, 1.0], (12, 1))
    driven = BlockErrors([0, 1, 2], errors, np.zeros(12, np.intp), *np.zeros((2, 3)))
    assert told_of(driven=driven).endswith("is left out: along whole recordings it is not better.")
    varied = np.array([[1.0, 0.05, 0.8], [1.0, 1.2, 0.8]] * 6)
    assert "its error is less sure (by its bound " in told_of(tried={"errors": varied})
    assert "Trial 1, " in told_of(bank=0.6, worse=[1])


def test_nothing_is_left_out_that_is_dearer_or_worse_or_where_nothing_tracks():
    assert told_of(fixed=1) == ""
    assert told_of(bank=0.4) == ""
    assert told_of(tried={"lost_above": 0.1}) == ""
