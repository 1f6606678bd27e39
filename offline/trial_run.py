"""Runs of an odometry on frames whose reference is known."""

import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from adaptune.archive import Frames
from adaptune.errors import in_a_line
from adaptune.geometry import Poses, invert, steps
from adaptune.odometry.base import OdometryInstance, UnavailableError, Usage
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.tracker import Tracker
from offline.prepared import SharedScan, SharedScans


class TrialRun:
    """A run of an odometry on a piece of a sequence, from frame `begin` to before `end`.

    An exception of the odometry is a fault, after which there is no pose.
    """

    def __init__(
        self,
        make: Callable[[], OdometryInstance],
        frames: Frames,
        lost_track: float | None,
        begin: int,
        end: int,
    ):
        n = len(frames.stamps)
        self.begin, self.end = begin, end
        self.T_odom_sensor = np.empty((n, 4, 4))
        self.restarted = np.zeros(n, bool)
        self.registered = np.ones(n, bool)
        self.seconds = np.zeros(n)
        self.lost_steps: dict[int, Poses] = {}
        self._make = make
        self._odometry: OdometryInstance | None = None
        self._failure: tuple[str, ...] = ()
        self._T_ref_sensor = frames.T_ref_sensor
        self._T_ref_steps = steps(frames.T_ref_sensor)
        self._bounds = np.diff(frames.stamps) * 1e-9 * (lost_track or np.inf)

    @property
    def faults(self) -> tuple[str, ...]:
        """See `Trial`."""
        return (*(() if self._odometry is None else self._odometry.faults), *self._failure)

    @property
    def usage(self) -> Usage:
        """What the odometry used."""
        return Usage(0.0, None) if self._odometry is None else self._odometry.usage

    def prepare_ms(self, scans: SharedScans) -> float:
        """Mean CPU time that it took to prepare a scan."""
        return 0.0 if self._odometry is None else scans.milliseconds(self._odometry)

    def step(self, i: int, scan: SharedScan) -> None:
        """Register the scan of frame `i`."""
        if not self._failure:
            try:
                self._step(i, scan)
            except UnavailableError:
                raise
            except Exception as error:
                self._failure = (in_a_line(error),)
        if self._failure:
            self._step_without_pose(i)

    def close(self) -> None:
        """End the odometry's processes; what they used stays known."""
        if self._odometry is not None:
            self._odometry.close()

    def _started(self) -> OdometryInstance:
        self._odometry = self._make()
        return self._odometry

    def _step(self, i: int, scan: SharedScan) -> None:
        if i == self.begin:
            T = self._T_ref_sensor[i]
            T = np.eye(4) if np.isnan(T[0, 0]) else T
            odometry = self._started()
            odometry.start(scan.by(odometry), T)
            self.T_odom_sensor[i] = T
            return
        assert self._odometry is not None
        odometry = self._odometry
        prepared = scan.by(odometry)
        begin = time.perf_counter()
        T, self.registered[i] = odometry.register(prepared)
        self.seconds[i] = time.perf_counter() - begin
        finite = np.isfinite(T).all()
        # An odometry without a pose counts as not moved.
        T_step = invert(self.T_odom_sensor[i - 1]) @ T if finite else np.eye(4)
        if self._lost(i, T_step if finite else None):
            self.lost_steps[i] = T_step
            T = self._T_ref_sensor[i]
            odometry.start(prepared, T, self._T_ref_steps[i - 1])
            self.restarted[i] = True
        elif not finite:
            # There is no reference at which to restart.
            T = self.T_odom_sensor[i - 1]
            odometry.start(prepared, T)
        self.T_odom_sensor[i] = T

    def _step_without_pose(self, i: int) -> None:
        self.registered[i] = False
        if self._lost(i, None):
            self.T_odom_sensor[i], self.restarted[i] = self._T_ref_sensor[i], True
            self.lost_steps[i] = np.eye(4)
        else:
            self.T_odom_sensor[i] = np.eye(4) if i == self.begin else self.T_odom_sensor[i - 1]

    def _lost(self, i: int, T_step: Poses | None) -> bool:
        if i == self.begin:
            return False
        T_ref_step = self._T_ref_steps[i - 1]
        if np.isnan(T_ref_step[0, 0]) or np.isinf(self._bounds[i - 1]):
            return False
        if T_step is None:
            return True
        departure = T_step[:3, 3] - T_ref_step[:3, 3]
        return bool(np.linalg.norm(departure) > self._bounds[i - 1])


class DrivenRun(TrialRun):
    """A run from end to end as a replay drives it: with the health check, without reference."""

    def __init__(self, make: Callable[[], OdometryInstance], frames: Frames, health: HealthCheck):
        super().__init__(make, frames, None, 0, len(frames.stamps))
        self.unhealthy = Counter[str]()
        self._stamps, self._health = frames.stamps.tolist(), health

    def _step(self, i: int, scan: SharedScan) -> None:
        if i == 0:
            self._tracker = Tracker(self._started(), self._health)
        prepared = scan.by(self._tracker.odometry)
        found = self._tracker.register_prepared(self._stamps[i], prepared)
        self.T_odom_sensor[i], self.registered[i] = found.T_odom_sensor, found.registered
        self.seconds[i] = found.register_seconds if i else 0.0
        self.unhealthy.update([found.unhealthy] if found.unhealthy else [])

    def _step_without_pose(self, i: int) -> None:
        super()._step_without_pose(i)
        self.unhealthy["no_pose"] += 1
