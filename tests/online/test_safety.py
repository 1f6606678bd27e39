"""What happens where an odometry, a switch or a selection goes wrong."""

import math

import numpy as np
import pytest

from adaptune.bank.bank import Bank
from adaptune.errors import OdometryError
from adaptune.odometry.base import InProcess, Odometry, Registration
from adaptune.odometry.tracker import HealthCheck
from adaptune.recording.scan import Scan
from adaptune.space import Float, ParameterSpace, Selection
from online.replay import replay

TENTH = 10**8
STEP = 0.1


class Cautious(HealthCheck):
    max_acceleration = 20.0


HEALTH = Cautious(max_speed=5.0)
FIXED = Selection(0, {"gain": 1.0})


class Fragile(Odometry):
    """Moves as it should while `gain` is 1, and else as told by a function of stamp and gain."""

    space = ParameterSpace({"gain": Float(low=0.0, high=9.0, baseline=1.0)})
    live, clean = True, True

    def __init__(self, wrong=lambda *_: None, parameters=None, refuses=()):
        super().__init__(parameters)
        self.wrong, self.refuses = wrong, refuses
        self.events = []

    def prepare(self, scan):
        return scan.stamp

    def start(self, prepared, T_odom_sensor, _motion=None):
        self.events.append(("start", round(prepared / TENTH)))
        self.T, self.at = T_odom_sensor, prepared

    def register(self, prepared):
        self.events.append(("register", round(prepared / TENTH)))
        step = STEP * (prepared - self.at) / TENTH
        wrong = self.wrong(round(prepared / TENTH), self.parameters["gain"])
        self.T, self.at = self.T.copy(), prepared
        self.T[0, 3] += step if wrong is None else wrong
        return Registration(self.T, registered=True)

    def configure(self, parameters):
        if parameters["gain"] in self.refuses:
            raise OdometryError("no such gain")
        super().configure(parameters)


class InTurns:
    """Chooses sets in turn."""

    def __init__(self, *gains):
        self.gains, self.n = gains, 0

    def observe(self, *_):
        pass

    def select(self):
        gain = self.gains[min(self.n, len(self.gains) - 1)]
        self.n += 1
        return Selection(round(gain), {"gain": gain})

    def measure(self):
        pass


def scans(n):
    return [Scan(i * TENTH, np.zeros((0, 3), np.float32)) for i in range(n)]


def drive(odometry, selector, n=40, fixed=FIXED):
    return replay(scans(n), InProcess(odometry), HEALTH, selector, what="home", fixed=fixed)


