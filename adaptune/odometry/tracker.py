"""Register scan after scan, and restart the odometry where its motion is not healthy."""

import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from adaptune.geometry import Poses, invert, rectify, rotation_angle
from adaptune.odometry.base import MemberState, Motions, OdometryInstance
from adaptune.odometry.health import Guard, HealthCheck
from adaptune.recording.scan import Scan

RESTART_WARM_UP = 2.0
"""Seconds of scans that an odometry sees again where it restarts with other parameters."""


class RegisteredScan(NamedTuple):
    """What became of a scan."""

    stamp: int
    T_odom_sensor: Poses
    registered: bool
    unhealthy: str | None
    prepare_seconds: float
    register_seconds: float
    begun: bool = True  # False before the odometry's first pose: the scan's is unknown
    states: Mapping[int, MemberState] = {}  # of a bank, see `Motions`


class _Seen(NamedTuple):
    """A scan of the last seconds, with its pose and the motion to it."""

    scan: Scan
    preparation: Hashable
    prepared: Any
    T_odom_sensor: Poses
    T_previous_current: Poses | None


@dataclass
class Tracker:
    """Registers scan after scan, and restarts the odometry where its motion is not healthy."""

    odometry: OdometryInstance
    health: HealthCheck
    # Called with the stamp of a scan and what is wrong, before the odometry restarts. It may
    # change the parameters; if it says that it did, the odometry sees the scans of the last
    # `RESTART_WARM_UP` seconds again. If its motion is still not healthy then, it restarts without
    # a past.
    on_unhealthy: Callable[[int, str], bool] | None = None
    # The pose of the first scan, and the motion that led there; None if the sensor stood still.
    T_odom_start: Poses = field(default_factory=lambda: np.eye(4))
    T_before_start: Poses | None = None
    bare: bool = False  # nothing restarts it
    _last: RegisteredScan | None = field(default=None, init=False)
    # From the pose of the scan before to that of the last one, where the odometry restarted.
    _T_jumped: Poses | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._guard = Guard(self.health)
        self._seen: deque[_Seen] = deque()

    @property
    def motions(self) -> Motions:
        """The odometry's over the last scan; after a restart, from the pose that it had before."""
        motions = self.odometry.motions
        if self._T_jumped is None:
            return motions
        return motions._replace(T_previous_current=self._T_jumped)

    def register(self, scan: Scan) -> RegisteredScan:
        """Find the pose of the next scan."""
        begin = time.perf_counter()
        prepared = self.odometry.prepare(scan)
        seconds = time.perf_counter() - begin
        return self.register_prepared(scan.stamp, prepared, seconds, scan)

    def register_prepared(
        self, stamp: int, prepared: Any, prepare_seconds: float = 0.0, scan: Scan | None = None
    ) -> RegisteredScan:
        """Find the pose of the next prepared scan; a warm-up needs the scan, too."""
        begin = time.perf_counter()
        registered, unhealthy, self._T_jumped = True, None, None
        if self._last is None:
            T_odom_sensor, T_previous_current = self.T_odom_start, self.T_before_start
            self.odometry.start(prepared, T_odom_sensor, T_previous_current)
            states = self.odometry.motions.states
        elif not self._last.begun:
            T_odom_sensor, T_previous_current = self._last.T_odom_sensor, None
            T, registered = self.odometry.register(prepared)
            states = self.odometry.motions.states
            if self.odometry.begun and np.isfinite(T).all():
                T_odom_sensor = T
        else:
            T_odom_previous = self._last.T_odom_sensor
            T_odom_sensor, registered = self.odometry.register(prepared)
            states = self.odometry.motions.states  # before it may restart
            elapsed = (stamp - self._last.stamp) * 1e-9
            with np.errstate(invalid="ignore"):  # the pose may be infinite
                T_previous_current = invert(T_odom_previous) @ T_odom_sensor
            if not self.bare:
                unhealthy = self._guard.check(T_previous_current, elapsed, registered)
            if unhealthy is not None:
                T_previous_healthy, T_healthy = self._guard.go_on(elapsed)
                # The motion was computed from the pose before: their errors of rounding multiply.
                T_odom_sensor = rectify(T_odom_previous @ T_previous_healthy @ T_healthy)
                T_previous_current = T_healthy
                T_warm = None
                if self.on_unhealthy is not None and self.on_unhealthy(stamp, unhealthy):
                    prepared = prepared if scan is None else self.odometry.prepare(scan)
                    T_warm = self._warm_up(prepared, T_healthy, elapsed)
                if T_warm is None:
                    self.odometry.start(prepared, T_odom_sensor, T_healthy)
                else:
                    T_odom_sensor = T_warm
                self._T_jumped = invert(T_odom_previous) @ T_odom_sensor
        if self.on_unhealthy is not None and scan is not None and self.odometry.rewinds:
            self._remember(scan, prepared, T_odom_sensor, T_previous_current)
        seconds, begun = time.perf_counter() - begin, self.odometry.begun
        result = (registered and begun, unhealthy, prepare_seconds, seconds, begun, states)
        self._last = RegisteredScan(stamp, T_odom_sensor, *result)
        return self._last

    def _remember(
        self, scan: Scan, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None
    ) -> None:
        preparation = self.odometry.preparation
        self._seen.append(_Seen(scan, preparation, prepared, T_odom_sensor, T_previous_current))
        while scan.stamp - self._seen[0].scan.stamp > RESTART_WARM_UP * 1e9:
            self._seen.popleft()

    def _warm_up(self, prepared: Any, T_healthy: Poses, elapsed: float) -> Poses | None:
        """Show the odometry the last seconds again; its pose then, None if that is not healthy."""
        if not self._seen:
            return None
        first, *others = self._seen
        start = self._prepared(first), first.T_odom_sensor, first.T_previous_current
        self.odometry.start(*start)
        for seen in others:
            self.odometry.register(self._prepared(seen))
        T_odom_sensor, registered = self.odometry.register(prepared)
        T = self.odometry.motions.T_previous_current
        if not (registered and np.isfinite(T).all() and np.isfinite(T_odom_sensor).all()):
            return None
        velocity, usual = (motion[:3, 3] / elapsed for motion in (T, T_healthy))
        turn_rate = float(rotation_angle(T)) / elapsed
        if self.health.exceeded(velocity, usual, elapsed, turn_rate) is not None:
            return None
        return T_odom_sensor

    def _prepared(self, seen: _Seen) -> Any:
        """A scan of the past, prepared as the odometry takes it now."""
        if seen.preparation == self.odometry.preparation:
            return seen.prepared
        return self.odometry.prepare(seen.scan)
