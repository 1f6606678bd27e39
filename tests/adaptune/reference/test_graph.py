import weakref
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_passes import chained, course, drifting, hop, pairs, passed, straight, truth, winding
from rooms import moved, scan_at, street

from adaptune.geometry import invert, steps
from adaptune.live.hops import Hop, HopCloud
from adaptune.metrics import sub_trajectory_rte, travelled
from adaptune.odometry.registry import odometry_class
from adaptune.recording.scan import Scan
from adaptune.reference import graph
from adaptune.reference.graph import (
    DEPARTURE,
    EVERY,
    HALVES,
    LATER,
    LENGTHS,
    MIN_INLIERS_OFFLINE,
    MOST,
    NEAR,
    POOL,
    SPACING,
    Consensus,
    Edge,
    closed,
    loops,
    optimised,
    pass_over,
    positions,
)
from adaptune.trajectory import Trajectory

N = 120
TRUTH = winding(N)
DRIFTING = drifting(TRUTH)


def edges(T, of=None, **wrong):
    return [Edge(*pair, hop(T, *pair, **wrong)) for pair in of or pairs(len(T))]


def farthest(T, other):
    return float(np.linalg.norm((T - other)[:, :3, 3], axis=1).max())


def test_registrations_that_are_right_take_the_drift_away():
    assert farthest(DRIFTING, TRUTH) > 2.0
    found = optimised(DRIFTING, edges(TRUTH))
    assert farthest(found, TRUTH) < 0.2
    assert np.nanmax(sub_trajectory_rte(TRUTH, found, 10.0)) < 0.2


def test_without_registrations_the_motions_stay():
    np.testing.assert_allclose(optimised(DRIFTING, []), DRIFTING, atol=1e-6)


@given(st.integers(0, 10**6))
@settings(max_examples=8, deadline=None)
def test_poses_begin_at_the_identity_and_their_rotations_stay_rotations(seed):
    rng = np.random.default_rng(seed)
    T = winding(40)
    somewhere = moved(*rng.normal(0.0, 100.0, 3), rng.uniform(-3.0, 3.0)) @ T
    noisy = [Edge(a, b, hop(T, a, b, rng.normal(0.0, 0.05, 3))) for a, b in pairs(40)]
    found = optimised(somewhere, noisy)
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)
    R = found[:, :3, :3]
    np.testing.assert_allclose(R.transpose(0, 2, 1) @ R, np.tile(np.eye(3), (40, 1, 1)), atol=1e-9)
    assert (np.linalg.det(R) > 0.0).all()
    assert (found[:, 3] == [0.0, 0.0, 0.0, 1.0]).all()


@pytest.mark.parametrize("off", [(3.0, 0.0, 0.0), (0.0, -20.0, 5.0)])
def test_one_registration_that_is_wrong_by_metres_hardly_counts(off):
    wrong = Edge(45, 70, hop(TRUTH, 45, 70, off))
    found = optimised(DRIFTING, [*edges(TRUTH), wrong])
    assert farthest(found, optimised(DRIFTING, edges(TRUTH))) < 0.02


def test_one_motion_that_is_wrong_by_a_metre_hardly_counts():
    motions = steps(TRUTH)
    motions[50, 0, 3] += 1.0
    assert farthest(optimised(chained(motions), edges(TRUTH)), TRUTH) < 0.1


def test_a_direction_that_registrations_do_not_tell_is_left_to_the_motions():
    # The path turns by 90 degrees from the start to the end of each: the frames differ.
    T = chained([moved(x=0.4, yaw=np.pi / 50)] * 60)
    ends = pairs(61, (25,), 1)
    wrong = {"off": (0.5, 0.0, 0.0)}
    assert farthest(optimised(T, edges(T, ends, **wrong)), T) > 0.3
    assert farthest(optimised(T, edges(T, ends, **wrong, unknown=[0])), T) < 0.02
    assert farthest(optimised(T, edges(T, ends, **wrong, unknown=[1])), T) > 0.3


def test_what_they_tell_across_a_tunnel_still_counts():
    T = straight(60)
    found = optimised(drifting(T, 0.0), edges(T, unknown=[0]))
    assert np.abs(found[:, 1, 3]).max() < 0.1 < np.abs(drifting(T, 0.0)[:, 1, 3]).max()


class TestPositions:
    T = winding(500, 1.0)
    bent = drifting(T, 0.0, 0.001)
    stamps = np.arange(500, dtype=np.int64) * 200_000_000
    elsewhere = moved(1e3, -2e3, 50.0, 2.0)

    def gps(self, noise=0.2):
        T = self.elsewhere @ self.T
        T[:, :3, 3] += np.random.default_rng(0).normal(0.0, noise, (500, 3))
        return Trajectory(self.stamps, T)

    def test_pull_a_bent_path_straight_and_hardly_change_short_ways(self):
        places = positions(self.gps(), self.stamps, self.bent)
        joined = optimised(self.bent, [], places)
        before, after = (
            [float(np.nanmean(sub_trajectory_rte(self.T, T, m))) for m in (2.0, 300.0)]
            for T in (self.bent, joined)
        )
        assert after[1] < 0.1 * before[1]
        assert after[0] < before[0] + 0.5
        # Positions themselves are far worse over short ways.
        assert np.nanmean(sub_trajectory_rte(self.T, self.gps().T_world_sensor, 2.0)) > 10.0
        np.testing.assert_allclose(joined[0], np.eye(4), atol=1e-12)

    def test_one_that_is_wrong_by_far_hardly_counts(self):
        # As where a GPS is reflected by a building.
        places = positions(self.gps(), self.stamps, self.bent)
        metres = places.metres.copy()
        metres[40] += 50.0
        found = [optimised(self.bent, [], p) for p in (places, places._replace(metres=metres))]
        assert farthest(*found) < 0.3

    def test_count_once_a_second_near_the_poses(self):
        places = positions(self.gps(0.0), self.stamps, self.T)
        np.testing.assert_array_equal(places.numbers, np.arange(0, 500, 5))
        np.testing.assert_allclose(places.metres, self.T[::5, :3, 3], atol=1e-6)


