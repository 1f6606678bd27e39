import numpy as np
from made_replays import bank, kept, replay, sequence

from adaptune.report.charts import Line
from online.charts import familiarity_chart


def test_familiarity_is_shown_of_those_that_know_it():
    known = bank()._replace(familiarity=np.array([0.2, np.nan, 0.9]))
    (panel,) = familiarity_chart(sequence(fixed=kept(), paper=replay(), adaptive=known)).panels
    assert [d.name for d in panel.drawn if isinstance(d, Line)] == ["adaptive"]
    assert familiarity_chart(sequence(paper=replay())) is None
