"""Register scan after scan, and restart the odometry where its motion is not healthy."""

import time
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from adaptune.geometry import Poses, invert, rectify
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.health import Guard, HealthCheck
from adaptune.sequence.scan import Scan


class RegisteredScan(NamedTuple):
    """What became of a scan."""

    stamp: int
    T_odom_sensor: Poses
    registered: bool
    unhealthy: str | None
    prepare_seconds: float
    register_seconds: float


@dataclass
class Tracker:
    """Registers scan after scan, and restarts the odometry where its motion is not healthy."""

    odometry: OdometryInstance  # a new instance
    health: HealthCheck
    _last: RegisteredScan | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._guard = Guard(self.health)

    def register(self, scan: Scan) -> RegisteredScan:
        """Find the pose of the next scan."""
        begin = time.perf_counter()
        prepared = self.odometry.prepare(scan)
        return self.register_prepared(scan.stamp, prepared, time.perf_counter() - begin)

    def register_prepared(
        self, stamp: int, prepared: Any, prepare_seconds: float = 0.0
    ) -> RegisteredScan:
        """Find the pose of the next scan, which such an odometry has prepared."""
        begin = time.perf_counter()
        registered, unhealthy = True, None
        if self._last is None:
            T_odom_sensor = np.eye(4)
            self.odometry.start(prepared, T_odom_sensor)
        else:
            T_odom_previous = self._last.T_odom_sensor
            T_odom_sensor, registered = self.odometry.register(prepared)
            elapsed = (stamp - self._last.stamp) * 1e-9
            with np.errstate(invalid="ignore"):  # the pose may be infinite
                T_previous_current = invert(T_odom_previous) @ T_odom_sensor
            unhealthy = self._guard.check(T_previous_current, elapsed, registered)
            if unhealthy is not None:
                T_previous_healthy, T_healthy = self._guard.go_on(elapsed)
                # The motion was computed from the pose before: their errors of rounding multiply.
                T_odom_sensor = rectify(T_odom_previous @ T_previous_healthy @ T_healthy)
                self.odometry.start(prepared, T_odom_sensor, T_healthy)
        seconds = time.perf_counter() - begin
        self._last = RegisteredScan(
            stamp, T_odom_sensor, registered, unhealthy, prepare_seconds, seconds
        )
        return self._last
