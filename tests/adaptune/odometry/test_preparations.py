import numpy as np
import pytest

from adaptune.odometry.base import InProcess, Odometry, Preparations, Registration
from adaptune.odometry.keyframe import KeyframeGicp, KeyframeNdt, KeyframeSettings, KeyframeVgicp
from adaptune.recording.scan import Scan
from adaptune.space import Float, ParameterSpace


class Cell(Odometry):
    """Prepares scans by a parameter, and refuses those that were prepared by another value."""

    space = ParameterSpace({"cell": Float(low=0.0, high=9.0, baseline=1.0)})
    live = clean = True
    count = 0

    @property
    def preparation(self):
        return type(self), self.parameters["cell"]

    def prepare(self, scan):
        Cell.count += 1
        return scan.stamp, self.parameters["cell"]

    def start(self, prepared, T_odom_sensor, _T_previous_current=None):
        self.T = np.array(T_odom_sensor)
        assert prepared[1] == self.parameters["cell"]

    def register(self, prepared):
        assert prepared[1] == self.parameters["cell"]
        self.T[0, 3] += 0.1
        return Registration(self.T.copy(), True)


@pytest.fixture(autouse=True)
def count():
    Cell.count = 0


def cell(value):
    return InProcess(Cell({"cell": value}))


def scan(i):
    return Scan(i * 10**8, np.ones((30, 3), np.float32))


def test_a_scan_is_prepared_once_for_all_that_are_alike():
    one, alike, other = cell(1.0), cell(1.0), cell(2.0)
    shared = Preparations().of(scan(3))
    assert shared.by(one) is shared.by(alike)
    assert shared.by(other) == (3 * 10**8, 2.0)
    assert Cell.count == 2
    assert shared.stamp == 3 * 10**8


def test_gicp_and_vgicp_share_clouds_of_the_same_downsampling():
    fine = {"downsampling": 0.25}
    assert KeyframeGicp(fine).preparation == KeyframeVgicp(fine).preparation
    assert KeyframeGicp(fine).preparation != KeyframeGicp().preparation
    assert KeyframeGicp(fine).preparation != KeyframeNdt(fine).preparation
    near = KeyframeSettings(min_range=2.0)
    assert KeyframeGicp(fine).preparation != KeyframeGicp(fine, near).preparation
    # The number of iterations does not matter.
    assert KeyframeGicp({"iterations": 5}).preparation == KeyframeGicp().preparation
