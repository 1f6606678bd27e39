"""A check of an odometry's poses that needs no reference."""

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from adaptune.geometry import Poses, rotation_angle

_STILL = 1e-6
"""Metres and radians by which a pose that stays where it is may move."""
_WALK = 0.5
"""Metres a second."""


class HealthCheck(BaseModel):
    """Bounds on a platform's motion.

    Odometries that predict by constant velocity run away after a failure and do not come back. A
    step that the platform cannot have made shows it.

    Attributes
    ----------
    max_speed : float
        Metres a second.
    max_acceleration : float
        Metres a second squared, of the step's mean velocity against the last healthy one's;
        generous enough for the noise of two differentiations.
    max_turn_rate : float
        Degrees a second.
    max_freeze : float
        Seconds for which the pose may stay where it is to the micrometre, after a step faster than
        half a metre a second. A robot that comes to a stand slows down before, and the noise of
        its scans moves the pose of one that registers them: only an odometry that has given up
        stops dead.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    max_speed: float = Field(40.0, gt=0)
    max_acceleration: float = Field(30.0, gt=0)
    max_turn_rate: float = Field(360.0, gt=0)
    max_freeze: float = Field(1.0, gt=0)

    def healthy(
        self,
        velocity: Poses,
        last_velocity: Poses | None,
        elapsed: float,
        turn_rate: float = 0.0,
    ) -> bool:
        """Whether the platform can have moved like this.

        Parameters
        ----------
        velocity
            Metres a second in the sensor's frame, of shape (3,).
        last_velocity
            The last healthy one; none if there is none yet.
        elapsed
            Seconds since `last_velocity`.
        turn_rate
            Radians a second.
        """
        if not turn_rate <= np.radians(self.max_turn_rate):
            return False
        speed = np.linalg.norm(velocity)
        if not np.isfinite(speed) or speed > self.max_speed:
            return False
        if last_velocity is None:
            return True
        change = float(np.linalg.norm(velocity - last_velocity))
        return change <= self.max_acceleration * elapsed

    def still(self, T_previous_current: Poses) -> bool:
        """Whether a pose of shape (4, 4) stays where it is, to the micrometre."""
        moved = np.linalg.norm(T_previous_current[:3, 3])
        return bool(max(moved, rotation_angle(T_previous_current)) < _STILL)

    def frozen(self, seconds: float, speed: float) -> bool:
        """Whether a pose has frozen, and not come to a stand.

        Parameters
        ----------
        seconds
            For which it has been still.
        speed
            Metres a second, of the last step before.
        """
        return speed > _WALK and seconds > self.max_freeze
