"""Rigid transforms as homogeneous matrices, one or many at a time."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Poses = NDArray[np.float64]
"""Homogeneous matrices of shape (..., 4, 4), named ``T_target_source``."""


def invert(T_target_source: Poses) -> Poses:
    """Invert rigid transforms: ``T_source_target``, of shape (..., 4, 4)."""
    R_source_target = np.swapaxes(T_target_source[..., :3, :3], -1, -2)
    T_source_target = np.zeros_like(T_target_source)
    T_source_target[..., :3, :3] = R_source_target
    T_source_target[..., :3, 3] = -(R_source_target @ T_target_source[..., :3, 3, None])[..., 0]
    T_source_target[..., 3, 3] = 1.0
    return T_source_target


def rectify(T_target_source: Poses) -> Poses:
    """Remove rounding errors from rotations by one Newton step of the polar decomposition.

    Where each pose is predicted from the two before it, they more than double with every scan.
    """
    T = T_target_source.copy()
    R = T[..., :3, :3]
    T[..., :3, :3] = 1.5 * R - 0.5 * R @ np.swapaxes(R, -1, -2) @ R
    return T


def squared_ranges(points: NDArray[Any]) -> NDArray[Any]:
    """Squared distances of points of shape (n, 3) from the origin, of shape (n,)."""
    # Columns take a third of the time of `einsum` over rows.
    x, y, z = points.T
    return np.asarray(x * x + y * y + z * z)


def count_within(points: NDArray[Any], low: float, high: float) -> int:
    """Number of points of shape (n, 3) farther than `low` and nearer than `high`."""
    squared = squared_ranges(points)
    return int(np.count_nonzero((squared > low * low) & (squared < high * high)))


def steps(T_world_sensor: Poses) -> Poses:
    """Motions ``T_previous_current``, of shape (n - 1, 4, 4), of every pose but the first."""
    return invert(T_world_sensor[:-1]) @ T_world_sensor[1:]


def scale(T_previous_current: Poses, share: float) -> Poses:
    """Scale a motion, of shape (4, 4), to a share of its time: the exponential of its logarithm."""
    if share == 1.0:
        return T_previous_current
    from scipy.spatial.transform import RigidTransform

    # SciPy wants the last row exactly; products of poses have it but for rounding.
    T = np.vstack([T_previous_current[:3], [0.0, 0.0, 0.0, 1.0]])
    screw = RigidTransform.from_matrix(T).as_exp_coords()
    return np.asarray(RigidTransform.from_exp_coords(share * screw).as_matrix())


def mean_motion(T_previous_current: Poses, weights: NDArray[np.float64]) -> Poses:
    """Weighted mean of motions: of translations, and the rotation nearest to that of rotations.

    Motions of shape (..., n, 4, 4) turn by nearly the same. Weights of shape (..., n) are not all
    zero. The mean is of shape (..., 4, 4).
    """
    shares = weights / weights.sum(axis=-1, keepdims=True)
    T: Poses = np.einsum("...n,...nij->...ij", shares, T_previous_current)
    T[..., 3, :] = 0.0, 0.0, 0.0, 1.0  # the shares add up to 1 but for rounding
    # Newton's steps double the digits: turns that differ by a radian take five.
    for _ in range(5):
        if np.abs(np.linalg.det(T[..., :3, :3]) - 1.0).max(initial=0.0) < 1e-13:
            break
        T = rectify(T)
    return T


def rotation_angle(T_target_source: Poses) -> Any:
    """Angle of the rotations in radians, of shape (...)."""
    R = T_target_source[..., :3, :3]
    # atan2 keeps its precision at small angles, where the arc cosine of the trace loses it.
    sine = 0.5 * np.sqrt(
        (R[..., 2, 1] - R[..., 1, 2]) ** 2
        + (R[..., 0, 2] - R[..., 2, 0]) ** 2
        + (R[..., 1, 0] - R[..., 0, 1]) ** 2
    )
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)
    return np.arctan2(sine, cosine)


def nearest_rotation(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The rotation of shape (3, 3) that takes vectors of shape (n, 3) nearest to others.

    By Kabsch (Acta Cryst. 1976). Where the vectors lie on a line, the turn about it is arbitrary.
    """
    U, _, Vt = np.linalg.svd(target.T @ source)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def from_quaternions(translations: ArrayLike, quaternions: ArrayLike) -> Poses:
    """Poses (n, 4, 4) from translations (n, 3) and quaternions x, y, z, w (n, 4) of any length."""
    from scipy.spatial.transform import Rotation

    translations = np.asarray(translations, np.float64).reshape(-1, 3)
    T = np.tile(np.eye(4), (len(translations), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(np.reshape(quaternions, (-1, 4))).as_matrix()
    T[:, :3, 3] = translations
    return T


def to_quaternions(T_target_source: Poses) -> NDArray[np.float64]:
    """Quaternions x, y, z, w (w >= 0) of poses of shape (n, 4, 4), of shape (n, 4)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(T_target_source[:, :3, :3]).as_quat(canonical=True))


_FARTHEST = 1e6  # metres between two frames of one platform


def to_pose(given: Any) -> Poses:
    """Pose of shape (4, 4) from ``x y z qx qy qz qw`` or a matrix's rows; else a ValueError."""
    what = "give numbers: x y z qx qy qz qw, or the four rows of a 4x4 matrix"
    try:
        values = np.array(given, np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(what) from error
    if values.shape not in ((7,), (4, 4), (3, 4)) or not np.abs(values).max() <= _FARTHEST:
        raise ValueError(what)
    if values.shape == (7,):
        if not 0.99 < np.linalg.norm(values[3:]) < 1.01:
            raise ValueError("its quaternion (qx qy qz qw, the last four) has not length 1")
        return np.asarray(from_quaternions(values[None, :3], values[None, 3:])[0])
    R = values[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
        raise ValueError("its first three columns and rows are not a rotation")
    if values.shape == (4, 4) and np.abs(values[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise ValueError("its last row is not 0 0 0 1; is it transposed?")
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    # Written with a few digits, it is a rotation only nearly.
    T[:3, :3] = Rotation.from_matrix(R).as_matrix()
    T[:3, 3] = values[:3, 3]
    return T
