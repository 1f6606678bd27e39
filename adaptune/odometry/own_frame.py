"""Odometries that begin at rest in a frame of their own, and give poses at other moments.

A scan takes a while. adaptune's poses belong to its stamp, the start. An odometry that deskews
gives the pose at the end, where its newest point was measured. One that takes a scan as it is
gives, about, the pose at its middle. While the sensor gets faster or slower, motions between
those are not the motions between stamps.
"""

from abc import abstractmethod
from typing import Any

import numpy as np

from adaptune.geometry import Poses, invert, rectify, scale
from adaptune.odometry.base import Odometry, Registration
from adaptune.odometry.faults import pose_fault
from adaptune.recording.scan import Scan

START, MIDDLE, END = 0.0, 0.5, 1.0  # shares of a scan's duration


def duration_of(scan: Scan) -> int:
    """Nanoseconds from a scan's stamp to its last point; 0 if the points' times do not differ."""
    if scan.times is None or not len(scan) or not np.ptp(scan.times):
        return 0
    return scan.span


class AtStamp:
    """Carries an odometry's poses back to the stamps of scans.

    Between two poses of the odometry, the velocity is taken as constant. A pose belongs to the
    moment after this share of a scan's duration.
    """

    def __init__(self, share: float):
        self._share = share
        self._before: tuple[float, Poses] = 0.0, np.eye(4)
        self._begun_at: int | None = None
        self._T_odom_begun = np.eye(4)

    def begin(
        self, stamp: int, duration: int, T_odom_sensor: Poses, T_previous_current: Poses | None
    ) -> Poses:
        """Begin with a scan, and return where the odometry has to believe it is.

        Stamp and duration are in nanoseconds. The motion from the scan before goes on; if it is
        None, the first motion that the odometry finds is taken for that during the first scan.
        """
        then, T_odom_then = stamp + self._share * duration, T_odom_sensor
        self._T_odom_begun = np.eye(4)
        self._begun_at = stamp if T_previous_current is None else None
        if T_previous_current is not None and then > stamp:
            T_odom_then = T_odom_sensor @ scale(T_previous_current, self._share)
        self._before = then, T_odom_then
        return T_odom_then

    def __call__(self, stamp: int, duration: int, T_odom_then: Poses) -> Poses:
        """The pose at a scan's stamp, from the odometry's; a faulty pose is left as it is."""
        if pose_fault(T_odom_then):
            return T_odom_then
        before, T_odom_before = self._before
        then = stamp + self._share * duration
        if self._begun_at is not None:
            if before < then:
                moved = invert(T_odom_before) @ T_odom_then
                missing = scale(moved, (before - self._begun_at) / (then - before))
                self._T_odom_begun = T_odom_before @ missing @ invert(T_odom_before)
                T_odom_before = T_odom_before @ missing
            self._begun_at = None
        T_odom_then = self._T_odom_begun @ T_odom_then
        self._before = then, T_odom_then
        if then == stamp or then <= before:
            return T_odom_then
        moved = invert(T_odom_before) @ T_odom_then
        return np.asarray(T_odom_before @ scale(moved, (stamp - before) / (then - before)))


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
