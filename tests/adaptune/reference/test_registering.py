import weakref
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from made_passes import course, passed, straight, truth
from rooms import moved

from adaptune.geometry import invert, steps
from adaptune.live.hops import Hop, HopCloud
from adaptune.metrics import sub_trajectory_rte, travelled
from adaptune.odometry.registry import odometry_class
from adaptune.recording.scan import Scan
from adaptune.reference import graph
from adaptune.reference.graph import (
    DEPARTURE,
    HALVES,
    LENGTHS,
    MIN_INLIERS_OFFLINE,
    POOL,
    SPACING,
    Consensus,
    pass_over,
)

N_MEMBERS = 3


class Made:
    """Drives along poses that are made up; `answer` stands for the registration of two scans."""

    def __init__(self, monkeypatch, T, members=None, seconds=0.1):
        self.stamps = (np.arange(len(T)) * round(seconds * 1e9)).tolist()
        motions = np.concatenate([np.eye(4)[None], steps(T)])
        members = np.repeat(motions[:, None], N_MEMBERS, 1) if members is None else members
        self.answer = lambda guess: Hop(guess, np.eye(3))
        self.asked, self.alive, self.most = [], weakref.WeakSet(), 0
        along = iter(zip(T, members, strict=True))

        class Along:
            n_members = N_MEMBERS

            def register(self, _):
                return next(along)

        monkeypatch.setattr(graph, "Consensus", Along)
        monkeypatch.setattr(graph, "HopCloud", self._cloud)
        monkeypatch.setattr(graph, "register", self._register)
        monkeypatch.setattr(graph, "processes", self._here)

    def drive(self):
        points = np.zeros((0, 3), np.float32)
        self.found = pass_over(Scan(stamp, points) for stamp in self.stamps)
        return self.found.guesses

    def pairs(self):
        return [(guess.start, guess.end) for guess in self.drive()]

    @contextmanager
    def _here(self, *_):
        """In this process, where what stands for registering is known."""
        vars(graph)["_registering"].cache_clear()
        with ThreadPoolExecutor(1) as pool:
            yield pool

    def _cloud(self, *given):
        cloud = HopCloud(*given)
        self.alive.add(cloud)
        self.most = max(self.most, len(self.alive))
        return cloud

    def _register(self, start, end, guesses, min_inliers, reaches):
        assert start in self.alive
        assert end in self.alive
        assert (min_inliers, reaches) == (MIN_INLIERS_OFFLINE, (2.0, 0.5))
        (guess,) = guesses
        self.asked.append(guess)
        return self.answer(guess)


@pytest.fixture
def made(monkeypatch):
    return partial(Made, monkeypatch)


def ends_of(pairs):
    return sorted({end for _, end in pairs})


def test_every_third_scan_is_registered_2_5_and_10_m_back(made):
    pairs = made(straight(101, 0.4)).pairs()
    assert ends_of(pairs) == [*range(6, 100, 3), 100]
    of_60 = [start for start, end in pairs if end == 60]
    # The nearest that are so far: 2.4, 6.0 and 10.8 m.
    assert of_60 == [54, 45, 33]


@pytest.mark.parametrize(
    ("step", "seconds", "apart"),
    [
        (0.4, 0.1, 3),  # three scans of 10 Hz
        (0.4, 0.05, 5),  # a quarter of a second
        (1.2, 0.1, 2),  # fast: 2 m at most
        (5.0, 0.1, 1),
        (0.03, 0.1, 7),  # slow: 0.2 m at least
    ],
)
def test_scans_are_registered_after_some_time_and_some_way(made, step, seconds, apart):
    pairs = made(straight(120 if step > 0.1 else 500, step), seconds=seconds).pairs()
    assert {b - a for a, b in pairwise(ends_of(pairs)[:-1])} == {apart}


def test_a_robot_that_stands_registers_nothing(made):
    T = np.concatenate([straight(40), np.repeat(straight(40)[-1:], 200, 0), straight(40)])
    T[240:, 0, 3] += T[39, 0, 3]
    T[:, :2, 3] += np.random.default_rng(0).normal(0.0, 0.01, (len(T), 2))
    ends = ends_of(made(T).pairs())
    assert not [end for end in ends if 43 < end < 240]
    assert [end for end in ends if end > 240]


def test_the_last_scan_is_registered_however_near_it_is(made):
    for n in (100, 101, 102):
        pairs = made(straight(n)).pairs()
        assert [start for start, end in pairs if end == n - 1]
        assert len(set(pairs)) == len(pairs)


def test_enough_registrations_begin_at_the_first_scan(made):
    # It creeps, and then it is fast: the scans at 2, 5 and 10 m all are near others.
    metres = np.concatenate([np.arange(0.0, 1.9, 0.21), np.arange(3.85, 40.0, 1.9)])
    T = np.array([moved(x) for x in metres])
    pairs = made(T, seconds=0.3).pairs()
    assert len([start for start, _ in pairs if start == 0]) >= len(LENGTHS)
    assert len(set(pairs)) == len(pairs)


def test_no_error_of_the_last_scans_is_lost(made):
    drive, errors = made(straight(12, 1.2)), [OSError("the disk is full")]

    def fail_once(guess):
        if errors:
            raise errors.pop()
        return Hop(guess, np.eye(3))

    drive.answer = fail_once
    with pytest.raises(OSError, match="the disk is full"):
        drive.drive()


