from dataclasses import replace

import numpy as np
import pytest
import turns

from adaptune.geometry import invert
from adaptune.odometry import (
    Bank,
    HandOver,
    Isolated,
    Limits,
    Odometry,
    OdometryError,
    Registration,
    WarmUp,
)
from adaptune.odometry.gicp import KeyframeGicp, Settings
from adaptune.sequence import Imu, Scan
from adaptune.space import Float, ParameterSpace

NEAR = {"max_correspondence_distance": 2.0, "keyframe_interval": 1.0}
FAR = {"max_correspondence_distance": 1.0, "keyframe_interval": 4.0}


class Walker(Odometry):
    """Moves by `speed` along x with every scan, where no script says otherwise."""

    space = ParameterSpace({"speed": Float(low=0.0, high=9.0, baseline=1.0)})
    live = False

    def __init__(self, parameters, script=None):
        super().__init__(parameters)
        self.script = script or {}
        self.seen = []
        self.starts = []

    def prepare(self, scan):
        return round(scan.stamp / 1e9)

    def start(self, prepared, T_odom_sensor, T_previous_current=None):
        self.seen.append(prepared)
        self.starts.append((prepared, T_odom_sensor[0, 3]))
        self.motion = T_previous_current
        self.T = T_odom_sensor.copy()

    def register(self, prepared):
        self.seen.append(prepared)
        self.T = self.T.copy()
        self.T[0, 3] += self.script.get(prepared, self.parameters["speed"])
        return Registration(self.T, prepared != 4)


def every(seconds):
    """A warm-up on all scans of the last seconds."""
    return WarmUp(seconds, seconds, 1)


def at(second):
    return Scan(round(second * 1e9), np.zeros((0, 3), np.float32))


def x_of(box, seconds, switches=()):
    """Where a box is along x at every scan."""
    switches = dict(switches)
    x = []
    for i, second in enumerate(seconds):
        if second in switches:
            box.configure(switches[second])
        prepared = box.prepare(at(second))
        if i == 0:
            box.start(prepared, np.eye(4))
            x.append(0.0)
        else:
            x.append(float(box.register(prepared).T_odom_sensor[0, 3]))
    return x


def x_on(box, seconds):
    """Where a box that has begun is along x at further scans."""
    return [float(box.register(box.prepare(at(s))).T_odom_sensor[0, 3]) for s in seconds]


def makes(scripts=None):
    """What makes walkers, and the list of those it made."""
    made = []

    def make(parameters):
        made.append(Walker(parameters, (scripts or {}).get(parameters["speed"])))
        return made[-1]

    return make, made


def test_hand_over_never_jumps_and_warms_up_on_the_last_seconds():
    make, made = makes()
    box = HandOver(make, {"speed": 1.0}, warm_up=every(3.0))
    x = x_of(box, range(10), {6: {"speed": 2.0}})
    assert x == [0, 1, 2, 3, 4, 5, 7, 9, 11, 13]
    old, new = made
    assert old.seen == [0, 1, 2, 3, 4, 5]
    # Four scans lie within three seconds; the first of them at the pose it was given.
    assert new.seen == [2, 3, 4, 5, 6, 7, 8, 9]
    assert new.starts == [(2, 2.0)]


def test_hand_over_sees_less_of_what_is_long_ago():
    make, made = makes()
    box = HandOver(make, {"speed": 1.0}, WarmUp(8.0, 2.0, 3))
    x_of(box, range(14), {12: {"speed": 2.0}})
    assert made[1].seen == [3, 6, 9, 10, 11, 12, 13]


@pytest.mark.parametrize("beside", [0, 3])
def test_what_an_imu_measured_during_scans_that_are_left_out_is_seen(beside):
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
        return made[-1]

    def scan(second):
        stamps = np.arange(10) * 10**8 + (second - 1) * 10**9 + 1
        return replace(at(second), imu=Imu(stamps, *np.zeros((2, 10, 3))))

    box = HandOver(make, {"speed": 1.0}, WarmUp(8.0, 2.0, 3), beside)
    for second in range(20):
        if second == 12:
            box.configure({"speed": 2.0})
        prepared = box.prepare(scan(second))
        if second == 0:
            box.start(prepared, np.eye(4))
        else:
            box.register(prepared)
    old, new = made
    assert new.seen == [3, 6, 9, *range(10, 20)]
    # All since the one it began with, in order and each once.
    assert new.stamps == [t for second in range(3, 20) for t in scan(second).imu.stamps]
    assert old.stamps == [t for second in range(old.seen[-1] + 1) for t in scan(second).imu.stamps]


