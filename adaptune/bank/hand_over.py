"""Hand-over: other parameters on the way, for odometries that read them only when they begin."""

import numpy as np

from adaptune.bank.bank import Make, RecentScans, Successor
from adaptune.geometry import Poses, invert, rectify
from adaptune.odometry.base import (
    LastMotion,
    Motions,
    OdometryInstance,
    Preparations,
    PreparedScan,
    Registration,
    Usage,
    WarmUp,
)
from adaptune.recording.scan import Scan
from adaptune.selection import Selection
from adaptune.space import ParameterSet


class HandOver(OdometryInstance):
    """An odometry that a new instance replaces when its parameters change.

    The new instance first sees the scans of the last seconds, from the pose and the motion that
    were found for the first of them. Then its motions continue the trajectory: no pose jumps. Its
    map is as old as the warm-up is long. One that a fault ends on the way is dropped, and the old
    instance goes on until other parameters are selected.

    Parameters
    ----------
    make
        Makes instances.
    parameters
        The first parameters.
    warm_up
        Which scans a new instance sees.
    catch_up_scans
        How many of them it sees with every new scan, while the old instance still gives the poses;
        at least two. With 0 it sees all at once, and the next scan waits.
    """

    def __init__(
        self, make: Make, parameters: ParameterSet, warm_up: WarmUp, catch_up_scans: int = 0
    ):
        self.parameters = dict(parameters)
        self._make = make
        self._catch_up_scans = catch_up_scans
        self._current = make(self.parameters)
        self._preparations = Preparations()
        self._recent = RecentScans(warm_up)
        self._current_parameters = self.parameters
        self._successor: Successor | None = None
        self._T_odom_own = np.eye(4)
        self._ended_faults: list[str] = []
        self._ended_usage = Usage(0.0, None)
        self._last_motion = LastMotion()

    @property
    def faults(self) -> list[str]:
        return [*self._ended_faults, *(fault for one in self._instances for fault in one.faults)]

    @property
    def usage(self) -> Usage:
        return Usage.total([self._ended_usage, *(one.usage for one in self._instances)], max)

    @property
    def motions(self) -> Motions:
        return self._last_motion.motions

    @property
    def _instances(self) -> list[OdometryInstance]:
        return [self._current, *([self._successor.odometry] if self._successor else [])]

    def prepare(self, scan: Scan) -> PreparedScan:
        prepared = self._preparations.of(scan)
        prepared.by(self._current)
        return prepared

    def start(
        self, prepared: PreparedScan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        # A successor that is being warmed up takes over.
        if self._successor is not None:
            self._replace(self._successor.odometry)
        self._current.start(prepared.by(self._current), T_odom_sensor, T_previous_current)
        self._T_odom_own = np.eye(4)
        self._recent.start(prepared, T_odom_sensor, T_previous_current)
        self._last_motion.start(T_odom_sensor, T_previous_current)

    def submit(self, prepared: PreparedScan) -> None:
        self._submitted = prepared
        self._current.submit(prepared.by(self._current))

    def collect(self) -> Registration:
        successor = self._successor
        # An instance in another process registers the new scan meanwhile.
        if successor is not None:
            successor.catch_up(self._catch_up_scans - 1)
        T_own_sensor, registered = self._current.collect()
        T_odom_sensor = self._T_odom_own @ T_own_sensor
        self._last_motion.move(T_odom_sensor)
        if np.isfinite(T_odom_sensor).all():
            self._recent.add(self._submitted, T_odom_sensor)
            if successor is not None:
                successor.waiting.append(self._recent.last)
                successor.catch_up(1)
                if not successor.waiting:
                    self._take_over(successor)
        return Registration(T_odom_sensor, registered)

    def apply(self, selection: Selection) -> None:
        # Nothing changes if the instance has or will have these parameters.
        wanted = dict(selection.parameters)
        if wanted == self.parameters:
            return
        self.parameters = wanted
        if self._successor is not None:
            self._end(self._successor.odometry)
            self._successor = None
        if wanted == self._current_parameters:
            return
        instance = self._make(wanted)
        if not self._recent:
            self._replace(instance)
            return
        self._successor = self._recent.replay_to(instance)
        if not self._catch_up_scans:
            self._successor.catch_up()
            self._take_over(self._successor)

    def close(self) -> None:
        for instance in self._instances:
            instance.close()

    def _take_over(self, successor: Successor) -> None:
        if successor.odometry.ended and not self._current.ended:
            self._end(successor.odometry)
            self._successor = None
            return
        self._replace(successor.odometry)
        T_odom_sensor, T_own_sensor = self._recent.last.T_odom_sensor, successor.T_own_sensor
        # Exactly the identity where both are the same.
        self._T_odom_own = np.eye(4)
        if not np.array_equal(T_odom_sensor, T_own_sensor):
            self._T_odom_own = rectify(T_odom_sensor @ invert(T_own_sensor))

    def _replace(self, instance: OdometryInstance) -> None:
        self._end(self._current)
        self._current, self._current_parameters = instance, self.parameters
        self._successor = None

    def _end(self, instance: OdometryInstance) -> None:
        instance.close()
        self._ended_faults += instance.faults
        self._ended_usage = Usage.total([self._ended_usage, instance.usage], max)
