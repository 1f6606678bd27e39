from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from rooms import moved, scan_at, street

from adaptune.live import evidence
from adaptune.live.evidence import LOST, SELDOM, LiveEvidence, spread_of
from adaptune.live.hops import Hop
from adaptune.live.own_error import OwnError
from adaptune.model.weights import measured_weights
from adaptune.odometry.base import Motions
from adaptune.recording.scan import Scan
from adaptune.space import Selection

STEP = 1.0
"""Metres from scan to scan, ten a second."""
NOTHING = Scan(0, np.zeros((0, 3), np.float32))


@cache
def scan(i):
    return scan_at(street(), STEP * i, seed=i)


def exact(start, end, guesses):  # noqa: ARG001 - as `register`
    """In place of registrations: what the sensor moved, from its numbered scans."""
    return Hop(moved(STEP * (end.number - start.number)), np.eye(3))


def smeared(i):
    """A scan of a sensor that moves on while it takes it, also the first one."""
    points = scan(i).points
    times = np.linspace(0.0, 0.1, len(points), dtype=np.float32)
    behind = np.outer(times / 0.1 * STEP, [1.0, 0.0, 0.0]).astype(np.float32)
    return Scan(i * 10**8, points - behind, times=times)


class Numbered:
    is_prepared = False

    def __init__(self, scan, T_previous_current, seconds):  # noqa: ARG002 - as `HopCloud`
        self.number = scan.stamp // 10**8

    def moved(self, T_current_next, seconds):
        pass


@pytest.fixture
def exactly(monkeypatch):
    """Registrations that are right; the test may put others in their place."""
    monkeypatch.setattr(evidence, "HopCloud", Numbered)
    monkeypatch.setattr(evidence, "register", exact)
    return lambda register: monkeypatch.setattr(evidence, "register", register)


def drive(live, n, motions, scans=None, first=0):
    """Show scans, and measure once a second; returns what was measured."""
    found = []
    for i in range(first, first + n):
        one = NOTHING if scans is None else scans(i)
        stamp = i * 10**8
        live.observe(stamp, Scan(stamp, one.points), motions(i - 1))
        if i % 10 == 0:
            found.append(live.measure())
    return [one for one in found if one is not None]


def bank(*factors):
    """Motions of a bank whose first member's are its own, each with a factor on its speed."""

    def motions(i):  # noqa: ARG001 - the same over every scan
        members = {trial: moved(STEP * factor) for trial, factor in enumerate(factors)}
        return Motions(members[0], members)

    return motions


def test_the_weights_leave_a_member_that_drifts():
    live = LiveEvidence((0, 1, 2))
    found = drive(live, 31, bank(1.0, 1.005, 1.03), scan)
    assert [round((one.end.stamp - one.start.stamp) / 1e8) for one in found] == [5, 10, 10]
    squares = live.squares()
    assert squares.products[0, 0] < 0.3**2
    assert squares.products[2, 2] == pytest.approx(3.0**2, rel=0.15)
    assert squares.products[1, 1] < 1.0
    first, _, third = measured_weights(3, squares)
    assert third < 0.02
    assert first > 0.6
    assert live.own_error().mean < 0.3
    assert live.health.state == "unknown"  # no second was compared


def test_the_first_scan_is_compensated_by_the_motion_after_it():
    live = LiveEvidence()
    for i in range(12):
        live.observe(i * 10**8, smeared(i), Motions(moved(STEP if i > 1 else 0.0), {}))
    found = live.measure()
    assert (found.start.stamp, found.end.stamp) == (0, 10**9)
    np.testing.assert_allclose(found.hop.T_start_end, moved(10.0 * STEP), atol=0.05)


def test_nothing_is_measured_before_the_first_hop(exactly):  # noqa: ARG001
    live = LiveEvidence()
    assert drive(live, 6, bank(1.0)) == []
    assert live.squares() is None
    assert live.own_error() is None
    assert live.health.state == "unknown"  # no second was compared
    selection = live.estimated(Selection(3, {}))
    assert np.isnan(selection.estimated_error)


def test_it_is_in_doubt_after_two_rejections_in_a_row_and_sound_again(exactly):
    live = LiveEvidence((0, 1))
    drive(live, 50, bank(1.0, 1.0))
    exactly(lambda *_: None)
    states = []
    for i in range(50, 80, 10):
        drive(live, 10, bank(1.0, 1.0), first=i)
        states.append(live.health.state)
    assert states == ["unknown", "doubtful", "doubtful"]
    selection = live.estimated(Selection(0, {}))
    assert selection.state == "doubtful"
    assert np.isnan(selection.estimated_error)
    exactly(exact)
    drive(live, 10, bank(1.0, 1.0), first=80)
    assert live.health.state == "unknown"  # no second was compared