@pytest.mark.parametrize(
    ("wrong", "found"), [(math.nan, "no_pose"), (9.0, "max_speed"), (math.inf, "no_pose")]
)
def test_after_an_impossible_pose_the_fixed_set_is_used_with_a_warm_up(wrong, found, caplog):
    odometry = Fragile(lambda n, gain: wrong if gain == 2.0 and n >= 25 else None)
    result = drive(odometry, InTurns(1.0, 2.0))
    what = f"the health check found {found}"
    applied = [(c.stamp // TENTH, c.selection.trial, c.fallen_back) for c in result.choices]
    assert applied == [(0, 1, ""), (10, 2, ""), (20, 2, ""), (25, 0, what)]
    assert [(c.stamp // TENTH, c.why_not) for c in result.rejected] == [
        (30, "the odometry failed with it")
    ]
    assert f"home: {what} at 2.5 s; the fixed set is used" in caplog.text
    # It saw the last two seconds again, and goes on as if nothing had happened.
    at = odometry.events.index(("start", 4))
    assert odometry.events[at + 1 : at + 22] == [("register", n) for n in range(5, 26)]
    np.testing.assert_allclose(
        result.trajectory.T_world_sensor[:, 0, 3], STEP * np.arange(40), atol=1e-9
    )
    assert result.restarted.sum() == 1


def test_a_set_is_tried_again_after_a_minute():
    odometry = Fragile(lambda n, gain: 9.0 if gain == 2.0 and n == 15 else None)
    result = drive(odometry, InTurns(1.0, 2.0), n=800)
    assert [c.stamp // TENTH for c in result.rejected] == list(range(20, 615, 10))
    assert result.choices[-1].selection.trial == 2


def test_where_the_fixed_set_is_in_use_the_odometry_restarts_as_ever():
    faults = [(Fragile(lambda n, _: 9.0 if n == 25 else None), s) for s in (InTurns(1.0), None)]
    of = [
        drive(odometry, selector, fixed=Selection(1, {"gain": 1.0}))
        for odometry, selector in faults
    ]
    np.testing.assert_array_equal(of[0].trajectory.T_world_sensor, of[1].trajectory.T_world_sensor)
    assert faults[0][0].events == faults[1][0].events
    assert of[0].restarted.sum() == 1


def test_where_the_baseline_has_just_been_taken_the_odometry_restarts_with_it():
    odometry = Fragile(lambda n, _: 9.0 if n == 25 else None)
    fixed = Selection(1, {"gain": 1.0})
    result = drive(odometry, InTurns(1.0, 1.0, 0.0), fixed=fixed)
    assert [(c.selection.trial, c.fallen_back) for c in result.choices][2:] == [(0, "")] * 2
    assert not result.rejected
    assert result.restarted.sum() == 1
    # Later, the fault is its own.
    odometry = Fragile(lambda n, gain: 9.0 if n == 25 and gain == 0.0 else None)
    result = drive(odometry, InTurns(0.0), fixed=fixed)
    assert result.choices[-1].fallen_back == "the health check found max_speed"
    assert [c.why_not for c in result.rejected] == ["the odometry failed with it"]


def test_where_the_warm_up_fails_too_it_begins_without_a_past():
    odometry = Fragile(lambda n, _: 9.0 if n == 25 else None)
    result = drive(odometry, InTurns(1.0, 2.0))
    assert odometry.events.count(("start", 4)) == odometry.events.count(("start", 25)) == 1
    np.testing.assert_allclose(
        result.trajectory.T_world_sensor[:, 0, 3], STEP * np.arange(40), atol=1e-9
    )


def test_a_switch_that_fails_returns_to_the_fixed_set(caplog):
    odometry = Fragile(refuses=(2.0,))
    result = drive(odometry, InTurns(3.0, 2.0, 3.0))
    assert [c.selection.trial for c in result.choices] == [3, 0, 3, 3]
    assert [c.why_not for c in result.rejected] == ["no such gain"]
    assert "home: trial 2 cannot be applied: no such gain at 1.0 s" in caplog.text


def test_where_the_fixed_set_cannot_be_applied_either_the_last_set_stays(caplog):
    odometry = Fragile(refuses=(1.0, 2.0))
    result = drive(odometry, InTurns(3.0, 2.0))
    assert odometry.parameters["gain"] == 3.0
    assert [c.selection.trial for c in result.choices] == [3]
    assert "nor can the fixed set: no such gain" in caplog.text
    assert len(result.trajectory) == 40


def test_without_a_fixed_set_a_switch_that_fails_is_an_error():
    with pytest.raises(OdometryError, match="no such gain"):
        drive(Fragile(refuses=(2.0,)), InTurns(2.0), fixed=None)


def test_a_bank_without_a_pose_gets_the_fixed_weights():
    def make(parameters):
        return InProcess(Fragile(lambda n, _: math.nan if n == 25 else None, parameters))

    bank = Bank(make, {0: {"gain": 1.0}, 2: {"gain": 2.0}}, 1.0)
    half = Selection(2, {"gain": 2.0}, {0: 0.2, 2: 0.8})
    fixed = Selection(0, {"gain": 1.0}, {0: 1.0, 2: 0.0})

    class Half(InTurns):
        def select(self):
            return half

    result = replay(scans(40), bank, HEALTH, Half(), fixed=fixed)
    weights = [(c.stamp // TENTH, c.selection.weights[0]) for c in result.choices]
    # Members stay: those that failed have restarted.
    assert weights == [(0, 0.2), (10, 0.2), (20, 0.2), (25, 1.0), (30, 0.2)]
    np.testing.assert_allclose(
        result.trajectory.T_world_sensor[:, 0, 3], STEP * np.arange(40), atol=1e-9
    )


def test_where_a_bank_that_rests_fails_all_join_in():
    made = []

    def make(parameters):
        one = Fragile(lambda n, gain: 9.0 if n == 25 and gain == 1.0 else None, parameters)
        made.append(one)
        return InProcess(one)

    bank = Bank(make, {0: {"gain": 1.0}, 2: {"gain": 2.0}}, 1.0)
    fixed = Selection(0, {"gain": 1.0}, {0: 1.0, 2: 0.0})

    class Alone(InTurns):
        def select(self):
            return fixed._replace(resting=frozenset({2}))

    result = replay(scans(40), bank, HEALTH, Alone(), what="home", fixed=fixed)
    rested = [(c.stamp // TENTH, bool(c.selection.resting)) for c in result.choices]
    assert rested == [(0, True), (10, True), (20, True), (25, False), (30, True)]
    assert made[1].events[0] == ("start", 4)
    assert made[1].events[-1] == ("register", 29)
    np.testing.assert_allclose(
        result.trajectory.T_world_sensor[:, 0, 3], STEP * np.arange(40), atol=1e-9
    )
