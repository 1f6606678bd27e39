"""The scans of the last seconds, on which a new instance builds its map before it takes over."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from adaptune.geometry import Poses, invert
from adaptune.odometry.base import OdometryInstance, WarmUp
from adaptune.odometry.preparations import PreparedScan
from adaptune.sequence.imu import Imu, joined
from adaptune.space import ParameterSet

Make = Callable[[ParameterSet], OdometryInstance]
"""Makes a new instance with these parameters."""


class PastScan(NamedTuple):
    """A scan with the pose and the motion that were found for it."""

    scan: PreparedScan
    T_odom_sensor: Poses
    T_previous_current: Poses | None

    @property
    def imu(self) -> Imu | None:
        """What the IMU measured since the scan before."""
        return self.scan.scan.imu


class RecentScans:
    """The scans of the last seconds.

    Parameters
    ----------
    warm_up
        Which of them a new instance sees.
    """

    def __init__(self, warm_up: WarmUp):
        self._warm_up = warm_up
        self._past: deque[PastScan] = deque()
        self._n_dropped = 0

    def __bool__(self) -> bool:
        return bool(self._past)

    def start(self, scan: PreparedScan, T_odom_sensor: Poses, motion: Poses | None) -> None:
        """Forget all scans and begin with this one."""
        self._past, self._n_dropped = deque([PastScan(scan, T_odom_sensor, motion)]), 0

    def add(self, scan: PreparedScan, T_odom_sensor: Poses) -> None:
        """Add the newest scan and drop those that are too old."""
        T_previous_current = invert(self.last.T_odom_sensor) @ T_odom_sensor
        self._past.append(PastScan(scan, T_odom_sensor, T_previous_current))
        while len(self._past) > 1 and self._age(self._past[0]) > self._warm_up.seconds:
            self._past.popleft()
            self._n_dropped += 1

    @property
    def last(self) -> PastScan:
        """The newest scan."""
        return self._past[-1]

    def replay_to(self, odometry: OdometryInstance) -> "Successor":
        """Start an instance with the first of these scans; the others wait for it."""
        _, full_rate, stride = self._warm_up
        seen: list[PastScan] = []
        missed: list[Imu] = []
        for number, past in enumerate(self._past, self._n_dropped):
            if self._age(past) <= full_rate or number % stride == 0:
                seen.append(self._with_imu(past, missed))
                missed = []
            elif seen and past.imu is not None:
                missed.append(past.imu)
        return Successor(odometry, seen)

    def _with_imu(self, past: PastScan, missed: list[Imu]) -> PastScan:
        """A scan with all IMU measurements since the last scan that the instance sees."""
        scan = past.scan.scan
        if not missed or scan.imu is None:
            return past
        joint = replace(scan, imu=joined([*missed, scan.imu]))
        return past._replace(scan=past.scan.with_scan(joint))

    def _age(self, past: PastScan) -> float:
        return (self.last.scan.stamp - past.scan.stamp) * 1e-9


class Successor:
    """A new instance on its way through scans of the past, of which some are still waiting.

    `T_own_sensor`, of shape (4, 4), is its own newest pose.
    """

    def __init__(self, odometry: OdometryInstance, past: Iterable[PastScan]):
        self.odometry = odometry
        self.waiting = deque(past)
        self._start(self.waiting.popleft())

    def catch_up(self, n: int | None = None) -> None:
        """See at most `n` more scans, or all."""
        for _ in range(len(self.waiting) if n is None else n):
            if self.waiting:
                self.submit()
                self.collect()

    def submit(self) -> None:
        """Begin to register the next of the scans that wait."""
        self._submitted = self.waiting.popleft()
        self.odometry.submit(self._submitted.scan.by(self.odometry))

    def collect(self) -> None:
        """Wait for its pose."""
        self.T_own_sensor = self.odometry.collect().T_odom_sensor
        if not np.isfinite(self.T_own_sensor).all():
            # It begins without a past.
            self._start(self.waiting.pop() if self.waiting else self._submitted)
            self.waiting.clear()

    def _start(self, past: PastScan) -> None:
        prepared = past.scan.by(self.odometry)
        self.odometry.start(prepared, past.T_odom_sensor, past.T_previous_current)
        self.T_own_sensor = past.T_odom_sensor


def catch_up_together(successors: Sequence[Successor]) -> None:
    """See all scans that wait; those at the end register while those at the beginning do."""
    while waiting := [one for one in successors if one.waiting]:
        for one in waiting:
            one.submit()
        for one in reversed(waiting):
            one.collect()
