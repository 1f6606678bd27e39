from dataclasses import replace

import pytest

from online.statistics import ALL, ORACLES, ComparisonRow, Ratio
from online.tables import explained, remarks, verdict


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
        "Drive adaptive: 0.7 % RTE over 10 m instead of 1 % with the fixed set and 1.5 % with the "
        "odometry's own parameters, on 12 test sequences.",
        "It has 0.70 times the fixed set's error (95 % interval 0.68 to 0.72), for 4.0 times its "
        "CPU time (20 ms a scan).",
    ]


@pytest.mark.parametrize(("ratio", "interval"), [(0.93, "0.90 to 0.96"), (1.3, "1.26 to 1.34")])
def test_one_set_is_advised_where_adapting_is_not(ratio, interval):
    assert verdict(cheap(adaptive=ratio), 10.0) == [
        "Drive the fixed set: 1 % RTE over 10 m instead of 1.5 % with the odometry's own "
        "parameters, on 12 test sequences.",
        f"Adapting is not worth its cost on 12 test sequences: {ratio:.2f} times its error (95 % "
        f"interval {interval}), for 4.0 times its CPU time (20 ms a scan).",
    ]


@pytest.mark.parametrize("interval", [None, (0.4, 1.1)])
def test_a_gain_that_may_be_chance_is_not_advised(interval):
    rows = [replace(row, ratio_interval=interval) for row in cheap(adaptive=0.7)]
    first, second = verdict(rows, 10.0)
    assert first.startswith("Drive the fixed set: ")
    assert second.endswith(
        "which may be chance: drive more test recordings, or longer ones, to know."
    )


def test_own_parameters_are_kept_where_they_do_best():
    against = {"baseline": Ratio(1.2, (1.1, 1.3))}
    rows = [replace(row, against=against) for row in cheap(baseline=0.8, adaptive=0.96)]
    first, second = verdict(rows, 10.0)
    assert first.startswith(
        "Keep the odometry's own parameters: 0.8 % RTE over 10 m instead of 1 %"
    )
    assert "1.20 times its error (95 % interval 1.10 to 1.30)" in second
    better = {"baseline": Ratio(0.75, (0.7, 0.8))}
    rows = [replace(row, against=better) for row in cheap(baseline=0.8, adaptive=0.6)]
    assert verdict(rows, 10.0)[0].startswith("Drive adaptive: 0.6 %")


@pytest.mark.parametrize(
    ("ratios", "start"),
    [
        ({"equal_cost": 0.6, "adaptive": 0.8}, "Drive the best set that costs no more: 0.6 %"),
        ({"equal_cost": 0.95}, "Drive the fixed set: 1 %"),
        ({"best_default": 0.9, "baseline": 1.1}, "Drive the best odometry with its own param"),
        ({"even": 0.5, "adaptive": 0.8}, "Drive adaptive: 0.8 %"),
        ({"paper": 0.5, "adaptive": 0.8}, "Drive adaptive: 0.8 %"),
        ({"baseline": 1.0}, "Keep the odometry's own parameters: 1 %"),
    ],
)
def test_only_what_can_be_driven_is_advised(ratios, start):
    assert verdict(every(**ratios), 10.0)[0].startswith(start)


def test_why_nothing_was_adapted_is_told():
    why = "a program that runs whole recordings cannot change its parameters"
    assert verdict(every(), 5.0, why)[1:] == [f"Adapting was not tried: {why}."]
    kept = [replace(row, switches=0) for row in every(adaptive=1.0)]
    assert verdict(kept, 5.0)[1:] == ["Adapting was not driven: the training promised no gain."]


@pytest.mark.parametrize(
    ("ratio", "first"),
    [
        (0.7, "Adapting gained 30 % on 12 test sequences: `adaptive` has 0.70 times the fixed "
              "set's error (95 % interval 0.68 to 0.72)."),
        (1.3, "Adapting lost 30 % on 12 test sequences"),
        (1.004, "Adapting changed nothing that counts on 12"),
    ],
)  # fmt: skip
def test_the_first_of_the_details_says_what_was_gained(ratio, first):
    assert explained(every(adaptive=ratio))[0].startswith(first)


def test_a_ratio_near_1_with_a_wide_interval_is_open():
    wide = [replace(row, ratio_interval=(0.6, 1.7)) for row in rows_of(adaptive=0.98)]
    said = explained([*every(adaptive=0.98)[:-3], *wide])
    assert said[0].startswith("Whether adapting gains is open, on 12 test sequences")
    assert any(s.startswith("Whether tuning gains is open, on 12 test sequences") for s in said)


def test_with_few_sequences_the_interval_speaks_of_these_alone():
    few = [row for i in range(3) for row in rows_of(f"s{i}", adaptive=0.7)] + rows_of(adaptive=0.7)
    assert explained(few)[0].endswith("The interval speaks of these recordings alone.")
    assert explained(rows_of("a", adaptive=0.7))[0].endswith("these recordings alone.")
    assert "alone" not in explained(every(adaptive=0.7))[0]
    # Twelve parts of two recordings are two.
    of_two = [replace(row, recordings=2) for row in every(adaptive=0.7)]
    assert explained(of_two)[0].endswith("these recordings alone.")


def test_without_a_mode_that_adapts_tuning_is_the_result():
    said = explained(every(baseline=1.25))
    assert said[0].startswith("Tuning alone gained 20 % of the baseline's error")
    assert len(said) == 1


