import itertools
import os
import signal
import time
from dataclasses import dataclass
from functools import partial

import drives
import numpy as np
import pytest
from clocks import SteppedClock
from noting_selector import Noting, refusing

from adaptune.errors import AdaptuneError
from adaptune.odometry.base import InProcess, Motions, Registration
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.recording.scan import Imu, ImuNoise, Scan
from adaptune.selector import TimedSelector, UntrainedSelector, untrained_sets
from adaptune.space import Selection
from adaptune.study.config import RealTimeConfig
from online.real_time import arrivals, replay_in_real_time
from online.selector_process import SLOTS, Answer, SelectorProcess

TENTH = 10**8
"""Nanoseconds between scans."""
HEALTH = HealthCheck()


def scans(n, imu=False):
    points = np.zeros((30, 3), np.float32)
    for i in range(n):
        measured = Imu(
            np.array([i]), np.full((1, 3), i), np.zeros((1, 3)), np.eye(4), ImuNoise(1, 1, 1, 1)
        )
        yield Scan(i * TENTH, points, imu=measured if imu else None)


class Steady:
    """An odometry that drives straight on, and takes its time."""

    live, space, warm_up = True, None, 0.0

    def __init__(self, seconds=0.0, prepares=0.0):
        self.clock = SteppedClock()
        self.seconds, self.prepares = seconds, prepares
        self.prepared = []
        self.parameters = {"fine": 1}

    @property
    def preparation(self):
        return self.parameters["fine"]

    def prepare(self, scan):
        self.prepared.append((scan.stamp, self.preparation))
        self.clock.sleep(self.prepares)
        return scan

    def start(self, _, T_odom_sensor, __=None):
        self.T = T_odom_sensor

    def register(self, _):
        self.clock.sleep(self.seconds)
        self.T = self.T.copy()
        self.T[0, 3] += 0.1
        return Registration(self.T)

    def configure(self, parameters):
        self.parameters |= parameters


@dataclass
class Answering:
    """Stands for a process that answers after so many seconds, with sets in turn."""

    seconds: float = 0.0
    unseen: int = 0
    cpu: float = 1.0
    period: float = 1.0

    def __post_init__(self):
        self.fallback = Selection(1, {"fine": 1})
        self.turns = itertools.cycle((2, 1))
        self.shown = {}

    def show(self, stamp, *_):
        self.shown[stamp] = self.clock.now()
        return True

    def answer_to(self, stamp, seconds):
        left = self.shown[stamp] + self.seconds - self.clock.now()
        self.clock.sleep(min(left, seconds))
        if left > seconds:
            return None
        fine = next(self.turns)
        return Answer(stamp, Selection(fine, {"fine": fine}), self.cpu)


def run(odometry, n=30, selector=None, **settings):
    clock = odometry.clock
    if selector is not None:
        selector.clock = clock
    settings = RealTimeConfig(**settings)
    return replay_in_real_time(
        scans(n), InProcess(odometry), HEALTH, settings, selector, clock=clock
    )


def test_scans_come_when_they_are_due():
    clock, came = SteppedClock(), []
    for arrival in arrivals(scans(8), 10.0, 1, clock):
        assert clock.now() == pytest.approx(arrival.due)
        assert not arrival.dropped
        came.append((arrival.scan.stamp, arrival.due))
    assert came == [(i * TENTH, pytest.approx(0.01 * i)) for i in range(8)]