def circle(metres, laps, step=0.5):
    n = round(metres / step)
    return chained([moved(x=step, yaw=2.0 * np.pi / n)] * (n * laps))


def found_in(T, every=1):
    return loops(T, np.arange(0, len(T), every))


def test_a_path_that_comes_by_again_has_loops_all_along_the_second_lap():
    T = circle(80.0, 2)
    metres, found = travelled(T), found_in(T)
    ends = metres[[loop[1] for loop in found]]
    assert ends[0] == pytest.approx(80.0, abs=NEAR + 1.0)
    assert ends[-1] > 160.0 - 2 * EVERY
    assert (np.diff(ends) >= EVERY).all()
    assert (np.diff(ends) < EVERY + 1.0).all()
    for start, end in found:
        assert metres[end] - metres[start] > LATER
        assert np.linalg.norm((T[end] - T[start])[:3, 3]) <= NEAR


def test_a_loop_begins_at_the_nearest_place():
    T = circle(80.0, 2)
    # The first one is found before the lap is full; the others lie on each other.
    for start, end in found_in(T)[1:]:
        assert end - start == 160


def test_there_are_not_too_many():
    T = circle(400.0, 4)
    found = found_in(T)
    assert MOST / 2 < len(found) <= MOST
    # All along the path, not only where it begins.
    assert travelled(T)[found[-1][1]] > 1550.0


@pytest.mark.parametrize("T", [straight(400), circle(28.0, 1), np.tile(np.eye(4), (50, 1, 1))])
def test_a_path_that_does_not_come_by_again_has_none(T):
    assert not found_in(T)


class TestClosed:
    """A drive of 15 m and back again, with scans where it begins and where it ends."""

    at = np.concatenate([np.arange(0.0, 15.0, 0.5), np.arange(15.0, 0.4, -0.5)])
    loop = (2, len(at) - 2)

    def scans(self):
        world = street(20.0)
        for i, x in enumerate(self.at):
            here = i in (*self.loop, len(self.at) - 1)
            yield scan_at(world, x, i * 10**8) if here else Scan(i * 10**8, np.zeros((0, 3), "f4"))

    def known(self, wrong):
        T = np.array([moved(x) for x in self.at])
        T[-3:, 1, 3] += wrong
        return T

    def test_a_loop_is_measured(self):
        (edge,) = closed(self.scans(), [self.loop], self.known(0.15))
        assert edge[:2] == self.loop
        way = self.at[self.loop[1]] - self.at[self.loop[0]]
        np.testing.assert_allclose(edge.hop.T_start_end, moved(way), atol=0.03)

    def test_one_that_departs_from_the_path_is_rejected(self):
        # It would be measured: GICP starts within 2 m.
        assert not closed(self.scans(), [self.loop], self.known(0.6))

    def test_scans_without_points_and_the_last_scan_have_none(self):
        n = len(self.at)
        wanted = [(3, n - 3), (self.loop[0], n - 1)]
        assert not closed(self.scans(), wanted, self.known(0.0))


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
                return *next(along), True

        monkeypatch.setattr(graph, "Consensus", Along)
        monkeypatch.setattr(graph, "HopCloud", self._cloud)
        monkeypatch.setattr(graph, "register", self._register)

    def drive(self):
        points = np.zeros((0, 3), np.float32)
        self.found = pass_over(Scan(stamp, points) for stamp in self.stamps)
        return self.found.guesses

    def pairs(self):
        return [(guess.start, guess.end) for guess in self.drive()]

    def _cloud(self, *given):
        cloud = HopCloud(*given)
        self.alive.add(cloud)
        self.most = max(self.most, len(self.alive))
        return cloud

    def _register(self, start, end, guesses, min_inliers):
        assert start in self.alive
        assert end in self.alive
        assert min_inliers == MIN_INLIERS_OFFLINE
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


def test_few_scans_are_in_memory(made):
    most = []
    for n in (200, 1500):
        drive = made(straight(n))
        drive.drive()
        most.append(drive.most)
    assert most[0] == most[1] < 20


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
    for start, end, member, measured in found.guesses:
        assert member == -1
        true = invert(T[start]) @ T[end]
        assert np.linalg.norm((measured.T_start_end - true)[:3, 3]) < 0.1
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
        before, *_ = consensus.register(scan)
    stamp = course()[8].stamp
    empty = Scan(stamp, np.zeros((0, 3), np.float32))
    T, members, registered = consensus.register(empty)
    assert np.isfinite(T).all()
    assert np.linalg.norm((T - before)[:3, 3]) < 1.0
    assert members.shape == (Consensus.n_members, 4, 4)
    assert not registered