def test_it_is_lost_where_two_hops_disagree_with_it(exactly):  # noqa: ARG001
    live = LiveEvidence((0, 1))
    far_off = 1.0 + 1.5 * LOST / 100.0
    drive(live, 20, bank(far_off, 1.0))
    assert live.health.state == "doubtful"  # one hop
    drive(live, 10, bank(far_off, 1.0), first=20)
    assert live.health.state == "lost"
    selection = live.estimated(Selection(0, {}))
    assert selection.restart == {0}
    assert selection.estimated_error > LOST / 2
    drive(live, 20, bank(1.0, 1.0), first=30)
    assert live.health.state == "unknown"  # no second was compared


def test_a_lost_member_is_told_to_restart_once(exactly):  # noqa: ARG001
    live, wrong_once = LiveEvidence((0, 1)), 30
    drive(live, wrong_once, bank(1.0, 1.0))

    def jump(i):
        return bank(1.0, 20.0 if i in (wrong_once + 5, wrong_once + 15) else 1.0)(i)

    asked = []
    for i in range(wrong_once, wrong_once + 90, 10):
        drive(live, 10, jump, first=i)
        asked.append(live.estimated(Selection(0, {})).restart)
    assert asked.count(frozenset({1})) == 1
    assert set(asked) == {frozenset(), frozenset({1})}


def test_a_scan_without_a_pose_is_no_loss_of_track(exactly):  # noqa: ARG001
    nan = np.full((4, 4), np.nan)
    live = LiveEvidence((0,))
    drive(live, 30, bank(1.0))

    def failing(i):
        return Motions(nan, {0: nan}) if i in (35, 45) else bank(1.0)(i)

    drive(live, 41, failing, first=30)
    assert live.health.state == "unknown"  # no second was compared
    assert live.estimated(Selection(0, {})).restart == frozenset()


def test_a_robot_that_stands_does_not_drive_by_jitter(exactly):  # noqa: ARG001
    rng = np.random.default_rng(0)
    live = LiveEvidence((0,))
    drive(live, 60, bank(1.0))
    before = live.squares()

    def jitter(_):
        T = moved(0.003 * rng.standard_normal())
        return Motions(T, {0: T})

    assert len(drive(live, 600, jitter, first=60)) <= 1  # the way before it stood
    assert live.squares().windows < before.windows + 1.0


def test_after_a_reset_it_is_as_new(exactly):  # noqa: ARG001
    live = LiveEvidence((0, 1))
    drive(live, 60, bank(1.5, 1.0))
    assert live.health.state == "lost"
    live.reset()
    assert live.health.state == "unknown"  # no second was compared
    assert live.squares() is None
    assert live.estimated(Selection(0, {})).restart == frozenset()
    drive(live, 60, bank(1.0, 1.0))
    assert live.own_error().mean < 0.01


def test_it_forgets_the_hops_of_another_set(exactly):  # noqa: ARG001
    live = LiveEvidence()
    drive(live, 60, bank(1.05))
    live.forget()
    assert live.squares() is None
    # No hop goes back to what another set drove.
    found = drive(live, 40, bank(1.0), first=60)
    assert found
    assert min(one.start.stamp for one in found) >= 59 * 10**8
    assert live.own_error().mean < 0.01


def test_after_a_restart_the_own_error_has_the_jump_and_the_members_are_as_new(exactly):  # noqa: ARG001
    live, jump = LiveEvidence((0, 1), length=10.0), 40

    def restarting(i):
        found = bank(1.0, 1.02)(i)
        T = moved(STEP - 0.5) if i == jump else found.T_previous_current
        return found._replace(T_previous_current=T, starts=int(i >= jump))

    drive(live, jump + 1, restarting)
    assert live.squares().products[1, 1] == pytest.approx(4.0, rel=0.01)
    assert live.own_error().mean == pytest.approx(0.0, abs=1e-6)
    drive(live, 10, restarting, first=jump + 1)
    assert live.squares() is None  # over the restart
    assert live.due(in_doubt=False)
    assert live.health.state == "doubtful"
    drive(live, 10, restarting, first=jump + 11)
    assert live.squares().products[1, 1] == pytest.approx(4.0, rel=0.01)
    # One of six sub-trajectories lost half a metre of ten.
    error = live.own_error()
    assert error.low < 5.0 / 6.0 < error.high


