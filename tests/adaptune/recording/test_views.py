import numpy as np
import pytest
import rec
from pydantic import ValidationError

from adaptune.recording import Imu, Scan, SequenceConfig, SequenceError
from adaptune.recording.recording import open_sequence
from adaptune.recording.views import with_imu


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return rec.drive(tmp_path_factory.mktemp("drive") / "a.bag")


def seen(bag, *views, **options):
    return open_sequence(SequenceConfig(bag=str(bag), reference="/poses", views=views, **options))


def tenths(sequence):
    return [(scan.stamp - rec.START) // 10**8 for scan in sequence]


def test_cut_keeps_parts(bag):
    assert tenths(seen(bag, {"cut": [[0.2, 0.45], [1, 1.15]]})) == [2, 3, 4, 10, 11]
    with pytest.raises(SequenceError, match="its views leave no scan; cut or drop less"):
        list(seen(bag, {"cut": [[100, 200]]}))


def test_drop_loses_its_share_in_every_pass_the_same(bag):
    kept = tenths(seen(bag, {"drop": 0.5}))
    assert 5 < len(kept) < 15
    assert tenths(seen(bag, {"drop": 0.5})) == kept
    cut = seen(bag, {"cut": [[0.7, 1.2]]}, {"drop": 0.5})
    assert tenths(cut) == [k for k in kept if 7 <= k < 12]


def test_speed_changes_arrival_and_nothing_else(bag):
    plain = list(seen(bag))
    fast = seen(bag, {"speed": 2})
    scans = list(fast)
    assert [s.stamp for s in scans] == [s.stamp for s in plain]
    stamps = np.array([s.stamp for s in scans])
    np.testing.assert_array_equal(fast.played_at(stamps) - stamps[0], np.arange(20) * 5 * 10**7)
    assert np.array_equal(seen(bag).played_at(stamps), stamps)


def test_reverse_mirrors_scans_times_and_poses(bag):
    plain, backward = list(seen(bag)), list(seen(bag, {"reverse": True}))
    assert len(backward) == 20
    assert all(np.diff([s.stamp for s in backward]) == 10**8)
    assert backward[0].stamp == plain[0].stamp
    for a, b in zip(plain, reversed(backward), strict=True):
        assert np.array_equal(a.points, b.points)
        np.testing.assert_allclose(b.times, a.times.max() - a.times, atol=1e-8)
    # A point is where it was: the pose at the time of each point is the same.
    trajectory, mirrored = seen(bag).reference(), seen(bag, {"reverse": True}).reference()
    last = plain[3].stamp + round(float(plain[3].times[-1]) * 1e9)
    there = trajectory.at(np.array([last]))
    here = mirrored.at(np.array([backward[-4].stamp]))
    np.testing.assert_allclose(here, there, atol=1e-9)
    twice = list(seen(bag, {"reverse": True}, {"reverse": True}))
    assert [s.stamp for s in twice] == [s.stamp for s in plain]
    cut = seen(bag, {"cut": [[0, 0.5]]}, {"reverse": True})
    assert np.array_equal(next(iter(cut)).points, plain[4].points)


def test_reverse_needs_the_cache_for_a_bag(bag, monkeypatch):
    with pytest.raises(SequenceError, match="leave `cache` on"):
        list(seen(bag, {"reverse": True}, cache=False))
    monkeypatch.setenv("ADAPTUNE_CACHE_GB", "0.000001")
    with pytest.raises(SequenceError, match="ADAPTUNE_CACHE_GB"):
        list(seen(bag, {"reverse": True}))


def test_noise_moves_points_along_their_rays(bag):
    view = {"noise": 0.1}
    errors = []
    for plain, noisy, again in zip(seen(bag), seen(bag, view), seen(bag, view), strict=True):
        assert np.array_equal(noisy.points, again.points)
        ranges = np.linalg.norm(plain.points, axis=1)
        errors.append(np.linalg.norm(noisy.points, axis=1) - ranges)
        rays = plain.points / ranges[:, None]
        assert np.abs(np.cross(noisy.points, rays)).max() < 1e-4
    assert np.std(np.concatenate(errors)) == pytest.approx(0.1, rel=0.1)
    assert not np.allclose(errors[0], errors[1])


def test_a_transform_leaves_the_world_where_it_is(bag):
    view = {"transform": [1, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]}
    plain, moved = seen(bag), seen(bag, view)
    T, T_moved = plain.reference().T_world_sensor, moved.reference().T_world_sensor
    for i, (a, b) in enumerate(zip(plain, moved, strict=True)):
        assert not np.allclose(a.points, b.points)
        world = a.points @ T[2 * i, :3, :3].T + T[2 * i, :3, 3]
        again = b.points @ T_moved[2 * i, :3, :3].T + T_moved[2 * i, :3, 3]
        np.testing.assert_allclose(again, world, atol=1e-4)


@pytest.mark.parametrize(
    "view",
    [
        {},
        {"cut": [[2, 1]]},
        {"drop": 1.5},
        {"speed": 0},
        {"rings": 2},
        {"transform": [1, 2, 3]},
        {"noise": 1, "reverse": True},
        {"blur": 1},
    ],
)
def test_views_that_make_no_sense_are_refused(bag, view):
    with pytest.raises(ValidationError):
        SequenceConfig(bag=str(bag), views=[view])


class Inertial:
    """Scans of 0.1 s, one of them lost, and an IMU of 100 Hz."""

    name, n_messages = "inertial", 4

    def __init__(self, begin, end):
        stamps = np.arange(round(begin * 1e9), round(end * 1e9), 10**7)
        zeros = np.zeros((len(stamps), 3))
        self.imu = lambda: Imu(stamps, zeros, zeros) if len(stamps) else None
        self.reference = self.played_at = None

    def __iter__(self):
        points, times = np.zeros((2, 3), np.float32), np.array([0.0, 0.095], np.float32)
        for tenth in (0, 1, 3, 4):
            yield Scan(tenth * 10**8, points.copy(), times.copy())


def hundredths(begin, end):
    measured = [scan.imu for scan in with_imu(Inertial(begin, end))]
    return [(imu.stamps // 10**7).tolist() for imu in measured]


def test_scans_bring_along_what_the_imu_measured_since_the_one_before():
    # To the first measurement at the scan's end or after it; the first begins with the one before.
    expected = [[*range(11)], [*range(11, 21)], [*range(21, 41)], [*range(41, 51)]]
    assert hundredths(0.0, 9.0) == expected
    assert hundredths(-1.0, 9.0) == expected
    assert hundredths(0.15, 0.45) == [[15], [*range(16, 21)], [*range(21, 41)], [*range(41, 45)]]


def test_an_imu_that_is_not_there_or_of_another_time():
    with pytest.raises(SequenceError, match="inertial: holds no measurements of an IMU; name"):
        hundredths(0.0, 0.0)
    for begin in (-9.0, 20.0):
        with pytest.raises(SequenceError, match="record both on the same clock, or leave"):
            hundredths(begin, begin + 5.0)


@pytest.mark.parametrize(
    ("view", "cache"),
    [
        (None, False),
        (None, True),
        ({"noise": 0.1}, True),
        ({"drop": 0.3}, False),
        ({"cut": [[0.2, 1.8]]}, True),
        ({"reverse": True}, True),
    ],
)
def test_reading_from_a_scan_on_gives_the_same_scans(bag, monkeypatch, cache, view):
    monkeypatch.setattr("adaptune.recording.recording._BEFORE", 0.25)
    sequence = seen(bag, *([view] if view else []), cache=cache)
    scans = list(sequence)  # into the cache
    last = scans[-5:]
    some = list(sequence.since(last[0].stamp))
    assert 5 <= len(some) < (len(scans) if view is None else 21)
    for one, other in zip(last, some[-5:], strict=True):
        assert one.stamp == other.stamp
        assert np.array_equal(one.points, other.points)
