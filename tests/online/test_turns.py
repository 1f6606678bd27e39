"""What two sides cost: how often equal ones differ, and that a loss is found."""

import numpy as np
import pytest

from online.turns import cost_ratios


def costs(rng, ratio=1.0, scans=200, machine=0.0, of_turns=0.0):
    """Milliseconds of both sides, in two turns; the machine is slower or faster for both alike."""
    scan = 10.0 + 2.0 * np.sin(np.arange(scans) / 20.0)
    walk = np.cumsum(rng.normal(size=(1, 2, scans)), axis=2) / scans**0.5
    noise = 0.05 * rng.normal(size=(2, 2, scans)) + of_turns * rng.normal(size=(2, 2, 1))
    return scan * np.exp(machine * walk + noise) * np.array([ratio, 1.0])[:, None, None]


def found_worse(every, share=0.05):
    """Whether a row, or that over all, is surely more than 10 % dearer."""
    n = len(every)
    ratios = cost_ratios(every, [str(i) for i in range(n)], 2.0 * share / (n + (n > 1)))
    return any(one.interval[0] > 1.0 and one.value > 1.1 for one in ratios)


@pytest.mark.parametrize("n", [1, 3, 7])
@pytest.mark.parametrize("of_turns", [0.0, 0.05])
def test_equal_sides_alarm_seldom_and_a_loss_is_found(n, of_turns):
    rng = np.random.default_rng(0)
    alarms, found = (
        [
            found_worse([costs(rng, by, machine=0.3, of_turns=of_turns) for _ in range(n)])
            for _ in range(60)
        ]
        for by in (1.0, 1.3)
    )
    assert np.mean(alarms) <= 0.05
    assert np.mean(found) >= (0.95 if not of_turns else 0.8)


@pytest.mark.parametrize("n", [1, 3, 7])
def test_one_figure_a_run_is_judged_by_the_runs_of_a_side(n):
    rng = np.random.default_rng(1)
    runs = lambda by: np.exp(0.02 * rng.normal(size=(2, 2, 1))) * [[[by]], [[1.0]]]  # noqa: E731
    assert sum(found_worse([runs(1.0) for _ in range(n)]) for _ in range(100)) <= 5
    assert sum(found_worse([runs(1.3) for _ in range(n)]) for _ in range(100)) >= 95


def test_runs_that_differ_by_half_say_nothing():
    assert not found_worse([np.array([[[12.0], [18.0]], [[9.0], [11.0]]])])


def test_what_slows_down_both_does_not_count():
    rng = np.random.default_rng(2)
    (calm,) = cost_ratios([costs(rng, 1.2)], ["a"], 0.05)
    (busy,) = cost_ratios([costs(rng, 1.2, machine=1.0)], ["a"], 0.05)
    assert calm.value == pytest.approx(busy.value, rel=0.02)
    assert busy.error < 2.0 * calm.error + 0.01


def test_the_same_figures_are_surely_equal_and_few_scans_say_nothing():
    same = np.full((2, 2, 100), 5.0)
    assert cost_ratios([same], ["a"], 0.05)[0][:2] == (1.0, (1.0, 1.0))
    short = costs(np.random.default_rng(3), 1.5, scans=39)
    assert cost_ratios([short], ["a"], 0.05)[0].interval is None


def test_the_turns_of_a_recording_count_where_they_differ_more_than_those_of_others():
    rng = np.random.default_rng(4)
    every = [costs(rng) for _ in range(40)]
    every[0][0, 0] *= 1.5  # something else ran
    first, *_, over_all = cost_ratios(every, [str(i) for i in range(40)], 0.001)
    assert first.interval[0] < 1.0 < first.interval[1]
    assert over_all.interval[0] < 1.0 < over_all.interval[1]
