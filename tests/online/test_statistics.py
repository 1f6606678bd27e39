from dataclasses import replace

import numpy as np
import pytest
from rooms import along_x

from adaptune.metrics import KittiError, kitti_error
from adaptune.trajectory import Trajectory, read_kitti
from online.compare import pooled, ratio_to
from online.statistics import (
    ORACLES,
    ComparisonRow,
    JudgedModes,
    Reference,
    StandardErrors,
    allowing_for,
)


def trajectory(T, first=0):
    return Trajectory(np.arange(first, first + len(T)) * 10**8, T)


def straight(n, step=1.0):
    return along_x(step * np.arange(n))


def over_all(rows):
    """The row of the only mode over all sequences."""
    return pooled([JudgedModes(r.sequence, [r], {r.mode: np.ones(30)}, 3) for r in rows])[0]


def row(sequence, standard, mode="fixed"):
    return ComparisonRow(sequence, mode, 1.0, 1.0, 0, 0, 0, standard=standard)


def test_errors_of_a_recorded_pair_are_those_of_evo_and_kitti(recorded):
    folder = recorded / "kitti_00"
    truth = trajectory(read_kitti(folder / "ground_truth_kitti.txt"))
    found = Reference(truth, 100.0).standard(trajectory(read_kitti(folder / "kiss_icp_kitti.txt")))
    assert found.ape == pytest.approx(3.500719, abs=1e-6)
    assert found.rpe == pytest.approx(0.034188, abs=1e-6)
    assert found.kitti.translation == pytest.approx(0.5283, abs=5e-5)
    cells = row("00", found).standard_columns()
    assert cells["APE [m]"] == found.ape
    assert cells["[deg/100 m]"] == pytest.approx(0.1887, abs=1e-4)
    assert cells["over [m]"] == "100-800"
    files = row("00", found).columns()
    assert files["_kitti_lengths_m"] == "100 200 300 400 500 600 700 800"
    assert files["_kitti_deg_per_m"] == found.kitti.rotation


def test_errors_of_the_last_seconds_stand_where_their_sub_trajectories_end():
    # The odometry goes 10 % too far over the tenth to the twentieth metre.
    T = straight(40)
    T[10:20, 0, 3] += 0.1 * np.arange(1, 11)
    T[20:, 0, 3] += 1.0
    reference = Reference(trajectory(straight(40)), 4.5)
    errors, behind = (f(trajectory(T)) for f in (reference.errors, reference.errors_behind))
    assert np.isnan(errors[35:]).all()
    assert np.isnan(behind[:5]).all()
    step = float(np.diff(trajectory(T).stamps[:2])[0]) * 1e-9
    n = int(30.0 / step) + 1
    expected = [errors[max(0, i + 1 - n) : i + 1].mean() for i in range(35)]
    np.testing.assert_allclose(behind[5:], expected)
    assert np.nanmax(errors) > 5.0
    assert np.isnan(Reference(None, 4.5).errors_behind(trajectory(T))).all()


def test_errors_around_a_pose_are_those_of_the_sub_trajectories_through_it():
    T = straight(40)
    T[10:, 0, 3] += 0.5
    reference, odometry = Reference(trajectory(straight(40)), 4.5), trajectory(T)
    errors, around = reference.errors(odometry), reference.errors_around(odometry)
    # Each starts at a pose and ends at the fifth after it.
    expected = [errors[max(0, i - 5) : min(i + 1, 35)].mean() for i in range(40)]
    np.testing.assert_allclose(around, expected, atol=1e-9)
    assert around[[4, 15]].tolist() == pytest.approx([0.0, 0.0], abs=1e-9)
    assert np.isnan(Reference(None, 4.5).errors_around(odometry)).all()