def test_hand_over_beside_the_old_instance():
    make, made = makes()
    box = HandOver(make, {"speed": 1.0}, every(3.0), beside=2)
    x = x_of(box, range(12), {6: {"speed": 2.0}})
    # It sees 2, then 3 and 4 while scan 6 is registered, 5 and 6 at 7, 7 and 8 at 8.
    assert made[1].seen == [*range(2, 12)]
    assert x == [0, 1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14]
    assert made[0].seen == [*range(9)]


def test_hand_over_that_is_no_longer_wanted():
    make, made = makes()
    box = HandOver(make, {"speed": 1.0}, every(3.0), beside=2)
    x = x_of(box, range(10), {5: {"speed": 2.0}, 6: {"speed": 3.0}, 7: {"speed": 1.0}})
    assert x == list(range(10))
    assert [len(walker.seen) for walker in made] == [10, 3, 3]


def test_a_new_start_lets_the_newcomer_begin():
    make, made = makes()
    box = HandOver(make, {"speed": 1.0}, every(9.0), beside=2)
    x_of(box, range(6), {5: {"speed": 2.0}})
    box.start(box.prepare(at(6)), np.eye(4))
    assert box.register(box.prepare(at(7))).T_odom_sensor[0, 3] == 2.0
    assert made[0].seen == [*range(6)]


def test_hand_over_makes_nothing_for_the_parameters_it_has():
    make, made = makes()
    box = HandOver(make, {"speed": 1.0}, warm_up=every(3.0))
    x_of(box, range(6), {0: {"speed": 1.0}, 3: {"speed": 1.0}})
    assert len(made) == 1


def test_hand_over_before_the_first_scan():
    make, made = makes()
    box = HandOver(make, {"speed": 1.0}, warm_up=every(3.0))
    assert x_of(box, range(3), {0: {"speed": 3.0}}) == [0, 3, 6]
    assert made[0].seen == []


def test_hand_over_begins_without_warm_up_where_that_fails():
    make, made = makes({2.0: {4: np.nan}})
    box = HandOver(make, {"speed": 1.0}, warm_up=every(3.0))
    assert x_of(box, range(8), {6: {"speed": 2.0}}) == [0, 1, 2, 3, 4, 5, 7, 9]
    assert made[1].starts == [(2, 2.0), (5, 5.0)]


def test_a_new_start_forgets_what_was_before():
    make, made = makes()
    box = HandOver(make, {"speed": 1.0}, warm_up=every(30.0))
    x_of(box, range(4))
    T = np.eye(4)
    T[0, 3] = 100.0
    box.start(box.prepare(at(4)), T)
    box.configure({"speed": 2.0})
    assert box.register(box.prepare(at(5))).T_odom_sensor[0, 3] == 102.0
    assert made[1].seen == [4, 5]


def test_registrations_keep_their_word():
    make, _ = makes()
    for box in (
        HandOver(make, {"speed": 1.0}, every(3.0)),
        Bank(make, [{"speed": 1.0}], every(3.0)),
    ):
        box.start(box.prepare(at(3)), np.eye(4))
        assert not box.register(box.prepare(at(4))).registered
        assert box.register(box.prepare(at(5))).registered


def test_the_mean_of_all_motions_is_taken_by_their_weights():
    make, made = makes()
    box = Bank(make, [{"speed": 1.0}, {"speed": 1.05}, {"speed": 1.09}], every(3.0), 0.1)
    x = x_of(box, range(5), {2: {"speed": 1.09}})
    np.testing.assert_allclose(np.diff(x), [1.0, 1.09, 1.09, 1.09])
    box.weigh((0.5, 0.0, 0.5))
    np.testing.assert_allclose(np.diff([x[-1], *x_on(box, range(5, 8))]), 1.045)
    box.weigh((0.0, 0.0, 0.0))
    np.testing.assert_allclose(np.diff(x_on(box, range(8, 10))), (1.0 + 1.05 + 1.09) / 3)
    assert box.restarts == 0
    assert len(made) == 3


