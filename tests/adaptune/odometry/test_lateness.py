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

from adaptune.hosting import server
from adaptune.odometry.bank import Bank
from adaptune.odometry.base import WarmUp
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.isolation import SERVICE, Limits
from adaptune.odometry.lateness import ALWAYS
from adaptune.odometry.pool import OdometryPool
from adaptune.odometry.registry import odometry_class
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan

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
        banks.append(Bank(pool, sets, WarmUp(seconds=1.0), cores=2, rate=rate))
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


def test_a_member_that_is_always_late_is_removed(make, scans, caplog):
    bank = make(4.0)
    with caplog.at_level(logging.WARNING, "adaptune.odometry.lateness"):
        poses, _ = run(bank, scans, {5: signal.SIGSTOP})
    assert list(bank.late.removed) == [False, True]
    assert bank.late.scans[1] >= ALWAYS
    assert caplog.messages == [
        f"trial 5 (gicp) was late at {ALWAYS} scans in a row; the bank goes on without it"
    ]
    np.testing.assert_allclose(poses[:, 0, 3], STEP * np.arange(30), atol=0.05)
    # It does not start again either.
    begin = time.perf_counter()
    bank.start(bank.prepare(scans[0]), np.eye(4))
    assert time.perf_counter() - begin < 1.0


def test_a_bank_that_starts_again_waits_for_those_at_work(make, scans):
    bank = make(0.5)
    run(bank, scans[:12], {10: signal.SIGSTOP})
    assert bank.late.scans[1] >= 2
    tell(signal.SIGCONT)
    bank.start(bank.prepare(scans[12]), np.eye(4))
    for i, scan in enumerate(scans[13:20], 1):
        T = bank.register(bank.prepare(scan)).T_odom_sensor
        np.testing.assert_allclose(T[0, 3], STEP * i, atol=0.05)


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