@pytest.mark.parametrize("queue", [1, 2])
def test_the_oldest_that_wait_are_dropped_as_in_a_queue_of_ros(queue):
    clock, found = SteppedClock(), []
    for arrival in arrivals(scans(12), 5.0, queue, clock):  # one every 20 ms
        found.append(arrival)
        clock.sleep(0.07)
    stamps = [arrival.scan.stamp // TENTH for arrival in found]
    assert (stamps[0], stamps[-1]) == (0, 11)
    # The newest are always taken.
    assert stamps[-queue:] == list(range(12 - queue, 12))
    assert [arrival.dropped for arrival in found[1:]] == (np.diff(stamps) - 1).tolist()
    assert 12 - len(found) == sum(arrival.dropped for arrival in found) >= 4


def test_with_no_queue_all_scans_wait():
    clock, found = SteppedClock(), []
    for arrival in arrivals(scans(10), 50.0, 0, clock):
        found.append(arrival.scan.stamp)
        clock.sleep(0.01)
    assert found == [i * TENTH for i in range(10)]


def test_what_the_imu_measured_is_not_dropped():
    clock, turned = SteppedClock(), []
    for arrival in arrivals(scans(10, imu=True), 20.0, 1, clock):
        turned += arrival.scan.imu.angular_velocity[:, 0].tolist()
        clock.sleep(0.02)
    assert turned == list(range(10))


def test_an_error_of_the_recording_is_raised_here():
    def broken():
        yield from scans(3)
        raise AdaptuneError("the bag ends in a message")

    with pytest.raises(AdaptuneError, match="the bag ends"):
        replay_in_real_time(broken(), InProcess(Steady()), HEALTH, RealTimeConfig(rate=100.0))
    with pytest.raises(AdaptuneError, match="no scan to replay"):
        replay_in_real_time([], InProcess(Steady()), HEALTH, RealTimeConfig())


def test_selections_are_applied_before_their_scan_is_registered():
    odometry = Steady()
    result = run(odometry, 25, Answering(), rate=10.0, deadline=9.0, queue=0)
    assert [choice.stamp for choice in result.choices] == [0, 10 * TENTH, 20 * TENTH]
    assert (result.missed, result.dropped) == (0, 0)
    assert odometry.prepared[:2] == [(0, 2), (TENTH, 2)]
    assert [fine for stamp, fine in odometry.prepared if stamp == 10 * TENTH] == [1]
    assert len(result.late) == len(result.trajectory) == 25
    # A second of CPU time in the other process, for 25 scans.
    assert result.cpu_ms > 40.0


def test_a_selection_that_comes_while_the_scan_is_prepared():
    odometry = Steady(prepares=0.2)
    result = run(odometry, 3, Answering(0.5), deadline=0.8, queue=0)
    assert [choice.stamp for choice in result.choices] == [0]
    # Another preparation prepares the scan again.
    assert odometry.prepared[:3] == [(0, 1), (0, 2), (TENTH, 2)]
    assert result.waited[0] == pytest.approx(0.4)


def test_late_selections_are_dropped_and_the_last_set_stays():
    odometry = Steady()
    result = run(odometry, 25, Answering(0.05), rate=10.0, deadline=0.02, queue=0)
    assert result.missed == 3
    assert not result.choices
    assert odometry.parameters == {"fine": 1}
    assert result.waited == pytest.approx([0.01] * 3)


def test_an_odometry_that_is_too_slow_drops_scans():
    result = run(Steady(0.03), 40, rate=10.0)  # one every 10 ms
    assert result.dropped == 25
    assert len(result.trajectory) == 40 - result.dropped


SETS = untrained_sets(KeyframeGicp.space, 3)
SECOND = 10**9


def moved(metres):
    T = np.eye(4)
    T[0, 3] = metres
    return Motions(T, dict.fromkeys(SETS.trials, T))


def drive(n=30, step=0.5):
    return [Scan(stamp, points) for stamp, points, _ in drives.scans(0, n, step)]


@pytest.fixture
def started():
    processes = []

    def start(make, period=1.0):
        processes.append(SelectorProcess(make, period))
        return processes[-1]

    yield start
    for process in processes:
        process.close()


def test_it_selects_what_a_selector_here_selects(started):
    scans, make = drive(), partial(UntrainedSelector, SETS, 10.0)
    here, there = TimedSelector(make()), started(make)
    n = 0
    for scan in scans:
        expected = here.update(scan.stamp, scan, moved(0.5))
        here.measure()
        assert there.show(scan.stamp, scan, moved(0.5))
        answer = there.answer_to(scan.stamp, 60.0)
        assert (answer.selection is None) == (expected is None)
        if expected is not None:
            n += 1
            assert repr(answer.selection) == repr(expected)
    assert n == 3
    assert there.unseen == 0
    assert there.cpu > 0.0


def test_scans_arrive_whole(started):
    process = started(Noting, 1e-9)
    for n in (3, 40_000, 0, 7):  # a larger one needs another place
        rng = np.random.default_rng(n)
        points = rng.normal(0.0, 9.0, (n, 3)).astype(np.float32)
        noise = ImuNoise(*np.ones(4).tolist())
        imu = Imu(np.arange(2), np.full((2, 3), 0.5), np.zeros((2, 3)), np.eye(4), noise)
        scan = Scan(n, points, times=np.arange(n, dtype=np.float32), imu=imu)
        stamp = time.time_ns()
        process.show(stamp, scan, moved(1.0))
        told = process.answer_to(stamp, 60.0).selection.parameters
        assert told["points"] == points.tolist()
        assert told["times"] == list(range(n))
        assert told["gyro"] == [[0.5] * 3] * 2


def test_it_never_waits_and_the_motion_of_what_was_not_shown_is_not_lost(started, tmp_path):
    process, scan = started(partial(Noting, tmp_path / "gate"), 1e-9), drive(1)[0]
    shown = [process.show(stamp, scan, moved(0.25)) for stamp in range(SLOTS + 3)]
    (tmp_path / "gate").touch()
    assert shown == [True] * SLOTS + [False] * 3
    assert process.unseen == 3
    assert process.answer_to(SLOTS - 1, 60.0).stamp == SLOTS - 1
    assert process.show(SLOTS + 3, scan, moved(0.25))
    told = process.answer_to(SLOTS + 3, 60.0).selection.parameters
    assert told["metres"] == 1.0
    assert set(told["member"].values()) == {1.0}


def test_where_the_clock_goes_back_no_motion_of_before_counts(started, tmp_path):
    process, scan = started(partial(Noting, tmp_path / "gate"), 1e-9), drive(1)[0]
    for stamp in range(SLOTS + 3):
        process.show(10 * SECOND + stamp, scan, moved(0.25))
    (tmp_path / "gate").touch()
    assert process.answer_to(10 * SECOND + SLOTS - 1, 60.0)
    assert process.show(0, scan, moved(0.0))
    assert process.answer_to(0, 60.0).selection.parameters["metres"] == 0.0


def test_an_answer_that_is_late_is_dropped(started, tmp_path):
    process, scan = started(partial(Noting, tmp_path / "gate"), 1e-9), drive(1)[0]
    process.show(1, scan, moved(0.1))
    assert process.answer_to(1, 0.01) is None
    (tmp_path / "gate").touch()
    process.show(2, scan, moved(0.1))
    assert process.answer_to(2, 60.0).stamp == 2


def test_an_error_gives_the_fixed_set(started):
    process, scan = started(partial(Noting, fails=True)), drive(1)[0]
    process.show(1, scan, moved(0.1))
    assert process.answer_to(1, 60.0).selection.parameters == {"fixed": True}
    process.show(2, scan, moved(0.1))
    assert process.answer_to(2, 60.0).selection is None
    assert process.alive


def test_a_process_that_is_killed_gives_no_answers(started, caplog):
    process, scan = started(Noting), drive(1)[0]
    os.kill(process._process.pid, signal.SIGKILL)
    for stamp in range(2 * SLOTS):
        process.show(stamp, scan, moved(0.1))
        assert process.answer_to(stamp, 0.2) is None
    assert not process.alive
    assert caplog.text.count("the selector's process has ended; the last set stays") == 1


def test_one_that_cannot_be_made_is_refused():
    with pytest.raises(AdaptuneError, match="the selector's process: there is no such descriptor"):
        SelectorProcess(refusing, 1.0)