def test_a_lost_one_is_left_out_and_started_anew():
    make, made = makes({1.0: {5: 4.0}})
    box = Bank(make, [{"speed": 1.0}, {"speed": 1.02}, {"speed": 1.06}], every(2.0), 0.1)
    box.weigh((0.4, 0.3, 0.3))
    x = x_of(box, range(9))
    mean = 0.4 + 0.3 * 1.02 + 0.3 * 1.06
    np.testing.assert_allclose(np.diff(x), [mean] * 4 + [4.0] + [mean] * 3)
    assert box.restarts == 0  # The first is trusted more than its weight says, ...
    make, made = makes({1.02: {5: 4.0}})
    box = Bank(make, [{"speed": 1.0}, {"speed": 1.02}, {"speed": 1.06}], every(2.0), 0.1)
    box.weigh((0.4, 0.3, 0.3))
    x = x_of(box, range(9))
    rest = (0.4 + 0.3 * 1.06) / 0.7  # ... and two are more than one.
    np.testing.assert_allclose(np.diff(x), [mean] * 4 + [rest] + [mean] * 3)
    assert box.restarts == 1
    # Scans 3, 4 and 5 lie within two seconds.
    assert [second for second, _ in made[1].starts] == [0, 3]
    assert made[1].seen[-7:] == [5, 3, 4, 5, 6, 7, 8]


def test_where_two_disagree_the_heavier_is_believed_and_the_first_more():
    make, _ = makes()
    box = Bank(make, [{"speed": 1.0}, {"speed": 3.0}], every(2.0), 0.1)
    assert x_of(box, range(5), {3: {"speed": 3.0}}) == [0, 1, 2, 5, 8]
    for heavy, step, seconds in ((0.6, 1.0, range(5, 8)), (0.7, 3.0, range(8, 11))):
        box.weigh((1.0 - heavy, heavy))
        np.testing.assert_allclose(np.diff(x_on(box, seconds)), step)
    assert box.restarts == 0


@pytest.mark.parametrize("chosen", [1.0, 3.0])
def test_no_pose_is_worse_than_any(chosen):
    make, _ = makes({1.0: {3: np.nan}})
    box = Bank(make, [{"speed": 1.0}, {"speed": 3.0}], every(2.0), 0.1)
    x = x_of(box, range(6), {0: {"speed": chosen}})
    assert np.diff(x).tolist() == [chosen, chosen, 3.0, chosen, chosen]
    assert box.restarts == 1


def test_no_pose_at_all_is_told():
    make, _ = makes({s: {3: np.nan} for s in (1.0, 3.0)})
    box = Bank(make, [{"speed": 1.0}, {"speed": 3.0}], every(2.0), 0.1)
    x = x_of(box, range(4))
    assert np.isnan(x[3])
    # The caller starts it anew.
    T = np.eye(4)
    T[0, 3] = 7.0
    box.start(box.prepare(at(3)), T)
    assert box.register(box.prepare(at(4))).T_odom_sensor[0, 3] == 8.0


def test_a_bank_has_no_other_sets():
    make, _ = makes()
    with pytest.raises(OdometryError, match="no instance of the bank has the parameters"):
        Bank(make, [{"speed": 1.0}], every(1.0)).configure({"speed": 2.0})


def drive(box, switch=None, n=30):
    poses = [np.eye(4)]
    for i in range(n):
        if switch and i and i % 5 == 0:
            box.configure(switch[i // 5 % len(switch)])
        prepared = box.prepare(turns.turn(i % 15))
        if i == 0:
            box.start(prepared, np.eye(4))
        else:
            poses.append(box.register(prepared).T_odom_sensor)
    return np.array(poses)


def test_a_bank_of_equal_instances_is_the_single_run():
    bank = Bank(lambda _: KeyframeGicp(NEAR), [NEAR, FAR], warm_up=every(1.0))
    switched = drive(bank, [NEAR, FAR], n=15)
    np.testing.assert_allclose(switched, drive(KeyframeGicp(NEAR), n=15), atol=1e-12)


def test_a_bank_in_other_processes_is_the_same():
    def elsewhere(parameters):
        return Isolated("gicp", parameters, Settings(), Limits())

    a, b = (
        drive(Bank(make, [NEAR, FAR], every(0.5)), [NEAR, FAR], 15)
        for make in (KeyframeGicp, elsewhere)
    )
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("mechanism", ["hand_over", "bank"])
def test_real_odometries_go_straight_on(mechanism):
    if mechanism == "bank":
        box = Bank(
            KeyframeGicp, [NEAR, FAR, {**NEAR, "keyframe_interval": 2.0}], warm_up=every(0.5)
        )
    else:
        box = HandOver(KeyframeGicp, NEAR, warm_up=every(0.5))
    poses = drive(box, [FAR, NEAR], n=15)
    steps = invert(poses[:-1]) @ poses[1:]
    np.testing.assert_allclose(steps[:, 0, 3], turns.STEP, atol=0.05)
    np.testing.assert_allclose(steps[:, 1:3, 3], 0.0, atol=0.05)
