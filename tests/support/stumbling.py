"""Odometries that know the way, and fail where they are told to."""

import numpy as np

from adaptune.odometry import BaseSettings, Odometry, Registration
from adaptune.space import Float, ParameterSpace


class Settings(BaseSettings):
    fault: str = "none"
    step: float = 0.3
    axis: int = 0


class Stumbling(Odometry):
    """Goes `step` along an axis with every scan; the settings say what goes wrong.

    Errs by a fifth. With a large `x` it is right, but at the tenth scan it slows down, and never
    finds its way again.
    """

    space = ParameterSpace({"x": Float(low=0.0, high=1.0, baseline=0.5)})
    settings_type = Settings
    live, clean = False, True

    def __init__(self, *args):
        super().__init__(*args)
        self.scan, self.lost = 0, 0
        if self.settings.fault == "constructor":
            raise RuntimeError("no licence")

    def prepare(self, scan):
        if self.settings.fault == "prepare":
            raise RuntimeError("no licence")
        return scan

    def start(self, _prepared, T_odom_sensor, _motion=None):
        if self.settings.fault == "start":
            raise RuntimeError("no licence")
        self.T, self.lost = T_odom_sensor, 0

    def register(self, _prepared):
        self.scan += 1
        if self.settings.fault == "register":
            raise RuntimeError("no licence")
        if self.settings.fault == "nothing":
            return None
        T = self.T.copy()
        if self.settings.fault == "NaN":
            T[:] = np.nan
        step = self.settings.step * (1.0 if self.parameters["x"] > 0.6 else 0.8)
        if self.parameters["x"] > 0.6 and (self.lost or self.scan == 10):
            self.lost += 1
            step = max(step - 0.15 * self.lost, -0.05)
        T[self.settings.axis, 3] += step
        self.T = T
        return Registration(T, registered=True)


class Apart(Stumbling):
    """The same in a process of its own."""

    clean = False
