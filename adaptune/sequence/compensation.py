"""Motion compensation: all points of a scan as seen from the sensor's pose at its start."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.geometry import Poses
from adaptune.sequence.imu import Imu
from adaptune.sequence.scan import Scan

# Rotation changes slowly: between these many moments of a scan it is taken as constant.
_MOMENTS = 64
# Metres: cells and search radius for the registration of a scan with its neighbour.
_CELL, _REACH = 0.5, 2.0
# small_gicp crashes on an empty target.
_FEWEST = 20
# Seconds; the mean velocity between scans further apart is not that of either.
_FAR = 1.0


def compensate(scan: Scan, T_start_end: Poses, duration: float) -> Scan:
    """Undo a motion of constant velocity: the points as seen from the sensor at the scan's stamp.

    `T_start_end` is the sensor's pose `duration` seconds after the stamp, seen from where it was at
    the stamp. Afterwards all points have the time 0. A scan whose points have no times is returned
    as it is.
    """
    if scan.times is None or not len(scan):
        return scan
    from scipy.spatial.transform import Rotation

    twist = Rotation.from_matrix(T_start_end[:3, :3]).as_rotvec() / duration
    velocity = T_start_end[:3, 3] / duration
    moments = np.linspace(0.0, max(float(scan.times.max()), 1e-9), _MOMENTS)
    points = _rotate(scan, moments, Rotation.from_rotvec(moments[:, None] * twist))
    points += scan.times[:, None] * velocity.astype(np.float32)
    return replace(scan, points=points, times=np.zeros_like(scan.times))


def neighbour_motions(scans: Iterable[Scan]) -> Iterator[tuple[Scan, Poses | None, float]]:
    """Register each scan with the one read before it (GICP).

    Both were measured in the same motion, so that its distortion hardly matters.

    Yields
    ------
    scan : Scan
    T_before_scan : ndarray of shape (4, 4), or None where it is not known
    seconds : float
        Between their stamps; negative where scans are read backwards.
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
        if before is not None and now is not None and 0 < abs(seconds) <= _FAR:
            options = {"max_correspondence_distance": _REACH, "num_threads": 1}
            result = small_gicp.align(
                before[0], now[0], before[1], init_T_target_source=guess, **options
            )
            if result.converged and result.num_inliers > now[0].size() / 2:
                T_before_scan = geometry.rectify(result.T_target_source)
        yield scan, T_before_scan, seconds
        guess = np.eye(4) if T_before_scan is None else T_before_scan
        before, last = now, scan.stamp


def compensate_neighbours(scans: Iterable[Scan]) -> Iterator[Scan]:
    """Undo the motion within each scan, as fast as it was since the one read before.

    Where that is not known, the motion known last still holds for a second. Other scans, such as
    the first, pass as they are.
    """
    known: tuple[Poses, float, int] | None = None
    for scan, T_before_scan, seconds in neighbour_motions(scans):
        if T_before_scan is not None:
            known = T_before_scan, seconds, scan.stamp
        if known is None or abs(scan.stamp - known[2]) > _FAR * 1e9:
            yield scan
        elif known[1] > 0:
            yield compensate(scan, known[0], known[1])
        else:
            yield compensate(scan, geometry.invert(known[0]), -known[1])


def turning_of(scans: Iterable[Scan]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """How fast the sensor turned: stamps between scans and radians per second, of shape (n,)."""
    stamps, rates = [], []
    for scan, T_before_scan, seconds in neighbour_motions(scans):
        if T_before_scan is not None:
            stamps.append(scan.stamp - round(seconds * 0.5e9))
            rates.append(float(geometry.rotation_angle(T_before_scan)) / seconds)
    return np.array(stamps, np.int64), np.array(rates, np.float64)


def compensate_rotation(scan: Scan, imu: Imu) -> Scan:
    """Undo the rotation that a gyroscope measured during the scan.

    Translation stays. A scan without times, or without measurements around it, is returned as it
    is. Both are on the same clock.
    """
    if scan.times is None or not len(scan):
        return scan
    span = float(scan.times.max())
    first, last = np.searchsorted(imu.stamps, [scan.stamp, scan.stamp + round(span * 1e9)])
    # One measurement before the scan and one after it.
    if first == 0 or last >= len(imu):
        return scan
    part = slice(first - 1, last + 1)
    seconds = (imu.stamps[part] - scan.stamp) * 1e-9
    rates = imu.angular_velocity[part] @ imu.T_sensor_imu[:3, :3].T
    from scipy.spatial.transform import Rotation

    moments = np.linspace(0.0, max(span, 1e-9), _MOMENTS)
    at = np.stack([np.interp(moments, seconds, rates[:, i]) for i in range(3)], axis=1)
    steps = Rotation.from_rotvec((at[1:] + at[:-1]) * 0.5 * np.diff(moments)[:, None])
    rotations = [Rotation.identity()]
    for step in steps:
        rotations.append(rotations[-1] * step)
    return replace(scan, points=_rotate(scan, moments, Rotation.concatenate(rotations)))


def _rotate(scan: Scan, moments: NDArray[np.float64], rotations: Any) -> NDArray[np.float32]:
    """Rotate each point by the rotation at its time.

    The rotation of a point is looked up on a grid fine enough that the step between neighbours,
    a 64th of the scan's rotation, is met by interpolating the rotated points linearly.
    """
    assert scan.times is not None
    matrices = rotations.as_matrix().astype(np.float32)
    place = np.clip(scan.times / np.float32(moments[1]), 0, _MOMENTS - 1)
    low = np.minimum(place.astype(np.intp), _MOMENTS - 2)
    share = (place - low)[:, None]
    before = np.einsum("nij,nj->ni", matrices[low], scan.points)
    after = np.einsum("nij,nj->ni", matrices[low + 1], scan.points)
    return np.asarray(before + share * (after - before))
