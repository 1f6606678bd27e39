import os
import signal
import time
from functools import partial

import drives
import numpy as np
import pytest
from noting_selector import Noting, refusing

from adaptune.errors import AdaptuneError
from adaptune.odometry.base import Motions
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.recording.scan import Imu, ImuNoise, Scan
from adaptune.selector import TimedSelector, UntrainedSelector, untrained_sets
from online.real_time import SLOTS, SelectorProcess

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
            assert 0.0 < answer.seconds < 20.0
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
