"""A bank in real time, of which a member is stopped on the way."""

import contextlib
import logging
import os
import signal
import time
from pathlib import Path

import drives
import numpy as np
import pytest

from adaptune.bank.bank import Bank, Lateness
from adaptune.bank.members import SERVICE
from adaptune.odometry.base import LastMotion, OdometryInstance, Registration
from adaptune.odometry.factory import OdometryFactory, OdometryPool
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits
from adaptune.odometry.tracker import HealthCheck, Tracker
from adaptune.processes import server
from adaptune.recording.scan import Scan
from adaptune.selection import Selection

STEP = 0.25
"""Metres between scans, ten a second."""
SETS = {n: {"odometry": "gicp", "keyframe_interval": k} for n, k in ((3, 1.0), (5, 2.0))}
EVEN = Selection(3, {}, {3: 0.5, 5: 0.5})


@pytest.fixture(scope="module")
def scans():
    return [Scan(stamp, points) for stamp, points, _ in drives.scans(0, 30, STEP)]


@pytest.fixture
def make():
    """Makes banks of which trial 5 runs in another process."""
    factory = OdometryFactory("gicp", {}, odometry_class("gicp").space, Limits())
    pool = OdometryPool({"gicp": factory})
    banks = []

    def bank(rate):
        sets = {trial: pool.space.complete(one) for trial, one in SETS.items()}
        banks.append(Bank(pool, sets, 1.0, cores=2, rate=rate))
        banks[-1].apply(EVEN)
        return banks[-1]

    yield bank
    tell(signal.SIGCONT)
    for one in banks:
        one.close()


def children(process):
    return map(int, Path(f"/proc/{process}/task/{process}/children").read_text().split())


def tell(what):
    """Send a signal to the process with the member."""
    for watcher in children(server(SERVICE, "gicp").process.pid):
        for process in children(watcher):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, what)


def run(bank, scans, signals):
    """Poses, and motions of trial 5; before some scans its process gets a signal."""
    poses, moved = [np.eye(4)], []
    for i, scan in enumerate(scans):
        if i in signals:
            tell(signals[i])
        if i in signals and signals[i] == signal.SIGCONT:
            time.sleep(0.5)  # it catches up
        prepared = bank.prepare(scan)
        if i == 0:
            bank.start(prepared, np.eye(4))
            continue
        poses.append(bank.register(prepared).T_odom_sensor)
        moved.append(bank.motions.members[5])
    return np.array(poses), np.array(moved)


def test_the_mean_is_that_of_members_in_time(make, scans):
    bank = make(0.1)
    poses, moved = run(bank, scans, {10: signal.SIGSTOP, 14: signal.SIGCONT})
    # Where the tests share a core, it may be late once more.
    late = np.isnan(moved[:, 0, 0])
    assert late[9:13].all()
    assert late.sum() == bank.late.scans[1] <= 8
    assert bank.late.scans[0] == 0
    assert not bank.late.removed.any()
    # Its motion over the first scan that it sees again does not hold those that it missed.
    np.testing.assert_allclose(moved[~late][:, 0, 3], STEP, atol=0.05)
    np.testing.assert_allclose(poses[:, 0, 3], STEP * np.arange(30), atol=0.05)


def test_a_member_that_is_always_late_is_removed(make, scans, caplog, monkeypatch):
    monkeypatch.setattr("adaptune.bank.bank.ALWAYS", 1.0)
    bank = make(4.0)
    with caplog.at_level(logging.WARNING, "adaptune.bank.bank"):
        poses, _ = run(bank, scans, {5: signal.SIGSTOP})
    assert list(bank.late.removed) == [False, True]
    assert bank.late.scans[1] >= 10
    assert caplog.messages == ["trial 5 (gicp) was late for 1 s; the bank goes on without it"]
    np.testing.assert_allclose(poses[:, 0, 3], STEP * np.arange(30), atol=0.05)
    # It does not start again either.
    begin = time.perf_counter()
    bank.start(bank.prepare(scans[0]), np.eye(4))
    assert time.perf_counter() - begin < 1.0