def test_few_scans_are_in_memory(made):
    most = []
    for n in (200, 1500):
        drive = made(straight(n))
        drive.drive()
        most.append(drive.most)
    assert 1 < most[0] == most[1] < 20


@pytest.mark.parametrize("n", [0, 1, 2])
def test_a_recording_of_hardly_any_scan(made, n):
    drive = made(straight(9)[:n])
    assert not drive.pairs()
    found = drive.found
    assert len(found.stamps) == len(found.T_odom_sensor) == n
    assert found.T_previous_current.shape == (n, N_MEMBERS, 4, 4)


class TestGuesses:
    """Members that leave the consensus after 20 scans, by another speed each."""

    def members(self, n, speeds):
        motions = np.tile(moved(0.4), (n, N_MEMBERS, 1, 1))
        motions[20:, :, 0, 3] = speeds
        return motions

    def drive(self, made, speeds, fails=False):
        drive = made(straight(60), self.members(60, speeds))
        if fails:
            drive.answer = lambda _: None
        return drive

    def test_members_are_not_tried_where_the_consensus_leads_there(self, made):
        assert {g.member for g in self.drive(made, (0.4, 0.6, 0.8)).drive()} == {-1}

    def test_members_are_tried_where_it_fails(self, made):
        drive = self.drive(made, (0.4, 0.6, 0.8), fails=True)
        found = drive.drive()
        assert all(guess.hop is None for guess in found)
        late = [g for g in found if g.start > 20]
        # The first one moves as the consensus does.
        assert {g.member for g in late} == {-1, 1, 2}
        assert {g.member for g in found if g.end < 20} == {-1}
        assert len(drive.asked) == len(found)
        for guess, asked in zip(found, drive.asked, strict=True):
            if guess in late:
                speed = (0.4, 0.4, 0.6, 0.8)[guess.member + 1]
                assert asked[0, 3] == pytest.approx(speed * (guess.end - guess.start))

    def test_members_that_agree_with_each_other_are_tried_once(self, made):
        found = self.drive(made, (0.6, 0.61, 0.6), fails=True).drive()
        assert {g.member for g in found} == {-1, 0}

    def test_a_member_without_a_motion_moves_as_the_consensus(self, made):
        motions = self.members(60, (0.4, 0.4, 0.6))
        motions[:, 1] = np.nan
        motions[30, 2] = np.nan
        drive = made(straight(60), motions)
        drive.answer = lambda _: None
        found = drive.drive()
        assert {g.member for g in found} == {-1, 2}
        assert {g.member for g in found if g.start > 30} == {-1, 2}
        assert np.isfinite(drive.asked).all()

    @pytest.mark.parametrize(("beyond", "kept"), [(-0.02, True), (0.02, False)])
    def test_a_registration_that_departs_from_its_guess_is_rejected(self, made, beyond, kept):
        drive = self.drive(made, (0.4, 0.4, 0.4))

        def answer(guess):
            off = DEPARTURE[0] + DEPARTURE[1] * guess[0, 3] + beyond
            return Hop(guess @ moved(y=off), np.eye(3))

        drive.answer = answer
        assert {guess.hop is not None for guess in drive.drive()} == {kept}


def test_on_a_simulated_street_registrations_are_right():
    found, T = passed(), truth()
    np.testing.assert_array_equal(found.stamps, [scan.stamp for scan in course()])
    assert len(found.guesses) > 50
    for start, end, member, hop in found.guesses:
        assert member == -1
        true = invert(T[start]) @ T[end]
        assert np.linalg.norm((hop.T_start_end - true)[:3, 3]) < 0.1
    ends = ends_of([guess[:2] for guess in found.guesses])
    metres = travelled(T)[ends]
    assert (np.diff(metres)[:-1] >= SPACING[0]).all()


def test_the_halves_are_the_pool_and_have_no_algorithm_in_common():
    assert sorted(HALVES[0] + HALVES[1]) == list(range(len(POOL))) == list(range(5))
    kinds = [{POOL[i][0] for i in half} for half in HALVES]
    assert not kinds[0] & kinds[1]


def test_it_follows_the_drive():
    found = passed()
    np.testing.assert_array_equal(found.T_odom_sensor[0], np.eye(4))
    assert np.nanmean(sub_trajectory_rte(truth(), found.T_odom_sensor, 5.0)) < 1.5


@pytest.mark.parametrize("kind", sorted({kind for kind, _ in POOL}))
def test_a_scan_is_prepared_once_for_all_members_of_a_kind(monkeypatch, kind):
    cls, prepared = odometry_class(kind), []
    prepare = cls.prepare
    monkeypatch.setattr(
        cls, "prepare", lambda self, scan: prepared.append(0) or prepare(self, scan)
    )
    consensus = Consensus()
    for scan in course()[:3]:
        consensus.register(scan)
    # One kind may prepare as the other does.
    shared = sum(odometry_class(k).prepare is cls.prepare for k in {k for k, _ in POOL})
    assert len(prepared) == 3 * shared


def test_scans_without_points_leave_it_moving_on():
    consensus = Consensus()
    for scan in course()[:8]:
        before, _ = consensus.register(scan)
    stamp = course()[8].stamp
    empty = Scan(stamp, np.zeros((0, 3), np.float32))
    T, members = consensus.register(empty)
    assert np.isfinite(T).all()
    assert np.linalg.norm((T - before)[:3, 3]) < 1.0
    assert members.shape == (Consensus.n_members, 4, 4)
