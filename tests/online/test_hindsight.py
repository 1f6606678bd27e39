import numpy as np
import pytest

from online.statistics import ORACLE, ComparisonRow, JudgedModes, oracle_row


def judged(rte=1.0):
    rows = [ComparisonRow("a", mode, rte, 1.0) for mode in ("baseline", "fixed")]
    return JudgedModes("a", rows, {}, 1)


def oracle(errors):
    return dict(enumerate(np.array(errors, np.float32).T))


def test_the_best_set_of_the_sequence():
    errors = [[0.2, 0.8]] * 5 + [[0.9, 0.4]] * 5
    row = oracle_row(judged(), oracle(errors), 1)
    # The fixed set, the second one, has 0.6 in its trial, and 1.0 in its replay.
    assert (row.mode, row.rte) == (ORACLE, pytest.approx(0.55 / 0.6))
    assert oracle_row(judged(), oracle(errors), 0).ratio == pytest.approx(1.0)
    assert oracle_row(judged(), oracle(errors), 9) is None


def test_lost_tracks_are_clipped_and_frames_without_errors_left_out():
    errors = [[np.inf, 0.5]] * 5 + [[0.1, 0.5]] * 5 + [[np.nan, np.nan]] * 5
    assert oracle_row(judged(2.0), oracle(errors), 1).rte == pytest.approx(2.0)
    # A lost track counts 30 %.
    assert oracle_row(judged(2.0), oracle(errors), 0).ratio == pytest.approx(0.5 / 15.05)


def test_without_a_reference_there_is_no_oracle():
    assert oracle_row(judged(None), oracle([[0.5, 0.5]]), 0) is None
    assert oracle_row(judged(), oracle([[np.nan, np.nan]]), 0) is None