class Slow(OdometryInstance):
    """A member of another process that needs its time, by a clock of its own."""

    apart = True

    def __init__(self, seconds):
        self.seconds, self.done, self.n = seconds, 0.0, 0
        self.moved = LastMotion()

    @property
    def motions(self):
        return self.moved.motions

    @property
    def busy(self):
        return self.submitted and time.perf_counter() < self.done

    submitted = False

    def ready(self, seconds):
        time.sleep(max(min(self.done - time.perf_counter(), seconds), 0.0))
        return time.perf_counter() >= self.done

    def prepare(self, scan):
        return scan

    def start(self, prepared, T_odom_sensor, T_previous_current=None):
        self.first, self.T_first, self.submitted = prepared.stamp, T_odom_sensor, False
        self.moved.start(T_odom_sensor, T_previous_current)

    def submit(self, prepared):
        assert not self.busy
        self.stamp, self.submitted = prepared.stamp, True
        self.done = time.perf_counter() + self.seconds

    def collect(self):
        self.ready(10.0)
        T = self.T_first.copy()
        T[0, 3] += STEP * (self.stamp - self.first) / 10**8
        self.moved.move(T)
        self.submitted, self.n = False, self.n + 1
        return Registration(T)

    def close(self):
        pass


def test_a_bank_of_which_nobody_is_in_time_waits_for_the_first(scans):
    """As one odometry that is too slow does."""
    slow = {3: Slow(0.03), 5: Slow(0.05)}
    bank = Bank(lambda given: slow[given["n"]], {n: {"n": n} for n in slow}, rate=10.0)
    bank.apply(EVEN)
    poses, moved = run(bank, scans, {})  # one every 10 ms
    np.testing.assert_allclose(poses[:, 0, 3], STEP * np.arange(30), atol=1e-6)
    assert np.isfinite(poses).all()
    assert slow[3].n == 29
    # The slower one comes now and then, with its motion over the last scan alone.
    known = np.isfinite(moved[:, 0, 3])
    assert known.sum() < 25
    np.testing.assert_allclose(moved[known][:, 0, 3], STEP, atol=1e-6)


def test_a_bank_that_starts_again_waits_for_those_at_work(make, scans):
    bank = make(0.5)
    run(bank, scans[:12], {10: signal.SIGSTOP})
    assert bank.late.scans[1] >= 2
    tell(signal.SIGCONT)
    bank.start(bank.prepare(scans[12]), np.eye(4))
    for i, scan in enumerate(scans[13:20], 1):
        T = bank.register(bank.prepare(scan)).T_odom_sensor
        np.testing.assert_allclose(T[0, 3], STEP * i, atol=0.05)


def test_a_gap_does_not_make_it_wait_as_long(scans):
    """Six members see the same gap of an hour, which counts once."""
    members = [Slow(0.0) for _ in range(6)]
    late = Lateness(members, list("abcdef"), 1.0)
    for member in members:
        member.start(scans[0], np.eye(4))
    for scan, interval in zip(scans[1:9], [0.01] * 7 + [3600.0], strict=True):
        members[0].seconds = 6.0 if interval > 1.0 else 0.0
        late.begin()
        for member in members:
            member.submit(scan)
        begin = time.perf_counter()
        found = late.collect(range(6), interval)
        assert time.perf_counter() - begin < 5.0
    assert [np.isfinite(one.T_odom_sensor).all() for one in found] == [False] + [True] * 5


def test_in_lockstep_nobody_is_late(make, scans):
    alone, in_time = make(None), make(0.2)
    poses, _ = run(alone, scans, {})
    others, moved = run(in_time, scans, {})
    assert not alone.late.scans.any()
    if not in_time.late.scans.any():
        np.testing.assert_array_equal(poses, others)
        assert np.isfinite(moved).all()


def test_a_member_that_restarts_sees_the_past_bit_by_bit(make, scans):
    waits, goes_on = make(None), make(0.1)
    for bank in (waits, goes_on):
        bank.start(bank.prepare(scans[0]), np.eye(4))
        for i, scan in enumerate(scans[1:], 1):
            if i == 15:
                bank.apply(EVEN._replace(restart=frozenset({5})))
            T = bank.register(bank.prepare(scan)).T_odom_sensor
            np.testing.assert_allclose(T[0, 3], STEP * i, atol=0.05)
            moved = bank.motions.members[5]
            # Ten scans of the past and those that come meanwhile, two more at a time.
            is_away = bank is goes_on and 15 <= i < 20
            assert np.isnan(moved[0, 3]) == is_away, i
            if not is_away:
                np.testing.assert_allclose(moved[0, 3], STEP, atol=0.05)
        assert bank.restarts == 1
    assert not goes_on.late.removed.any()


