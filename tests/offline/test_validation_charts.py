import numpy as np
import pytest

from adaptune.report.charts import Band, Line, Points
from offline.charts import stretch_chart
from offline.tuning import figures


def stretches(n_recordings=2, n=6):
    rng = np.random.default_rng(0)
    return [
        {
            "recording": f"drive_{r}",
            "stretch": i,
            "fixed [%]": 0.5,
            "one set": 1.0,
            "adaptive": float(np.exp(rng.normal(-0.2, 0.1))),
        }
        for r in range(n_recordings)
        for i in range(n)
    ]


def test_stretches_are_sorted_and_have_the_interval_of_their_mean():
    rows = stretches()
    (panel,) = stretch_chart(rows).panels  # one set is the fixed set
    points = [d for d in panel.drawn if isinstance(d, Points)]
    assert [p.name for p in points] == ["drive_0", "drive_1"]
    ranks = np.concatenate([p.x for p in points])
    ratios = np.concatenate([p.y for p in points])
    np.testing.assert_array_equal(np.argsort(ranks), np.argsort(ratios))
    of = figures(np.log([r["adaptive"] for r in rows]), [r["recording"] for r in rows])
    (band,) = (d for d in panel.drawn if isinstance(d, Band))
    assert (band.low[0], band.high[0]) == (of.low, of.high)
    mean = next(d for d in panel.drawn if isinstance(d, Line))
    assert mean.y[0] == pytest.approx(np.exp(np.log(ratios).mean()))
    assert panel.title == f"adaptive: {of.geometric:.2f} ({of.low:.2f}-{of.high:.2f})"
