import numpy as np
import pytest

from adaptune.runs.archive import TrialSummary
from offline.config import OfflineConfig
from offline.objective import (
    baseline_words,
    judge,
    trajectory_metrics,
    unread_in_words,
)


def config(**given):
    return OfflineConfig.model_validate(given)


def test_a_sum_is_a_mean_over_sequences():
    of = config(objective={"rte": 1, "ms_per_scan": 0.1})
    runs = [TrialSummary({"a": 1}, 1.0, 0, 0, 10.0), TrialSummary({"a": 1}, 3.0, 0, 0, 30.0)]
    judged = judge(of, dict(enumerate(runs)))
    assert judged.parameters == {"a": 1}
    assert judged.value == pytest.approx(0.5 * (1.0 + 1.0) + 0.5 * (3.0 + 3.0))


def test_runs_of_the_baseline_give_a_sentence():
    repeats = [{"rte": e, "rpe": 0.1 * e} for e in (1.0, 2.0, 3.0)]
    runs = [TrialSummary({}, 2.0, 0, 0, 1.0, {"rpe": 0.2}, repeats)] * 2
    once = config(baseline_runs=3, objective="rpe")
    assert judge(once, dict(enumerate(runs))).value == pytest.approx(0.2)
    assert baseline_words(once, runs) == [
        "The baseline ran 3 times: rpe [m] 0.2 in the mean, 0.1 to 0.3, standard deviation 0.1."
    ]
    assert baseline_words(once, [TrialSummary({}, 2.0, 0, 0, 1.0)]) == []
    assert baseline_words(config(objective="cpu"), runs) == []


def test_a_metric_that_cannot_be_measured_counts_as_the_largest():
    of = config(objective={"rte": 1.0, "kitti": 1.0})
    runs = [TrialSummary({}, 2.0, 0, 0, 1.0, {"kitti": 1.0}), TrialSummary({}, 2.0, 0, 0, 1.0)]
    assert judge(of, dict(enumerate(runs))).value == pytest.approx(0.5 * (3.0 + 2.0 + 1e6))
    poses = np.tile(np.eye(4), (6, 1, 1))
    assert trajectory_metrics(np.full_like(poses, np.nan), poses) == {}


@pytest.mark.parametrize(
    ("errors", "said"),
    [
        ([(4.0, 2.0)] * 3, "All 3 sets gave the same poses"),
        ([(4.0, 30.0)] * 2, "All 2 sets gave the same poses"),
        ([(4.0, 2.0), (4.0, 2.0), (4.0, 2.0 + 1e-15)], None),
        ([(30.0, 30.0)] * 3, None),  # lost
        ([(4.0, 2.0)], None),
    ],
)
def test_sets_that_all_give_the_same_poses_are_told(errors, said):
    def runs(of, label=None):
        named = {} if label is None else {"odometry": label}
        return {n: TrialSummary({**named, "a": n}, e[of], 0, 0, 1.0) for n, e in enumerate(errors)}

    words = unread_in_words({"one": runs(0), "two": runs(1)})
    assert [line.startswith(str(said)) for line in words] == [True] * (said is not None)
    # Of several odometries, one; a set that failed gives no poses to compare.
    other = {9: TrialSummary({"odometry": "icp"}, 1.0, 0, 0, 1.0)}
    failed = {8: TrialSummary({"odometry": "gicp"}, 5.0, 0, 0, 1.0, failure="it ended")}
    words = unread_in_words({"one": runs(0, "gicp") | other | failed})
    assert all("sets of gicp gave the same poses" in line for line in words)
