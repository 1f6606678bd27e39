import numpy as np
import pytest
from rooms import moved
from walker import Walker, at, x_on

from adaptune.odometry import InProcess, OdometryError
from adaptune.space import Selection


class Plain(Walker):
    """Returns a tuple of its own, and the same array every time."""

    def start(self, prepared, T_odom_sensor, T_previous_current=None):
        super().start(prepared, T_odom_sensor, T_previous_current)
        self.one = T_odom_sensor.copy()

    def register(self, prepared):
        self.one[:] = super().register(prepared).T_odom_sensor
        return self.one, True


def test_motions_chain_whatever_an_adapter_returns():
    odometry = InProcess(Plain({"speed": 2.0}))
    given = moved(0.5)
    odometry.start(odometry.prepare(at(0)), np.eye(4), given)
    assert odometry.motions.T_previous_current[0, 3] == 0.5
    for second in (1, 2, 3):
        registration = odometry.register(odometry.prepare(at(second)))
        assert registration.registered is True
        assert registration.T_odom_sensor[0, 3] == 2.0 * second
        assert odometry.motions.T_previous_current[0, 3] == 2.0
    assert odometry.motions.members == {}


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
