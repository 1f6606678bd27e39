import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from estimates import made_of
from hypothesis import given, settings
from hypothesis import strategies as st
from made_passes import straight

from adaptune.metrics import window_ends
from adaptune.reference.estimated import (
    BREAK,
    HALVES_TO_WHOLE,
    OF_BOTH,
    EstimatedReference,
    EstimateError,
    Registrations,
)
from adaptune.reference.stored import StoredEstimate, estimate_chart, write_estimate
from adaptune.report.charts import Points, Spans

ABOUT = {"bag": "drive.bag", "topics": ["/points"], "version": 1}


def reference(n=201, lost=(50,)):
    stamps = 1_600_000_000_123_456_789 + np.arange(n, dtype=np.int64) * 10**8
    return made_of(stamps, straight(n), lost=lost)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("estimates") / "new" / "drive.tum"
    return path, write_estimate(path, reference(), ABOUT)


def of_errors(errors):
    return StoredEstimate(Path("a.tum"), {}, 9, 9.0, 0.0, errors)


def test_what_is_written_is_read(written):
    path, stored = written
    assert StoredEstimate.read(path) == stored
    found = reference()
    assert stored.about == ABOUT
    assert stored.scans == 201
    assert stored.metres == pytest.approx(found.path(), abs=1e-3)
    assert stored.unknown_share == pytest.approx(found.unknown_share(), abs=1e-4)
    assert list(stored.errors) == [1.0, 2.0, 5.0, 10.0, 25.0, 50.0]  # a path of 60 m, in two parts
    for length, error in stored.errors.items():
        assert error == pytest.approx(found.error(length), abs=1e-4)


def test_it_is_plain_data_beside_a_picture(written):
    path, stored = written
    assert {file.name for file in path.parent.iterdir()} == {"drive.tum", "drive.png", "drive.json"}
    known = json.loads(path.with_suffix(".json").read_text())
    assert set(known) == {
        *("about", "scans", "metres", "unknown_share", "unknown_seconds", "error_percent")
    }
    ((begin, end, why),) = known["unknown_seconds"]
    assert 4.9 < begin < end < 6.2
    assert why == "too few registrations"
    assert known["error_percent"]["10.0"] == stored.errors[10.0]


def test_between_lengths_the_error_is_in_between():
    stored = of_errors({100.0: 0.1, 1.0: 10.0, 10.0: 1.0})
    assert stored.error(10.0) == pytest.approx(1.0)
    # Both are halfway when they are logarithms.
    assert stored.error(math.sqrt(10.0)) == pytest.approx(math.sqrt(10.0))
    assert stored.error(50.0) == pytest.approx(0.2)
    # Over less than the shortest, it is wrong by as many metres.
    assert stored.error(0.1) == pytest.approx(100.0)
    assert stored.error(140.0) == pytest.approx(0.1)
    assert math.isnan(stored.error(160.0))


@given(st.floats(1.0, 100.0), st.floats(0.0, 20.0), st.floats(0.0, 20.0))
def test_it_is_never_beyond_those_beside_it(length, one, other):
    stored = of_errors({1.0: one, 100.0: other})
    low, high = sorted(max(error, 1e-4) for error in (one, other))
    assert low * 0.999 <= stored.error(length) <= high * 1.001


def test_without_any_length_the_error_is_unknown(tmp_path):
    assert math.isnan(of_errors({}).error(10.0))
    stored = write_estimate(tmp_path / "short.tum", reference(3, ()), {})
    assert stored.errors == {}
    assert StoredEstimate.read(tmp_path / "short.tum") == stored


WHOLE = {"about": {}, "scans": 9, "metres": 9.0, "unknown_share": 0.0, "error_percent": {"5": 1}}


@pytest.mark.parametrize(
    "text",
    [
        "",
        json.dumps(WHOLE)[:40],
        "[]",
        "\udcff",
        *(json.dumps({k: v for k, v in WHOLE.items() if k != left}) for left in WHOLE),
        json.dumps(WHOLE | {"scans": "many"}),
        json.dumps(WHOLE | {"error_percent": [1.0]}),
        json.dumps(WHOLE | {"error_percent": {"five": 1.0}}),
        json.dumps(WHOLE | {"error_percent": {"5": {}}}),
    ],
)
def test_a_damaged_file_is_named(tmp_path, text):
    file = tmp_path / "drive.json"
    file.write_text(text, errors="surrogateescape")
    with pytest.raises(EstimateError, match=r"drive\.json: is damaged .*; remove it and drive.tum"):
        StoredEstimate.read(tmp_path / "drive.tum")


