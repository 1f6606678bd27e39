"""Motion within a scan, and what it tells: undo it, and find how far two clocks are apart."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.geometry import Poses
from adaptune.recording.scan import Scan
from adaptune.trajectory import Trajectory

# Rotation changes slowly: between these many moments of a scan it is taken as constant.
_SWEEP_MOMENTS = 64
# Metres: cells and search radius for the registration of a scan with its neighbour.
_CELL, _REACH = 0.5, 2.0
_FEWEST = 20  # small_gicp crashes on an empty target
_FAR = 1.0  # seconds; the mean velocity between scans further apart is not that of either


def compensate(scan: Scan, T_start_end: Poses, duration: float) -> Scan:
    """Undo a motion of constant velocity: the points as seen from the sensor at the scan's stamp.

    `T_start_end` is the sensor's pose `duration` seconds later, seen from there. Afterwards all
    points have the time 0. A scan whose points have no times is returned as it is.
    """
    if scan.times is None or not len(scan):
        return scan
    from scipy.spatial.transform import Rotation

    twist = Rotation.from_matrix(T_start_end[:3, :3]).as_rotvec() / duration
    velocity = T_start_end[:3, 3] / duration
    moments = np.linspace(0.0, max(float(scan.times.max()), 1e-9), _SWEEP_MOMENTS)
    matrices = Rotation.from_rotvec(moments[:, None] * twist).as_matrix().astype(np.float32)
    # The rotation of a point is looked up on a grid fine enough that the step between neighbours,
    # a 64th of the scan's rotation, is met by interpolating the rotated points linearly.
    place = np.clip(scan.times / np.float32(moments[1]), 0, _SWEEP_MOMENTS - 1)
    low = np.minimum(place.astype(np.intp), _SWEEP_MOMENTS - 2)
    share = (place - low).astype(np.float32)[:, None]
    before = np.einsum("nij,nj->ni", matrices[low], scan.points)
    after = np.einsum("nij,nj->ni", matrices[low + 1], scan.points)
    points = before + share * (after - before)
    points += scan.times[:, None] * velocity.astype(np.float32)
    return replace(scan, points=points, times=np.zeros_like(scan.times))


def neighbour_motions(scans: Iterable[Scan]) -> Iterator[tuple[Scan, Poses | None, float]]:
    """Register each scan with the one read before it (GICP): both are distorted alike.

    Yields each scan, ``T_before_scan`` of shape (4, 4), or None where it is not known, and the
    seconds between their stamps.
    """
    import small_gicp

    before: Any = None
    last, guess = 0, np.eye(4)
    for scan in scans:
        now = None
        if len(scan) >= _FEWEST:
            points = scan.points.astype(np.float64)
            now = small_gicp.preprocess_points(points, downsampling_resolution=_CELL, num_threads=1)
            now = now if now[0].size() >= _FEWEST else None
        seconds = (scan.stamp - last) * 1e-9
        T_before_scan = None
        if before is not None and now is not None and 0 < seconds <= _FAR:
            result = small_gicp.align(
                *(before[0], now[0], before[1]),
                init_T_target_source=guess,
                max_correspondence_distance=_REACH,
                num_threads=1,
            )
            if result.converged and result.num_inliers > now[0].size() / 2:
                T_before_scan = geometry.rectify(result.T_target_source)
        yield scan, T_before_scan, seconds
        guess = np.eye(4) if T_before_scan is None else T_before_scan
        before, last = now, scan.stamp


def compensate_neighbours(scans: Iterable[Scan]) -> Iterator[Scan]:
    """Undo the motion within each scan, as fast as it was since the one read before.

    The motion known last holds for a second. Other scans, such as the first, pass as they are.
    """
    known: tuple[Poses, float, int] | None = None
    for scan, T_before_scan, seconds in neighbour_motions(scans):
        if T_before_scan is not None:
            known = T_before_scan, seconds, scan.stamp
        if known is None or scan.stamp - known[2] > _FAR * 1e9:
            yield scan
        else:
            yield compensate(scan, known[0], known[1])


def turning_of(scans: Iterable[Scan]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """How fast the sensor turned: stamps between scans and radians per second, of shape (n,)."""
    stamps, rates = [], []
    for scan, T_before_scan, seconds in neighbour_motions(scans):
        if T_before_scan is not None:
            stamps.append(scan.stamp - round(seconds * 0.5e9))
            rates.append(float(geometry.rotation_angle(T_before_scan)) / seconds)
    return np.array(stamps, np.int64), np.array(rates, np.float64)


_LEAST_CORRELATION = 0.8  # of two rates of turning that show the same motion
_RATE = 50.0  # samples per second to compare


def clock_offset(
    trajectory: Trajectory, stamps: NDArray[np.int64], turning: NDArray[np.float64]
) -> float | None:
    """Seconds to add to a trajectory's stamps so that it turns as in `turning_of`.

    The rates of turning, which no choice of frames changes, are correlated at every offset at which
    the shorter recording lies at least half inside the other. None if they show other motions.
    """
    if len(trajectory) < 3 or len(stamps) < 3:
        return None
    turned = geometry.rotation_angle(geometry.steps(trajectory.T_world_sensor))
    seconds = np.diff(trajectory.stamps) * 1e-9
    middles = trajectory.seconds[:-1] + seconds / 2
    other = (stamps - stamps[0]) * 1e-9
    # Each is a mean over the time between its samples: it is averaged over the other's too.
    a = _sampled(middles, turned / seconds, float(np.median(np.diff(other))))
    b = _sampled(other, turning, float(np.median(seconds)))
    if min(len(a), len(b)) < 2 * _RATE:
        return None
    coefficients, lags = _correlation(a, b)
    best = int(np.argmax(coefficients))
    if coefficients[best] < _LEAST_CORRELATION:
        return None
    start = (stamps[0] - trajectory.stamps[0]) * 1e-9 - middles[0]
    return float(start + lags[best] / _RATE)


def _sampled(
    seconds: NDArray[np.float64], values: NDArray[np.float64], over: float
) -> NDArray[np.float64]:
    # Ten hours at 50 Hz; anything longer is a stamp gone wrong.
    grid = np.arange(seconds[0], min(seconds[-1], seconds[0] + 36000.0), 1.0 / _RATE)
    window = min(max(round(over * _RATE), 1), max(len(grid), 1))
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
