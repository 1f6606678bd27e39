import warnings
from dataclasses import replace

import numpy as np
import pytest
from made_passes import straight
from made_references import made_of
from pictures import is_white, texts

from adaptune.reference.stored import Registrations, StoredEstimate, draw_estimate

NAN = float("nan")


def drawn(path, found, title="drive"):
    """Draw it as SVG, without a warning; its texts."""
    stored = StoredEstimate.of(path, found, {})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_estimate(path.with_suffix(".svg"), title, found, stored, 10.0)
    return texts(path)


def reference(n=201, lost=(), accepted=(), residual=()):
    m = len(residual)
    found = made_of(np.arange(n, dtype=np.int64) * 10**8, straight(n), lost=lost)
    starts, ends = np.arange(m) % 10, 20 + np.arange(m)
    of = Registrations(starts, ends, np.array(accepted, bool), np.array(residual, float))
    return replace(found, registrations=of)


def shaded(path):
    """Spans of time that are marked."""
    return path.with_suffix(".svg").read_text().count("fill: #d55e00; opacity: 0.15")


def test_registrations_are_counted_by_what_became_of_them(tmp_path):
    path = tmp_path / "a.png"
    found = reference(
        accepted=[1, 1, 1, 0, 0, 0], residual=[0.01, 0.0, 0.02, 0.5, 0.7, NAN], lost=[60, 120]
    )
    written = drawn(path, found)
    assert {"3 agree", "2 differ", "1 failed", "path", "start"} <= set(written)
    assert shaded(path) == 2


@pytest.mark.parametrize(
    ("accepted", "residual", "label"),
    [([1], [0.01], "1 agree"), ([0], [0.3], "1 differ"), ([0, 0], [NAN, NAN], "2 failed")],
)
def test_what_there_is_not_is_not_in_the_legend(tmp_path, accepted, residual, label):
    written = drawn(tmp_path / "a.png", reference(accepted=accepted, residual=residual))
    kinds = ("agree", "differ", "failed")
    assert [text for text in written if text.endswith(kinds)] == [label]
    assert not shaded(tmp_path / "a.png")


def test_without_registrations(tmp_path):
    written = drawn(tmp_path / "a.png", reference())
    assert "path" in written
    assert "differ from the reference by [cm], logarithmic" in written


def test_the_title_says_how_accurate_it_is_and_what_is_unknown(tmp_path):
    path = tmp_path / "a.png"
    found = reference(lost=[100])
    (title,) = [text for text in drawn(path, found, "the drive") if text.startswith("the drive")]
    assert title == (
        f"the drive: 76 m, wrong by {found.error(10.0):.2g} % over 10 m, "
        "unknown for 5.0 % of the scans"
    )


def title_of(path, found):
    return next(text for text in drawn(path, found) if text.startswith("drive:"))


def test_a_short_one_tells_no_error(tmp_path):
    assert "% over 10 m" in title_of(tmp_path / "a.png", reference(61))
    assert "wrong" not in title_of(tmp_path / "a.png", reference(9))


def test_a_little_that_is_unknown_is_not_nothing(tmp_path):
    assert "unknown" not in title_of(tmp_path / "a.png", reference())
    found = reference(4001, lost=[3999])
    assert "unknown for 0.1 % of the scans" in title_of(tmp_path / "a.png", found)


def test_a_picture_is_a_white_png(tmp_path):
    found = reference(accepted=[1, 0], residual=[0.01, NAN], lost=[3])
    path = tmp_path / "a.png"
    draw_estimate(path, "drive", found, StoredEstimate.of(path, found, {}), 10.0)
    assert is_white(path)
