"""The consensus: several odometries side by side, and the motion on which they agree."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from adaptune.bank.bank import Bank
from adaptune.geometry import Poses
from adaptune.odometry.base import InProcess
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.tracker import WARM_UP, Tracker
from adaptune.recording.scan import Scan
from adaptune.space import ParameterSet, Selection

POOL: tuple[tuple[str, Mapping[str, float]], ...] = (
    ("gicp", {"max_correspondence_distance": 2.2, "keyframe_interval": 1.3}),
    ("gicp", {"max_correspondence_distance": 1.3, "keyframe_interval": 3.1}),
    ("gicp", {"max_correspondence_distance": 4.5, "keyframe_interval": 5.3}),
    ("vgicp", {"resolution": 0.9, "keyframe_interval": 1.7}),
    ("vgicp", {"resolution": 1.8, "keyframe_interval": 3.7}),
)
"""Odometries and their parameters. No study's trials are among them: the reference that judges an
odometry is not made with it."""
HALVES = ((0, 1, 2), (3, 4))
"""Members of either half, which have no algorithm in common."""
_DOWNSAMPLING = 0.45
"""Metres between points of their clouds."""


class Consensus:
    """Runs the pool scan after scan.

    A bank of even weights: members that agree move it by their mean, others are warmed up on the
    last scans at its pose.
    """

    n_members = len(POOL)

    def __init__(self) -> None:
        def make(parameters: Mapping[str, Any]) -> InProcess:
            kind, given = POOL[int(parameters["number"])]
            cls: Any = odometry_class(kind)
            return InProcess(cls(dict(given), cls.settings_type(downsampling=_DOWNSAMPLING)))

        sets: dict[int, ParameterSet] = {n: {"number": n} for n in range(len(POOL))}
        self._bank = Bank(make, sets, WARM_UP)
        even = dict.fromkeys(sets, 1.0)
        self._bank.apply(Selection(trial=0, parameters={}, weights=even))
        self._tracker = Tracker(self._bank, HealthCheck())

    def register(self, scan: Scan) -> tuple[Poses, Poses]:
        """Register the next scan.

        Returns the consensus's pose, of shape (4, 4), and the motions of the members, of shape
        (n_members, 4, 4), NaN where one has none.
        """
        found = self._tracker.register(scan)
        members = self._bank.motions.members
        T_previous_current = np.array([members[i] for i in range(len(POOL))])
        return found.T_odom_sensor, T_previous_current
