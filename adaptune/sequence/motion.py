"""Motion compensation: all points of a scan as seen from where the sensor was at its start."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from adaptune.geometry import Poses
from adaptune.sequence.imu import Imu
from adaptune.sequence.scan import Scan

# Rotation changes slowly: between these many moments of a scan it is taken as constant.
_MOMENTS = 64


def compensate(scan: Scan, T_start_end: Poses, duration: float) -> Scan:
    """Undo a motion of constant velocity.

    Parameters
    ----------
    scan
        A scan whose points have times; one without is given back as it is.
    T_start_end
        Pose of the sensor `duration` after the scan's stamp, seen from where it was at the stamp;
        of shape (4, 4).
    duration
        Seconds.

    Returns
    -------
    Scan
        Its points in the sensor's frame at the stamp.
    """
    if scan.times is None or not len(scan):
        return scan
    twist = Rotation.from_matrix(T_start_end[:3, :3]).as_rotvec() / duration
    velocity = T_start_end[:3, 3] / duration
    moments = np.linspace(0.0, max(float(scan.times.max()), 1e-9), _MOMENTS)
    points = _rotate(scan, moments, Rotation.from_rotvec(moments[:, None] * twist))
    return replace(scan, points=points + scan.times[:, None] * velocity.astype(np.float32))


def compensate_rotation(scan: Scan, imu: Imu) -> Scan:
    """Undo the rotation that a gyroscope measured during the scan.

    Translation is left in. A scan whose points have no times, or of which the IMU tells nothing,
    is given back as it is.

    Parameters
    ----------
    scan, imu
        On the same clock.
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
    moments = np.linspace(0.0, max(span, 1e-9), _MOMENTS)
    at = np.stack([np.interp(moments, seconds, rates[:, i]) for i in range(3)], axis=1)
    steps = Rotation.from_rotvec((at[1:] + at[:-1]) * 0.5 * np.diff(moments)[:, None])
    rotations = [Rotation.identity()]
    for step in steps:
        rotations.append(rotations[-1] * step)
    return replace(scan, points=_rotate(scan, moments, Rotation.concatenate(rotations)))


def _rotate(scan: Scan, moments: NDArray[np.float64], rotations: Rotation) -> NDArray[np.float32]:
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
    rotated: NDArray[np.float32] = before + share * (after - before)
    return rotated
