"""Odometries that begin at rest in a frame of their own."""

from abc import abstractmethod
from typing import Any

import numpy as np

from adaptune.geometry import Poses, invert, rectify
from adaptune.odometry.base import Odometry, Registration
from adaptune.odometry.scan_time import START, AtStamp

NO_IMU = "{} needs an IMU, and the scans do not bring along what one measured"


class OwnFrameOdometry(Odometry):
    """An odometry that can begin only at rest, in its own frame, and with a usable scan.

    The first pose that it returns places its frame. Where it returns none, the last motion goes
    on. What `prepare` returns is `usable` or not, and has the scan's `stamp` and `duration` in
    nanoseconds. Poses that belong to a later moment of a scan are carried back to its stamp.
    """

    _share = START
    """Of a scan's duration, after which its pose belongs; it may be set until `_begin` returns."""

    @abstractmethod
    def _begin(self, prepared: Any) -> None:
        """Make a new one for a usable scan, which `_process` receives next."""

    @abstractmethod
    def _process(self, prepared: Any) -> Poses | None:
        """Process a scan, usable or not, and return ``T_own_sensor`` if there is a pose."""

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self._T_odom_sensor = T_odom_sensor
        self._T_previous_current = np.eye(4) if T_previous_current is None else T_previous_current
        self._T_known = T_previous_current
        self._T_odom_own: Poses | None = None
        self._begun = False
        self._correct(prepared)

    def register(self, prepared: Any) -> Registration:
        T_odom_previous = self._T_odom_sensor
        self._T_odom_sensor = T_odom_previous @ self._T_previous_current
        registered = self._correct(prepared)
        if registered:
            self._T_previous_current = rectify(invert(T_odom_previous) @ self._T_odom_sensor)
        return Registration(self._T_odom_sensor, registered)

    def _correct(self, prepared: Any) -> bool:
        """Correct the predicted pose; False if the odometry returned none."""
        if not self._begun:
            if not prepared.usable:
                return False
            self._begin(prepared)
            self._at_stamp = AtStamp(self._share)
            self._begun = True
        T_own_sensor = self._process(prepared)
        if T_own_sensor is None:
            return False
        taken = prepared.stamp, prepared.duration
        if self._T_odom_own is None:
            T_odom_then = self._at_stamp.begin(*taken, self._T_odom_sensor, self._T_known)
            self._T_odom_own = T_odom_then @ invert(T_own_sensor)
            return True
        self._T_odom_sensor = self._at_stamp(*taken, self._T_odom_own @ T_own_sensor)
        return True
