from dataclasses import replace

import pytest

from adaptune.paired import Ratio
from online.statistics import ALL, ORACLE, ComparisonRow
from online.verdict import decided, late, remarks, verdict


def rows_of(sequence=ALL, **ratios):
    """Rows of modes with an interval of 3 % on both sides."""
    return [
        ComparisonRow(
            sequence, mode, ratio, ratio, 0, 3, 0, ratio_interval=(0.97 * ratio, 1.03 * ratio)
        )
        if mode != "fixed"
        else ComparisonRow(sequence, mode, 1.0, 1.0, 0, 0, 0, cpu_ms=5.0)
        for mode, ratio in ({"baseline": 1.5, "fixed": 1.0} | ratios).items()
    ]


def every(n=12, **ratios):
    return [row for i in range(n) for row in rows_of(f"s{i}", **ratios)] + rows_of(**ratios)


def cheap(**ratios):
    return [replace(row, cpu_ms=20.0 if row.mode == "adaptive" else 5.0) for row in every(**ratios)]


def test_adapting_is_advised_where_it_is_worth_its_cost():
    assert verdict(cheap(adaptive=0.7), 10.0) == [
        "Drive adaptive: 0.700 % at 20.0 ms a scan instead of 1.000 % at 5.0 ms a scan with the "
        "fixed set and 1.500 % at 5.0 ms a scan with the odometry's own parameters, RTE over 10 m, "
        "on 12 test sequences.",
        "It has 0.70 times the fixed set's error (95 % interval 0.68 to 0.72), for 4.0 times its "
        "CPU time (20.0 ms a scan).",
    ]


@pytest.mark.parametrize(
    ("ratio", "interval", "what"),
    [
        (0.93, "0.90 to 0.96", "is not worth its cost"),
        (1.02, "0.99 to 1.05", "did no better"),
        (1.3, "1.26 to 1.34", "did worse"),
    ],
)
def test_one_set_is_advised_where_adapting_is_not(ratio, interval, what):
    assert verdict(cheap(adaptive=ratio), 10.0, worth=0.05)[0].startswith(
        "Drive adaptive" if ratio < 0.95 else "Drive the fixed set"
    )
    assert verdict(cheap(adaptive=ratio), 10.0) == [
        "Drive the fixed set: 1.000 % at 5.0 ms a scan instead of 1.500 % at 5.0 ms a scan with "
        "the odometry's own parameters, RTE over 10 m, on 12 test sequences; the odometry's own "
        "parameters have 1.50 times the fixed set's error (95 % interval 1.46 to 1.54).",
        f"Adapting {what} on 12 test sequences: "
        f"{ratio:.2f} times its error (95 % interval {interval}), for 4.0 times its CPU time (20.0 "
        f"ms a scan).",
    ]


@pytest.mark.parametrize("interval", [None, (0.4, 1.1)])
def test_a_gain_that_may_be_chance_is_not_advised(interval):
    rows = [replace(row, ratio_interval=interval) for row in cheap(adaptive=0.7)]
    first, second = verdict(rows, 10.0)
    assert first.startswith("Drive the fixed set: ")
    assert second.endswith(
        "that may be chance: drive more test recordings, or longer ones, to know."
    )


def test_a_gain_over_the_best_set_of_its_cost_may_be_chance():
    rows = cheap(adaptive=0.87, equal_cost=0.93)
    assert verdict(rows, 10.0)[0].startswith("Drive the fixed set")
    doubtful = {"equal_cost": Ratio(0.94, (0.8, 1.1))}
    rows = [replace(r, against=doubtful) if r.mode == "adaptive" else r for r in rows]
    assert verdict(rows, 10.0)[1] == (
        "Adapting had 0.87 times its error (95 % interval 0.84 to 0.90), for 4.0 times its CPU "
        "time (20.0 ms a scan); that is 0.94 times the error of the best single set that costs no "
        "more than adapting (95 % interval 0.80 to 1.10): drive more test recordings, or longer "
        "ones, to know."
    )
    worse = {"equal_cost": Ratio(1.2, (1.1, 1.3))}
    rows = [replace(r, against=worse) if r.mode == "adaptive" else r for r in rows]
    assert verdict(rows, 10.0)[1].endswith("than adapting (95 % interval 1.10 to 1.30).")


def test_own_parameters_are_kept_where_they_do_best():
    against = {"baseline": Ratio(1.2, (1.1, 1.3))}
    rows = [replace(row, against=against) for row in cheap(baseline=0.8, adaptive=0.96)]
    first, second = verdict(rows, 10.0)
    assert first.startswith("Keep the odometry's own parameters: 0.800 % at 5.0 ms a scan instead")
    assert "1.20 times its error (95 % interval 1.10 to 1.30)" in second
    better = {"baseline": Ratio(0.75, (0.7, 0.8))}
    rows = [replace(row, against=better) for row in cheap(baseline=0.8, adaptive=0.6)]
    assert verdict(rows, 10.0)[0].startswith("Drive adaptive: 0.600 % at 20.0 ms")