@pytest.mark.parametrize("ratio", [0.4, 1.0, 1.6])
def test_without_an_interval_nothing_is_claimed(ratio):
    few = every(3, adaptive=ratio, paper=1.3 * ratio, even=1.1)
    against = {"even": Ratio(0.9)}
    said = explained([replace(row, ratio_interval=None, against=against) for row in few])
    unknown = "nothing can be said of how sure"
    assert said[0] == (
        f"Whether adapting gains is not known, on 3 test sequences: `adaptive` has {ratio:.2f} "
        f"times the fixed set's error (no interval); {unknown} that is."
    )
    assert any(s.startswith("Whether choosing adds to that is not known") for s in said)
    assert (
        f"`paper` has {1.3 * ratio:.2f} times the fixed set's error (no interval); {unknown}"
        in (s.removesuffix(" that is.") for s in said)
    )
    assert said[-1].startswith("Whether tuning gains is not known, on 3 test sequences: ")
    assert not any("surely differ" in s or "open" in s for s in said)


def test_a_mode_that_surely_does_not_differ_is_told_from_one_that_may():
    said = explained(every(adaptive=0.7, paper=1.004))
    assert any(s.startswith("`paper` changed nothing that counts: 1.00 times") for s in said)
    wide = [
        replace(row, ratio_interval=(0.6, 1.7)) if row.mode == "paper" else row
        for row in every(adaptive=0.7, paper=1.004)
    ]
    assert any(s.startswith("`paper` does not surely differ: 1.00 times") for s in explained(wide))


def test_what_kept_the_fixed_set_did_not_adapt():
    rows = [replace(row, switches=0, ratio_interval=None) for row in every(adaptive=1.0)]
    said = explained(rows)
    assert said[0] == (
        "Nothing was adapted, nothing gained: `adaptive` kept the fixed set on 12 test sequences."
    )


def test_losses_costs_controls_and_rivals_are_told():
    rows = every(adaptive=0.7, paper=1.4, equal_cost=0.875, even=1.02)
    sure = {
        "better": 11,
        "worse": 1,
        "surely_better": 9,
        "surely_worse": 1,
        "cpu_ms": 20.0,
        "against": {"even": Ratio(0.69, (0.6, 0.8)), "equal_cost": Ratio(0.8, (0.7, 0.9))},
    }
    rows = [replace(r, **sure) if (r.sequence, r.mode) == (ALL, "adaptive") else r for r in rows]
    rows = [
        replace(r, ratio=1.2) if (r.sequence, r.mode) == ("s3", "adaptive") else r for r in rows
    ]
    said = explained(rows)
    for sentence in (
        "By more than 1 %, it has less error on 11 of 12 sequences, and more on 1 (s3); surely "
        "better on 9, surely worse on 1.",
        "It takes 20.0 ms of CPU time a scan: 4.0 times what the fixed set takes.",
        "`adaptive` has 0.80 times the error of the best set that costs no more (95 % interval "
        "0.70 to 0.90).",
        "Choosing added to that: `adaptive` has 0.69 times the error of `even` (95 % interval 0.60 "
        "to 0.80).",
        "`paper` is worse: 1.40 times the fixed set's error (95 % interval 1.36 to 1.44).",
    ):
        assert sentence in said
    assert any(s.startswith("The study's bank with even weights has 1.02 times") for s in said)
    assert any(s.startswith("Tuning alone gained 33 % of the baseline's error") for s in said)


def test_on_how_many_sequences_it_can_be_sure_is_told():
    sure = {"better": 12, "worse": 0, "surely_better": 10, "surely_worse": 0}
    rows = [replace(r, **sure) if r.sequence == ALL else r for r in every(adaptive=0.7)]
    short = ("s0", "s1")
    rows = [replace(r, ratio_interval=None) if r.sequence in short else r for r in rows]
    told = "and more on none; surely better on 10, surely worse on 0, of 10 long enough to tell."
    assert any(said.endswith(told) for said in explained(rows))


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


def test_without_a_model_the_untrained_bank_is_compared_with_the_baseline():
    rows = [
        replace(row, yardstick="baseline")
        for row in every(untrained=0.8)
        if row.mode in ("baseline", "untrained")
    ]
    said = explained([replace(r, ratio=1.0) if r.mode == "baseline" else r for r in rows])
    assert said[0].startswith(
        "Adapting gained 20 % on 12 test sequences: `untrained` has 0.80 times"
    )
    assert "the baseline's error" in said[0]


def test_nothing_is_said_where_nothing_is_known():
    rows = [replace(row, rte=None, ratio=None) for row in rows_of("a", adaptive=0.5)]
    nobody = "No test sequence has a reference: nobody can say what was gained."
    assert verdict(rows, 10.0) == [nobody]
    assert explained(rows) == []
    oracle = ComparisonRow(ALL, ORACLES[0], 0.5, 0.5, 0, 0, 0)
    assert not any(ORACLES[0] in said for said in explained([*every(adaptive=0.7), oracle]))


def test_an_end_near_1_shows_on_which_side_it_lies():
    near = [replace(row, ratio_interval=(1.004, 1.12)) for row in rows_of(adaptive=1.04)]
    said = explained([*every(adaptive=1.04)[:-3], *near])
    assert "(95 % interval 1.004 to 1.12)" in said[0]


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
