"""An odometry that does what a script says, and what the tests of banks share."""

import numpy as np

from adaptune.odometry import InProcess, Odometry, Registration
from adaptune.recording import Scan
from adaptune.space import Float, ParameterSpace, Selection


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


def at(second):
    return Scan(round(second * 1e9), np.zeros((0, 3), np.float32))


def selected(what):
    """A selection of parameters, or of a trial."""
    return Selection(0, what) if isinstance(what, dict) else Selection(what, {})


def x_of(odometry, seconds, switches=()):
    """Where an odometry is along x at every scan, with selections applied before some."""
    switches = dict(switches)
    x = []
    for i, second in enumerate(seconds):
        if second in switches:
            odometry.apply(selected(switches[second]))
        prepared = odometry.prepare(at(second))
        if i == 0:
            odometry.start(prepared, np.eye(4))
            x.append(0.0)
        else:
            x.append(float(odometry.register(prepared).T_odom_sensor[0, 3]))
    return x


def x_on(odometry, seconds):
    return [float(odometry.register(odometry.prepare(at(s))).T_odom_sensor[0, 3]) for s in seconds]


def makes(scripts=None):
    made = []

    def make(parameters):
        made.append(Walker(parameters, (scripts or {}).get(parameters["speed"])))
        return InProcess(made[-1])

    return make, made


def kept(make):
    instances = []

    def keep(parameters):
        instances.append(make(parameters))
        return instances[-1]

    return keep, instances
