from dataclasses import replace

from tables import with_run

from adaptune.paired import Ratio
from online.statistics import ALL, ORACLE, ComparisonRow
from online.verdict import choices, decided, late, remarks, verdict


def rows_of(sequence=ALL, **ratios):
    """Rows of modes with intervals of 3 % on both sides; ratios are to the fixed set's error."""
    ratios = {"baseline": 2.0, "fixed": 1.0} | ratios
    rows = []
    for mode, ratio in ratios.items():
        to_own = ratio / ratios["baseline"]
        against = {"baseline": Ratio(to_own, (0.97 * to_own, 1.03 * to_own))}
        row = ComparisonRow(sequence, mode, ratio, ratio, switches=3, against=against)
        row = replace(row, ratio_interval=(0.97 * ratio, 1.03 * ratio))
        rows.append(with_run(row, cpu_ms=5.0))
    return rows


def every(n=12, **ratios):
    return [row for i in range(n) for row in rows_of(f"s{i}", **ratios)] + rows_of(**ratios)


def front(fixed=7, equal=3, best=9, recommended="fixed", left_out=""):
    """Rows of the front, as training writes them."""
    roles = {0: ["own parameters"]}
    for what, trial in (
        ("within the budget", fixed),
        ("no more CPU time", equal),
        ("any CPU time", best),
        ("just below the budget", 5),
    ):
        roles.setdefault(trial, []).append(what)
    rows = [
        {
            "what": ", ".join(what),
            "trial": trial,
            "recommended": trial == fixed and recommended == "fixed",
            "error [%]": 1.0 - trial / 20.0,
            "cost [ms]": 5.0 + trial,
            "low": 0.3,
            "high": 0.8,
            "odometry": "",
            "file": "fixed.yaml" if trial == fixed else f"{trial}.yaml",
            "parameters": f"trial {trial}",
            "left out": left_out if trial == fixed and recommended == "fixed" else "",
        }
        for trial, what in roles.items()
    ]
    bank = {"what": "adaptive", "trial": None, "recommended": recommended == "adaptive"}
    return [*rows, rows[0] | bank | {"file": "model.safetensors", "low": 0.2, "high": 0.7}]


def said_of(rows, recommended="fixed", of_training=None, obstacle=""):
    """The verdict with the front that belongs to it."""
    best = decided(rows, recommended)
    of_training = front(recommended=recommended) if of_training is None else of_training
    found = choices(rows, of_training, best.mode, obstacle)
    return verdict(rows, 10.0, recommended, found, obstacle, tried=32)


def test_of_several_odometries_the_verdict_names_those_that_drive():
    whose = {"baseline": "gicp", "fixed": "kiss_icp"}
    found = choices(every(), front(), "fixed")
    assert verdict(every(), 10.0, "fixed", found, odometries=whose)[0].startswith(
        "Drive the fixed set (kiss_icp, trial 7): 1.000 % instead of 2.000 % with gicp's own para"
    )
    kept = verdict(every(baseline=0.8), 10.0, "fixed", odometries=whose)
    assert kept[0].startswith("Keep gicp's own parameters: 0.800 %")


def test_what_drives_the_fixed_set_alone_is_said_so():
    rows = rows_of("a", adaptive=1.0)
    same = [*rows[:-1], replace(rows[-1], ratio_interval=(1.0, 1.0))]
    assert verdict(same, 10.0)[-1].startswith(
        "Adapting: exactly the fixed set's error, as it drove the same set"
    )


def test_what_to_drive_and_what_adapting_adds():
    assert said_of(every(adaptive=0.8)) == [
        "Drive the fixed set (trial 7): 1.000 % instead of 2.000 % with the odometry's own "
        "parameters, for 5.0 instead of 5.0 ms a scan.",
        "That is 0.50 times the error (95 % interval 0.48 to 0.52; RTE over 10 m, on 12 test "
        "sequences); on another drive, expect 0.30 to 0.80 times.",
        "With cores to spare: adaptive, 0.80 times the fixed set's error (95 % interval 0.78 to "
        "0.82), for 1.0 times the CPU time.",
    ]
    wide = [row | {"high": 1.35} for row in front()]
    expected = said_of(every(adaptive=0.8), of_training=wide)[1]
    assert expected.endswith("expect 0.30 to 1.35 times, so perhaps more.")


def test_a_bank_that_gains_nothing_is_not_offered():
    assert said_of(every(adaptive=1.01))[-1].startswith(
        "Adapting: 1.01 times the fixed set's error"
    )


