"""A bank in real time, of which members are late, rest, or restart on the way."""

import logging
import signal

import drives
import numpy as np
import pytest
from clocks import SteppedClock
from wicked import tell

from adaptune.bank.bank import MAX_LATE_SECONDS, Bank, Lateness
from adaptune.bank.members import SERVICE
from adaptune.odometry.base import LastMotion, OdometryInstance, Registration
from adaptune.odometry.factory import OdometryFactory, OdometryPool
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits
from adaptune.odometry.tracker import Tracker
from adaptune.recording.scan import Scan
from adaptune.space import Selection

STEP, TENTH = 0.25, 10**8
"""Metres, and nanoseconds, between scans."""
EVEN = Selection(3, {}, {3: 0.5, 5: 0.5})
X = {}
"""Where the sensor is at stamps that are not on the way."""


def scan(i):
    return Scan(i * TENTH, np.zeros((0, 3), np.float32))


class Slow(OdometryInstance):
    """A member of another process that needs its time."""

    isolated, warm_up = True, 1.0  # seconds

    def __init__(self, clock, seconds=0.0):
        self.clock, self.seconds, self.done, self.n = clock, seconds, 0.0, 0
        self.submitted = False
        self.moved = LastMotion()

    @property
    def motions(self):
        return self.moved.motions

    @property
    def busy(self):
        return self.submitted and self.clock.now() < self.done

    def ready(self, seconds):
        self.clock.sleep(min(self.done - self.clock.now(), seconds))
        return self.clock.now() >= self.done

    def prepare(self, scan):
        return scan

    def start(self, prepared, T_odom_sensor, T_previous_current=None):
        self.first, self.T_first, self.submitted = prepared.stamp, T_odom_sensor, False
        self.moved.start(T_odom_sensor, T_previous_current)

    def submit(self, prepared):
        assert not self.busy
        self.stamp, self.submitted = prepared.stamp, True
        self.done = self.clock.now() + self.seconds

    def collect(self):
        self.ready(1e9)
        T = self.T_first.copy()
        T[0, 3] += where(self.stamp) - where(self.first)
        self.moved.move(T)
        self.submitted, self.n = False, self.n + 1
        return Registration(T)

    def close(self):
        pass


def where(stamp):
    return X.get(stamp, STEP * stamp / TENTH)


@pytest.fixture
def clock():
    return SteppedClock()


def bank_of(clock, rate=1.0, **seconds):
    """A bank of trials 3 and 5, and its members; they need some seconds for each scan."""
    members = {n: Slow(clock, seconds.get(f"of_{n}", 0.0)) for n in (3, 5)}
    sets = {n: {"n": n} for n in members}
    bank = Bank(lambda own: members[own["n"]], sets, rate=rate, clock=clock)
    bank.apply(EVEN)
    return bank, members


def run(bank, clock, n=30, before=lambda _: None):
    """Poses along x, and motions of trial 5 along x, at scans that come when they are due."""
    x, moved = [], []
    for i in range(n):
        clock.sleep(0.1 * i - clock.now())
        before(i)
        prepared = bank.prepare(scan(i))
        if i == 0:
            bank.start(prepared, np.eye(4))
        x.append(0.0 if i == 0 else bank.register(prepared).T_odom_sensor[0, 3])
        moved.append(STEP if i == 0 else bank.motions.members[5][0, 3])
    return np.array(x), np.array(moved)


def test_the_mean_is_that_of_members_in_time(clock):
    bank, members = bank_of(clock)

    def before(i):
        members[5].seconds = 0.35 if i == 10 else 0.0

    x, moved = run(bank, clock, before=before)
    assert np.flatnonzero(np.isnan(moved)).tolist() == [10, 11, 12, 13]
    assert bank.late.scans.tolist() == [0, 4]
    assert not bank.late.removed.any()
    # Its motion over the first scan that it sees again does not hold those that it missed.
    np.testing.assert_allclose(moved[~np.isnan(moved)], STEP)
    np.testing.assert_allclose(x, STEP * np.arange(30))


