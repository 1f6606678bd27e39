import numpy as np
import pytest
from made_passes import chained, straight
from rooms import moved, scan_at, street

from adaptune.metrics import travelled
from adaptune.recording.scan import Scan
from adaptune.reference.graph import EVERY, LATER, MOST, NEAR, Loop, closed, loops


def circle(metres, laps, step=0.5):
    n = round(metres / step)
    return chained([moved(x=step, yaw=2.0 * np.pi / n)] * (n * laps))


def found_in(T, every=1):
    return loops(T, np.arange(0, len(T), every))


def test_a_path_that_comes_by_again_has_loops_all_along_the_second_lap():
    T = circle(80.0, 2)
    metres, found = travelled(T), found_in(T)
    ends = metres[[loop.end for loop in found]]
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
    assert travelled(T)[found[-1].end] > 1550.0


@pytest.mark.parametrize("T", [straight(400), circle(28.0, 1), np.tile(np.eye(4), (50, 1, 1))])
def test_a_path_that_does_not_come_by_again_has_none(T):
    assert not found_in(T)


class TestClosed:
    """A drive of 15 m and back again, with scans where it begins and where it ends."""

    at = np.concatenate([np.arange(0.0, 15.0, 0.5), np.arange(15.0, 0.4, -0.5)])
    loop = Loop(2, len(at) - 2)

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
        way = self.at[self.loop.end] - self.at[self.loop.start]
        np.testing.assert_allclose(edge.hop.T_start_end, moved(way), atol=0.03)

    def test_one_that_departs_from_the_path_is_rejected(self):
        # It would be measured: GICP starts within 2 m.
        assert not closed(self.scans(), [self.loop], self.known(0.6))

    def test_scans_without_points_and_the_last_scan_have_none(self):
        n = len(self.at)
        wanted = [Loop(3, n - 3), Loop(self.loop.start, n - 1)]
        assert not closed(self.scans(), wanted, self.known(0.0))
