import logging
from pathlib import Path
from types import SimpleNamespace

import faulty
import numpy as np
import pytest
import turns
from rooms import moved
from walker import at, makes, x_of, x_on

from adaptune.bank.bank import CATCH_UP, Bank
from adaptune.bank.rest import FIRST, FORGIVEN
from adaptune.odometry import OdometryError
from adaptune.odometry.base import WARM_UP, InProcess
from adaptune.odometry.faults import MOST_FAULTS
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.remote import Isolated, Limits
from adaptune.odometry.tracker import Tracker
from adaptune.recording import Scan
from adaptune.space import Selection

METHOD = Path(__file__).parents[3] / "docs/method.md"


def weigh(bank, *weights):
    bank.apply(Selection(bank.trials[0], {}, dict(zip(bank.trials, weights, strict=True))))


def steps_of(bank, n):
    """How far the bank comes along x with each of so many scans, ten a second."""
    return np.diff(x_of(bank, 0.1 * np.arange(n)))


def test_the_mean_of_all_motions_is_taken_by_their_weights():
    make, made = makes()
    odometry = Bank(make, {7: {"speed": 1.0}, 3: {"speed": 1.05}, 5: {"speed": 1.09}}, 0.1)
    x = x_of(odometry, range(2))
    odometry.apply(Selection(5, {}))
    x += x_on(odometry, range(2, 5))
    np.testing.assert_allclose(np.diff(x), [1.0, 1.09, 1.09, 1.09])
    weigh(odometry, 0.5, 0.0, 0.5)
    np.testing.assert_allclose(np.diff([x[-1], *x_on(odometry, range(5, 8))]), 1.045)
    weigh(odometry, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(np.diff(x_on(odometry, range(8, 10))), (1.0 + 1.05 + 1.09) / 3)
    assert odometry.restarts == 0
    assert len(made) == 3


@pytest.mark.parametrize("lost", range(3))
def test_a_lost_one_is_left_out_and_started_anew(lost):
    speeds, weights = np.array([1.0, 1.02, 1.06]), np.array([0.4, 0.3, 0.3])
    make, made = makes({speeds[lost]: {5: 4.0}})
    sets = {trial: {"speed": speed} for trial, speed in zip((7, 3, 5), speeds, strict=True)}
    odometry = Bank(make, sets, 0.1)
    weigh(odometry, *weights)
    x = x_of(odometry, range(9))
    mean, weights[lost] = weights @ speeds, 0.0
    rest = weights @ speeds / weights.sum()  # Two are more than one, whatever its place.
    np.testing.assert_allclose(np.diff(x), [mean] * 4 + [rest] + [mean] * 3)
    assert odometry.restarts == 1
    # Scans 3, 4 and 5 lie within two seconds.
    assert [second for second, _ in made[lost].starts] == [0, 3]
    assert made[lost].seen[-7:] == [5, 3, 4, 5, 6, 7, 8]


def test_a_member_that_is_lost_again_and_again_rests_for_twice_as_long_each_time():
    make, made = makes({1.02: dict.fromkeys(range(100), 4.0)})
    sets = {7: {"speed": 1.0}, 3: {"speed": 1.02}, 5: {"speed": 1.06}}
    odometry = Bank(make, sets, 0.1)
    # It is lost all the time.
    np.testing.assert_allclose(np.diff(x_of(odometry, range(100))), 1.0)
    # On the scans of two seconds, at once and then after 10, 20 and 40 s.
    assert [second for second, _ in made[1].starts] == [0, 0, 9, 29, 69]
    odometry.start(odometry.prepare(at(100)), np.eye(4))
    assert [second for second, _ in made[1].starts][-1] == 100  # with the bank, it begins anew


def test_a_member_that_was_well_for_a_minute_restarts_at_once():
    make, made = makes({1.02: dict.fromkeys((5, 9, 85), 4.0)})
    odometry = Bank(make, {7: {"speed": 1.0}, 3: {"speed": 1.02}, 5: {"speed": 1.06}}, 0.1)
    x_of(odometry, range(90))
    assert [second for second, _ in made[1].starts] == [0, 3, 16, 83]


def test_the_method_says_what_restarts_cost():
    text = " ".join(METHOD.read_text("utf-8").split())
    assert f"the scans of the last {WARM_UP:g} s again" in text
    assert CATCH_UP == 3
    assert "at most three of these scans with each new one" in text
    assert f"within {FORGIVEN:g} s rests for {FIRST:g}, {2 * FIRST:g}, {4 * FIRST:g} ... s" in text


@pytest.mark.parametrize("place", range(4))
def test_two_lost_members_that_agree_do_not_outvote_the_one_that_fits_the_scans(place):
    make, _ = makes()
    speeds = np.roll([turns.STEP, 0.0, 0.0, 3 * turns.STEP], place)
    bank = Bank(make, {trial: {"speed": speed} for trial, speed in enumerate(speeds)})
    weigh(bank, *[0.25] * 4)
    scans = list(map(turns.turn, range(13)))
    bank.start(bank.prepare(scans[0]), np.eye(4))
    x = [bank.register(bank.prepare(scan)).T_odom_sensor[0, 3] for scan in scans[1:]]
    np.testing.assert_allclose(x, turns.STEP * np.arange(1, 13))
    # The other three, at the first scan; a second later, they rest.
    assert bank.restarts == 3


def test_a_bank_that_is_lost_asks_the_scans_whom_to_believe():
    make, _ = makes()
    sets = {trial: {"speed": speed} for trial, speed in enumerate((0.0, 0.001, turns.STEP))}
    x = {}
    for lost in (False, True):
        bank = Bank(make, sets)
        bank.apply(
            Selection(0, {}, dict.fromkeys(range(3), 1 / 3), state="lost" if lost else "good")
        )
        bank.start(bank.prepare(turns.turn(0)), np.eye(4))
        x[lost] = bank.register(bank.prepare(turns.turn(1))).T_odom_sensor[0, 3]
    assert x[True] == pytest.approx(turns.STEP)
    assert x[False] == pytest.approx(0.0005)


def test_members_restart_where_the_selection_says_so():
    make, made = makes()
    odometry = Bank(make, {7: {"speed": 1.0}, 3: {"speed": 1.02}}, 0.1)
    x_of(odometry, range(5))
    odometry.apply(Selection(7, {}, {7: 0.5, 3: 0.5}, restart=frozenset({3})))
    x_on(odometry, range(5, 8))
    assert odometry.restarts == 1
    assert made[0].starts == [(0, 0.0)]
    # Scan 2 of the last two seconds, at the bank's pose, before the next scan.
    assert made[1].starts == [(0, 0.0), (2, 2.0)]
    assert made[1].seen[-6:] == [2, 3, 4, 5, 6, 7]


def test_one_that_needs_no_past_restarts_on_the_newest_scan():
    make, made = makes({1.02: {5: 4.0}})
    odometry = Bank(make, {7: {"speed": 1.0}, 3: {"speed": 1.02}, 5: {"speed": 1.06}}, 0.1)
    odometry._members[1].warm_up = 0.0
    x = x_of(odometry, range(7))
    assert made[1].starts[1:] == [(5, x[5])]
    assert made[1].seen == [0, 1, 2, 3, 4, 5, 5, 6]


def test_a_bank_that_is_lost_as_a_whole_says_so_of_the_scan_at_which_it_restarts():
    make, _ = makes({speed: {5: np.nan} for speed in (1.0, 1.02)})
    bank = Bank(make, {7: {"speed": 1.0}, 3: {"speed": 1.02}}, 0.1)
    tracker = Tracker(bank, HealthCheck())
    steps = [tracker.register(at(i)) for i in range(7)]
    assert [step.unhealthy for step in steps[4:]] == [None, "no_pose", None]
    told = [{*step.states.values()} for step in steps[4:]]
    assert told == [{"works"}, {"lost"}, {"works"}]


def test_stamps_of_today_are_no_floats():
    """No float holds 1.3e18 nanoseconds: rounded, the newest scan is not among the last ones."""
    make, _ = makes()
    odometry = Bank(make, {7: {"speed": 1.0}, 3: {"speed": 1.02}}, 0.1)
    for member in odometry._members:
        member.warm_up = 0.0
    stamps = [1_300_000_000_000_000_255 + i * 10**9 for i in range(3)]
    first, *others = (Scan(stamp, np.zeros((0, 3), np.float32)) for stamp in stamps)
    assert any(stamp < float(stamp) for stamp in stamps)
    odometry.start(odometry.prepare(first), np.eye(4))
    for scan in others:
        assert odometry.register(odometry.prepare(scan)).registered


def test_members_that_rest_see_no_scans_until_they_are_woken():
    make, made = makes()
    sets = {7: {"speed": 1.0}, 3: {"speed": 1.02}, 5: {"speed": 1.04}}
    odometry = Bank(make, sets, 0.1)
    alone = Selection(7, {}, {7: 1.0}, resting=frozenset({3, 5}))
    odometry.apply(alone)
    assert x_of(odometry, range(5)) == [0, 1, 2, 3, 4]
    assert [len(one.seen) for one in made] == [5, 0, 0]
    assert [t for t, T in odometry.motions.members.items() if np.isfinite(T).all()] == [7]
    assert odometry.motions.states == {7: "works", 3: "rests", 5: "rests"}
    odometry.apply(Selection(7, {}, {7: 0.5, 3: 0.5}, resting=frozenset({5})))
    np.testing.assert_allclose(np.diff([4.0, *x_on(odometry, range(5, 8))]), 1.01)
    # As one that restarts, it begins two seconds ago at the bank's pose.
    assert made[1].starts == [(2, 2.0)]
    assert made[1].seen == [2, 3, 4, 5, 6, 7]
    assert not made[2].seen
    odometry.apply(alone)
    np.testing.assert_allclose(np.diff(x_on(odometry, range(8, 11))), 1.0)
    assert len(made[1].seen) == 6
    # Where the bank starts, those that rest do not.
    odometry.start(odometry.prepare(at(11)), np.eye(4))
    assert [len(one.starts) for one in made] == [2, 1, 0]
    # One that is woken then begins as the others do.
    odometry.apply(Selection(7, {}, {7: 1.0}))
    odometry.start(odometry.prepare(at(12)), np.eye(4))
    x_on(odometry, [13])
    assert [one.starts[1:] for one in made[1:]] == [[(12, 0.0)], []]


def test_a_bank_has_no_other_sets():
    make, _ = makes()
    bank = Bank(make, {7: {"speed": 1.0}, 3: {"speed": 2.0}})
    with pytest.raises(OdometryError, match="the bank holds trials 7, 3, not 4"):
        bank.apply(Selection(4, {}))
    with pytest.raises(OdometryError, match="the bank holds trials 7, 3, not 4, 5"):
        bank.apply(Selection(7, {}, {7: 0.5, 5: 0.3, 4: 0.2}))


def test_motions_of_the_members_by_trial_number():
    (make, _), made = makes({1.02: {5: 4.0}}), []
    keep = lambda parameters: made.append(make(parameters)) or made[-1]  # noqa: E731
    bank = Bank(keep, {7: {"speed": 1.0}, 3: {"speed": 1.02}, 5: {"speed": 1.06}}, 0.1)
    x_of(bank, range(6))
    whole, members, starts, states = bank.motions
    assert starts == 1
    assert states == {7: "works", 3: "lost", 5: "works"}
    assert list(members) == [7, 3, 5]
    # The motion of the lost member before it was restarted.
    assert [T[0, 3] for T in members.values()] == pytest.approx([1.0, 4.0, 1.06])
    assert whole[0, 3] == pytest.approx(1.0)
    motion = moved(0.3)
    bank.start(bank.prepare(at(6)), np.eye(4), motion)
    assert [T[0, 3] for T in (bank.motions[0], *bank.motions[1].values())] == [0.3] * 4
    made[0].faults, made[2].faults = ["lost"], ["lost, too"]
    assert bank.faults == ["lost", "lost, too"]
    assert bank.usage.cpu == sum(instance.usage.cpu for instance in made)


def with_faulty(fault):
    """A bank of a walker and an odometry in another process, with their numbers 7 and 3."""
    walkers, _ = makes()

    def make(parameters):
        if "x" not in parameters:
            return walkers(parameters)
        limits = Limits(seconds=1.0, memory=1.0)
        return Isolated("faulty:Faulty", {"x": 0.1}, faulty.Settings(fault=fault), limits)

    sets = {3: {"odometry": "mine", "x": 0.1}, 7: {"speed": 0.1}}
    return Bank(make, sets)


def test_a_member_that_a_fault_has_ended_is_told_once_and_starts_again(caplog):
    bank = with_faulty("abort")
    with caplog.at_level(logging.WARNING, "adaptune.bank.bank"):
        np.testing.assert_allclose(steps_of(bank, 20), 0.1)
    told = [r.getMessage() for r in caplog.records if r.name == "adaptune.bank.bank"]
    # The warm-up meets the fault again; after that, it begins without a past.
    assert told == [
        "trial 3 (mine) ended: its process was ended by SIGABRT: about to go wrong; the bank goes "
        "on without it",
        "trial 3 (mine) is back",
    ]
    assert len(bank.faults) >= bank.restarts == 1
    assert not any(member.ended for member in bank._members)
    bank.close()


def test_a_member_that_has_rested_since_the_start_has_not_ended(caplog):
    bank = with_faulty("none")
    bank.apply(Selection(7, {}, {7: 1.0}, resting=frozenset({3})))
    np.testing.assert_allclose(steps_of(bank, 5), 0.1)
    bank.apply(Selection(7, {}, {7: 0.5, 3: 0.5}))
    assert all(member.ended for member in bank._members if member.isolated)
    np.testing.assert_allclose(np.diff(x_on(bank, range(5, 9))), 0.1)
    assert not any(member.ended for member in bank._members)
    assert not [r for r in caplog.records if r.name == "adaptune.bank.bank"]
    bank.close()


def test_of_members_that_have_all_ended_the_last_fault_is_of_the_last(caplog):
    bank = Bank(makes()[0], {n: {"speed": 0.1} for n in (7, 3, 5)})
    bank._members = members = [SimpleNamespace(faults=[], ended=False) for _ in range(3)]
    for i in (1, 2, 0):
        members[i].faults, members[i].ended = [f"member {i}"], True
        bank._tell()
        left = [] if i else ["member 1", "member 2", "member 0"]
        assert bank.faults == left
    assert len(caplog.messages) == 3


def test_one_that_cannot_start_is_out_for_good(caplog):
    bank = with_faulty("never begins")
    with caplog.at_level(logging.WARNING, "adaptune.bank.bank"):
        x = x_of(bank, range(600))
    np.testing.assert_allclose(np.diff(x), 0.1)
    assert [member.ended for member in bank._members].count(True) == 1
    assert sum(len(member.faults) for member in bank._members) == MOST_FAULTS
    assert not bank.faults  # the others go on
    # Twice for every restart, with a past and without.
    assert bank.restarts < MOST_FAULTS
    told = [r for r in caplog.records if r.name == "adaptune.bank.bank"]
    assert len(told) == 1


def test_other_processes_work_while_members_of_this_one_do():
    calls, walkers = [], makes()[0]

    class Noted(InProcess):
        def submit(self, prepared):
            calls.append(("submit", self.isolated))
            super().submit(prepared)

        def collect(self):
            calls.append(("collect", self.isolated))
            return super().collect()

    def make(parameters):
        one = Noted(walkers(parameters).odometry)
        one.isolated = parameters["speed"] > 1.0
        return one

    bank = Bank(make, {7: {"speed": 1.0}, 3: {"speed": 1.02}}, 0.1)
    x_of(bank, range(2))
    assert calls == [("submit", True), ("submit", False), ("collect", False), ("collect", True)]
    assert [T[0, 3] for T in bank.motions.members.values()] == [1.0, 1.02]
