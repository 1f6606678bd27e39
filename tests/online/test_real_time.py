import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from clocks import SteppedClock

from adaptune.errors import AdaptuneError, OdometryError
from adaptune.odometry.base import InProcess, Registration
from adaptune.odometry.tracker import HealthCheck
from adaptune.recording.scan import Imu, ImuNoise, Scan
from adaptune.space import Selection
from adaptune.study.config import RealTimeConfig
from online.real_time import Answer, arrivals, replay_in_real_time

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

    live, space = True, None

    def __init__(self, seconds=0.0, refuses=(), prepares=0.0):
        self.clock = SteppedClock()
        self.seconds, self.refuses, self.prepares = seconds, refuses, prepares
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
        if parameters.get("fine") in self.refuses:
            raise OdometryError("too fine")
        self.parameters |= parameters


@dataclass
class Answering:
    """Stands for a process that answers after so many seconds, with sets in turn."""

    seconds: float = 0.0
    unseen: int = 0
    cpu: float = 1.0
    period: float = 1.0

    def __post_init__(self):
        self.fixed = Selection(1, {"fine": 1})
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
        return Answer(stamp, Selection(fine, {"fine": fine}), self.seconds, self.cpu)

    def too_late(self):
        return []


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


def test_a_recording_played_twice_as_fast_comes_twice_as_fast():
    clock = SteppedClock()
    due = [a.due for a in arrivals(scans(8), 1.0, 1, clock, lambda stamps: stamps // 2)]
    assert due == pytest.approx([0.05 * i for i in range(8)])

    class Fast(list):
        played_at = staticmethod(lambda stamps: stamps // 4)

    odometry, recording = Steady(), Fast(scans(9))
    clock = odometry.clock
    replay_in_real_time(recording, InProcess(odometry), HEALTH, RealTimeConfig(), clock=clock)
    assert clock.now() == pytest.approx(0.2)


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


def test_one_that_cannot_be_applied_returns_to_the_fixed_set(caplog):
    odometry = Steady(refuses=[2])
    result = run(odometry, 25, Answering(), rate=10.0, deadline=9.0, queue=0)
    assert [choice.selection.trial for choice in result.choices] == [1, 1]
    assert result.choices[0].fallen_back == "trial 2 cannot be applied: too fine"
    # It is not tried again at once.
    assert [(choice.stamp, choice.why_not) for choice in result.rejected] == [
        (0, "too fine"),
        (20 * TENTH, "the odometry failed with it"),
    ]
    assert "cannot be applied: too fine at 0.0 s; the fixed set is used" in caplog.text
    assert len(result.trajectory) == 25


def test_an_odometry_that_is_too_slow_drops_scans():
    result = run(Steady(0.03), 40, rate=10.0)  # one every 10 ms
    assert result.dropped == 25
    assert len(result.trajectory) == 40 - result.dropped
