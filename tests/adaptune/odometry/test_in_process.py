import numpy as np
import pytest
from walker import Walker, at, x_on

from adaptune.bank.bank import Bank
from adaptune.odometry import InProcess, Motions, Odometry, OdometryError, Usage
from adaptune.space import Selection


class Mixed:
    """Methods of an adapter that know nothing of the base class."""

    prepare, start, register = Walker.prepare, Walker.start, Walker.register


class Via(Mixed, Odometry):
    space, live, script = Walker.space, False, {}

    def __init__(self, parameters=None):
        super().__init__(parameters)
        self.seen, self.starts = [], []


class Plain(Walker):
    """Returns a tuple of its own, and the same array every time."""

    def start(self, prepared, T_odom_sensor, T_previous_current=None):
        super().start(prepared, T_odom_sensor, T_previous_current)
        self.one = T_odom_sensor.copy()

    def register(self, prepared):
        self.one[:] = super().register(prepared).T_odom_sensor
        return self.one, True


@pytest.mark.parametrize("adapter", [Via, Plain])
def test_motions_chain_whatever_an_adapter_is_made_of(adapter):
    odometry = InProcess(adapter({"speed": 2.0}))
    given = np.eye(4)
    given[0, 3] = 0.5
    odometry.start(odometry.prepare(at(0)), np.eye(4), given)
    assert odometry.motions.T_previous_current[0, 3] == 0.5
    for second in (1, 2, 3):
        registration = odometry.register(odometry.prepare(at(second)))
        assert registration.registered is True
        assert registration.T_odom_sensor[0, 3] == 2.0 * second
        assert odometry.motions.T_previous_current[0, 3] == 2.0
    assert odometry.motions.members == {}


def test_a_bank_of_adapters_with_a_mixin_moves():
    sets = {4: {"speed": 1.0}, 9: {"speed": 1.05}}
    bank = Bank(lambda parameters: InProcess(Via(parameters)), sets, 2.0, 0.1)
    bank.start(bank.prepare(at(0)), np.eye(4))
    assert x_on(bank, range(1, 4)) == [1.0, 2.0, 3.0]
    moved = {trial: T[0, 3] for trial, T in bank.motions.members.items()}
    assert moved == pytest.approx({4: 1.0, 9: 1.05})


def test_before_the_first_scan_nothing_has_moved():
    odometry = InProcess(Walker({}))
    assert odometry.usage == Usage(0.0, None)
    assert list(odometry.faults) == []
    assert isinstance(odometry.motions, Motions)
    np.testing.assert_array_equal(odometry.motions.T_previous_current, np.eye(4))


def test_no_pose_is_no_motion():
    odometry = InProcess(Walker({}, {2: np.nan}))
    odometry.start(odometry.prepare(at(0)), np.eye(4))
    x_on(odometry, (1, 2))
    assert np.isnan(odometry.motions.T_previous_current[0, 3])
    odometry.start(odometry.prepare(at(2)), np.eye(4))
    np.testing.assert_array_equal(odometry.motions.T_previous_current, np.eye(4))


def test_other_parameters_of_an_adapter_that_is_not_live():
    odometry = InProcess(Walker({}))
    words = "scans: set online.switching.mechanism to bank"
    with pytest.raises(OdometryError, match=words):
        odometry.apply(Selection(0, {"speed": 2.0}))