@pytest.mark.parametrize(("metres", "lengths"), [(99, None), (150, "100"), (250, "100-200")])
def test_kittis_error_is_there_from_100_m_on(metres, lengths):
    truth = straight(metres + 2)
    found = Reference(trajectory(truth), 25.0).standard(trajectory(straight(metres + 2, 1.01)))
    cells = row("a", found).standard_columns()
    assert cells["over [m]"] == lengths
    assert (cells["KITTI [%]"] is None) == (lengths is None)
    assert cells["APE [m]"] > 0.1
    assert cells["RPE [m]"] == pytest.approx(0.01)


def test_scans_without_reference_do_not_count():
    truth, odometry = straight(60), trajectory(straight(100, 1.01))
    late = Reference(trajectory(truth, 20), 25.0).standard(odometry)
    assert late.rpe == pytest.approx(0.01)
    assert Reference(None, 25.0).standard(odometry) is None
    # One pose says nothing.
    assert Reference(trajectory(truth[:1], 20), 25.0).standard(odometry) is None


def test_all_sequences_have_mean_errors_and_kittis_over_all_sub_trajectories():
    truth = straight(400)
    truth[:, 1, 3] = np.sin(0.05 * np.arange(400))
    estimate = truth.copy()
    estimate[:, 1, 3] *= 1.1
    parts = [kitti_error(truth, estimate, (length,)) for length in (100.0, 200.0, 300.0)]
    want = kitti_error(truth, estimate)
    assert len({part.n for part in parts}) == 3  # the mean of the means is another
    short = KittiError(np.nan, np.nan, ())
    rows = [row(f"s{i}", StandardErrors(1.0 + i, 0.1, k)) for i, k in enumerate([*parts, short])]
    found = over_all([*rows, row("blind", None)])
    assert found.standard.ape == pytest.approx(2.5)
    assert found.standard.rpe == pytest.approx(0.1)
    assert found.standard.kitti[:2] == pytest.approx(want[:2])
    assert found.standard.kitti[2:] == want[2:]
    assert over_all([row("a", None)]).standard is None
    assert np.isnan(over_all([row("a", StandardErrors(1.0, 0.1, short))]).standard.kitti[0])


def test_what_a_mode_costs_is_in_its_columns():
    cells = replace(row("a", None), cpu_ms=12.5, cores=0.125, memory_mb=300.0).columns()
    assert (cells["ms a scan"], cells["cores"], cells["memory [MB]"]) == (12.5, 0.125, 300.0)
    old = row("a", None).columns()
    assert old["ms a scan"] is old["cores"] is old["memory [MB]"] is None
    costs = [(10.0, 0.1, 200.0), (20.0, 0.3, 400.0)]
    rows = [
        replace(row(name, None), cpu_ms=ms, cores=cores, memory_mb=mb)
        for name, (ms, cores, mb) in zip("ab", costs, strict=True)
    ]
    of_all = over_all(rows)
    assert of_all.cpu_ms == pytest.approx(15.0)
    assert of_all.cores == pytest.approx(0.2)
    assert of_all.memory_mb == 400.0
    assert over_all([row("a", None), row("b", None)]).cpu_ms is None


BLOCK = 20


