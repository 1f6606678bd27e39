import os
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from made_passes import (
    REACHES,
    chained,
    course,
    failed,
    guesses,
    hop,
    made_pass,
    pairs,
    passed,
    straight,
    truth,
    winding,
)
from rooms import moved

from adaptune.errors import NotInstalledError, import_extra
from adaptune.geometry import invert, steps
from adaptune.metrics import sub_trajectory_rte
from adaptune.recording.scan import Scan
from adaptune.reference import estimate
from adaptune.reference.estimate import estimate_reference, estimated
from adaptune.reference.estimated import EstimateError
from adaptune.reference.graph import HALVES, Consensus, Guess, pass_over

N = 121
TRUTH = winding(N)
SHORT, MIDDLE, LONG = REACHES


def equal_members():
    motions = np.concatenate([np.eye(4)[None], steps(TRUTH)])
    return np.repeat(motions[:, None], Consensus.n_members, axis=1)


def test_without_gtsam_it_says_at_once_what_to_install(monkeypatch):
    import_extra.cache_clear()
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(NotInstalledError, match=r"run `pip install 'adaptune\[reference\]'`"):
        estimate_reference(None)


class Recorded(list):
    name = "some.bag"
    n_messages = 3  # not that many


def later(scans, first, seconds):
    """The same scans; those from a number on come so much later."""
    return [
        Scan(s.stamp + (i >= first) * round(seconds * 1e9), s.points, s.times)
        for i, s in enumerate(scans)
    ]


def test_pose_graphs_are_solved_on_one_core(monkeypatch):
    cores = []
    monkeypatch.setattr(estimate, "pass_over", lambda *_: None)
    monkeypatch.setattr(
        estimate, "estimated", lambda *_: cores.append(len(os.sched_getaffinity(0)))
    )
    before = os.sched_getaffinity(0)
    estimate_reference(Recorded())
    assert cores == [1]
    assert os.sched_getaffinity(0) == before


class TestOfACourse:
    def test_it_is_right_and_knows_how_right(self):
        found, T = estimated("street", passed()), truth()
        assert found.trusted.all()
        for length in (5.0, 10.0):
            wrong = np.nanmean(sub_trajectory_rte(T, found.T_world_sensor, length))
            before = np.nanmean(sub_trajectory_rte(T, passed().T_odom_sensor, length))
            assert wrong < 0.7 * before
            assert wrong / 2.0 < found.error(length) < 2.0 * wrong
        assert found.error(10.0) < 0.3
        assert found.registrations.accepted.mean() > 0.9

    def test_the_same_scans_give_the_same_bytes(self):
        scans = Recorded(course()[:38])
        first, second = estimate_reference(scans), estimated("a", pass_over(scans))
        for name in ("T_world_sensor", "trusted", "halves"):
            assert getattr(first, name).tobytes() == getattr(second, name).tobytes()

    def test_scans_that_stop_for_ten_seconds_of_driving_are_masked(self):
        scans = course()[:40] + later(course()[63:], 0, 10.0 - 2.4)
        found = estimate_reference(Recorded(scans))
        assert not found.trusted[39]
        (gap,) = found.gaps()
        seconds = (found.stamps - found.stamps[0]) * 1e-9
        first, stop = gap.seconds
        assert first <= seconds[39] < seconds[40] < stop
        assert found.unknown_share() < 0.3


class TestRefusals:
    def test_a_robot_that_hardly_moves(self):
        scan, told = course()[0], []
        still = Recorded(Scan(scan.stamp + i * 10**8, scan.points) for i in range(5))
        with pytest.raises(
            EstimateError, match=r"^some.bag: by its scans, the robot comes 0\.\d m far.* 10 m: "
        ):
            estimate_reference(still, lambda *done: told.append(done))
        assert told == [(1, 3), (2, 3), (3, 3), (4, 4), (5, 5)]

    def test_a_robot_that_drives_round_a_small_room_is_not_refused(self):
        T = chained([moved(x=0.2, yaw=0.1)] * 300)
        assert estimated("a", made_pass(T, guesses(T))).path() > 50.0

    def test_a_corridor_that_does_not_tell_how_far(self):
        blind = [
            g._replace(hop=g.hop._replace(projection=np.diag([0.0, 1.0, 1.0])))
            for g in guesses(straight(N))
        ]
        with pytest.raises(EstimateError, match=r"% of its scans cannot be registered"):
            estimated("a", made_pass(straight(N), blind))

    @pytest.mark.parametrize("found", [[], failed(guesses(TRUTH), lambda *_: True)])
    def test_nothing_can_be_registered(self, found):
        with pytest.raises(EstimateError, match=r"^a: 99 % of its scans cannot .* too bare"):
            estimated("a", made_pass(TRUTH, found))

    def test_half_of_it_cannot_be_registered(self):
        found = failed(guesses(TRUTH), lambda _, end: end > 55)
        with pytest.raises(EstimateError, match=r"^a: 5\d % of its scans"):
            estimated("a", made_pass(TRUTH, found))
        found = failed(guesses(TRUTH), lambda _, end: end > 75)
        assert 0.3 < estimated("a", made_pass(TRUTH, found)).unknown_share() < 0.5