def test_what_may_be_driven_by_rising_budget_whatever_was_measured():
    rows = [
        with_run(row, cpu_ms=40.0) if row.mode == "adaptive" else row for row in every(adaptive=0.8)
    ]
    rows = [with_run(row, cpu_ms=4.5) if row.mode == "fixed" else row for row in rows]
    found = choices(rows, front(), "fixed")
    keys = ("what", "trial", "error [%]", "cost [ms]", "driven on", "recommended", "file")
    assert [tuple(row[key] for key in keys) for row in found] == [
        ("own parameters", 0, 2.0, 5.0, "test", False, "0.yaml"),
        ("no more CPU time", 3, 0.85, 8.0, "training", False, "3.yaml"),
        ("within the budget", 7, 1.0, 4.5, "test", True, "fixed.yaml"),
        ("any CPU time", 9, 0.55, 14.0, "training", False, "9.yaml"),
        ("adaptive", None, 0.8, 40.0, "test", False, "model.safetensors"),
    ]
    # One set may be the best at several costs, and no bank may be possible.
    assert len(choices(every(), front(7, 7, 7), "fixed", "why")) == 2
    # Without a front, what was driven is there.
    alone = choices(rows, [], "fixed")
    assert [row["mode"] for row in alone] == ["baseline", "fixed", "adaptive"]
    assert [row["recommended"] for row in alone] == [False, True, False]
    assert not any(row["recommended"] for row in choices(rows, front(), "none"))


def test_adapting_is_advised_where_training_recommends_it():
    said = said_of(every(adaptive=0.8), "adaptive")
    assert said[0].startswith("Drive adaptive: 0.800 % instead of 2.000 %")
    assert said[1].endswith("; on another drive, expect 0.20 to 0.70 times.")
    assert said[2].startswith("Adapting: 0.80 times the fixed set's error")
    best = decided(every(adaptive=0.8), "adaptive")
    assert best is not None
    assert best.mode == "adaptive"


def test_own_parameters_are_kept_where_training_found_nothing_better():
    said = said_of(every(baseline=1.0, adaptive=0.9), of_training=front(fixed=0, equal=0))
    assert said == [
        "Keep the odometry's own parameters: 1.000 % at 5.0 ms a scan (RTE over 10 m, on 12 test "
        "sequences).",
        "In training, none of 31 other sets was safely better within the budget.",
        "With cores to spare: adaptive, 0.90 times their error (95 % interval 0.87 to 0.93), for "
        "1.0 times the CPU time.",
    ]


def test_what_is_better_and_cheaper_and_was_left_out_is_told():
    rows, why = every(), "Left out: trial 4."
    assert said_of(rows, of_training=front(left_out=why))[-1] == why
    # Where the test contradicts training, something else is advised.
    assert why not in said_of(every(baseline=0.8), of_training=front(left_out=why))


def test_the_test_may_contradict_training():
    said = said_of(every(baseline=0.8))
    assert said[0].startswith("Keep the odometry's own parameters: 0.800 % at 5.0 ms a scan (RTE")
    assert said[1] == (
        "The fixed set, which training recommends, is surely worse here: 1.25 times its error (95 "
        "% interval 1.21 to 1.29)."
    )
    # What may be chance contradicts nothing.
    doubt = {"baseline": Ratio(1.25, (0.9, 1.7))}
    rows = [replace(r, against=doubt) if r.mode == "fixed" else r for r in every(baseline=0.8)]
    assert said_of(rows)[0].startswith("Drive the fixed set (trial 7)")
    short = {"baseline": Ratio(1.25)}
    rows = [replace(r, against=short) if r.mode == "fixed" else r for r in every(baseline=0.8)]
    sure = said_of(rows)[1]
    assert "1.25 times the error (the test is too short to tell how sure that is; " in sure


def test_a_test_outside_of_what_training_expected_is_told_as_that():
    wide, narrow = front(), [row | {"low": 0.04, "high": 0.44} for row in front()]
    assert said_of(every(), of_training=wide)[1].endswith(
        "on another drive, expect 0.30 to 0.80 times."
    )
    assert said_of(every(), of_training=narrow)[1].endswith("training expected 0.04 to 0.44 times.")


def test_what_loses_track_is_not_driven_where_the_baseline_holds_it():
    doubt = {"baseline": Ratio(10.0)}
    rows = [replace(r, against=doubt) if r.mode == "fixed" else r for r in every(fixed=20.0)]
    kept, why, *_ = said_of(rows)
    assert kept.startswith("Keep the odometry's own parameters: 2.000 %")
    assert why.startswith(
        "The fixed set, which training recommends, loses track on s0 (20.0 %), s1"
    )
    # Where the baseline does not hold it either, or the ratio is surely better, it is driven.
    assert said_of(every(fixed=20.0, baseline=15.0))[0].startswith("Keep")
    rows = [
        replace(r, against=doubt) if r.mode == "fixed" else r
        for r in every(fixed=9.0, baseline=6.0)
    ]
    assert said_of(rows)[0].startswith("Drive the fixed set")
    one = [*rows_of("lost", fixed=9.0, baseline=1.0), *every()]
    assert said_of(one)[0].startswith("Drive the fixed set")


