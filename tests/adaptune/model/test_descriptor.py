import sys
from importlib import metadata

import numpy as np
import pytest
import rooms
import turns
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptune.model.descriptor import (
    DESCRIPTORS,
    Describer,
    DescriptorError,
    averaged,
    lowest_elevation,
)
from adaptune.model.ndt import ndt_histogram
from adaptune.recording import Scan

EMPTY = Scan(0, np.empty((0, 3), np.float32))


MINE = """
import numpy as np

def shape(scan):
    return [float(len(scan)), 0.5]

def grows(scan):
    return np.zeros(2 if len(scan) else 1)

def flat(scan):
    return np.zeros((2, 2))

def unknown(scan):
    return np.full(3, np.nan if len(scan) else 0.0)

other = 3
"""


@pytest.fixture(autouse=True)
def mine(tmp_path, monkeypatch):
    (tmp_path / "my_descriptors.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("my_descriptors", None)


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_every_descriptor_describes_any_scan_by_as_many_numbers(name):
    describe = Describer([name])
    sizes = set()
    for scan in (EMPTY, turns.turn(0), Scan(0, turns.turn(0).points[:1]), turns.turn(1)):
        described = describe(scan)
        assert described.dtype == np.float32
        assert np.isfinite(described).all()
        sizes.add(described.shape)
    assert sizes == {(describe.blocks[name],)}


def test_it_tells_places_apart_and_not_headings():
    describe = Describer(["ndt"])
    here, there = turns.turn(0).points, turns.turn(40).points
    # The street's end, and the same place faced backwards: columns of rays stay where they were.
    turned = here * np.array([-1, -1, 1], np.float32)
    one, other, again = (describe(Scan(0, points)) for points in (here, there, turned))
    assert np.linalg.norm(one - again) < 0.3 * np.linalg.norm(one - other)


def test_several_descriptors_stand_one_after_the_other():
    describe = Describer(["my_descriptors:shape", "ndt"])
    scan = turns.turn(0)
    assert describe.blocks == {"my_descriptors:shape": 2, "ndt": 90}
    want = np.concatenate([[len(scan), 0.5], ndt_histogram(scan.points)])
    np.testing.assert_array_equal(describe(scan), want)


def test_descriptors_of_other_packages(monkeypatch):
    point = metadata.EntryPoint("theirs", "my_descriptors:shape", "adaptune.descriptors")
    monkeypatch.setattr("adaptune._system.strict.entry_points", lambda group: [point] * bool(group))
    assert Describer(["theirs"]).blocks == {"theirs": 2}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("ntd", "there is no descriptor 'ntd': did you mean 'ndt'.*module:function"),
        ("no_such_module:f", "cannot import no_such_module .*PYTHONPATH"),
        ("my_descriptors:other", "not a function"),
        ("my_descriptors:grows", r"scan 0 by an array of shape \(2,\), instead of \(1,\)"),
        ("my_descriptors:flat", r"of shape \(2, 2\), instead of one axis"),
        ("my_descriptors:unknown", "NaN or infinity"),
    ],
)
def test_names_and_arrays_that_do_not_do(name, message):
    with pytest.raises(DescriptorError, match=message):
        Describer([name])(turns.turn(0))


def test_averages_are_of_what_a_selector_has_seen():
    stamps = np.array([0.0, 0.4, 1.0, 1.4, 2.1, 2.5, 6.0])
    descriptors = np.arange(7, dtype=np.float32)[:, None] ** 2
    found = averaged(descriptors, (stamps * 1e9).astype(np.int64), 3, 1.0)
    # Frames at or before t, t - 1 and t - 2, where there are such.
    seen = [[0], [1], [2, 0], [3, 1], [4, 2, 0], [5, 3, 1], [6, 5, 5]]
    np.testing.assert_allclose(found[:, 0], [np.mean(np.square(s)) for s in seen], rtol=1e-6)
    np.testing.assert_array_equal(
        averaged(descriptors, (stamps * 1e9).astype(np.int64), 1, 1.0), descriptors
    )


def test_lowest_elevation_is_the_lowest_beams():
    azimuth = np.linspace(-np.pi, np.pi, 500)
    beams = []
    for degrees in (-30.0, -10.0, 10.0):
        r = 5.0 + np.sin(azimuth)
        beams.append([r * np.cos(azimuth), r * np.sin(azimuth), r * np.tan(np.radians(degrees))])
    points = np.concatenate([np.array(b).T for b in beams]).astype(np.float32)
    points[7] = [1.0, 0.0, -50.0]  # one stray return
    assert lowest_elevation(Scan(0, points)) == pytest.approx(-30.0, abs=1e-3)
    assert np.isnan(lowest_elevation(Scan(0, np.empty((0, 3), np.float32))))


modest = settings(max_examples=20, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def street(seed=0):
    """Points of a street, float32 of shape (n, 3)."""
    points = rooms.street(20.0, seed)
    return (points + np.random.default_rng(seed).normal(0.0, 0.02, points.shape)).astype(np.float32)


def plain_histogram(points):
    """The same by np.linalg.eigh, a cell at a time."""
    points = np.asarray(points, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    counts = np.zeros((10, 9))
    cells = {}
    for point in points:
        cells.setdefault(tuple(np.floor(point).astype(int)), []).append(point)
    for members in cells.values():
        if len(members) < 6:
            continue
        mean = np.mean(members, axis=0)
        distance = int(np.hypot(mean[0], mean[1]) / 3.0)
        values, vectors = np.linalg.eigh(np.cov(np.transpose(members), bias=True))
        if distance >= 10 or values[2] < 1e-12:
            continue
        counts[distance, plain_shape(values, vectors)] += 1
    return counts.ravel()


def plain_shape(values, vectors):
    (l3, l2, l1), (v3, _, v1) = values, vectors.T
    if l2 / l1 < 0.1:
        return min(2, int(3 * abs(v1[2])))
    if l3 / l2 < 0.1:
        return 3 + min(2, int(3 * abs(v3[2])))
    return 6 + (0 if l2 / l1 < 0.25 else 1 if l2 / l1 < 0.5 else 2)


@modest
@given(seeds)
def test_histogram_follows_its_definition(seed):
    points = street(seed)
    histogram = ndt_histogram(points)
    assert histogram.sum() > 50
    np.testing.assert_array_equal(histogram, plain_histogram(points))


@modest
@given(seeds, st.floats(0.01, 0.3), st.floats(0.01, 1.0), st.floats(0.01, 1.0))
def test_any_shape_follows_its_definition(seed, size, second, third):
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = []
    for _ in range(20):
        cell = rng.integers([-31, -31, -20], [31, 31, 20]) + 0.5
        points.append(
            np.clip(rng.normal(size=(40, 3)) * size * np.array([1, second, third]), -0.45, 0.45)
            @ rotation.T
            * 0.55
            + cell
        )
    points = np.concatenate(points).astype(np.float32)
    np.testing.assert_array_equal(ndt_histogram(points), plain_histogram(points))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_do_not_count(bad):
    points = street()
    rows = np.repeat(points[:300], 2, axis=0)
    rows[np.arange(600), np.arange(600) % 3] = bad
    mixed = np.random.default_rng(0).permutation(np.concatenate([points, rows]))
    np.testing.assert_array_equal(ndt_histogram(mixed), ndt_histogram(points))
    assert ndt_histogram(rows).sum() == 0
