from dataclasses import replace

import faulty
import numpy as np
import pytest
from walker import Walker, at, every, kept, makes, selected, x_of, x_on

from adaptune.bank.hand_over import HandOver
from adaptune.odometry import InProcess, WarmUp
from adaptune.odometry.remote import Isolated, Limits
from adaptune.recording import Imu


def test_hand_over_never_jumps_and_warms_up_on_the_last_seconds():
    make, made = makes()
    odometry = HandOver(make, {"speed": 1.0}, warm_up=every(3.0))
    x = x_of(odometry, range(10), {6: {"speed": 2.0}})
    assert x == [0, 1, 2, 3, 4, 5, 7, 9, 11, 13]
    old, new = made
    assert old.seen == [0, 1, 2, 3, 4, 5]
    # Four scans lie within three seconds; the first of them at the pose it was given.
    assert new.seen == [2, 3, 4, 5, 6, 7, 8, 9]
    assert new.starts == [(2, 2.0)]


def test_hand_over_sees_less_of_what_is_long_ago():
    make, made = makes()
    odometry = HandOver(make, {"speed": 1.0}, WarmUp(8.0, 2.0, 3))
    x_of(odometry, range(14), {12: {"speed": 2.0}})
    assert made[1].seen == [3, 6, 9, 10, 11, 12, 13]


@pytest.mark.parametrize("catch_up_scans", [0, 3])
def test_what_an_imu_measured_during_scans_that_are_left_out_is_seen(catch_up_scans):
    class Measured(Walker):
        def prepare(self, scan):
            return super().prepare(scan), scan.imu.stamps.tolist()

        def start(self, prepared, *motion):
            super().start(prepared[0], *motion)
            self.stamps = prepared[1]

        def register(self, prepared):
            self.stamps = self.stamps + prepared[1]
            return super().register(prepared[0])

    made = []

    def make(parameters):
        made.append(Measured(parameters))
        return InProcess(made[-1])

    def scan(second):
        stamps = np.arange(10) * 10**8 + (second - 1) * 10**9 + 1
        return replace(at(second), imu=Imu(stamps, *np.zeros((2, 10, 3))))

    odometry = HandOver(make, {"speed": 1.0}, WarmUp(8.0, 2.0, 3), catch_up_scans)
    for second in range(20):
        if second == 12:
            odometry.apply(selected({"speed": 2.0}))
        prepared = odometry.prepare(scan(second))
        if second == 0:
            odometry.start(prepared, np.eye(4))
        else:
            odometry.register(prepared)
    old, new = made
    assert new.seen == [3, 6, 9, *range(10, 20)]
    # All since the one it began with, in order and each once.
    assert new.stamps == [t for second in range(3, 20) for t in scan(second).imu.stamps]
    assert old.stamps == [t for second in range(old.seen[-1] + 1) for t in scan(second).imu.stamps]


def test_a_new_instance_catches_up_with_the_old_one():
    make, made = makes()
    odometry = HandOver(make, {"speed": 1.0}, every(3.0), catch_up_scans=2)
    x = x_of(odometry, range(12), {6: {"speed": 2.0}})
    # It sees 2, then 3 and 4 while scan 6 is registered, 5 and 6 at 7, 7 and 8 at 8.
    assert made[1].seen == [*range(2, 12)]
    assert x == [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14]
    assert made[0].seen == [*range(9)]


def test_hand_over_that_is_no_longer_wanted():
    make, made = makes()
    odometry = HandOver(make, {"speed": 1.0}, every(3.0), catch_up_scans=2)
    x = x_of(odometry, range(10), {5: {"speed": 2.0}, 6: {"speed": 3.0}, 7: {"speed": 1.0}})
    assert x == list(range(10))
    assert [len(walker.seen) for walker in made] == [10, 3, 3]


def test_a_new_start_lets_the_newcomer_begin():
    make, made = makes()
    odometry = HandOver(make, {"speed": 1.0}, every(9.0), catch_up_scans=2)
    x_of(odometry, range(6), {5: {"speed": 2.0}})
    odometry.start(odometry.prepare(at(6)), np.eye(4))
    assert odometry.register(odometry.prepare(at(7))).T_odom_sensor[0, 3] == 2.0
    assert made[0].seen == [*range(6)]


def test_hand_over_makes_nothing_for_the_parameters_it_has():
    make, made = makes()
    odometry = HandOver(make, {"speed": 1.0}, warm_up=every(3.0))
    x_of(odometry, range(6), {0: {"speed": 1.0}, 3: {"speed": 1.0}})
    assert len(made) == 1


def test_hand_over_before_the_first_scan():
    make, made = makes()
    odometry = HandOver(make, {"speed": 1.0}, warm_up=every(3.0))
    assert x_of(odometry, range(3), {0: {"speed": 3.0}}) == [0, 3, 6]
    assert made[0].seen == []


def test_hand_over_begins_without_warm_up_where_that_fails():
    make, made = makes({2.0: {4: np.nan}})
    odometry = HandOver(make, {"speed": 1.0}, warm_up=every(3.0))
    assert x_of(odometry, range(8), {6: {"speed": 2.0}}) == [0, 1, 2, 3, 4, 5, 7, 9]
    assert made[1].starts == [(2, 2.0), (5, 5.0)]


def test_a_new_start_forgets_what_was_before():
    make, made = makes()
    odometry = HandOver(make, {"speed": 1.0}, warm_up=every(30.0))
    x_of(odometry, range(4))
    T = np.eye(4)
    T[0, 3] = 100.0
    odometry.start(odometry.prepare(at(4)), T)
    odometry.apply(selected({"speed": 2.0}))
    assert odometry.register(odometry.prepare(at(5))).T_odom_sensor[0, 3] == 102.0
    assert made[1].seen == [4, 5]


def test_it_keeps_what_its_instances_used_and_reported():
    make, made = kept(makes()[0])
    odometry = HandOver(make, {"speed": 1.0}, every(3.0))
    x_of(odometry, range(4))
    used = odometry.usage.cpu
    made[0].faults = ["lost"]
    odometry.apply(selected({"speed": 2.0}))
    x_on(odometry, range(4, 8))
    made[1].faults = ["lost again"]
    assert odometry.faults == ["lost", "lost again"]
    assert odometry.usage.cpu == sum(instance.usage.cpu for instance in made) > used
    assert odometry.usage.memory is None


def test_registrations_keep_their_word():
    make, _ = makes()
    odometry = HandOver(make, {"speed": 1.0}, every(3.0))
    odometry.start(odometry.prepare(at(3)), np.eye(4))
    assert not odometry.register(odometry.prepare(at(4))).registered
    assert odometry.register(odometry.prepare(at(5))).registered


@pytest.mark.parametrize("catch_up_scans", [0, 3])
def test_one_that_cannot_begin_does_not_take_over(catch_up_scans):
    make, made = makes()

    def make_either(parameters):
        if "x" not in parameters:
            return make(parameters)
        return Isolated("faulty:Faulty", {}, faulty.Settings(fault="never begins"), Limits())

    odometry = HandOver(make_either, {"speed": 1.0}, every(3.0), catch_up_scans)
    switches = {4: {"x": 0.5}, 7: {"x": 0.5}, 9: {"speed": 1.0}, 12: {"speed": 2.0}}
    x = x_of(odometry, range(18), switches)
    assert np.diff(x)[:11].tolist() == [1.0] * 11
    assert np.diff(x)[-1] == 2.0
    # It was tried for one selection of two, from its first scan on and from the last.
    assert 2 <= len(odometry.faults) <= 3
    assert len(made) == 2