class TestMembers:
    """The consensus loses track over three scans; member 3 does not."""

    lost = slice(50, 53)

    def members(self):
        found = equal_members()
        motions = found[:, 0].copy()
        # The one that is right there is noisy elsewhere.
        found[:, 3, 1, 3] += 0.02 * np.sin(np.arange(N))
        found[51:54, 3] = motions[51:54]
        found[51:54, [0, 1, 2, 4], 0, 3] += 1.0
        return found

    def consensus(self):
        motions = steps(TRUTH)
        motions[self.lost, 0, 3] += 1.0
        return chained(motions)

    @staticmethod
    def spans(start, end):
        return start < 53 and end > 50

    def passed(self, member):
        right = failed(guesses(TRUTH), self.spans)
        spanning = [pair for pair in pairs(N) if self.spans(*pair)]
        return made_pass(self.consensus(), right + guesses(TRUTH, spanning, member), self.members())

    def test_one_takes_over_where_registrations_confirm_it(self, monkeypatch):
        begun, optimised = [], estimate.optimised
        monkeypatch.setattr(
            estimate,
            "optimised",
            lambda T, *of, **more: begun.append(T) or optimised(T, *of, **more),
        )
        found = estimated("a", self.passed(3))
        off = np.linalg.norm((steps(found.T_world_sensor) - steps(TRUTH))[:, :3, 3], axis=1)
        assert off.max() < 0.02
        assert found.trusted.all()
        np.testing.assert_allclose(steps(begun[0])[self.lost], steps(TRUTH)[self.lost], atol=1e-9)
        # Elsewhere the consensus stays, which is better there.
        assert off[:40].max() < 0.001

    def test_none_takes_over_where_it_has_no_motion(self):
        made = self.passed(3)
        made.T_previous_current[52, 3] = np.nan
        found = estimated("a", made)
        assert not found.trusted[self.lost].any()
        assert np.isfinite(found.T_world_sensor).all()
        assert np.isfinite(found.halves).all()

    def test_the_one_with_most_registrations_takes_over(self):
        made = self.passed(3)
        wrong = self.consensus()
        some = [(45, 58), (40, 53), (30, 55)]
        others = [Guess(*pair, 1, hop(wrong, *pair)) for pair in some]
        found = estimated("a", made_pass(wrong, [*made.guesses, *others], made.T_previous_current))
        assert np.linalg.norm(found.T_world_sensor[-1, :3, 3] - TRUTH[-1, :3, 3]) < 0.2


