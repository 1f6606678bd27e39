"""A check of an odometry's poses that needs no reference."""

from collections import Counter, deque
from statistics import median

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from adaptune.geometry import Poses, invert, rotation_angle, scale
from adaptune.strict import StrictModel

_STILL = 1e-6
"""Metres and radians by which a pose that stays where it is may move."""
_WALK = 0.5
"""Metres a second."""
_INTERVALS = 11
"""Newest intervals between scans whose median is the usual one."""
_MOST_JITTER = 0.5
"""The largest share of an interval that counts as jitter of its stamps."""
_SETTLED = 1.0
"""Seconds after which an odometry knows how fast it is: a recording may begin in motion. KISS-ICP
in a car at 12 m/s moves after half a second, and then catches up for 0.3 s at twice that speed."""
_RECENT = 0.5
"""Seconds of healthy motion whose mean goes on where the odometry restarts: one step is noisy."""
_PATIENCE = 1.0
"""Seconds within which an odometry may take back a jump. A noisy one jumps back and forth, and is
worse off if it is restarted; one that has run away does not come back."""


class HealthCheck(StrictModel):
    """Bounds on a platform's motion.

    An odometry that predicts by constant velocity runs away after a failure and does not come
    back. A step that the platform cannot have made reveals it, unless it is taken back.

    Attributes
    ----------
    max_speed : float
        Metres a second.
    max_acceleration : float
        Metres a second squared, of the step's mean velocity against the last healthy one's;
        generous enough for the noise of two differentiations. Irregular stamps widen it. What
        counts is the mean velocity over up to a second: what is taken back within it does not. In
        the first second of a recording it does not count.
    max_turn_rate : float
        Degrees a second.
    max_freeze : float
        Seconds for which the pose may stay where it is to the micrometre, after a step faster than
        half a metre a second. A robot slows down before it stops, and the noise of its scans moves
        the pose: only an odometry that has given up stops dead.
    max_unregistered : int
        Scans in a row that the odometry reports as not registered.
    """

    max_speed: float = Field(40.0, gt=0, le=1e9)
    max_acceleration: float = Field(30.0, gt=0, le=1e9)
    max_turn_rate: float = Field(360.0, gt=0, le=1e9)
    max_freeze: float = Field(1.0, gt=0, le=1e9)
    max_unregistered: int = Field(10, ge=1, le=10**9)

    def exceeded(
        self,
        velocity: Poses,
        last_velocity: Poses | None,
        elapsed: float,
        turn_rate: float = 0.0,
        stamp_noise: float = 0.0,
    ) -> str | None:
        """The bound that this motion exceeds, if any.

        Parameters
        ----------
        velocity
            Metres a second in the sensor's frame, of shape (3,).
        last_velocity
            The last healthy one; None if there is none yet.
        elapsed
            Seconds since `last_velocity`.
        turn_rate
            Radians a second.
        stamp_noise
            Metres a second by which the change of velocity may come from the stamps.
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

    def still(self, T_previous_current: Poses) -> bool:
        """Whether a pose of shape (4, 4) stays where it is, to the micrometre."""
        moved = np.linalg.norm(T_previous_current[:3, 3])
        return bool(max(moved, rotation_angle(T_previous_current)) < _STILL)

    def frozen(self, seconds: float, speed: float) -> bool:
        """Whether a pose that stands still for `seconds`, after a step at `speed`, has frozen."""
        return speed > _WALK and seconds > self.max_freeze


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

        Parameters
        ----------
        T_previous_current
            The motion, of shape (4, 4); not finite where the odometry gave no pose.
        elapsed
            Seconds that it took.
        registered
            Whether the odometry registered the scan.
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
            while sum(of for _, of in self._recent) - self._recent[0][1] >= _RECENT:
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
        regular 10 Hz. The usual interval, or a multiple of it where scans are missing, is
        then as likely as what the stamps say.
        """
        usual = median(self._intervals)
        turns = max(1, round(elapsed / usual))
        return min(abs(elapsed - turns * usual) / elapsed, _MOST_JITTER)

    def _frozen(self, T_previous_current: Poses, elapsed: float) -> bool:
        if not self._health.still(T_previous_current):
            self._moving, self._still = (T_previous_current, elapsed), 0.0
            return False
        self._still += elapsed
        if self._moving is None:
            return False
        T, seconds = self._moving
        if not self._health.frozen(self._still, float(np.linalg.norm(T[:3, 3])) / seconds):
            return False
        self._healthy, self._still = self._moving, 0.0
        self._recent = deque([self._moving])
        return True

    def go_on(self, elapsed: float) -> tuple[Poses, Poses]:
        """How the last healthy motion goes on.

        Returns
        -------
        T_previous_healthy : ndarray of shape (4, 4)
            From the pose before to where it would have been: takes back a jump of the last scans.
        T_healthy_current : ndarray of shape (4, 4)
            The motion from there, for so many seconds.
        """
        T_previous_current, seconds = np.eye(4), 0.0
        for T, of in self._recent:
            T_previous_current, seconds = T_previous_current @ T, seconds + of
        seconds = seconds or 1.0
        T_way, of_way = self._taken_back
        T_previous_healthy = invert(T_way) @ scale(T_previous_current, of_way / seconds)
        return T_previous_healthy, scale(T_previous_current, elapsed / seconds)


def _velocity(T_previous_current: Poses, seconds: float) -> Poses:
    return T_previous_current[:3, 3] / seconds


def unhealthy(
    check: HealthCheck,
    T_previous_current: Poses,
    stamps: NDArray[np.int64],
    registered: NDArray[np.bool_],
) -> dict[str, int]:
    """How often a `Guard` finds each fault in a trajectory of n poses.

    Parameters
    ----------
    check
        The bounds.
    T_previous_current
        Motions of shape (n - 1, 4, 4).
    stamps, registered
        Of shape (n,); stamps in nanoseconds.
    """
    guard = Guard(check)
    elapsed = (np.diff(stamps) * 1e-9).tolist()
    found = map(guard.check, T_previous_current, elapsed, registered[1:].tolist())
    return dict(Counter(what for what in found if what is not None))
