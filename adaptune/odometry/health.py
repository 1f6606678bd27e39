"""A check of an odometry's poses that needs no reference."""

from collections import deque
from statistics import median
from typing import ClassVar

import numpy as np
from pydantic import Field

from adaptune._system.strict import StrictModel
from adaptune.geometry import Poses, invert, rotation_angle, scale

_STILL = 1e-6  # metres and radians by which a pose that stays where it is may move
_WALK = 0.5  # metres a second
_INTERVALS = 11  # newest intervals between scans whose median is the usual one
_MOST_JITTER = 0.5  # the largest share of an interval that counts as jitter of its stamps
_SETTLED = 1.0
"""Seconds after which an odometry knows how fast it is: a recording may begin in motion. KISS-ICP
in a car at 12 m/s moves after half a second, and then catches up for 0.3 s at twice that speed."""
_RECENT = 0.5
"""Seconds of healthy motion whose mean goes on where the odometry restarts: one step is noisy."""
_FROZEN_SCANS = 10
"""Scans, at their usual interval, for which a pose may stay where it is, whatever `max_freeze`:
keyframes that come once a second may look alike."""
_PATIENCE = 1.0
"""Seconds within which an odometry may take back a jump. A noisy one jumps back and forth, and is
worse off if it is restarted; one that has run away does not come back."""


class HealthCheck(StrictModel):
    """Bounds on a platform's motion.

    An odometry that predicts by constant velocity runs away after a failure and does not come
    back. A step that the platform cannot have made reveals it, unless it is taken back.
    """

    max_speed: float = Field(40.0, gt=0, le=1e9)  # metres a second

    # Seconds for which the pose may stay where it is to the micrometre, after a step faster than
    # half a metre a second. A robot slows down before it stops, and the noise of its scans moves
    # the pose: only an odometry that has given up stops dead.
    max_freeze: ClassVar[float] = 1.0
    # Metres a second squared, of the step's mean velocity against the last healthy one's; generous
    # enough for the noise of two differentiations. Irregular stamps widen it. What counts is the
    # mean velocity over up to a second: what is taken back within it does not. In the first second
    # of a recording it does not count.
    max_acceleration: ClassVar[float] = 30.0
    # Degrees a second.
    max_turn_rate: ClassVar[float] = 360.0
    # Scans in a row that the odometry reports as not registered.
    max_unregistered: ClassVar[int] = 10

    def exceeded(
        self,
        velocity: Poses,
        last_velocity: Poses | None,
        elapsed: float,
        turn_rate: float = 0.0,
        stamp_noise: float = 0.0,
    ) -> str | None:
        """The bound that this motion exceeds, if any.

        Velocities are in metres a second in the sensor's frame, of shape (3,), the last healthy one
        is None if there is none yet. `elapsed` is in seconds since then, the turn rate in radians a
        second. `stamp_noise` is by how much the stamps may change the velocity.
        """
        if not turn_rate <= np.radians(self.max_turn_rate):
            return "max_turn_rate"
        speed = np.linalg.norm(velocity)
        if not np.isfinite(speed) or speed > self.max_speed:
            return "max_speed"
        if last_velocity is None:
            return None
        change = float(np.linalg.norm(velocity - last_velocity))
        most = self.max_acceleration * elapsed + stamp_noise
        return "max_acceleration" if change > most else None


