"""One rule over quantities and recordings: restarts are pooled, and parts of one count as one."""

from types import SimpleNamespace

import numpy as np
import pytest

from adaptune.paired import Pair
from online.gate import RESTARTS, PairedReplays, SharedReplays, compare_sides
from online.statistics import ALL
from online.turns import COST

BLOCK = 10


def paired(i, *, ratio=1.0, restarts=(0, 0), lost=(0, 0), recording=None, seed=0):
    rng = np.random.default_rng((seed, i))
    errors = np.exp(0.2 * rng.normal(size=(2, 200))) * [[ratio], [1.0]]
    summary = SimpleNamespace(scans=200, lacking=0)
    named = SimpleNamespace(name=f"drive_{i}", summary=summary)
    pair = Pair(errors, BLOCK, recording or f"content {i}")
    return PairedReplays((named, named), pair, np.arange(200.0), restarts, lost)


def judge(pairs, costs=None):
    config = SimpleNamespace(sub_trajectory=2.0)
    odometry = SimpleNamespace(name="gicp")
    side = SimpleNamespace(name="side", odometry=odometry, config=config)
    return compare_sides(SharedReplays(side, side, "baseline", pairs, ""), costs, 0.05, 0.1)


def of(gate, quantity):
    return [row for row in gate.rows if row.quantity == quantity]


@pytest.mark.parametrize(
    ("restarts", "lost", "verdict"),
    [
        ((43, 42), (1, 0), "equal"),
        ((1, 0), (1, 0), "equal"),
        ((5, 0), (5, 0), "unclear"),
        ((9, 0), (9, 0), "worse"),
        ((0, 9), (0, 9), "better"),
        ((20, 20), (12, 12), "equal"),
        ((30, 3), (1, 0), "equal"),  # once, and then again and again in the same place
    ],
)
def test_restarts_are_pooled(restarts, lost, verdict):
    """The first drive has all but one of them."""
    pairs = [paired(0, restarts=restarts, lost=lost), paired(1), paired(2)]
    (row,) = of(judge(pairs), RESTARTS)
    assert (row.recording, row.new, row.old) == (ALL, *restarts)
    assert row.verdict == verdict


def test_equal_sides_alarm_once_in_twenty_times_however_many_recordings():
    for n in (1, 4, 12):
        verdicts = [judge([paired(i, seed=seed) for i in range(n)]).verdict for seed in range(100)]
        assert verdicts.count("worse") <= 5


def test_parts_of_a_recording_count_as_one():
    parts = [paired(i, recording="hall") for i in range(7)]
    gate = judge(parts)
    assert ", 1 recording in 7 parts: " in gate.words
    assert [row.recording for row in of(gate, "error")] == [*(f"drive_{i}" for i in range(7)), ALL]
    # What differs between recordings would be more.
    ratios = (0.7, 1.4, 0.8, 1.3, 0.9, 1.2, 1.0)
    together, apart = (
        of(judge([paired(i, ratio=r, recording=one) for i, r in enumerate(ratios)]), "error")[-1]
        for one in ("hall", None)
    )
    assert together.ratio == apart.ratio
    assert together.high / together.low < apart.high / apart.low


def test_costs_that_are_not_known_are_told_and_no_matter_if_off():
    pairs = [paired(0), paired(1)]
    known = {COST: np.full((2, 2, 100), 8.0)}
    rows = of(judge(pairs, {"drive_0": known, "drive_1": "its bag is gone"}), COST)
    assert [(row.verdict, row.why) for row in rows] == [
        ("equal", ""),
        ("unclear", "its bag is gone"),
        ("equal", "known on 1 of 2 recordings"),
    ]
    rows = of(judge(pairs, dict.fromkeys(("drive_0", "drive_1"), "gone")), COST)
    assert [row.verdict for row in rows] == ["unclear"] * 3
    assert of(judge(pairs), COST) == []


def test_half_a_millisecond_is_no_matter():
    rng = np.random.default_rng(0)
    for old, verdict in ((1.0, "equal"), (10.0, "worse")):
        both = (
            old * np.array([[1.2], [1.0]])[..., None] * np.exp(0.01 * rng.normal(size=(2, 2, 99)))
        )
        (row,) = of(judge([paired(0)], {"drive_0": {COST: both}}), COST)
        assert row.verdict == verdict
