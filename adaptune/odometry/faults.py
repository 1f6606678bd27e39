"""An odometry that may go wrong."""

import logging
from collections.abc import Sequence

import numpy as np

from adaptune.geometry import Poses
from adaptune.odometry.base import WITHOUT_POSE, OdometryInstance, Registration
from adaptune.space import ParameterSet

MOST_FAULTS = 10
"""An instance with so many faults does not start again: the rest of its sequence is lost."""
MAX_SHARE_WITHOUT_POSE = 0.1
"""Share of the scans from which an odometry that gives no pose for them has failed."""
_TOLERANCE = 1e-3  # by how much a rotation times its transpose may differ from the identity

_log = logging.getLogger(__name__)


class Faulting(OdometryInstance):
    """An instance that may go wrong, and notes it."""

    faults: Sequence[str] = ()

    def __init__(self, name: str, parameters: ParameterSet):
        self.name = name
        self.parameters = dict(parameters)

    @property
    def given_up(self) -> bool:
        return len(self.faults) >= MOST_FAULTS

    def note_fault(self, what: str) -> Registration:
        """Note a fault and end; the pose of a scan with a fault."""
        self.close()
        if what not in self.faults:
            _log.warning("%s with %s: %s", self.name, self.parameters, what)
        self.faults = [*self.faults, what]
        if self.given_up:
            _log.warning("%s: fault number %d, it does not start again", self.name, MOST_FAULTS)
        return WITHOUT_POSE


def pose_fault(T_odom_sensor: Poses) -> str | None:
    """What is wrong with a pose, if anything."""
    if T_odom_sensor.shape != (4, 4):
        return f"of shape {T_odom_sensor.shape}"
    if not np.isfinite(T_odom_sensor).all():
        return "that is not finite"
    if np.abs(T_odom_sensor[3] - (0.0, 0.0, 0.0, 1.0)).max() > _TOLERANCE:
        return "that is not rigid: its last row is not 0 0 0 1; is it transposed?"
    R = T_odom_sensor[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(R) < 0:
        return "that is not rigid"
    return None
