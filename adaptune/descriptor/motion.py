"""The motion of the sensor, computed from the poses of the scans before."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert, rotation_angle
from adaptune.sequence import Scan

MOTION = "motion"
"""Name of the descriptor that is filled in from poses."""
SECOND = 10**9
"""Nanoseconds over which motion is measured."""


def unknown(scan: Scan) -> NDArray[np.float64]:  # noqa: ARG001 - poses give it
    """Zeros in place of the motion until the poses are known, of shape (2,)."""
    return np.zeros(2)


def speed_and_turn_rate(stamps: NDArray[np.int64], T_odom_sensor: Poses) -> NDArray[np.float64]:
    """Metres and radians a second over the last second before each pose, of shape (n, 2).

    Stamps are rising nanoseconds. The motion is zero at the first pose. Unknown poses (NaN) take
    the motion of the last known one.
    """
    known = np.flatnonzero(np.isfinite(T_odom_sensor).all(axis=(1, 2)))
    if not len(known):
        return np.zeros((len(stamps), 2))
    at, T = stamps[known], T_odom_sensor[known]
    before = np.maximum(np.searchsorted(at, at - SECOND, side="right") - 1, 0)
    T_before_now = invert(T[before]) @ T
    seconds = np.maximum((at - at[before]) * 1e-9, 1e-9)
    moved = np.linalg.norm(T_before_now[:, :3, 3], axis=1)
    motion = np.column_stack([moved, rotation_angle(T_before_now)]) / seconds[:, None]
    latest = np.searchsorted(known, np.arange(len(stamps)), side="right") - 1
    return np.asarray(motion[np.maximum(latest, 0)])


def fill_in(
    descriptors: NDArray[np.float32], blocks: Mapping[str, int], motion: NDArray[np.float64]
) -> None:
    """Write the motion (..., 2) into the block of the motion descriptor, if there is one.

    Descriptors are of shape (..., n_features); `blocks` are their numbers by name, in order.
    """
    begin = 0
    for name, size in blocks.items():
        if name == MOTION:
            descriptors[..., begin : begin + size] = motion
        begin += size
