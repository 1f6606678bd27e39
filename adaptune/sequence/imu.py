"""Measurements of an IMU."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.geometry import Poses
from adaptune.trajectory import Trajectory

_CORRELATION = 0.8
_MEASURED = ("stamps", "angular_velocity", "acceleration")


class ImuNoise(NamedTuple):
    """White noise and random walk of the biases of an IMU; by default those of a fair MEMS IMU."""

    gyroscope: float = 2e-4  # rad/s for a root hertz
    accelerometer: float = 2e-3  # m/s^2 for a root hertz
    gyroscope_walk: float = 2e-5  # rad/s^2 for a root hertz
    accelerometer_walk: float = 2e-4  # m/s^3 for a root hertz


USUAL = ImuNoise()


@dataclass(frozen=True, eq=False)
class Imu:
    """What an IMU measured, in its own frame.

    Attributes
    ----------
    stamps : ndarray of shape (n,)
        Strictly increasing integer nanoseconds.
    angular_velocity : ndarray of shape (n, 3)
        Radians per second.
    acceleration : ndarray of shape (n, 3)
        Metres per second squared, gravity included.
    T_sensor_imu : ndarray of shape (4, 4)
        The IMU's pose in the LiDAR's frame.
    noise : ImuNoise
    """

    stamps: NDArray[np.int64]
    angular_velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    T_sensor_imu: Poses = field(default_factory=lambda: np.eye(4))
    noise: ImuNoise = USUAL

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def nbytes(self) -> int:
        """Memory that the measurements take, in bytes."""
        return self.stamps.nbytes + self.angular_velocity.nbytes + self.acceleration.nbytes

    def part(self, first: int, last: int) -> "Imu":
        """Measurements from number `first` to before number `last`."""
        return replace(self, **{name: getattr(self, name)[first:last] for name in _MEASURED})


def joined(parts: Sequence[Imu]) -> Imu:
    """Measurements of one IMU, one part after the other."""
    whole: dict[str, Any]
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _MEASURED}
    return replace(parts[0], **whole)


def clock_offset(
    trajectory: Trajectory,
    stamps: NDArray[np.int64],
    turning: NDArray[np.float64],
    rate: float = 50.0,
) -> float | None:
    """Seconds to add to a trajectory's stamps so that it turns when a gyroscope or a LiDAR does.

    The rates of turning, which no choice of frames changes, are correlated at every offset at
    which the shorter recording lies at least half inside the other.

    Parameters
    ----------
    trajectory
        On its own clock.
    stamps, turning
        Nanoseconds on the other clock and radians per second, of shape (n,).
    rate
        Samples per second to compare.

    Returns
    -------
    float or None
        None if the two do not show the same motion.
    """
    if len(trajectory) < 3 or len(stamps) < 3:
        return None
    turned = geometry.rotation_angle(geometry.steps(trajectory.T_world_sensor))
    seconds = np.diff(trajectory.stamps) * 1e-9
    middles = (trajectory.stamps[:-1] - trajectory.stamps[0]) * 1e-9 + seconds / 2
    other = (stamps - stamps[0]) * 1e-9
    # Each is a mean over the time between its samples: it is averaged over the other's too.
    a = _sampled(middles, turned / seconds, rate, float(np.median(np.diff(other))))
    b = _sampled(other, turning, rate, float(np.median(seconds)))
    if min(len(a), len(b)) < 2 * rate:
        return None
    coefficients, lags = _correlation(a, b)
    best = int(np.argmax(coefficients))
    if coefficients[best] < _CORRELATION:
        return None
    start = (stamps[0] - trajectory.stamps[0]) * 1e-9 - middles[0]
    return float(start + lags[best] / rate)


def _sampled(
    seconds: NDArray[np.float64], values: NDArray[np.float64], rate: float, over: float
) -> NDArray[np.float64]:
    # Ten hours at 50 Hz; anything longer is a stamp gone wrong.
    grid = np.arange(seconds[0], min(seconds[-1], seconds[0] + 36000.0), 1.0 / rate)
    window = min(max(round(over * rate), 1), max(len(grid), 1))
    return np.convolve(np.interp(grid, seconds, values), np.ones(window) / window, mode="same")


def _correlation(
    a: NDArray[np.float64], b: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Pearson's coefficient of the overlap of `a`, moved to start at each sample of `b`."""
    from scipy.signal import correlate

    def slide(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(correlate(y, x, mode="full", method="fft"))

    lags = np.arange(-(len(a) - 1), len(b))
    ones_a, ones_b = np.ones_like(a), np.ones_like(b)
    n = np.maximum(slide(ones_a, ones_b).round(), 1.0)
    mean_a, mean_b = slide(a, ones_b) / n, slide(ones_a, b) / n
    covariance = slide(a, b) / n - mean_a * mean_b
    variance_a = slide(a**2, ones_b) / n - mean_a**2
    variance_b = slide(ones_a, b**2) / n - mean_b**2
    scale = np.sqrt(np.maximum(variance_a * variance_b, 1e-18))
    enough = n >= min(len(a), len(b)) / 2
    return np.where(enough, covariance / scale, -1.0), lags