def test_one_that_rests_is_not_late_and_sees_the_past_bit_by_bit(make, scans):
    bank = make(0.1)
    resting = EVEN._replace(resting=frozenset({5}))
    bank.apply(resting)
    bank.start(bank.prepare(scans[0]), np.eye(4))
    known = []
    for i, scan in enumerate(scans[1:], 1):
        prepared = bank.prepare(scan)
        # In real time, a selection may come after a scan was prepared.
        if i == 15:
            bank.apply(EVEN)
        T = bank.register(prepared).T_odom_sensor
        np.testing.assert_allclose(T[0, 3], STEP * i, atol=0.05)
        known.append(bool(np.isfinite(bank.motions.members[5]).all()))
    # It joins in at the next scan, sees ten scans of the past and those that come meanwhile.
    assert known == [False] * 20 + [True] * (len(known) - 20)
    assert bank.restarts == 1
    assert not bank.late.removed.any()
    assert not bank.late.scans[1]


def test_one_that_restarts_does_not_wait_for_those_that_are_woken(make, scans):
    bank = make(0.1)
    bank.apply(EVEN._replace(resting=frozenset({5})))
    bank.start(bank.prepare(scans[0]), np.eye(4))
    for i, scan in enumerate(scans[1:], 1):
        if i == 15:
            (first,) = set(bank.trials) - {5}
            bank.apply(EVEN._replace(restart=frozenset({first})))
        T = bank.register(bank.prepare(scan)).T_odom_sensor
        np.testing.assert_allclose(T[0, 3], STEP * i, atol=0.05)
        moved = bank.motions.members[5]
        # No motion contains the way that it did not see.
        assert np.isnan(moved[0, 3]) if i < 20 else abs(moved[0, 3] - STEP) < 0.05
    assert bank.restarts == 2


def test_a_bank_that_fails_in_real_time_goes_on_with_all_members(make, scans):
    bank = make(0.1)
    # There is no time for scans of the past.
    assert not bank.rewinds
    assert make(None).rewinds
    fixed = Selection(3, {}, {3: 1.0})
    tracker = Tracker(bank, HealthCheck(max_speed=20.0), lambda *_: bank.apply(fixed) is None)
    bank.apply(fixed._replace(resting=frozenset({5})))
    unhealthy, known = [], []
    for i, scan in enumerate(scans):
        # At one scan, the way of a tenth of a second is made in a hundredth of that.
        stamp = scans[14].stamp + 10**6 if i == 15 else scan.stamp
        unhealthy.append(tracker.register(Scan(stamp, scan.points)).unhealthy)
        known.append(bool(np.isfinite(bank.motions.members[5]).all()))
    assert [i for i, what in enumerate(unhealthy) if what] == [15]
    assert known[:15] == [False] * 15
    assert all(known[20:])


def test_a_bank_may_start_while_a_member_restarts(make, scans):
    bank = make(0.1)
    run(bank, scans[:15], {})
    bank.apply(EVEN._replace(restart=frozenset({5})))
    bank.register(bank.prepare(scans[15]))
    assert list(bank.late.away) == [False, True]
    bank.start(bank.prepare(scans[16]), np.eye(4))
    T = bank.register(bank.prepare(scans[17])).T_odom_sensor
    np.testing.assert_allclose(T[0, 3], STEP, atol=0.05)


def test_where_all_restart_it_waits_for_them(make, scans):
    bank = make(0.1)
    run(bank, scans[:15], {})
    bank.apply(EVEN._replace(restart=frozenset({3, 5})))
    T = bank.register(bank.prepare(scans[15])).T_odom_sensor
    assert not bank.late.away.any()
    np.testing.assert_allclose(T[0, 3], STEP * 15, atol=0.05)