def judged(name, ratio, rng, n=400, recording="", **more):
    """A sequence on which a mode has a ratio to the fixed set's error, but for noise."""
    fixed = 1.0 + 0.3 * rng.random(n)
    errors = {"fixed": fixed, "adaptive": ratio * fixed * (1.0 + 0.1 * rng.standard_normal(n))}
    means = {mode: float(of.mean()) for mode, of in errors.items()}
    rows = [
        ComparisonRow(name, mode, mean, mean / means["fixed"], 0, 2, 0, **more)
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
    short = of_ratios([0.5, 1.1], n=9 * BLOCK)
    assert adaptive(pooled(short)).ratio_interval is None


def test_the_parts_of_one_recording_are_no_recordings():
    ratios = [0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1]
    apart = adaptive(pooled(of_ratios(ratios))).ratio_interval
    together = adaptive(pooled(of_ratios(ratios, recording="hall"))).ratio_interval
    assert together[1] - together[0] < 0.5 * (apart[1] - apart[0])  # of this recording alone
    short = of_ratios(ratios, n=5 * BLOCK, recording="hall")
    assert adaptive(pooled(short)).ratio_interval is None
    # Two recordings of four parts each vary as two would.
    rng = np.random.default_rng(0)
    halves = [judged(f"{r}{i}", r, rng, recording=str(r)) for r in (0.5, 1.0) for i in range(4)]
    six = [judged(f"{r}{i}", r, rng, recording=f"{r}{i}") for r in (0.5, 1.0) for i in range(4)]
    assert [adaptive(pooled(of)).recordings for of in (halves, six)] == [2, 8]
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


def test_sequences_count_as_better_or_worse_and_as_surely_so():
    found = of_ratios([0.5, 0.9, 1.3])
    ends = {"s0": (0.4, 0.6), "s1": (0.8, 1.01), "s2": (1.2, 1.4)}
    found = [
        one._replace(
            rows=[
                replace(row, ratio_interval=ends[one.name]) if row.mode == "adaptive" else row
                for row in one.rows
            ]
        )
        for one in found
    ]
    row = adaptive(pooled(found))
    assert (row.better, row.worse) == (2, 1)
    assert (row.surely_better, row.surely_worse) == (1, 1)
    short = adaptive(pooled(of_ratios([0.5, 0.6, 1.3], n=BLOCK)))
    assert (short.better, short.worse, short.surely_better) == (2, 1, None)


def test_the_worst_tenth_is_over_stretches_of_all_sequences():
    found = of_ratios([0.5] * 9 + [2.0])
    assert adaptive(pooled(found)).worst_tenth == pytest.approx(2.0, rel=0.05)
    # Five stretches of 80 frames in each sequence: a tenth of fifty are the last five.
    found[-1].errors["adaptive"][:320] = found[-1].errors["fixed"][:320]
    expected = np.exp((np.log(2.0) + 4 * np.log(1.0)) / 5)
    row = adaptive(pooled(found))
    assert row.worst_tenth == pytest.approx(expected, rel=0.05)
    assert row.stretches == 50
    few = adaptive(pooled(of_ratios([0.5] * 9, n=4 * BLOCK)))
    assert (few.worst_tenth, few.stretches) == (None, 9)


def test_the_gap_is_that_to_the_best_set_of_each_sequence():
    found = of_ratios([0.8, 0.8])
    best = [
        ComparisonRow(one.name, ORACLES[0], 0.6 * one.rows[0].rte, 0.6, 0, 0, 0) for one in found
    ]
    rows = pooled(found, best)
    assert adaptive(rows).gap_closed == pytest.approx(0.5, abs=0.02)
    assert rows[-1].mode == ORACLES[0]
    assert rows[-1].rte == pytest.approx(0.6 * rows[0].rte)
    # Known on some sequences only, it tells nothing of all.
    assert adaptive(pooled(found, best[:1])).gap_closed is None


def test_what_an_estimated_reference_errs_is_in_the_interval():
    plain = adaptive(pooled(of_ratios([0.8] * 8))).ratio_interval
    found = of_ratios([0.8] * 8, reference_error=0.2)
    low, high = adaptive(pooled(found)).ratio_interval
    assert low < plain[0]
    assert high > plain[1]
    mine, others = found[0].pair("adaptive").mean(axis=1)
    _, ends = allowing_for((mine, mine), (mine / others,) * 2, others, 0.3)
    assert low / plain[0] == pytest.approx(ends[0] / (mine / others), rel=0.01)


def test_sequences_without_a_reference_do_not_count():
    blind = judged("blind", 3.0, np.random.default_rng(1))
    empty = [replace(row, rte=None, ratio=None) for row in blind.rows]
    found = of_ratios([0.5, 0.5])
    with_blind = pooled([*found, blind._replace(rows=empty)])
    assert with_blind == pooled(found)