@pytest.mark.parametrize(
    "at", ["adaptune.reference.stored.draw_chart", "adaptune.reference.stored.write_text"]
)
def test_what_was_known_before_is_not_of_new_poses(tmp_path, monkeypatch, at):
    path = tmp_path / "one.tum"
    write_estimate(path, reference(), {"of": 1})
    assert StoredEstimate.read(path).about == {"of": 1}

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(at, interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_estimate(path, reference(), {"of": 2})
    assert StoredEstimate.read(path) is None


NAN = float("nan")


def test_registrations_are_counted_by_what_became_of_them():
    found = made_of(np.arange(201, dtype=np.int64) * 10**8, straight(201), lost=[60, 120])
    accepted = np.array([1, 1, 1, 0, 0, 0], bool)
    residual = np.array([0.01, 0.0, 0.02, 0.5, 0.7, NAN])
    of = Registrations(np.arange(6), 20 + np.arange(6), accepted, residual)
    path, registrations = estimate_chart("a", replace(found, registrations=of)).panels
    points = [one.name for one in registrations.drawn if isinstance(one, Points)]
    assert points == ["2 differ", "3 agree", "1 failed"]
    assert sum(isinstance(one, Spans) for one in registrations.drawn) == 2
    assert np.isnan(path.drawn[0].x[60:80]).any()


NONE = np.zeros(0, np.intp)
NO_REGISTRATIONS = Registrations(NONE, NONE, NONE.astype(bool), NONE.astype(float))


def along(n=101, seconds=0.1, lost=(), step=0.3, halves=None):
    """A straight path; `seconds` from scan to scan; motions in `lost` cannot be trusted."""
    intervals = np.broadcast_to(np.round(np.multiply(seconds, 1e9)).astype(np.int64), n - 1)
    stamps = 10**18 + np.concatenate([[0], np.cumsum(intervals)])
    trusted = np.ones(n - 1, bool)
    trusted[list(lost)] = False
    T = straight(n, step)
    halves = np.stack([T, T]) if halves is None else halves
    return EstimatedReference(stamps, T, trusted, halves, NO_REGISTRATIONS)


@st.composite
def references(draw):
    """At any rate, with pauses, and with motions that cannot be trusted."""
    n = draw(st.integers(2, 60))
    usual = draw(st.sampled_from([0.02, 0.1, 0.5, 1.0, 1.1, 3.0]))
    lost = draw(st.sets(st.integers(0, n - 2), max_size=6))
    pauses = draw(st.dictionaries(st.integers(0, n - 2), st.floats(0.001, 20.0), max_size=4))
    seconds = np.full(n - 1, usual)
    seconds[list(pauses)] = list(pauses.values())
    return along(n, seconds, lost)


@given(references())
@settings(max_examples=200, deadline=None)
def test_a_motion_that_is_not_trusted_leaves_a_gap_and_no_more_than_must_be(found):
    assert found.known[0]
    for i in np.flatnonzero(~found.known):
        last = np.flatnonzero(~found.trusted[:i])[-1]
        assert i == last + 1 or found.stamps[i] - found.stamps[last] <= BREAK * 1e9
    known = np.flatnonzero(found.known)
    for i in np.flatnonzero(~found.trusted):
        before, after = known[known <= i][-1], known[known > i]
        if len(after):
            assert after[0] - before >= 2
            assert found.stamps[after[0]] - found.stamps[before] > BREAK * 1e9


@given(references(), st.sampled_from([0.1, 0.3, 1.0, 5.0]))
@settings(max_examples=200, deadline=None)
def test_no_sub_trajectory_crosses_a_motion_that_is_not_trusted(found, length):
    ends = window_ends(found.trajectory().at(found.stamps), length)
    untrusted = np.flatnonzero(~found.trusted)
    for start in np.flatnonzero(ends >= 0):
        assert not ((untrusted >= start) & (untrusted < ends[start])).any()


@given(references())
@settings(max_examples=200, deadline=None)
def test_gaps_are_where_poses_are_unknown(found):
    seconds = (found.stamps - found.stamps[0]) * 1e-9
    gaps, inside = found.gaps(), np.zeros(len(seconds), bool)
    spans = [gap.seconds for gap in gaps]
    for first, stop in spans:
        assert first < stop
        inside |= (seconds > first) & (seconds < stop)
    assert all(stop <= first for (_, stop), (first, _) in pairwise(spans))
    inside[-1] |= bool(spans) and spans[-1][1] == seconds[-1] and not found.known[-1]
    np.testing.assert_array_equal(inside, ~found.known)


def test_a_gap_lasts_from_the_last_known_pose_to_the_next():
    found = along(lost=[20, 25])
    assert found.gaps()[0].seconds == pytest.approx((2.0, 3.6))
    assert found.unknown_share() == pytest.approx(15 / 101)
    assert along(lost=[99]).gaps()[0].seconds == pytest.approx((9.9, 10.0))
    assert along(lost=[0]).gaps()[0].seconds == pytest.approx((0.0, 1.1))
    assert along().gaps() == []
    assert along().unknown_share() == 0.0


def test_the_path_counts_as_far_as_it_is_known():
    assert along().path() == pytest.approx(30.0)
    # Ten poses are left out, and so eleven motions.
    assert along(lost=[20]).path() == pytest.approx(30.0 - 11 * 0.3)


def too_long(n, share, step=0.3):
    return np.stack([straight(n, step), straight(n, step * (1.0 + share))])


@pytest.mark.parametrize(("share", "length"), [(0.01, 5.0), (0.002, 20.0), (0.0, 5.0)])
def test_the_error_follows_from_how_the_halves_differ(share, length):
    found = along(halves=too_long(101, share))
    # A sub-trajectory ends at the first pose beyond its length.
    way = 0.3 * np.floor(length / 0.3 + 1.0)
    differ = 100.0 * share * way / length
    expected = np.hypot(HALVES_TO_WHOLE * differ, OF_BOTH)
    assert found.error(length) == pytest.approx(expected, rel=1e-6)


def test_the_error_does_not_count_where_poses_are_unknown():
    halves = too_long(101, 0.01)
    halves[1, 21:, 1, 3] += 5.0  # they part where the along is lost
    found = along(lost=[20], halves=halves)
    assert found.error(5.0) == pytest.approx(along(halves=too_long(101, 0.01)).error(5.0))
    assert along(halves=halves).error(5.0) > 5 * found.error(5.0)


@pytest.mark.parametrize(("lost", "length"), [([], 31.0), ([30, 60], 12.0), ([0], 30.0)])
def test_the_error_is_unknown_over_more_than_the_path(lost, length):
    assert np.isnan(along(lost=lost).error(length))
    assert np.isfinite(along(lost=lost).error(5.0))
