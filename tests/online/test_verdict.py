from dataclasses import replace

from adaptune.paired import Ratio
from online.statistics import ALL, ORACLE, ComparisonRow
from online.verdict import decided, late, remarks, verdict


def rows_of(sequence=ALL, **ratios):
    """Rows of modes with intervals of 3 % on both sides; ratios are to the fixed set's error."""
    ratios = {"baseline": 2.0, "fixed": 1.0} | ratios
    rows = []
    for mode, ratio in ratios.items():
        to_own = ratio / ratios["baseline"]
        against = {"baseline": Ratio(to_own, (0.97 * to_own, 1.03 * to_own))}
        row = ComparisonRow(sequence, mode, ratio, ratio, 0, 3, 0, against=against, cpu_ms=5.0)
        rows.append(replace(row, ratio_interval=(0.97 * ratio, 1.03 * ratio)))
    return rows


def every(n=12, **ratios):
    return [row for i in range(n) for row in rows_of(f"s{i}", **ratios)] + rows_of(**ratios)


def front(fixed=7, equal=3, best=9, recommended="fixed"):
    """Rows of the front, as training writes them."""
    roles = {0: ["own parameters"]}
    for what, trial in (
        ("no more CPU time", equal),
        ("within the budget", fixed),
        ("any CPU time", best),
    ):
        roles.setdefault(trial, []).append(what)
    return [
        {
            "what": ", ".join(what),
            "trial": trial,
            "recommended": trial == fixed and recommended == "fixed",
            "error [%]": 1.0 - trial / 20.0,
            "cost [ms]": 5.0 + trial,
            "low": 0.3,
            "high": 0.8,
        }
        for trial, what in roles.items()
    ] + [{"what": "adaptive", "trial": None, "recommended": recommended == "adaptive"}]


def test_what_to_drive_what_it_gives_and_what_time_buys():
    assert verdict(every(adaptive=0.8), 10.0, "fixed", front()) == [
        "Drive the fixed set (trial 7): 1.000 % at 5.0 ms a scan instead of 2.000 % at 5.0 ms a "
        "scan with the odometry's own parameters, RTE over 10 m, on 12 test sequences: 0.50 times "
        "its error (95 % interval 0.48 to 0.52); on another drive, 0.30 to 0.80 times.",
        "At no more CPU time: trial 3, 0.850 % at 8.0 ms in training, on another drive 0.30 to "
        "0.80 times the error of the odometry's own parameters.",
        "At any CPU time: trial 9, 0.550 % at 14.0 ms in training, on another drive 0.30 to 0.80 "
        "times the error of the odometry's own parameters.",
        "With cores to spare: adaptive, 0.800 % at 5.0 ms a scan: 0.80 times the fixed set's error "
        "(95 % interval 0.78 to 0.82).",
    ]
    # One set may be the best at several costs.
    assert len(verdict(every(), 10.0, "fixed", front(7, 7, 7))) == 1


def test_adapting_is_advised_where_training_recommends_it():
    rows = [{**row, "low": 0.2, "high": 0.7} for row in front(recommended="adaptive")]
    said = verdict(every(adaptive=0.8), 10.0, "adaptive", rows)
    assert said[0].startswith("Drive adaptive: 0.800 % at 5.0 ms a scan instead of 2.000 %")
    assert said[0].endswith("; on another drive, 0.20 to 0.70 times.")
    assert not any("cores to spare" in sentence for sentence in said)
    best = decided(every(adaptive=0.8), "adaptive")
    assert best is not None
    assert best.mode == "adaptive"


def test_own_parameters_are_kept_where_training_found_nothing_better():
    said = verdict(every(baseline=1.0, adaptive=0.9), 10.0, "fixed", front(fixed=0, equal=0))
    assert said[0] == (
        "Keep the odometry's own parameters: 1.000 % at 5.0 ms a scan, RTE over 10 m, on 12 test "
        "sequences."
    )
    assert said[1] == "In training, no set within the budget was safely better."
    assert said[2].startswith("At any CPU time: trial 9, ")
    assert said[3].startswith("With cores to spare: adaptive")


