"""Notice poses that belong to another frame than the LiDAR's."""

import numpy as np

from adaptune.geometry import Poses, invert, rotation_angle
from adaptune.metrics import window_ends
from adaptune.odometry.base import OdometryError


def check_frame(T_own_sensor: Poses, T_ref_sensor: Poses | None) -> None:
    """Refuse poses that move as the reference does, but along other axes.

    The rotation that aligns displacements over a metre with those of the reference (Kabsch, Acta
    Cryst. 1976) must not remove most of their difference.
    """
    if T_ref_sensor is None:
        return
    ends = window_ends(T_ref_sensor, 1.0)
    starts = np.flatnonzero((ends >= 0) & np.isfinite(T_own_sensor[:, 0, 0]))
    starts = starts[np.isfinite(T_own_sensor[ends[starts], 0, 0])]
    if len(starts) < 10:
        return
    own, truth = (
        (invert(T[starts]) @ T[ends[starts]])[:, :3, 3] for T in (T_own_sensor, T_ref_sensor)
    )
    U, _, Vt = np.linalg.svd(truth.T @ own)
    T_truth_own = np.eye(4)
    T_truth_own[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    before = np.linalg.norm(own - truth, axis=1).mean()
    after = np.linalg.norm(own @ T_truth_own[:3, :3].T - truth, axis=1).mean()
    if before > 0.3 and after < 0.2 * before:
        angle = np.degrees(rotation_angle(T_truth_own))
        raise OdometryError(
            f"the program's poses are those of another frame: turned by {angle:.0f} degrees, they "
            f"are the reference's; give the LiDAR's pose in it (odometry.settings.extrinsic)"
        )
