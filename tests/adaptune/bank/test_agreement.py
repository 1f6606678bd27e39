import numpy as np
import pytest

from adaptune.bank.members import Agreement, share

EVEN = np.full(4, 0.25)


def motions(*steps, turns=0.0):
    T = np.tile(np.eye(4), (len(steps), 1, 1))
    T[:, 0, 3] = steps
    angles = np.broadcast_to(turns, len(steps))
    T[:, 0, 0] = T[:, 1, 1] = np.cos(angles)
    T[:, 1, 0] = np.sin(angles)
    T[:, 0, 1] = -np.sin(angles)
    return T


def judged(each, seconds=0.1, weights=EVEN, lost_track=3.0, **others):
    agreement = Agreement(len(weights), lost_track)
    return np.array([agreement.judge(T, seconds, weights, **others) for T in each])


def test_members_that_move_alike_agree_and_the_bank_moves_by_their_mean():
    agreement = Agreement(3, 3.0)
    weights = np.array([0.5, 0.3, 0.2])
    T = motions(0.10, 0.11, 0.12, turns=[0.0, 0.001, 0.002])
    assert agreement.judge(T, 0.1, weights).all()
    assert not agreement.judged
    expected = motions(0.107, turns=0.0007)[0]
    np.testing.assert_allclose(agreement.T_previous_current, expected, atol=1e-9)


def test_jitter_is_no_departure():
    back_and_forth = 0.2 * (-1.0) ** np.arange(40)
    each = [motions(0.1, 0.1, 0.1, 0.1 + jitter) for jitter in back_and_forth]
    assert judged(each).all()
    # The same as a departure is noticed.
    each = [motions(0.1, 0.1, 0.1, 0.1 + abs(jitter)) for jitter in back_and_forth]
    assert not judged(each)[5:, 3].any()


@pytest.mark.parametrize(
    ("drift", "speed"), [(0.2, 1.0), (-0.2, 1.0), (-1.0, 0.5), (-1.0, 1.0), (-1.0, 10.0)]
)
def test_a_departure_is_noticed_within_a_second(drift, speed):
    step = 0.1 * speed
    departing = motions(step, step, step, step * (1.0 + drift))
    agreeing = judged([motions(*[step] * 4)] * 20 + [departing] * 10)
    assert agreeing[:20].all()
    assert agreeing[:, :3].all()
    assert not agreeing[-1, 3]
    # Seven hundredths of the way are not a departure.
    assert judged([motions(step, step, step, 1.07 * step)] * 40).all()


def test_a_member_that_turns_otherwise_is_noticed_within_a_second():
    turned = motions(*[0.1] * 4, turns=[0.0, 0.0, 0.0, np.radians(0.4)])
    agreeing = judged([motions(*[0.1] * 4)] * 20 + [turned] * 10)
    assert agreeing[:20].all()
    assert not agreeing[-1, 3]
    # All of them may turn.
    assert judged([motions(*[0.1] * 4, turns=np.radians(9.0))] * 30).all()


def test_a_jump_is_noticed_at_once():
    agreeing = judged([motions(1.0, 1.0, 1.0, 1.0)] * 20 + [motions(1.0, 1.0, 1.0, 1.31)])
    np.testing.assert_array_equal(agreeing[-1], [True, True, True, False])


def test_what_members_usually_differ_by_is_allowed_up_to_a_lost_track():
    """A wobble over several seconds, which nobody follows but one."""
    wobble = 0.006 * np.sign(np.sin(np.arange(400) / 5.0))
    agreement = Agreement(4, 3.0)
    for w in wobble:
        assert agreement.judge(motions(0.1, 0.1 + w, 0.1 - w, 0.1), 0.1, EVEN).all()
    late = [agreement.judge(motions(0.1, 0.1, 0.1, 0.12), 0.1, EVEN) for _ in range(9)]
    assert np.all(late)
    assert not judged([motions(0.1, 0.1, 0.1, 0.12)] * 9)[-1, 3]
    assert not judged([motions(0.1, 0.1, 0.1, 0.105)] * 9, lost_track=0.04)[-1, 3]


