import numpy as np
import pytest

from adaptune.archive import Summary
from offline.config import OfflineConfig
from offline.objective import (
    Verdict,
    allowed,
    baseline_words,
    best_by_trials,
    candidates,
    choose_fixed,
    judge,
    trajectory_metrics,
)


def config(**given):
    return OfflineConfig.model_validate(given)


def test_a_sum_is_a_mean_over_sequences():
    of = config(objective={"rte": 1, "ms_per_scan": 0.1})
    runs = [Summary({"a": 1}, 1.0, 0, 0, 10.0), Summary({"a": 1}, 3.0, 0, 0, 30.0)]
    verdict = judge(of, runs)
    assert verdict.parameters == {"a": 1}
    assert verdict.value == pytest.approx(0.5 * (1.0 + 1.0) + 0.5 * (3.0 + 3.0))


def test_the_best_few_and_the_baseline_are_candidates():
    verdicts = {n: Verdict({}, float(value)) for n, value in enumerate([9, 7, 5, 3, 4, 6])}
    assert candidates(verdicts) == [3, 4, 2, 5, 0]
    verdicts[0] = verdicts[0]._replace(failure="no pose")
    assert candidates(verdicts) == [3, 4, 2, 5]


def test_who_is_restarted_more_often_than_the_baseline_is_no_candidate():
    verdicts = {n: Verdict({}, float(n), restarts=r) for n, r in enumerate([2, 3, 2, 0])}
    assert candidates(verdicts) == [0, 2, 3]
    assert allowed({0: np.inf, 1: 5.0, 2: np.inf}) == {1}
    # The baseline's restarts count also where it costs too much.
    assert candidates(verdicts, [1, 2]) == [2]


def test_the_fixed_set_is_the_best_over_whole_recordings():
    trials = {3: 1.0, 4: 1.1, 0: 2.0}
    assert choose_fixed(trials, {3: 1.0, 4: 1.1, 0: 2.0}) == 3
    assert choose_fixed(trials, {3: 3.0, 4: 1.1, 0: 2.0}) == 4
    assert choose_fixed(trials, {3: 3.0, 4: 2.1, 0: 2.0}) == 0
    # Of those that are nearly equal, the one with the best trials.
    assert choose_fixed(trials, {3: 3.0, 4: 2.03, 0: 2.0}) == 4
    # One that was not driven along all of it counts with its trials.
    assert choose_fixed(trials, {3: 3.0, 0: 2.0}) == 4


def test_of_repeated_trials_the_surely_best_is_taken():
    def summary(*errors):
        repeats = [{"rte": e} for e in errors]
        return Summary({}, float(np.mean(errors)), 0, 0, 1.0, repeats=repeats)

    steady, lucky = [summary(1.1, 1.1, 1.1)] * 2, [summary(0.2, 0.9, 1.9), summary(1.0, 1.0, 1.0)]
    verdicts = [judge(config(repeats=3), runs) for runs in (steady, lucky)]
    assert verdicts[0].margin == 0.0
    # The standard error of the mean of two means of three, times Student's t with four degrees.
    error = np.sqrt(np.var([0.2, 0.9, 1.9], ddof=1) / 3) / 2
    assert verdicts[1].margin == pytest.approx(2.1318 * error, rel=1e-4)
    assert verdicts[1].value < verdicts[0].value
    assert best_by_trials(dict(enumerate(verdicts))) == 0
    assert judge(config(), [Summary({}, 1.0, 0, 0, 1.0)]).margin == 0.0


def test_runs_of_the_baseline_alone_give_it_no_margin_but_a_sentence():
    repeats = [{"rte": e, "rpe": 0.1 * e} for e in (1.0, 2.0, 3.0)]
    runs = [Summary({}, 2.0, 0, 0, 1.0, {"rpe": 0.2}, repeats)] * 2
    once = config(baseline_runs=3, objective="rpe")
    assert judge(once, runs).bound == judge(once, runs).value == pytest.approx(0.2)
    assert baseline_words(once, runs) == [
        "The baseline ran 3 times: rpe [m] 0.2 in the mean, 0.1 to 0.3, standard deviation 0.1."
    ]
    assert baseline_words(once, [Summary({}, 2.0, 0, 0, 1.0)]) == []
    assert baseline_words(config(objective="cpu"), runs) == []


def test_a_metric_that_cannot_be_measured_counts_as_the_largest():
    of = config(objective={"rte": 1.0, "kitti": 1.0})
    runs = [Summary({}, 2.0, 0, 0, 1.0, {"kitti": 1.0}), Summary({}, 2.0, 0, 0, 1.0)]
    assert judge(of, runs).value == pytest.approx(0.5 * (3.0 + 2.0 + 1e6))
    poses = np.tile(np.eye(4), (6, 1, 1))
    assert trajectory_metrics(np.full_like(poses, np.nan), poses) == {}