def test_where_nothing_is_in_doubt_it_is_seldom_due(exactly):
    live, due = LiveEvidence((0, 1), length=10.0), []

    def show(n):
        for _ in range(n):
            i = len(due)
            stamp = i * 10**8
            live.observe(stamp, Scan(stamp, NOTHING.points), bank(1.0, 1.01)(i))
            due.append(live.due(in_doubt=False))
            if due[-1]:
                live.measure()

    show(20)
    # Until there is a hop, and one over a sub-trajectory.
    assert np.flatnonzero(due).tolist() == [*range(7), 16]
    show(SELDOM)
    assert np.flatnonzero(due[17:]).tolist() == [SELDOM - 1]
    assert live.due(in_doubt=True)
    exactly(lambda *_: None)
    show(SELDOM + 1)
    assert due[-1]  # the last one was rejected


def test_its_spread_is_how_far_the_members_came_apart(exactly):  # noqa: ARG001
    live = LiveEvidence((0, 1))
    assert live.spread() == 0.0
    drive(live, 12, bank(1.0, 1.04))
    assert live.spread() == pytest.approx(2.0, rel=1e-3)
    assert spread_of(np.zeros((4, 0, 3))).tolist() == [0.0] * 4


def test_the_own_error_is_the_odometrys_over_the_length(exactly):  # noqa: ARG001
    live = LiveEvidence((0, 1), length=40.0)
    drive(live, 101, bank(1.02, 1.0))
    # Of the way that the odometry believes to have driven.
    error = live.own_error()
    assert error.mean == pytest.approx(2.0, rel=0.05)
    assert error.low < error.mean < error.high
    drive(live, 200, bank(1.02, 1.0), first=101)
    more = live.own_error()
    assert more.mean == pytest.approx(error.mean, rel=0.05)
    assert more.high - more.low < error.high - error.low


def test_members_that_disagree_are_asked_where_the_odometry_was_rejected_before(exactly):
    asked = []

    def register(start, end, guesses):  # noqa: ARG001 - all are rejected
        asked.append([guess[0, 3] for guess in guesses])

    exactly(register)
    live = LiveEvidence((0, 1, 2, 3, 4))
    drive(live, 31, bank(1.0, 1.01, 1.1, 1.2, 1.3))
    # First from 5 m before; then from 10 and 5 m before, the odometry's own motion first.
    assert [len(guesses) for guesses in asked[:5]] == [1, 1, 1, 2, 2]
    _, own, short, others, _ = asked[:5]
    assert own[0] == pytest.approx(2.0 * short[0])
    np.testing.assert_allclose(np.array(others) / own[0], [1.1, 1.2], atol=1e-6)


def test_a_long_hop_is_tried_where_the_short_one_fails(exactly):
    def long_only(start, end, guesses):
        return exact(start, end, guesses) if end.number - start.number > 5 else None

    live = LiveEvidence()
    exactly(lambda start, end, guesses: exact(start, end, guesses) if end.number < 30 else None)
    drive(live, 41, bank(1.0))  # the last is rejected: for a while short hops come first
    exactly(long_only)
    assert len(drive(live, 30, bank(1.0), first=41)) == 3


def test_a_registration_that_another_does_not_confirm_counts_as_rejected(exactly):
    """Where a scene repeats itself, a registration may be wrong by metres, and look sound."""

    def wrong(*pairs):
        def register(start, end, guesses):
            hop = exact(start, end, guesses)
            wrong = (start.number, end.number) in pairs
            return hop._replace(T_start_end=np.eye(4)) if wrong else hop

        return register

    for pairs, found, lost in (([(39, 49)], 9, False), ([(39, 49), (49, 59)], 8, True)):
        exactly(wrong(*pairs))
        live = LiveEvidence((0, 1))
        taken, states = [], []
        for i in range(0, 110, 10):
            taken += [one.end.stamp for one in drive(live, 10, bank(1.01, 0.0), first=i)]
            states.append(live.health.state)
        assert len(taken) == found
        assert not {end * 10**8 for _, end in pairs} & set(taken)
        assert ("doubtful" in states) == lost
        assert states[-1] == "unknown"
        assert live.own_error().mean < 1.1
        assert measured_weights(2, live.squares())[0] > 0.75


def at(step):
    """Registrations that are right, where the sensor moves so far with each scan."""
    return lambda start, end, _: Hop(moved(step * (end.number - start.number)), np.eye(3))


