"""Odometries that go wrong in the way, and at the scan, that they are told to."""

import ctypes
import os
import sys
import time
from pathlib import Path

import numpy as np

from adaptune.odometry import BaseSettings, Odometry, Registration
from adaptune.space import Float, ParameterSpace

WRONG = {"nothing": None, "text": ("left", 1)}
"""What is no registration."""
ELSEWHERE = ("init", "prepare", "start", *WRONG, "hangs in init")
"""Faults that do not happen at the scan."""
n_instances = 0


class Settings(BaseSettings):
    fault: str = "none"
    at: int = 300_000_000
    once: str = ""  # a file; it goes wrong only where it is not there yet
    step: float = 0.3
    axis: int = 0


class Faulty(Odometry):
    """Drives 0.1 m along x with every scan."""

    space = ParameterSpace({"x": Float(low=0.0, high=1.0, baseline=0.5)})
    settings_type = Settings
    live, warm_up = True, 1.5  # seconds

    def __init__(self, *args):
        global n_instances  # noqa: PLW0603
        super().__init__(*args)
        n_instances += 1
        self.raise_in("init")
        if self.settings.fault == "hangs in init":
            time.sleep(60)

    def raise_in(self, where):
        if self.settings.fault == where:
            raise RuntimeError(f"no planes in {where}")

    def prepare(self, scan):
        self.raise_in("prepare")
        if self.settings.fault == "leaves":
            os._exit(3)
        return scan

    def start(self, _prepared, T_odom_sensor, _motion=None):
        self.T = T_odom_sensor
        self.raise_in("start")
        if self.settings.fault == "never begins":
            os.abort()

    def register(self, prepared):
        self.raise_in("register")
        self.T = self.moved()
        T = self.T.copy()
        if prepared.stamp == self.settings.at and self.is_due():
            os.write(1, b"about to go wrong\n")
            self.go_wrong(T)
        if self.settings.fault in WRONG:
            return WRONG[self.settings.fault]
        if self.settings.fault == "shape":
            T = T[:3]
        return Registration(T, n_instances == 1)

    def is_due(self):
        if not self.settings.once:
            return True
        try:
            Path(self.settings.once).touch(exist_ok=False)
        except FileExistsError:
            return False
        return True

    def moved(self):
        T = self.T.copy()
        T[0, 3] += 0.1 if self.parameters["x"] < 0.9 else 0.3
        return T

    def go_wrong(self, T):
        match self.settings.fault:
            case "abort":
                os.abort()
            case "segmentation fault":
                ctypes.string_at(0)
            case "exit":
                sys.exit(0)
            case "raise":
                raise RuntimeError("no planes here")
            case "hang":
                time.sleep(60)
            case "memory":
                np.ones(1 << 30)
            case wrong:
                spoil(T, wrong)


def spoil(T, fault):
    """Make a pose wrong."""
    match fault:
        case "NaN":
            T[0, 3] = np.nan
        case "not rigid":
            T[:3, :3] *= 1.1
        case "transposed":
            T[:] = T.T.copy()
        case "mirrored":
            T[2, 2] = -1.0


class Clean(Faulty):
    """Says that no scan ends its process."""

    clean = True


class Stumbling(Faulty):
    """Goes `step` along an axis with every scan.

    Errs by a fifth. With a large `x` it is right, but at the tenth scan it slows down, and never
    finds its way again.
    """

    live, clean = False, True
    scan, lost = 0, 0

    def start(self, *given):
        self.lost = 0
        super().start(*given)

    def register(self, prepared):
        found = super().register(prepared)
        return found and Registration(found.T_odom_sensor)

    def moved(self):
        self.scan += 1
        T, step = self.T.copy(), self.settings.step
        if self.parameters["x"] <= 0.6:
            step *= 0.8
        elif self.lost or self.scan == 10:
            self.lost += 1
            step = max(step - 0.15 * self.lost, -0.05)
        T[self.settings.axis, 3] += step
        return T


class Apart(Stumbling):
    """The same in a process of its own."""

    clean = False


class Inertial(Clean):
    needs_imu = True