def test_a_member_that_is_always_late_is_removed(clock, caplog):
    bank, members = bank_of(clock)

    def before(i):
        members[5].seconds = 0.0 if i < 5 else 1e6

    n = 8 + round(MAX_LATE_SECONDS / 0.1)
    with caplog.at_level(logging.WARNING, "adaptune.bank.bank"):
        x, _ = run(bank, clock, n, before)
    assert list(bank.late.removed) == [False, True]
    assert bank.motions.states == {3: "works", 5: "late"}
    assert caplog.messages == ["trial 5 was late for 5 s; the bank goes on without it"]
    np.testing.assert_allclose(x, STEP * np.arange(n))
    # It does not start again either.
    bank.start(bank.prepare(scan(n)), np.eye(4))
    assert clock.now() < 10.0


def test_a_bank_of_which_nobody_is_in_time_waits_for_the_first(clock):
    """As one odometry that is too slow does."""
    bank, members = bank_of(clock, of_3=0.3, of_5=0.5)
    x, moved = run(bank, clock)
    np.testing.assert_allclose(x, STEP * np.arange(30))
    assert members[3].n == 29
    # The slower one comes now and then, with its motion over the last scan alone.
    known = np.isfinite(moved)
    assert known.sum() < 25
    np.testing.assert_allclose(moved[known], STEP)


def test_a_bank_that_starts_again_does_not_wait_for_those_at_work(clock):
    bank, members = bank_of(clock)

    def before(i):
        members[5].seconds = 3.0 if i == 10 else 0.0

    run(bank, clock, 12, before)
    assert bank.late.scans[1] == 2
    bank.start(bank.prepare(scan(12)), np.eye(4))
    assert clock.now() < 1.2
    known = []
    for i in range(1, 40):
        clock.sleep(0.1 * (12 + i) - clock.now())
        T = bank.register(bank.prepare(scan(12 + i))).T_odom_sensor
        assert T[0, 3] == pytest.approx(STEP * i)
        if np.isfinite(bank.motions.members[5]).all():
            known.append(12 + i)
    # It begins anew once it is done with its scan, and sees the last second before it is back.
    assert known[0] in range(40, 48)
    assert known == list(range(known[0], 52))
    assert bank.restarts == 1
    assert members[5].first >= 12 * TENTH


def test_a_gap_does_not_make_it_wait_as_long(clock):
    """Six members see the same gap of an hour, which counts once."""
    members = [Slow(clock) for _ in range(6)]
    late = Lateness(members, list("abcdef"), 1.0, clock)
    for member in members:
        member.start(scan(0), np.eye(4))
    for i, interval in enumerate([0.01] * 7 + [3600.0], 1):
        members[0].seconds = 6.0 if interval > 1.0 else 0.0
        late.begin()
        for member in members:
            member.submit(scan(i))
        registrations = late.collect(range(6), interval)
    assert clock.now() == pytest.approx(0.01)
    known = [np.isfinite(one.T_odom_sensor).all() for one in registrations]
    assert known == [False] + [True] * 5


@pytest.mark.parametrize("rate", [None, 1.0])
def test_a_member_that_restarts_sees_the_past_bit_by_bit(clock, rate):
    bank, _ = bank_of(clock, rate)

    def before(i):
        if i == 15:
            bank.apply(EVEN._replace(restart=frozenset({5})))

    x, moved = run(bank, clock, before=before)
    np.testing.assert_allclose(x, STEP * np.arange(30))
    # In real time: ten scans of the past and those that come meanwhile, two more at a time.
    away = [15, 16, 17, 18, 19] if rate else []
    assert np.flatnonzero(np.isnan(moved)).tolist() == away
    np.testing.assert_allclose(moved[np.isfinite(moved)], STEP)
    assert bank.restarts == 1
    assert not bank.late.removed.any()