@pytest.mark.parametrize("speed", [0.5, 5.0, 10.0, 20.0])
def test_a_slip_counts_at_any_speed(exactly, speed):
    """The odometry slips aside over half a second; one hop a second sees it."""
    step, slip = 0.1 * speed, 0.12 * speed

    def slipping(i):
        T = moved(step)
        T[1, 3] = slip / 5 if 304 <= i < 309 else 0.0
        return Motions(T, {})

    exactly(at(step))
    live, seen = LiveEvidence(), []
    for i in range(0, 450, 10):
        drive(live, 10, slipping, first=i)
        seen.append(live.own_error() and live.own_error().mean)
    assert seen[28] == pytest.approx(0.0, abs=1e-6)
    assert max(seen[30:]) > 0.02 * 100.0 * slip / 25.0
    assert live.health.state == "unknown"  # no second was compared


def test_what_a_hop_cannot_tell_counts_for_nothing(exactly):
    blind = np.diag([0.0, 1.0, 1.0])
    exactly(lambda *hop: exact(*hop)._replace(projection=blind))
    live = LiveEvidence((0, 1))
    drive(live, 60, bank(1.0, 1.5))
    np.testing.assert_allclose(live.squares().products, 0.0, atol=1e-12)
    assert live.own_error() is None
    assert live.estimated(Selection(0, {})).restart == frozenset()


def dying(dead, factors=(1.0, 1.001, 1.002)):
    """Motions of a bank of which the last member has no pose over some scans."""

    def motions(i):
        found = bank(*factors)(i)
        if i in dead:
            found.members[len(factors) - 1] = np.full((4, 4), np.nan)
        return found

    return motions


def test_a_member_without_a_pose_has_no_weight_until_it_is_measured_again(exactly):  # noqa: ARG001
    live, present, others = LiveEvidence((0, 1, 2)), {}, LiveEvidence((0, 1, 2))
    motions, dead = bank(1.0, 1.001, 0.999), range(60, 75)
    drive(others, 61, motions)
    drive(live, 61, motions)
    assert live.present().all()
    for i in range(61, 121):
        drive(live, 1, dying(dead, (1.0, 1.001, 0.999)), first=i)
        drive(others, 1, motions, first=i)
        present[i] = live.present().tolist()
        if i == 80:
            # What is known of the others is the same.
            np.testing.assert_allclose(
                live.squares().products[:2, :2], others.squares().products[:2, :2]
            )
    # A hop of ten metres that ends at scan 89 begins after the last scan without a pose.
    gone = [i for i, of_members in present.items() if not of_members[2]]
    assert gone == list(range(61, 90))
    assert all(of_members[:2] == [True, True] for of_members in present.values())
    squares = live.squares().products
    assert squares[2, 2] < 0.2**2
    assert measured_weights(3, live.squares())[2] > 0.0


def test_a_member_that_nothing_measures_has_weight_again_after_a_while():
    live = LiveEvidence((0, 1))
    drive(live, 31, dying(range(20, 22), (0.0, 0.0)))
    assert live.present().tolist() == [True, False]
    drive(live, 291, bank(0.0, 0.0), first=31)
    assert live.present().tolist() == [True, False]
    drive(live, 10, bank(0.0, 0.0), first=322)
    assert live.present().tolist() == [True, True]


def test_where_nobody_has_a_pose_all_keep_their_weight():
    live = LiveEvidence((0, 1))
    nothing = np.full((4, 4), np.nan)
    drive(live, 3, lambda _: Motions(nothing, {0: nothing, 1: nothing}))
    assert live.present().all()


@pytest.mark.parametrize(
    ("case", "share"),
    [
        ({}, 1.0),
        ({"similarity": np.nan}, 1.0),
        ({"similarity": 0.5 * evidence.SIMILAR}, 0.5),
        ({"similarity": 0.0}, None),
        ({"predicted": 0.4 / evidence.CONTRADICTED}, None),
        ({"restarted": 90 * 10**9}, None),
        ({"restarted": 10 * 10**9}, 1.0),
        ({"members": (3, 7)}, None),
    ],
)
def test_a_prediction_counts_where_training_knows_the_place(case, share):
    given = {"similarity": 1.0, "predicted": 1.0, "restarted": 0, "members": ()} | case
    alone = OwnError(1.0, 0.5, 2.0)
    own = SimpleNamespace(estimate_with=lambda _, known: known)
    live = SimpleNamespace(
        members=given["members"],
        own_error=lambda: alone,
        _own=own,
        _newest=SimpleNamespace(stamp=100 * 10**9),
        _restarted=given["restarted"],
    )
    found = LiveEvidence._own_error_with(live, given["predicted"], given["similarity"])
    assert found == (alone if share is None else share)
