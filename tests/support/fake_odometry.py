"""An odometry that takes no time: the true motion of `drives`, with an error that is its own."""

import zlib

import numpy as np

from adaptune.odometry import Odometry, Registration
from adaptune.odometry.keyframe import KeyframeGicp, KeyframeSettings
from adaptune.space import ParameterSpace

NAME = "fake_odometry:Fake"
SPEED = 3.0
"""Metres a second along x, which is how all drives in `drives` go."""


class Fake(Odometry):
    """Takes the parameters and settings of keyframe GICP.

    The error of a motion grows with `keyframe_interval`, and with the distance from the best
    `max_correspondence_distance`, which changes from scan to scan around 1 m. The errors of two
    sets differ, so that their mean is better than each.
    """

    space = ParameterSpace(
        {
            key: KeyframeGicp.space.parameters[key]
            for key in ("max_correspondence_distance", "keyframe_interval")
        }
    )
    settings_type = KeyframeSettings
    live = True
    clean = True

    def prepare(self, scan):
        return scan

    def start(self, prepared, T_odom_sensor, _motion=None):
        self._stamp, self._T = prepared.stamp, T_odom_sensor

    def register(self, prepared):
        distance, interval = (float(self.parameters[key]) for key in type(self).space.parameters)
        content = zlib.crc32(prepared.points[:64].tobytes())
        off = np.log(distance) + np.sin(content)
        scale = 0.004 + 0.008 * abs(off) + 0.0005 * interval
        rng = np.random.default_rng((content, hash((distance, interval)) & 0xFFFFFFFF))
        step = [1.0, 0.0, 0.0] + scale * rng.normal(0.5 * np.sign(off), 1.0, 3)
        seconds = (prepared.stamp - self._stamp) / 1e9
        self._stamp, self._T = prepared.stamp, self._T.copy()
        self._T[:3, 3] += self._T[:3, :3] @ (SPEED * seconds * step)
        return Registration(self._T, registered=True)

    def configure(self, parameters):
        self.parameters |= parameters
