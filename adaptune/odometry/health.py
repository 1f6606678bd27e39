"""A check of an odometry's poses that needs no reference."""

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from adaptune.geometry import Poses


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
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    max_speed: float = Field(40.0, gt=0)
    max_acceleration: float = Field(30.0, gt=0)
    max_turn_rate: float = Field(360.0, gt=0)

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
