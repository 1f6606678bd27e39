import numpy as np
import pytest
from made_replays import SECONDS, bank, kept, replay, sequence

from adaptune.report.charts import Line, Mark
from online.charts import familiarity_chart, histograms, latency_chart


def test_familiarity_is_shown_of_those_that_know_it():
    known = bank()._replace(familiarity=np.array([0.2, np.nan, 0.9]))
    (panel,) = familiarity_chart(sequence(fixed=kept(), paper=replay(), adaptive=known)).panels
    assert [d.name for d in panel.drawn if isinstance(d, Line)] == ["adaptive"]
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