def test_the_heaviest_group_wins_whatever_its_place():
    T = motions(0.1, 0.1, 0.3, 0.3)
    for weights, expected in (
        ([0.3, 0.3, 0.2, 0.2], [1, 1, 0, 0]),
        ([0.2, 0.2, 0.3, 0.3], [0, 0, 1, 1]),
        ([0.1, 0.1, 0.8, 0.0], [0, 0, 1, 1]),
        ([1.0, 0.0, 0.0, 0.0], [1, 1, 0, 0]),
    ):
        agreeing = judged([T] * 9, weights=np.array(weights))
        np.testing.assert_array_equal(agreeing[-1], np.array(expected, bool))


def test_all_of_a_group_are_near_each_other():
    # Each is near the next one only.
    T = motions(0.1, 0.115, 0.13, 0.145)
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    agreeing = judged([T] * 30, weights=weights)[15:]
    assert (agreeing == [False, False, True, True]).all()


def test_of_groups_as_heavy_the_one_wins_that_goes_on_as_before():
    for steps, expected in (((0.1, 0.1, 0.6, 0.6), 0.1), ((0.6, 0.1, 0.6, 0.1), 0.1)):
        agreement = Agreement(4, 3.0)
        for _ in range(10):
            agreement.judge(motions(*[0.1] * 4), 0.1, EVEN)
        agreement.judge(motions(*steps), 0.1, EVEN)
        assert agreement.T_previous_current[0, 3] == pytest.approx(expected)


class Asked:
    """Short registrations that find members as far away as they are told."""

    def __init__(self, *distances):
        self.distances, self.calls = np.array(distances), []

    def __call__(self, T_then_now, ago):
        self.calls.append((T_then_now, ago))
        return self.distances


def test_two_lost_ones_that_agree_are_outvoted_by_the_short_registrations():
    T = motions(0.1, 0.3, 0.0, 0.0)
    weights = np.array([0.2, 0.1, 0.35, 0.35])
    assert judged([T] * 9, weights=weights)[-1].tolist() == [False, False, True, True]
    asked = Asked(0.101, 0.2, 0.3, 0.3)
    agreement = Agreement(4, 3.0)
    for _ in range(9):
        agreeing = agreement.judge(T, 0.1, weights, asked)
    assert agreeing.tolist() == [True, False, False, False]
    assert agreement.judged
    assert agreement.due.tolist() == [False, True, True, True]
    T_then_now, ago = asked.calls[-1]
    assert ago == (1, 9)
    np.testing.assert_allclose(T_then_now[0], T, atol=1e-12)
    np.testing.assert_allclose(T_then_now[1, :, 0, 3], 9 * T[:, 0, 3], atol=1e-12)


def test_they_are_asked_only_where_nobody_has_the_most_or_the_bank_is_lost():
    lone = [motions(0.1, 0.1, 0.1, 0.5)] * 3
    asked = Asked(0.3, 0.3, 0.3, 0.1)
    assert not judged(lone, alignment=asked)[-1, 3]
    assert not asked.calls
    assert judged(lone, alignment=asked, lost=True)[-1].tolist() == [False, False, False, True]
    assert asked.calls
    # A heavy member alone is not the most of them, nor are three light ones.
    asked = Asked(0.1, 0.1, 0.102, 0.3)
    heavy = np.array([0.1, 0.1, 0.1, 0.7])
    assert judged(lone, weights=heavy, alignment=asked)[-1].tolist() == [True, True, True, False]
    # Nor are most members that weigh less than half.
    asked, weights = Asked(0.1, 0.1, 0.3, 0.3, 0.3), np.array([0.3, 0.0, 0.4, 0.3, 0.0])
    of_five = [motions(0.1, 0.1, 0.1, 0.5, 0.9)] * 3
    assert judged(of_five, weights=weights, alignment=asked)[-1].sum() == 3
    assert not asked.calls
    light = np.array([0.1, 0.1, 0.2, 0.3, 0.3])
    assert np.flatnonzero(judged(of_five, weights=light, alignment=asked)[-1]).tolist() == [0, 1]
    # Nobody is asked what all agree on.
    asked = Asked(0.1, 0.2, 0.3, 0.4)
    assert judged([motions(*[0.1] * 4)] * 3, alignment=asked, lost=True).all()
    assert not asked.calls


