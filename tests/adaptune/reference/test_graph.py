import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_passes import chained, drifting, hop, pairs, straight, winding
from rooms import moved, scan_at, street

from adaptune.geometry import steps
from adaptune.metrics import sub_trajectory_rte, travelled
from adaptune.recording.scan import Scan
from adaptune.reference.graph import (
    EVERY,
    LATER,
    MOST,
    NEAR,
    Edge,
    closed,
    loops,
    optimised,
)

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