def test_the_test_may_contradict_training():
    said = verdict(every(baseline=0.8), 10.0, "fixed", front())
    assert said[0].startswith("Keep the odometry's own parameters: 0.800 % at 5.0 ms a scan, RTE")
    assert said[1] == (
        "The fixed set, which training recommends, is surely worse here: 1.25 times its error (95 "
        "% interval 1.21 to 1.29)."
    )
    # What may be chance contradicts nothing.
    doubt = {"baseline": Ratio(1.25, (0.9, 1.7))}
    rows = [replace(r, against=doubt) if r.mode == "fixed" else r for r in every(baseline=0.8)]
    assert verdict(rows, 10.0, "fixed", front())[0].startswith("Drive the fixed set (trial 7)")
    short = {"baseline": Ratio(1.25)}
    rows = [replace(r, against=short) if r.mode == "fixed" else r for r in every(baseline=0.8)]
    first = verdict(rows, 10.0, "fixed", front())[0]
    assert "1.25 times its error (the test is too short to tell how sure that is)" in first


def test_a_rule_of_the_user_s_is_named():
    of_rule = "`mine:Rule` had 0.95 times the fixed set's error (95 % interval 0.92 to 0.98), for "
    rows = every(adaptive=0.8, **{"mine:Rule": 0.95})
    assert verdict(rows, 10.0, "fixed", front())[-1].startswith(of_rule)


def test_why_nothing_adapts_is_told():
    why = "a program that runs whole recordings cannot change its parameters"
    said = verdict(every(), 5.0, "fixed", front(7, 7, 7), why)
    assert said[1:] == [f"Nothing adapts: {why}."]
    estimated = [replace(row, reference="estimated") for row in every()]
    assert ", on 12 test sequences by an estimated reference" in verdict(estimated, 5.0)[0]


def test_it_is_told_where_what_is_advised_comes_too_late():
    rows = [replace(row, cpu_ms=120.0) for row in rows_of("slow", fixed=1.0, adaptive=0.9)]
    rows += [replace(row, cpu_ms=20.0) for row in rows_of("fast", fixed=1.0, adaptive=0.9)]
    said = "On slow, scans come every 100 ms: 120 ms of CPU time a scan take several cores."
    assert late(rows, "fixed", {"slow": 100.0, "fast": 50.0}) == [said]
    assert not late(rows, "fixed", {"slow": 120.0, "fast": 50.0})
    assert not late([replace(row, cpu_ms=None) for row in rows], "fixed", {"slow": 100.0})


def test_a_bank_is_compared_with_even_weights_in_error_and_cost():
    against = {"even": Ratio(0.9, (0.8, 0.99))}
    costs = {"adaptive": 20.0, "even": 18.0}
    rows = [
        replace(r, cpu_ms=costs.get(r.mode), against=against) for r in every(adaptive=0.8, even=0.9)
    ]
    assert (
        "`adaptive` has 0.90 times the error of the same bank with even weights (95 % interval "
        "0.80 to 0.99), at 20.0 ms of CPU time a scan against 18.0."
    ) in remarks(rows)


def test_the_verdict_of_a_study_without_a_model_goes_by_the_baseline():
    rows = [
        replace(row, yardstick="baseline", ratio=1.0 if row.mode == "baseline" else 0.8)
        for row in every(baseline=1.0, untrained=0.8)
        if row.mode != "fixed"
    ]
    first = verdict(rows, 10.0)[0]
    assert first.startswith("Drive the untrained bank: 0.800 % at 5.0 ms a scan instead of 1.000 %")
    assert first.endswith(": 0.80 times its error (95 % interval 0.78 to 0.82).")
    best = decided(rows)
    assert best is not None
    assert best.mode == "untrained"
    alone = [row for row in rows if row.mode == "baseline"]
    assert verdict(alone, 10.0) == [
        "Keep the odometry's own parameters: 1.000 % at 5.0 ms a scan, RTE over 10 m, on 12 test "
        "sequences."
    ]
    near = [replace(row, ratio_interval=(1.004, 1.12)) for row in every(adaptive=1.04)]
    assert "(95 % interval 1.004 to 1.12)" in verdict(near, 10.0)[-1]


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