def test_they_are_not_heard_where_they_know_nothing():
    T, asked = motions(0.1, 0.1, 0.5, 0.5), Asked(*[np.inf] * 4)
    agreement = Agreement(4, 3.0)
    agreeing = agreement.judge(T, 0.1, np.array([0.3, 0.3, 0.2, 0.2]), asked)
    assert agreeing.tolist() == [True, True, False, False]
    assert asked.calls
    assert not agreement.judged


@pytest.mark.parametrize("nothing", [np.nan, np.inf, 1e200])
def test_who_has_no_motion_is_left_out_and_begins_anew(nothing):
    agreement = Agreement(4, 3.0)
    sound = motions(*[0.1] * 4)
    for _ in range(10):
        agreement.judge(sound, 0.1, EVEN)
    T = motions(0.1, 0.1, 0.1, nothing)
    assert agreement.judge(T, 0.1, EVEN).tolist() == [True, True, True, False]
    assert agreement.due.tolist() == [False, False, False, True]
    assert agreement.judge(sound, 0.1, EVEN).all()
    assert not agreement.judge(motions(*[nothing] * 4), 0.1, EVEN).any()
    assert np.isnan(agreement.T_previous_current).all()
    assert agreement.judge(sound, 0.1, EVEN).all()


@pytest.mark.parametrize(("departs", "due"), [(0.3, False), (0.6, True)])
def test_who_slips_is_left_out_and_who_is_far_off_restarts_as_well(departs, due):
    """At 1 m/s members may differ by 0.1 m in a second, and restart from 0.2 m on."""
    agreement = Agreement(4, 3.0)
    for _ in range(30):
        assert agreement.judge(motions(*[0.1] * 4), 0.1, EVEN).all()
    apart = 0.5 * departs  # twice the greatest that is tolerated, at most
    found = []
    for _ in range(10):
        T = motions(0.1, 0.1, 0.1, 0.1 + 0.1 * apart)
        found.append((agreement.judge(T, 0.1, EVEN)[3], agreement.due[3]))
    assert not found[-1][0]
    assert any(asked for _, asked in found) == due


def test_who_restarts_begins_where_the_bank_is_and_has_a_second():
    agreement = Agreement(4, 3.0)
    lost = motions(0.1, 0.1, 0.1, 0.0)
    agreeing, restarts = [], 0
    for i in range(50):
        agreeing.append(agreement.judge(lost if i < 35 else motions(*[0.1] * 4), 0.1, EVEN)[3])
        restarts += agreement.due[3]
        assert not agreement.due[:3].any()
        agreement.restarted(agreement.due)
    assert 2 <= restarts <= 4
    # Once it was restarted and is sound, it agrees again.
    assert agreeing[-1]
    assert not np.all(agreeing)


@pytest.mark.parametrize("stamps", [np.arange(0.0, 9.0, 0.5), np.cumsum([0.1, 0.4, 0.1, 2.5] * 4)])
def test_scans_may_be_rare_or_missing(stamps):
    seconds = np.diff(stamps)
    each = [motions(s, s, s, 1.07 * s) for s in seconds]
    agreement = Agreement(4, 3.0)
    assert all(agreement.judge(T, s, EVEN).all() for T, s in zip(each, seconds, strict=True))
    stands = motions(1.0, 1.0, 1.0, 0.0)
    assert not [agreement.judge(stands, 1.0, EVEN) for _ in range(2)][-1][3]


def test_equal_shares_where_those_that_agree_have_no_weight():
    agreeing = np.array([False, True, True])
    assert share(np.array([0.5, 0.3, 0.2]), agreeing).tolist() == [0.0, 0.3, 0.2]
    assert share(np.array([1.0, 0.0, 0.0]), agreeing).tolist() == [0.0, 1.0, 1.0]
