"""An odometry that believes its IMU alone."""

import numpy as np

from adaptune.odometry import Odometry, Registration
from adaptune.space import Float, ParameterSpace


class Inertial(Odometry):
    """Moves along x by as many metres as there were measurements since the scan before."""

    space = ParameterSpace({"scale": Float(low=0.0, high=2.0, baseline=1.0)})
    live = False
    needs_imu = True

    def prepare(self, scan):
        return len(scan.imu)

    def start(self, prepared, T_odom_sensor, T_previous_current=None):
        self.T, self.began_with = T_odom_sensor, (prepared, T_previous_current)

    def register(self, prepared):
        step = np.eye(4)
        step[0, 3] = prepared * self.parameters["scale"]
        self.T = self.T @ step
        return Registration(self.T)
