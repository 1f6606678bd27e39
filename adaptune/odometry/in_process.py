"""An odometry in this process, as an instance that can be driven."""

import time
from collections.abc import Hashable, Sequence
from typing import Any

from adaptune.geometry import Poses
from adaptune.odometry.base import (
    LastMotion,
    Motions,
    Odometry,
    OdometryInstance,
    Registration,
    Usage,
)
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan


class InProcess(OdometryInstance):
    """Runs an adapter in this process, and records its motion and its CPU time.

    Parameters
    ----------
    odometry
        The adapter, which nothing else may use.
    """

    faults: Sequence[str] = ()

    def __init__(self, odometry: Odometry):
        self.odometry = odometry
        self._cpu = 0.0
        self._last_motion = LastMotion()

    @property
    def usage(self) -> Usage:
        """CPU time of the registrations; the memory is that of this process."""
        return Usage(self._cpu, None)

    @property
    def motions(self) -> Motions:
        return self._last_motion.motions

    @property
    def preparation(self) -> Hashable:
        return self.odometry.preparation

    def prepare(self, scan: Scan) -> Any:
        return self.odometry.prepare(scan)

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self.odometry.start(prepared, T_odom_sensor, T_previous_current)
        self._last_motion.start(T_odom_sensor, T_previous_current)

    def submit(self, prepared: Any) -> None:
        self._submitted = prepared

    def collect(self) -> Registration:
        begin = time.process_time()
        registration = Registration(*self.odometry.register(self._submitted))
        self._cpu += time.process_time() - begin
        self._last_motion.move(registration.T_odom_sensor)
        return registration

    def apply(self, selection: Selection) -> None:
        self.odometry.configure(selection.parameters)

    def close(self) -> None:
        pass  # there is no other process
