from dataclasses import replace
from pathlib import Path

import numpy as np
from made_passes import straight
from made_references import made_of

from adaptune.reference.stored import Registrations, StoredEstimate, estimate_chart
from adaptune.report.charts import Line, Points, Spans

NAN = float("nan")


def chart_of(found, title="drive"):
    stored = StoredEstimate.of(Path("a.tum"), found, {})
    return estimate_chart(title, found, stored, 10.0)


def drawn(found, kind):
    return [d for panel in chart_of(found).panels for d in panel.drawn if isinstance(d, kind)]


def reference(n=201, lost=(), accepted=(), residual=()):
    m = len(residual)
    found = made_of(np.arange(n, dtype=np.int64) * 10**8, straight(n), lost=lost)
    starts, ends = np.arange(m) % 10, 20 + np.arange(m)
    of = Registrations(starts, ends, np.array(accepted, bool), np.array(residual, float))
    return replace(found, registrations=of)


def test_registrations_are_counted_by_what_became_of_them():
    found = reference(
        accepted=[1, 1, 1, 0, 0, 0], residual=[0.01, 0.0, 0.02, 0.5, 0.7, NAN], lost=[60, 120]
    )
    named = [points.name for points in drawn(found, Points)]
    assert named == ["start", "2 differ", "3 agree", "1 failed"]
    assert len(drawn(found, Spans)) == 2
    assert [line.name for line in drawn(found, Line)] == ["path", "unknown path"]


def test_the_title_says_how_accurate_it_is_and_what_is_unknown():
    found = reference(lost=[100])
    assert chart_of(found, "the drive").title == (
        f"the drive: 76 m, wrong by {found.error(10.0):.2g} % over 10 m, "
        "unknown for 5.0 % of the scans"
    )
    assert "% over 10 m" in chart_of(reference(61)).title
    assert "wrong" not in chart_of(reference(9)).title  # too short
    assert "unknown" not in chart_of(reference()).title
    # A little is not nothing.
    assert "unknown for 0.1 % of the scans" in chart_of(reference(4001, lost=[3999])).title
