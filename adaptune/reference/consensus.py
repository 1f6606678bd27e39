"""The consensus: several odometries side by side, and the motion on which they agree."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from adaptune.geometry import Poses
from adaptune.odometry.bank import Bank
from adaptune.odometry.base import Odometry, WarmUp
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.in_process import InProcess
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.tracker import Tracker
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet

POOL: tuple[tuple[str, Mapping[str, float]], ...] = (
    ("gicp", {"max_correspondence_distance": 2.2, "keyframe_interval": 1.3}),
    ("gicp", {"max_correspondence_distance": 1.3, "keyframe_interval": 3.1}),
    ("gicp", {"max_correspondence_distance": 4.5, "keyframe_interval": 5.3}),
    ("vgicp", {"resolution": 0.9, "keyframe_interval": 1.7}),
    ("vgicp", {"resolution": 1.8, "keyframe_interval": 3.7}),
)
"""Odometries and their parameters. No study's trials are among them: the reference that judges an
odometry is not made with it."""
_WARM_UP = 2.0
"""Seconds. Odometries that register to a keyframe have no map to build."""
HALVES = ((0, 1, 2), (3, 4))
"""Members of either half, which have no algorithm in common."""
_SETTINGS: Mapping[str, Mapping[str, float]] = {
    "gicp": {"downsampling": 0.45},
    "vgicp": {"downsampling": 0.45},
}


class Consensus:
    """Runs the pool scan after scan.

    A bank of even weights: members that agree move it by their mean, others are warmed up on the
    last scans at its pose.

    Attributes
    ----------
    n_members : int
        Size of the pool.
    """

    n_members = len(POOL)

    def __init__(self) -> None:
        def adapter(kind: str, parameters: Mapping[str, float]) -> Odometry:
            cls: Any = odometry_class(kind)
            made: Odometry = cls(dict(parameters), cls.settings_type(**_SETTINGS[kind]))
            return made

        def make(parameters: Mapping[str, Any]) -> InProcess:
            return InProcess(adapter(*POOL[int(parameters["number"])]))

        sets: dict[int, ParameterSet] = {n: {"number": n} for n in range(len(POOL))}
        self._bank = Bank(make, sets, WarmUp(seconds=_WARM_UP))
        even = dict.fromkeys(sets, 1.0)
        self._bank.apply(Selection(trial=0, parameters={}, weights=even))
        self._tracker = Tracker(self._bank, HealthCheck())

    def register(self, scan: Scan) -> tuple[Poses, Poses, bool]:
        """Register the next scan.

        Returns
        -------
        T_odom_sensor : ndarray of shape (4, 4)
            Of the consensus.
        T_previous_current : ndarray of shape (n_members, 4, 4)
            Motions of the members; NaN where one has none.
        registered : bool
            False where no member could register the scan.
        """
        found = self._tracker.register(scan)
        members = self._bank.motions.members
        T_previous_current = np.array([members[i] for i in range(self.n_members)])
        return found.T_odom_sensor, T_previous_current, found.registered