@pytest.mark.parametrize(
    ("ratios", "start"),
    [
        ({"equal_cost": 0.6, "adaptive": 0.8}, "Drive the fixed set: 1.000 %"),
        ({"equal_cost": 0.8, "adaptive": 0.6}, "Drive adaptive: 0.600 %"),
        ({"equal_cost": 0.95}, "Drive the fixed set: 1.000 %"),
        ({"best_default": 0.9, "baseline": 1.1}, "Drive the best odometry with its own param"),
        ({"even": 0.5, "adaptive": 0.8}, "Drive adaptive: 0.800 %"),
        ({"paper": 0.5, "adaptive": 0.8}, "Drive adaptive: 0.800 %"),
        ({"mine:Rule": 0.6, "adaptive": 0.8}, "Drive `mine:Rule`: 0.600 %"),
        ({"baseline": 1.0}, "Keep the odometry's own parameters: 1.000 %"),
    ],
)
def test_only_what_can_be_driven_is_advised(ratios, start):
    assert verdict(every(**ratios), 10.0)[0].startswith(start)


def test_a_rule_of_the_user_s_is_named():
    of_rule = "`mine:Rule` had 0.95 times the fixed set's error (95 % interval 0.92 to 0.98), for "
    for adaptive in (0.8, 1.02):
        rows = cheap(adaptive=adaptive, **{"mine:Rule": 0.95})
        assert verdict(rows, 10.0)[-1].startswith(of_rule)
    assert verdict(cheap(adaptive=0.7, **{"mine:Rule": 0.6}), 10.0)[-1].startswith(
        "`adaptive` had 0.7"
    )


def test_why_nothing_was_adapted_is_told():
    why = "a program that runs whole recordings cannot change its parameters"
    assert verdict(every(), 5.0, why)[1:] == [f"Adapting was not tried: {why}."]
    kept = [replace(row, switches=0) for row in every(adaptive=1.0)]
    assert verdict(kept, 5.0)[1:] == [
        "Training showed no gain from adapting: `adaptive` drove the same set."
    ]
    little = "there is too little to compare ways to adapt"
    assert verdict(kept, 5.0, little)[1:] == [f"`adaptive` drove the same set: {little}."]


def test_how_sure_it_is_that_one_set_is_better_is_told():
    for ratio, interval, sure in (
        (1.5, (1.2, 1.8), "; the odometry's own parameters have 1.50 times the fixed set's"),
        (
            1.5,
            (0.9, 1.8),
            "; the two may differ by chance: the odometry's own parameters have 1.50",
        ),
        (1.5, None, "; the test is too short to tell whether the two differ by chance"),
        (0.8, (0.7, 0.9), " have 0.80 times the fixed set's error (95 % interval 0.70 to 0.90)"),
        (0.8, None, "; the test is too short to tell whether the two differ by chance"),
    ):
        rows = [replace(row, ratio_interval=interval) for row in every(baseline=ratio)]
        (said,) = verdict(rows, 5.0)
        assert sure in said, (ratio, interval)
    # Where the test is too short, training counts unless the test clearly says another thing.
    for ratio, mode in ((0.75, "baseline"), (0.85, "fixed")):
        rows = [replace(row, ratio_interval=None) for row in every(baseline=ratio)]
        best = decided(rows)
        assert best is not None
        assert best.mode == mode
    same = [replace(row, ratio=1.0, rte=1.0, switches=0) for row in every()]
    assert verdict(same, 5.0) == [
        "Keep the odometry's own parameters: 1.000 %, RTE over 5 m, on 12 test sequences. "
        "No set that was tried did surely better in training."
    ]
    estimated = [replace(row, reference="estimated") for row in every()]
    assert ", on 12 test sequences by an estimated reference" in verdict(estimated, 5.0)[0]


def test_it_is_told_where_what_is_advised_comes_too_late():
    rows = [replace(row, cpu_ms=120.0) for row in rows_of("slow", fixed=1.0, adaptive=0.9)]
    rows += [replace(row, cpu_ms=20.0) for row in rows_of("fast", fixed=1.0, adaptive=0.9)]
    said = "On slow, scans come every 100 ms: 120 ms of CPU time a scan take several cores."
    assert late(rows, "fixed", {"slow": 100.0, "fast": 50.0}) == [said]
    assert not late(rows, "fixed", {"slow": 120.0, "fast": 50.0})
    assert not late([replace(row, cpu_ms=None) for row in rows], "fixed", {"slow": 100.0})


