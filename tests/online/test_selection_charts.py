import numpy as np
import pytest
from made_replays import SECONDS, bank, kept, replay, sequence

from adaptune.report.charts import Line, Mark, Points
from online.charts import familiarity_chart, histograms, latency_chart, period_ratios


def test_ratios_are_of_the_same_stretches_of_time():
    errors = np.where(SECONDS < 8.0, 2.0, np.where(SECONDS < 9.0, 3.0, 1.0))
    fixed = kept()
    fixed = fixed._replace(errors=np.full(len(SECONDS), 2.0))
    mode = replay(errors=errors)
    np.testing.assert_allclose(period_ratios(mode, fixed), [1.0, 1.5, 0.5])
    # Where one is unknown, so is the ratio.
    unknown = replay(errors=np.where(SECONDS < 8.0, np.nan, errors))
    np.testing.assert_allclose(period_ratios(unknown, fixed), [np.nan, 1.5, 0.5])


def test_familiarity_is_shown_of_those_that_know_it():
    known = bank()._replace(familiarity=np.array([0.2, np.nan, 0.9]))
    over_time, against = familiarity_chart(
        sequence(fixed=kept(), paper=replay(), adaptive=known)
    ).panels
    assert [d.name for d in over_time.drawn if isinstance(d, Line)] == ["adaptive"]
    (points,) = (d for d in against.drawn if isinstance(d, Points))
    np.testing.assert_array_equal(points.x, [0.2, np.nan, 0.9])
    # Without the fixed set there are no ratios.
    assert len(familiarity_chart(sequence(adaptive=known)).panels) == 1
    assert familiarity_chart(sequence(paper=replay())) is None


def test_shares_of_times_add_up():
    times = {"fixed": np.array([1.0, 1.0, 4.0]), "paper": np.array([2.0, 30.0])}
    for line in histograms(times):
        assert sum(line.y) == pytest.approx(100.0)
        assert len(line.x) == len(line.y)
    fixed, paper = histograms(times)
    assert list(fixed.x) == list(paper.x)
    assert fixed.y[0] == pytest.approx(200.0 / 3.0)


def test_a_replay_in_real_time_has_a_delay_of_its_poses():
    lockstep = latency_chart(sequence(fixed=kept(), paper=replay()))
    assert len(lockstep.panels) == 2
    late = replay()._replace(late_ms=np.full(len(SECONDS), 12.0))
    select, _, pose = latency_chart(sequence(fixed=kept(), paper=late)).panels
    assert not [d for d in select.drawn if isinstance(d, Mark)]
    (mark,) = (d for d in pose.drawn if isinstance(d, Mark))
    assert mark.at == pytest.approx(100.0)
    assert [d.name for d in pose.drawn if isinstance(d, Line)] == ["paper"]