class TestTrust:
    """A sound drive, but for the motion from scan 60 to 61."""

    @staticmethod
    def over(*reaches):
        return lambda start, end: start <= 60 < end and end - start in reaches

    def estimated(self, found):
        return estimated("a", made_pass(TRUTH, found))

    def test_short_registrations_that_fail_are_evidence_against_a_motion(self):
        some = self.over(SHORT, MIDDLE)
        # All short ones, and of the long ones all but four.
        found = self.estimated(
            failed(guesses(TRUTH), lambda *of: some(*of) or (self.over(LONG)(*of) and of[0] > 48))
        )
        assert not found.trusted[60]
        assert found.trusted[:45].all()
        assert found.trusted[75:].all()

    def test_long_ones_that_fail_are_not(self):
        # Two short ones confirm it, and eight long ones fail.
        found = failed(guesses(TRUTH), self.over(LONG))
        reference = self.estimated([g for g in found if not self.over(MIDDLE)(*g[:2])])
        assert reference.trusted.all()
        assert (~reference.registrations.accepted).sum() == 8
        assert np.isnan(reference.registrations.residual).sum() == 8

    def test_a_motion_needs_two_registrations(self):
        of_60 = self.over(SHORT)
        kept = [g for g in guesses(TRUTH) if not self.over(MIDDLE, LONG)(*g[:2])]
        assert self.estimated(kept).trusted[60]
        first = next(g for g in kept if of_60(*g[:2]))
        assert not self.estimated([g for g in kept if g is not first]).trusted[60]

    def test_those_that_disagree_are_however_long(self):
        # Half of them say that the robot came 0.6 m farther.
        wrong = self.over(*REACHES)
        crossing = [g for g in guesses(TRUTH) if wrong(g.start, g.end)]
        others = [g for g in guesses(TRUTH) if not wrong(g.start, g.end)]
        assert len(crossing) > 12
        crossing = [
            g if i % 3 == 0 else g._replace(hop=hop(TRUTH, g.start, g.end, (0.6, 0.0, 0.0)))
            for i, g in enumerate(crossing)
        ]
        found = self.estimated([*others, *crossing])
        assert not found.trusted[60]
        assert (~found.registrations.accepted).sum() >= 4
        assert np.nanmax(found.registrations.residual) > 0.2

    def test_what_a_registration_does_not_tell_is_no_disagreement(self):
        along = (0.6, 0.0, 0.0)
        T = straight(N)
        # Every second one tells all directions.
        some = [
            g._replace(hop=hop(T, *g[:2], along, unknown=[0])) if g.end % 6 else g
            for g in guesses(T)
        ]
        found = estimated("a", made_pass(T, some))
        assert found.trusted.all()
        assert found.registrations.residual.max() < 0.02

    def test_a_motion_that_one_registration_spans_is_not_trusted(self):
        # No scan between 40 and 60 was registered, as none would be while the robot is lifted.
        found = [g for g in guesses(TRUTH) if g.end <= 42 or g.start >= 60]
        reference = self.estimated([*found, *guesses(TRUTH, [(39, 63)])])
        assert not reference.trusted[42:60].any()
        assert reference.trusted[:36].all()


class TestHalves:
    def test_either_half_is_made_of_its_members_and_of_half_of_the_scans(self):
        motions = equal_members()
        motions[1:, list(HALVES[0]), 0, 3] += 0.02
        made = made_pass(TRUTH, guesses(TRUTH), motions)
        found = estimated("a", made)
        longer = [np.linalg.norm(steps(half)[-3:, :3, 3], axis=1).mean() for half in found.halves]
        assert longer[0] > longer[1] + 0.0002
        assert found.error(5.0) > estimated("a", made_pass(TRUTH, guesses(TRUTH))).error(5.0)

    def test_registrations_that_differ_from_scan_to_scan_part_them(self):
        ends = sorted({end for _, end in pairs(N)})
        found = [
            g._replace(hop=hop(TRUTH, *g[:2], (0.05 * (-1) ** ends.index(g.end), 0.0, 0.0)))
            for g in guesses(TRUTH)
        ]
        reference = estimated("a", made_pass(TRUTH, found))
        assert reference.trusted.all()
        assert 0.5 < reference.error(5.0) < 2.0

    def test_a_member_that_is_lost_does_not_count(self):
        motions = equal_members()
        motions[1:, 1, 0, 3] += 0.5
        motions[1:, 4] = np.nan
        found = estimated("a", made_pass(TRUTH, guesses(TRUTH), motions))
        assert found.error(5.0) < 0.05


def test_where_the_path_comes_by_again_scans_are_registered(monkeypatch):
    lap = [moved(x=0.4, yaw=2 * np.pi / 150)] * 300
    T, asked = chained(lap), []
    wrong = chained(lap @ moved(yaw=4e-5))
    made = made_pass(wrong, guesses(wrong))

    def closed(scans, wanted, known):
        asked.append((scans, wanted))
        assert np.shape(known) == T.shape
        return [estimate.Edge(*loop, hop(T, *loop), again=True) for loop in wanted]

    monkeypatch.setattr(estimate, "closed", closed)
    scans = SimpleNamespace()
    found = estimated("a", made, scans=scans)
    ((read, wanted),) = asked
    assert read is scans
    assert len(wanted) > 5
    ends = {g.end for g in made.guesses}
    assert all(set(loop) <= ends for loop in wanted)
    for start, end in wanted:
        back, was, true = (invert(P[start]) @ P[end] for P in (found.T_world_sensor, wrong, T))
        far = [np.linalg.norm((P - true)[:3, 3]) for P in (back, was)]
        assert far[0] < 0.3 * far[1]
