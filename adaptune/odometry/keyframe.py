"""Odometry that registers each scan to the last keyframe."""

from abc import abstractmethod
from typing import Any, NamedTuple

import numpy as np

from adaptune.geometry import Poses, invert, rectify
from adaptune.odometry.base import Odometry, Registration


class Alignment(NamedTuple):
    """What a registration of two clouds gave; `ok` is False where it cannot be believed."""

    T_target_source: Poses
    ok: bool


class KeyframeOdometry(Odometry):
    """Scan-to-keyframe odometry with a constant-velocity prediction.

    A scan becomes the new keyframe when it lies `keyframe_interval` metres or more from the old
    one. After Koide et al., IROS 2021.
    """

    live = True

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """See `Odometry.start`."""
        self._keyframe = prepared
        self._T_odom_keyframe = T_odom_sensor
        self._T_keyframe_sensor = np.eye(4)
        self._T_previous_current = np.eye(4) if T_previous_current is None else T_previous_current

    def register(self, prepared: Any) -> Registration:
        """See `Odometry.register`."""
        T_keyframe_guess = self._T_keyframe_sensor @ self._T_previous_current
        if not self.usable(prepared):
            self._T_keyframe_sensor = T_keyframe_guess
            return Registration(self._T_odom_keyframe @ T_keyframe_guess, registered=False)
        T_target_source, ok = T_keyframe_guess, False
        if self.usable(self._keyframe):
            T_target_source, ok = self.align(self._keyframe, prepared, T_keyframe_guess)
        if ok and np.isfinite(T_target_source).all():
            T_keyframe_sensor = rectify(T_target_source)
            self._T_previous_current = invert(self._T_keyframe_sensor) @ T_keyframe_sensor
        else:
            T_keyframe_sensor, ok = T_keyframe_guess, False
        self._T_keyframe_sensor = T_keyframe_sensor
        T_odom_sensor = self._T_odom_keyframe @ T_keyframe_sensor
        # What cannot be matched to the keyframe now will not be later, from further away.
        interval = self.parameters["keyframe_interval"]
        if not ok or np.linalg.norm(T_keyframe_sensor[:3, 3]) >= interval:
            self.start(prepared, T_odom_sensor, self._T_previous_current)
        return Registration(T_odom_sensor, ok)

    @abstractmethod
    def usable(self, prepared: Any) -> bool:
        """Whether there is enough in a scan to register it."""

    @abstractmethod
    def align(self, target: Any, source: Any, T_target_guess: Poses) -> Alignment:
        """Register two usable scans."""
