from dataclasses import replace

import numpy as np
import pytest

from online.compare import pooled, ratio_to
from online.statistics import ORACLE, ComparisonRow, JudgedModes

BLOCK = 20


def judged(name, ratio, rng, n=400, recording="", **more):
    """A sequence on which a mode has a ratio to the fixed set's error, but for noise."""
    fixed = 1.0 + 0.3 * rng.random(n)
    errors = {"fixed": fixed, "adaptive": ratio * fixed * (1.0 + 0.1 * rng.standard_normal(n))}
    means = {mode: float(of.mean()) for mode, of in errors.items()}
    rows = [
        ComparisonRow(name, mode, mean, mean / means["fixed"], switches=2, **more)
        for mode, mean in means.items()
    ]
    return JudgedModes(name, rows, errors, BLOCK, recording)


def of_ratios(ratios, seed=0, **more):
    rng = np.random.default_rng(seed)
    return [judged(f"s{i}", ratio, rng, **more) for i, ratio in enumerate(ratios)]


def adaptive(found):
    return next(row for row in found if row.mode == "adaptive")


def test_the_ratio_is_the_geometric_mean_and_lies_in_its_interval():
    row = adaptive(pooled(of_ratios([0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1])))
    assert row.ratio == pytest.approx(np.exp(np.mean(np.log(np.arange(5, 12) / 10))), rel=0.02)
    low, high = row.ratio_interval
    assert low < row.ratio < high
    # Sequences differ by more than frames do, so theirs is the larger part of the interval.
    within = adaptive(pooled(of_ratios([row.ratio] * 7))).ratio_interval
    assert high - low > 3 * (within[1] - within[0])
    assert pooled(of_ratios([0.5] * 7))[0].ratio_interval is None  # of the fixed set itself


def test_few_sequences_speak_of_themselves():
    few = adaptive(pooled(of_ratios([0.5, 1.1]))).ratio_interval
    assert few[1] - few[0] < 0.1
    short = of_ratios([0.5, 1.1], n=3 * BLOCK)
    assert adaptive(pooled(short)).ratio_interval is None


def test_the_parts_of_one_recording_are_no_recordings():
    ratios = [0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1]
    apart = adaptive(pooled(of_ratios(ratios))).ratio_interval
    together = adaptive(pooled(of_ratios(ratios, recording="hall"))).ratio_interval
    assert together[1] - together[0] < 0.5 * (apart[1] - apart[0])  # of this recording alone
    short = of_ratios(ratios, n=3 * BLOCK, recording="hall")
    assert adaptive(pooled(short)).ratio_interval is None
    # Two recordings of four parts each vary as two would.
    rng = np.random.default_rng(0)
    halves = [judged(f"{r}{i}", r, rng, recording=str(r)) for r in (0.5, 1.0) for i in range(4)]
    six = [judged(f"{r}{i}", r, rng, recording=f"{r}{i}") for r in (0.5, 1.0) for i in range(4)]
    of_halves, of_six = (adaptive(pooled(of)).ratio_interval for of in (halves, six))
    assert of_halves[1] - of_halves[0] < of_six[1] - of_six[0]


def test_a_mode_is_compared_with_another_one_on_the_same_frames():
    found = of_ratios([0.5] * 7)
    for one in found:
        one.errors["even"] = 0.8 * one.errors["adaptive"]
    ratio = ratio_to(found, "adaptive", "even")
    assert ratio.value == pytest.approx(1.25)
    assert ratio.interval == pytest.approx((1.25, 1.25))  # it differs nowhere
    to_fixed = ratio_to(found, "adaptive")
    assert to_fixed.interval == adaptive(pooled(found)).ratio_interval


def test_intervals_hold_the_truth_in_nearly_19_of_20_cases():
    held = []
    for seed in range(60):
        ratios = np.exp(np.random.default_rng(seed).normal(np.log(0.8), 0.2, 12))
        low, high = adaptive(pooled(of_ratios(ratios, seed, n=100))).ratio_interval
        held.append(low <= 0.8 <= high)
    assert np.mean(held) >= 0.85


def test_sequences_count_as_better_or_worse():
    found = of_ratios([0.5, 0.9, 1.3])
    row = adaptive(pooled(found))
    assert (row.better, row.worse) == (2, 1)


def test_the_worst_tenth_is_over_segments_of_all_sequences():
    found = of_ratios([0.5] * 9 + [2.0])
    assert adaptive(pooled(found)).worst_tenth == pytest.approx(2.0, rel=0.05)
    # Five segments of 80 frames in each sequence: a tenth of fifty are the last five.
    found[-1].errors["adaptive"][:320] = found[-1].errors["fixed"][:320]
    expected = np.exp((np.log(2.0) + 4 * np.log(1.0)) / 5)
    row = adaptive(pooled(found))
    assert row.worst_tenth == pytest.approx(expected, rel=0.05)
    few = adaptive(pooled(of_ratios([0.5] * 9, n=4 * BLOCK)))
    assert few.worst_tenth is None


def test_the_oracle_is_the_mean_of_the_best_set_of_each_sequence():
    found = of_ratios([0.8, 0.8])
    best = [ComparisonRow(one.name, ORACLE, 0.6 * one.rows[0].rte, 0.6) for one in found]
    rows = pooled(found, best)
    assert rows[-1].mode == ORACLE
    assert rows[-1].rte == pytest.approx(0.6 * rows[0].rte)
    # Known on some sequences only, it tells nothing of all.
    assert pooled(found, best[:1])[-1].mode != ORACLE


def test_what_an_estimated_reference_errs_is_in_the_interval():
    plain = adaptive(pooled(of_ratios([0.8] * 8))).ratio_interval
    low, high = adaptive(pooled(of_ratios([0.8] * 8, reference_error=0.2))).ratio_interval
    assert low < 0.97 * plain[0]
    assert high > 1.03 * plain[1]


def test_sequences_without_a_reference_do_not_count():
    blind = judged("blind", 3.0, np.random.default_rng(1))
    empty = [replace(row, rte=None, ratio=None) for row in blind.rows]
    found = of_ratios([0.5, 0.5])
    with_blind = pooled([*found, blind._replace(rows=empty)])
    assert with_blind == pooled(found)