def test_where_the_bank_fails_the_fixed_set_is_driven():
    said = said_of(every(adaptive=3.0), recommended="adaptive")
    assert said[0].startswith("Drive the fixed set")


def test_where_nothing_else_was_tried_that_is_why_the_baseline_is_kept():
    rows = every(baseline=1.0)
    assert verdict(rows, 10.0, tried=1)[1].startswith("No other set was tried: allow more trials")
    assert verdict(rows, 10.0, tried=2)[1].startswith("In training, the other set was not safely")


def test_a_rule_of_the_user_s_is_named():
    of_rule = "`mine:Rule` had 0.95 times the fixed set's error (95 % interval 0.92 to 0.98), for "
    rows = every(adaptive=0.8, **{"mine:Rule": 0.95})
    assert said_of(rows)[-1].startswith(of_rule)


def test_why_nothing_adapts_is_told():
    why = "a program that runs whole recordings cannot change its parameters"
    said = said_of(every(), of_training=front(7, 7, 7), obstacle=why)
    assert said[2:] == [f"Nothing adapts: {why}."]
    estimated = [replace(row, reference="estimated") for row in every()]
    assert ", on 12 test sequences by an estimated reference)" in verdict(estimated, 5.0)[1]


def test_it_is_told_where_what_is_advised_comes_too_late():
    rows = [with_run(row, cpu_ms=120.0) for row in rows_of("slow", fixed=1.0, adaptive=0.9)]
    rows += [with_run(row, cpu_ms=20.0) for row in rows_of("fast", fixed=1.0, adaptive=0.9)]
    said = "On slow, scans come every 100 ms: 120 ms of CPU time a scan take several cores."
    assert late(rows, "fixed", {"slow": 100.0, "fast": 50.0}) == [said]
    assert not late(rows, "fixed", {"slow": 120.0, "fast": 50.0})
    assert not late([with_run(row, cpu_ms=None) for row in rows], "fixed", {"slow": 100.0})


def test_it_is_told_where_what_is_advised_lost_scans_or_members_in_real_time():
    kept = {"rate": 12.0, "dropped_scans": 3.0, "missed_selections": 0.0, "pose_ms_p99": 210.0}
    of = {row.mode: row for row in rows_of("hall", fixed=1.0, adaptive=0.9)}
    rows = [of["fixed"], with_run(of["adaptive"], real_time=kept | {"removed_members": 1.0})]
    (said,) = late(rows, "adaptive", {})
    assert said.startswith(
        "On hall `adaptive` was too late for 3 scans and 1 of its members, which it went on "
        "without, at 12 times the recorded rate; 99 % of its poses came within 210 ms"
    )
    assert not late(rows, "fixed", {})
    rows[1] = with_run(rows[1], real_time=kept | {"dropped_scans": 0.0})
    assert not late(rows, "adaptive", {})


def test_a_bank_is_compared_with_even_weights_in_error_and_cost():
    against = {"even": Ratio(0.9, (0.8, 0.99))}
    costs = {"adaptive": 20.0, "even": 18.0}
    rows = [
        with_run(replace(row, against=against), cpu_ms=costs.get(row.mode))
        for row in every(adaptive=0.8, even=0.9)
    ]
    assert (
        "`adaptive` has 0.90 times the error of the same bank with even weights (95 % interval "
        "0.80 to 0.99), at 20.0 ms of CPU time a scan against 18.0."
    ) in remarks(rows)
    rows = [replace(row, against={"even": Ratio(1.03, (1.01, 1.05))}) for row in rows]
    assert any("weighing them gains nothing sure" in said for said in remarks(rows))


def test_the_verdict_of_a_study_without_a_model_goes_by_the_baseline():
    rows = [
        replace(row, yardstick="baseline", ratio=1.0 if row.mode == "baseline" else 0.8)
        for row in every(baseline=1.0, untrained=0.8)
        if row.mode != "fixed"
    ]
    first, sure = verdict(rows, 10.0)
    assert first.startswith("Drive the untrained bank: 0.800 % instead of 1.000 %")
    assert sure.startswith("That is 0.80 times the error (95 % interval 0.78 to 0.82; RTE over")
    best = decided(rows)
    assert best is not None
    assert best.mode == "untrained"
    alone = [row for row in rows if row.mode == "baseline"]
    assert verdict(alone, 10.0) == [
        "Keep the odometry's own parameters: 1.000 % at 5.0 ms a scan (RTE over 10 m, on 12 test "
        "sequences)."
    ]
    near = [replace(row, ratio_interval=(1.004, 1.12)) for row in every(adaptive=1.04)]
    assert "(95 % interval 1.004 to 1.12)" in verdict(near, 10.0)[-1]


def test_a_late_first_pose_is_told():
    rows = [with_run(row, first_pose=1.25) for row in rows_of("a", adaptive=0.5)]
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
    oracle = ComparisonRow(ALL, ORACLE, 0.5, 0.5)
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