@pytest.mark.parametrize("also_restarts", [False, True])
def test_one_that_rests_is_not_late_and_sees_the_past_bit_by_bit(clock, also_restarts):
    bank, _ = bank_of(clock)
    bank.apply(EVEN._replace(resting=frozenset({5})))

    def before(i):
        if i == 15:
            # One that restarts does not wait for those that are woken.
            bank.apply(EVEN._replace(restart=frozenset({3} if also_restarts else ())))

    x, moved = run(bank, clock, before=before)
    np.testing.assert_allclose(x, STEP * np.arange(30))
    assert np.flatnonzero(np.isfinite(moved))[1] in range(19, 22)
    np.testing.assert_allclose(moved[np.isfinite(moved)], STEP)
    assert bank.restarts == 1 + also_restarts
    assert not bank.late.scans[1]


def test_a_bank_that_fails_in_real_time_goes_on_with_all_members(clock, monkeypatch):
    bank, _ = bank_of(clock)
    # There is no time for scans of the past.
    assert not bank.rewinds
    fixed = Selection(3, {}, {3: 1.0})
    tracker = Tracker(bank, HealthCheck(max_speed=20.0), lambda *_: bank.apply(fixed) is None)
    bank.apply(fixed._replace(resting=frozenset({5})))
    # At one scan, the way of a tenth of a second is made in a hundredth of that.
    early = 14 * TENTH + 10**6
    monkeypatch.setitem(X, early, STEP * 15)
    unhealthy, known = [], []
    for i in range(30):
        made = Scan(early, scan(i).points) if i == 15 else scan(i)
        unhealthy.append(tracker.register(made).unhealthy)
        known.append(bool(np.isfinite(bank.motions.members[5]).all()))
    assert [i for i, what in enumerate(unhealthy) if what] == [15]
    assert known[:15] == [False] * 15
    assert all(known[20:])


def test_a_bank_may_start_while_a_member_restarts(clock):
    bank, _ = bank_of(clock)
    run(bank, clock, 15)
    bank.apply(EVEN._replace(restart=frozenset({5})))
    bank.register(bank.prepare(scan(15)))
    assert list(bank.late.away) == [False, True]
    bank.start(bank.prepare(scan(16)), np.eye(4))
    assert bank.register(bank.prepare(scan(17))).T_odom_sensor[0, 3] == pytest.approx(STEP)


def test_where_all_restart_it_waits_for_them(clock):
    bank, _ = bank_of(clock)
    run(bank, clock, 15)
    bank.apply(EVEN._replace(restart=frozenset({3, 5})))
    T = bank.register(bank.prepare(scan(15))).T_odom_sensor
    assert not bank.late.away.any()
    assert T[0, 3] == pytest.approx(STEP * 15)


def test_a_process_that_is_stopped_is_late_and_comes_back():
    gicp = OdometryFactory("gicp", {}, odometry_class("gicp").space, Limits())
    pool = OdometryPool({"gicp": gicp})
    sets = {3: {"keyframe_interval": 1.0}, 5: {"keyframe_interval": 2.0}}
    sets = {n: pool.space.complete({"odometry": "gicp"} | own) for n, own in sets.items()}
    bank = Bank(pool, sets, cores=2, rate=0.05)  # two seconds a scan
    bank.apply(EVEN)
    try:
        for i, (stamp, points, _) in enumerate(drives.scans(0, 16, STEP)):
            tell(SERVICE, "gicp", signal.SIGSTOP if i == 10 else signal.SIGCONT)
            prepared = bank.prepare(Scan(stamp, points))
            if i == 0:
                bank.start(prepared, np.eye(4))
                continue
            T = bank.register(prepared).T_odom_sensor
            assert T[0, 3] == pytest.approx(STEP * i, abs=0.05)
            if i == 10:
                assert np.isnan(bank.motions.members[5][0, 3])
                assert bank.late.scans[1] >= 1
                tell(SERVICE, "gicp", signal.SIGCONT)
                assert bank._members[1].ready(60.0)
        assert bank.motions.members[5][0, 3] == pytest.approx(STEP, abs=0.05)
    finally:
        tell(SERVICE, "gicp", signal.SIGCONT)
        bank.close()
