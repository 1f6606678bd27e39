from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_passes import straight
from made_references import made_of
from pictures import texts

from adaptune.reference.stored import Registrations, StoredEstimate, estimate_chart
from adaptune.report.charts import Line, Points, Spans
from adaptune.report.drawing import draw_chart

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


@pytest.mark.parametrize(
    ("accepted", "residual", "named"),
    [
        ([1], [0.01], ["1 agree"]),
        ([0], [0.3], ["1 differ"]),
        ([0, 0], [NAN, NAN], ["2 failed"]),
        ([], [], []),
    ],
)
def test_what_there_is_not_is_not_in_the_legend(accepted, residual, named):
    found = reference(accepted=accepted, residual=residual)
    assert [points.name for points in drawn(found, Points)] == ["start", *named]
    assert not drawn(found, Spans)
    assert [line.name for line in drawn(found, Line)] == ["path"]


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


def test_a_picture_is_drawn(tmp_path):
    found = reference(accepted=[1, 0], residual=[0.01, NAN], lost=[3])
    draw_chart(chart_of(found), tmp_path / "a.svg")
    assert {"path", "1 agree", "1 failed", "unknown", "start"} <= set(texts(tmp_path / "a.png"))
