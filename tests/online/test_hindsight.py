import numpy as np
import pytest

from adaptune.study.study import OracleErrors
from online.statistics import ORACLES, ComparisonRow, JudgedModes, oracle_rows


def judged(rte=1.0):
    rows = [ComparisonRow("a", mode, rte, 1.0, 0, 0, 0) for mode in ("baseline", "fixed")]
    return JudgedModes("a", rows, {}, 1)


def oracle(errors):
    errors = np.array(errors, np.float32)
    # Five scans a second, the first one at 7 s.
    stamps = 7 * 10**9 + np.arange(len(errors)) * 2 * 10**8
    return OracleErrors(stamps, tuple(range(errors.shape[1])), errors)


def test_the_best_set_of_the_sequence_and_that_of_every_period():
    # In the first second the first set is better, in the second one the other.
    errors = [[0.2, 0.8]] * 5 + [[0.9, 0.5]] * 5
    of_sequence, of_period = oracle_rows(judged(), oracle(errors), 0, period=1.0)
    assert (of_sequence.mode, of_period.mode) == ORACLES
    # The fixed set, the first one, has 0.55 in its trial, and 1.0 in its replay.
    assert of_sequence.rte == pytest.approx(1.0)
    assert of_period.ratio == pytest.approx(0.35 / 0.55)
    assert of_period.rte == pytest.approx(0.35 / 0.55)
    assert oracle_rows(judged(), oracle(errors), 1, period=1.0)[0].rte == pytest.approx(0.55 / 0.65)
    assert oracle_rows(judged(), oracle(errors), 9, period=1.0) == []
    # Within a period, one set is chosen.
    mixed = [[0.2, 0.8], [0.8, 0.2]] * 5
    assert oracle_rows(judged(), oracle(mixed), 0, period=2.0)[1].ratio == pytest.approx(1.0)


def test_lost_tracks_are_capped_and_frames_without_errors_left_out():
    errors = [[np.inf, 0.5]] * 5 + [[0.1, 0.5]] * 5 + [[np.nan, np.nan]] * 5
    of_sequence, of_period = oracle_rows(judged(2.0), oracle(errors), 1, period=1.0)
    assert of_sequence.ratio == pytest.approx(1.0)
    assert of_period.ratio == pytest.approx(0.3 / 0.5)
    assert of_period.rte == pytest.approx(2.0 * 0.3 / 0.5)
    # A lost track counts 30 %.
    of_sequence, _ = oracle_rows(judged(2.0), oracle(errors), 0, period=1.0)
    assert of_sequence.ratio == pytest.approx(0.5 / 15.05)


def test_without_a_reference_there_is_no_oracle():
    assert oracle_rows(judged(None), oracle([[0.5, 0.5]]), 0, 1.0) == []
    assert oracle_rows(judged(), oracle([[np.nan, np.nan]]), 0, 1.0) == []
