import logging
import threading
from dataclasses import replace

import drives
import numpy as np
import pytest
import rooms
from random_models import random_model

from adaptune.model import BankSettings
from adaptune.odometry.base import InProcess, Motions
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.recording.scan import Scan
from adaptune.selector import Periods, Selector, TimedSelector, UntrainedSelector
from adaptune.space import ParameterSets, Selection

SCAN = Scan(0, np.zeros((0, 3), np.float32))


def moved(metres):
    return Motions(rooms.moved(metres), {})


class Counting:
    """A selector that notes its calls, and raises at the scans that it is told to."""

    def __init__(self, raises=()):
        self.raises = set(raises)
        self.calls = []

    def reset(self):
        self.calls.append("reset")

    def observe(self, stamp, *_):
        self.calls.append(stamp)
        if stamp in self.raises:
            raise RuntimeError("out of luck")

    def select(self):
        self.calls.append("select")
        return Selection(7, {"speed": 1.0})

    def measure(self):
        self.calls.append("measure")

    def fall_back(self):
        return Selection(0, {"speed": 0.0})


def trials(timed, stamps, motions=None):
    """By stamp, the trial number of what is selected at each scan, or None."""
    found = {}
    for stamp in stamps:
        selection = timed.update(stamp, SCAN, motions or moved(0.1))
        found[stamp] = None if selection is None else selection.trial
    return found


@pytest.mark.parametrize("period", [0.1, 0.2, 0.3, 0.7, 1.0])
def test_no_selection_is_lost_to_rounding(period):
    periods = Periods(period * 1e9)
    every = round(period * 10)
    due = [i for i in range(6000) if periods.due(i * 10**8)]
    assert due == list(range(0, 6000, every))


@pytest.mark.parametrize("period", [0.0, -1.0, np.nan])
def test_periods_that_cannot_be(period):
    with pytest.raises(ValueError, match="above 0"):
        TimedSelector(Counting(), period)


def test_measures_after_each_selection_and_before_the_next_scan():
    selector = Counting()
    trials(TimedSelector(selector), [0, 1, 10**9, 10**9 + 1])
    once = ["measure", 1, 10**9, "select", "measure", 10**9 + 1]
    assert selector.calls == ["reset", 0, "select", *once]


def test_scans_that_come_twice_or_late_are_ignored():
    selector = Counting()
    timed = TimedSelector(selector)
    assert trials(timed, [0, 10**8])[0] == 7
    assert set(trials(timed, [10**8, 5 * 10**7]).values()) == {None}
    assert 5 * 10**7 not in selector.calls


def test_a_clock_that_goes_back_begins_another_drive(caplog):
    selector = Counting()
    timed = TimedSelector(selector)
    trials(timed, [50 * 10**8, 51 * 10**8])
    assert trials(timed, [10**8])[10**8] == 7
    assert selector.calls[-3:] == ["reset", 10**8, "select"]
    assert "the clock went back by 5.0 s" in caplog.text


def test_errors_cost_a_selection_and_not_the_drive(caplog):
    stamps = [i * 10**9 for i in range(8)]
    timed = TimedSelector(Counting(raises=stamps[2:5]))
    with caplog.at_level(logging.ERROR):
        selected = trials(timed, stamps)
    # The fixed set once, nothing while it goes on failing, then selections again.
    assert list(selected.values()) == [7, 7, 0, None, None, 7, 7, 7]
    assert caplog.text.count("the fixed set is used") == caplog.text.count("out of luck\n") == 1


def test_an_error_of_the_measurement_shows_at_the_next_scan(caplog):
    class Failing(Counting):
        def measure(self):
            raise RuntimeError("out of luck")

    timed = TimedSelector(Failing())
    trials(timed, [0])
    timed.measure()
    assert "out of luck" in caplog.text
    assert trials(timed, [1, 2, 10**9]) == {1: 0, 2: None, 10**9: 7}


@pytest.mark.parametrize(
    ("members", "reserve", "weights"),
    [((), 0, None), ((4, 10), 0, {4: 0.5, 10: 0.5}), ((4, 10), 1, {4: 1.0, 10: 0.0})],
)
def test_falls_back_to_the_fixed_set_or_to_members_that_never_rest(members, reserve, weights):
    model = replace(random_model(), bank_settings=BankSettings(reserve=reserve))
    found = Selector(model, members=members).fall_back()
    assert (found.trial, found.parameters) == (model.fixed, model.sets[model.fixed])
    assert found.weights == weights
    untrained = UntrainedSelector(model.sets, 10.0).fall_back()
    assert untrained.weights.pop(model.sets.trials[0]) == 1.0
    assert not any(untrained.weights.values())


def test_a_loop_in_a_thread_of_its_own(caplog):
    space, model = KeyframeGicp.space, random_model()
    of_gicp = tuple(space.from_unit(np.random.default_rng(0).random((6, 4))))
    model = replace(model, sets=ParameterSets(space, model.sets.trials, of_gicp))
    timed = TimedSelector(
        Selector(replace(model, bank=[], vectors=np.zeros((0, 0, 3), np.float32)))
    )
    odometry = InProcess(KeyframeGicp(model.sets[model.fixed]))
    first, *scans = [Scan(stamp, points) for stamp, points, _ in drives.scans(n_scans=25)]
    odometry.start(odometry.prepare(first), np.eye(4))
    poses = []

    def drive():
        for scan in scans:
            selection = timed.update(scan.stamp, scan, odometry.motions)
            if selection is not None:
                odometry.apply(selection)
            poses.append(odometry.register(odometry.prepare(scan)).T_odom_sensor)

    thread = threading.Thread(target=drive)
    thread.start()
    thread.join()
    np.testing.assert_allclose(poses[-1][:3, 3], [24 * 0.3, 0.0, 0.0], atol=0.15)
    assert "no parameters can be selected" not in caplog.text