class Guard:
    """Checks motion after motion, and remembers the last healthy one."""

    def __init__(self, check: HealthCheck):
        self._health = check
        # The last healthy motion, and the last one that was not still, each with its seconds.
        self._healthy: tuple[Poses, float] | None = None
        self._healthy_noise = 0.0
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)
        self._moving: tuple[Poses, float] | None = None
        self._recent: deque[tuple[Poses, float]] = deque()
        self._since = self._still = self._age = 0.0
        self._unregistered = 0
        # The way since the last healthy pose, and its seconds, where a jump may be taken back.
        self._doubtful: tuple[Poses, float] = np.eye(4), 0.0
        self._taken_back = self._doubtful  # at the last fault

    def check(
        self, T_previous_current: Poses, elapsed: float, registered: bool = True
    ) -> str | None:
        """What is wrong with a motion: `no_pose`, or the name of a bound; None if it is healthy.

        The motion, of shape (4, 4), took so many seconds. It is not finite where the odometry gave
        no pose.
        """
        self._since += elapsed
        self._age += elapsed
        self._intervals.append(elapsed)
        self._unregistered = 0 if registered else self._unregistered + 1
        before = self._doubtful
        what = self._fault(T_previous_current, elapsed)
        if what is None and self._unregistered >= self._health.max_unregistered:
            self._unregistered = 0
            what = "max_unregistered"
            # A jump that was taken back just now is none.
            before = before if self._doubtful[1] else self._doubtful
        if what is not None:
            self._taken_back, self._doubtful = before, (np.eye(4), 0.0)
        return what

    def _fault(self, T_previous_current: Poses, elapsed: float) -> str | None:
        """What is wrong with the motion itself."""
        if not np.isfinite(T_previous_current).all():
            return "no_pose"
        turn_rate = float(rotation_angle(T_previous_current)) / elapsed
        velocity = _velocity(T_previous_current, elapsed)
        if (what := self._health.exceeded(velocity, None, elapsed, turn_rate)) is not None:
            return what
        if self._frozen(T_previous_current, elapsed):
            return "max_freeze"
        noise = self._jitter(elapsed) * float(np.linalg.norm(velocity))
        T_way, seconds = self._doubtful
        way = T_way @ T_previous_current, seconds + elapsed
        if self._accelerates(way, self._since - seconds, noise):
            # Stamps are not quite even.
            if way[1] >= 0.95 * _PATIENCE:
                return "max_acceleration"
            self._doubtful = way
        else:
            self._healthy, self._healthy_noise, self._since = way, noise, 0.0
            self._recent.append(way)
            while sum(took for _, took in self._recent) - self._recent[0][1] >= _RECENT:
                self._recent.popleft()
            self._doubtful = np.eye(4), 0.0
        return None

    def _accelerates(self, way: tuple[Poses, float], elapsed: float, noise: float) -> bool:
        """Whether no platform goes on like this from the last healthy motion."""
        if self._healthy is None or self._age < _SETTLED:
            return False
        last, noise = _velocity(*self._healthy), noise + self._healthy_noise
        return self._health.exceeded(_velocity(*way), last, elapsed, 0.0, noise) is not None

    def _jitter(self, elapsed: float) -> float:
        """The share of an interval by which its stamps are irregular.

        A recording that stamps scans on arrival says 0.08 s and 0.13 s where a laser turned at a
        regular 10 Hz. The usual interval, or a multiple of it, is then as likely as what they say.
        """
        usual = median(self._intervals)
        turns = max(1, round(elapsed / usual))
        return min(abs(elapsed - turns * usual) / elapsed, _MOST_JITTER)

    def _frozen(self, T_previous_current: Poses, elapsed: float) -> bool:
        """Whether the pose stays where it is for too long, after a step faster than a walk."""
        moved = np.linalg.norm(T_previous_current[:3, 3])
        if max(moved, rotation_angle(T_previous_current)) >= _STILL:
            self._moving, self._still = (T_previous_current, elapsed), 0.0
            return False
        self._still += elapsed
        if self._moving is None:
            return False
        T, seconds = self._moving
        speed = float(np.linalg.norm(T[:3, 3])) / seconds
        most = max(self._health.max_freeze, _FROZEN_SCANS * median(self._intervals))
        if speed <= _WALK or self._still <= most:
            return False
        self._healthy, self._still = self._moving, 0.0
        self._recent = deque([self._moving])
        return True

    def go_on(self, elapsed: float) -> tuple[Poses, Poses]:
        """How the last healthy motion goes on, in two motions of shape (4, 4).

        The first leads from the pose before to where it would have been: it takes back a jump of
        the last scans. The second is the motion from there, for so many seconds.
        """
        T_previous_current, seconds = np.eye(4), 0.0
        for T, step_seconds in self._recent:
            T_previous_current, seconds = T_previous_current @ T, seconds + step_seconds
        seconds = seconds or 1.0
        T_way, of_way = self._taken_back
        T_previous_healthy = invert(T_way) @ scale(T_previous_current, of_way / seconds)
        return T_previous_healthy, scale(T_previous_current, elapsed / seconds)


def _velocity(T_previous_current: Poses, seconds: float) -> Poses:
    return T_previous_current[:3, 3] / seconds
