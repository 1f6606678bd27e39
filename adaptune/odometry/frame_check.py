"""Notice poses that belong to another frame than the LiDAR's, and references that do."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert, rotation_angle, steps
from adaptune.metrics import travelled, window_ends
from adaptune.odometry.base import OdometryError

_FEWEST, _SHORTEST = 10, 5.0
"""Frames, and metres, below which nothing is said of a reference."""
_MOVED = 0.2
"""Metres that an odometry moves while the reference moves one."""
_APART, _EXPLAINED = 20.0, 0.3
"""Degrees between an odometry's motions and the reference's, and the share that may be left."""
_SWAPPED = 45.0
"""Degrees between them that no rotation explains."""
_TURNED, _OTHERS = np.radians(3.0), 0.1
"""Radians of a turn, and the share of turns that may be otherwise than the others."""
_BACKWARDS = 120.0
"""Degrees from which a reference may be reversed in time."""


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


def contradiction(T_odom_sensor: Poses, T_ref_sensor: Poses) -> str | None:
    """What a reference looks like whose motions contradict an odometry's nearly everywhere.

    Directions over a metre, not their lengths, are compared, and turns: a rotation (Kabsch) must
    explain most of what they differ by. Noise and lost tracks are not explained by any.

    Parameters
    ----------
    T_odom_sensor
        Poses of shape (n, 4, 4), which owe nothing to the reference.
    T_ref_sensor
        The reference's, of shape (n, 4, 4); NaN where it is unknown.

    Returns
    -------
    str or None
        What has become of the reference, as in "it looks turned by about 90 degrees"; None if it
        does not contradict the odometry, or too little is known.
    """
    T_own, T_true = _motions(T_odom_sensor, T_ref_sensor, 1.0)
    # An odometry that stands still says nothing.
    moved = np.linalg.norm(T_own[:, :3, 3], axis=1) > _MOVED
    if moved.sum() < max(_FEWEST, 0.5 * len(moved)) or travelled(T_ref_sensor)[-1] < _SHORTEST:
        return None
    apart, left = _apart(T_own[moved, :3, 3], T_true[moved, :3, 3])
    if apart > _APART and left < _EXPLAINED * apart:
        return _turned(apart, T_odom_sensor, T_ref_sensor)
    same = _same_turns(*_motions(T_odom_sensor, T_ref_sensor, _SHORTEST))
    if same > 1.0 - _OTHERS and apart > _SWAPPED:
        return "its orientations fit, but its positions do not: it looks as if axes were swapped"
    if same < _OTHERS and apart < _APART:
        return "its turns go the other way: it looks mirrored, or its z axis points down"
    return None


def _motions(T_odom_sensor: Poses, T_ref_sensor: Poses, length: float) -> tuple[Poses, Poses]:
    """Motions of both while the reference moves so many metres."""
    ends = window_ends(T_ref_sensor, length)
    starts = np.flatnonzero(ends >= 0)
    own, true = (invert(T[starts]) @ T[ends[starts]] for T in (T_odom_sensor, T_ref_sensor))
    return own, true


def _same_turns(T_own: Poses, T_true: Poses) -> float:
    """Share of the turns that go the same way; NaN if there are few."""
    from scipy.spatial.transform import Rotation

    if len(T_own) < _FEWEST:
        return np.nan
    own, true = (Rotation.from_matrix(T[:, :3, :3]).as_rotvec() for T in (T_own, T_true))
    turning = np.minimum(np.linalg.norm(own, axis=1), np.linalg.norm(true, axis=1)) > _TURNED
    same = (own * true).sum(axis=1)[turning] > 0.0
    return float(same.mean()) if len(same) >= _FEWEST else np.nan


def _apart(own: Poses, true: Poses) -> tuple[float, float]:
    """Median angle between displacements in degrees, and what a rotation leaves of it."""
    own, true = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (own, true))
    U, _, Vt = np.linalg.svd(true.T @ own)
    R_true_own = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    both = ((v * true).sum(axis=1).clip(-1.0, 1.0) for v in (own, own @ R_true_own.T))
    before, after = (float(np.degrees(np.median(np.arccos(cosine)))) for cosine in both)
    return before, after


def _turned(degrees: float, T_odom_sensor: Poses, T_ref_sensor: Poses) -> str:
    """Tell a turned reference from one that runs backwards, by speeds and turn rates."""
    turned = f"it looks turned by about {5 * round(degrees / 5)} degrees"
    if degrees < _BACKWARDS:
        return turned
    own, true = (
        np.nan_to_num([np.linalg.norm(T[:, :3, 3], axis=1), rotation_angle(T)])
        for T in (steps(T_odom_sensor), steps(T_ref_sensor))
    )
    smooth = np.ones(min(10, own.shape[1])) / 10.0
    own, true = ([np.convolve(v, smooth, "same") for v in pair] for pair in (own, true))
    forwards, backwards = _alike(own, true), _alike(own, [v[::-1] for v in true])
    if backwards > forwards + 0.1:
        return "it looks reversed in time"
    return turned if forwards > backwards + 0.1 else f"{turned}, or reversed in time"


def _alike(own: Sequence[NDArray[np.float64]], true: Sequence[NDArray[np.float64]]) -> float:
    """Sum of the correlations between these series."""
    with np.errstate(invalid="ignore", divide="ignore"):
        each = [np.asarray(np.corrcoef(pair))[0, 1] for pair in zip(own, true, strict=True)]
    return float(np.nan_to_num(each).sum())