def test_a_rival_is_compared_once_in_error_and_cost_also_where_the_fixed_set_is_kept():
    for adaptive, switches in ((0.8, 3), (1.0, 0)):
        against = {"best_default": Ratio(adaptive / 1.25, (0.5, 0.9))}
        costs = {"adaptive": 20.0, "best_default": 30.0}
        rows = [
            replace(r, cpu_ms=costs.get(r.mode), against=against, switches=switches)
            for r in every(adaptive=adaptive, best_default=1.25)
        ]
        found = [said for said in remarks(rows) if "the best odometry with its own" in said]
        assert found == [
            f"`adaptive` has {adaptive / 1.25:.2f} times the error of the best odometry with its "
            f"own parameters (95 % interval 0.50 to 0.90), at 20.0 ms of CPU time a scan against "
            f"30.0."
        ]


def test_the_verdict_of_a_study_without_a_model_goes_by_the_baseline():
    rows = [
        replace(row, yardstick="baseline", ratio=1.0 if row.mode == "baseline" else 0.8)
        for row in every(baseline=1.0, untrained=0.8)
        if row.mode != "fixed"
    ]
    first, second = verdict(rows, 10.0)
    assert first.startswith("Drive the untrained bank: 0.800 % instead of 1.000 % with the")
    assert second == "It has 0.80 times the baseline's error (95 % interval 0.78 to 0.82)."
    best = decided(rows)
    assert best is not None
    assert best.mode == "untrained"
    alone = [row for row in rows if row.mode == "baseline"]
    assert verdict(alone, 10.0) == [
        "Keep the odometry's own parameters: 1.000 %, RTE over 10 m, on 12 test sequences."
    ]
    near = [replace(row, ratio_interval=(1.004, 1.12)) for row in every(adaptive=1.04)]
    assert "(95 % interval 1.004 to 1.12)" in verdict(near, 10.0)[1]


def test_a_late_first_pose_is_told():
    rows = [replace(row, first_pose=1.25) for row in rows_of("a", adaptive=0.5)]
    said = "On a the odometry gave its first pose after 1.2 s; errors count from there."
    assert said in remarks(rows)


def test_nothing_is_said_where_nothing_is_known():
    rows = [
        replace(row, rte=None, ratio=None, reference="none") for row in rows_of("a", adaptive=0.5)
    ]
    nobody = "No test sequence has a reference: nobody can say what was gained."
    assert verdict(rows, 10.0) == [nobody]
    short = [replace(row, reference="given") for row in rows]
    assert verdict(short, 10.0)[0].startswith(
        "No sub-trajectory of 10 m fits into what is known of a (test a longer part, or lower"
    )
    assert remarks(rows) == []
    assert decided(rows) is None
    oracle = ComparisonRow(ALL, ORACLE, 0.5, 0.5, 0, 0, 0)
    assert not any(ORACLE in said for said in verdict([*every(adaptive=0.7), oracle], 10.0))


def test_all_estimates_that_the_reference_contradicts_are_one_sentence():
    """The fixed set's error is 1.0 % by the reference."""
    fixed = [row for row in every(n=3) if row.mode == "fixed"]
    measured = [
        replace(row, estimated=1.5, estimated_interval=(low, 2.0))
        for row, low in zip(fixed, (1.2, 0.9, 1.1, 1.3), strict=True)
    ]
    said = [sentence for sentence in remarks(measured) if "estimates its own" in sentence]
    assert said == [
        "`fixed` estimates its own mean RTE at 1.500 % (95 % interval 1.200-2.000 %) on s0, where "
        "by the reference it is 1.000 %; 1.500 % (95 % interval 1.100-2.000 %) on s2, where by the "
        "reference it is 1.000 %. Either the estimate or the reference is wrong there over this "
        "length."
    ]


def test_a_single_set_that_costs_more_is_told_where_it_is_surely_better():
    rows = every(equal_cost=0.7)
    costs = {"equal_cost": 12.0}
    dear = [replace(row, cpu_ms=costs.get(row.mode, 5.0)) for row in rows]
    assert verdict(dear, 10.0)[1] == (
        "A single set that costs more has 0.70 times its error (95 % interval 0.68 to 0.72), for "
        "2.4 times its CPU time (12.0 ms a scan): `online.budget: 12` allows it."
    )
    cheap = [replace(row, cpu_ms=5.0) for row in rows]
    assert verdict(cheap, 10.0)[1] == (
        "A set (`equal_cost.yaml`) has 0.70 times its error (95 % interval 0.68 to 0.72), for 1.0 "
        "times its CPU time (5.0 ms a scan): drive both on another recording, to know."
    )
    as_good = [replace(row, cpu_ms=5.0) for row in every(equal_cost=0.95)]
    assert not any("drive both" in said for said in verdict(as_good, 10.0))
    short = [replace(row, ratio_interval=None) for row in dear]
    assert not any("budget" in said for said in verdict(short, 10.0))
