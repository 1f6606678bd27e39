"""An odometry that does what a script says, and what the tests of banks share."""

import numpy as np

from adaptune.odometry import InProcess, Odometry, Registration
from adaptune.recording import Scan
from adaptune.space import Float, ParameterSpace


class Walker(Odometry):
    """Moves by `speed` along x with every scan, where no script says otherwise."""

    space = ParameterSpace({"speed": Float(low=0.0, high=9.0, baseline=1.0)})
    live, warm_up = False, 2.0  # seconds

    def __init__(self, parameters, script=None):
        super().__init__(parameters)
        self.script = script or {}
        self.seen = []
        self.starts = []

    def prepare(self, scan):
        return round(scan.stamp / 1e9)

    def start(self, prepared, T_odom_sensor, _motion=None):
        self.seen.append(prepared)
        self.starts.append((prepared, T_odom_sensor[0, 3]))
        self.T = T_odom_sensor.copy()

    def register(self, prepared):
        self.seen.append(prepared)
        self.T = self.T.copy()
        self.T[0, 3] += self.script.get(prepared, self.parameters["speed"])
        return Registration(self.T, prepared != 4)


def at(second):
    return Scan(round(second * 1e9), np.zeros((0, 3), np.float32))


def x_of(odometry, seconds):
    """Where an odometry that starts at the first scan is along x at every scan."""
    first, *others = seconds
    odometry.start(odometry.prepare(at(first)), np.eye(4))
    return [0.0, *x_on(odometry, others)]


def x_on(odometry, seconds):
    return [float(odometry.register(odometry.prepare(at(s))).T_odom_sensor[0, 3]) for s in seconds]


def makes(scripts=None):
    made = []

    def make(parameters):
        made.append(Walker(parameters, (scripts or {}).get(parameters["speed"])))
        return InProcess(made[-1])

    return make, made
