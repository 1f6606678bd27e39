"""Errors of an odometry: over sub-trajectories, as KITTI's benchmark and as evo define them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert, nearest_rotation, rotation_angle, steps

WORST = 0.1  # share of the segments that are the worst
KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
JITTER = 0.1
"""Metres. A robot that stands does not drive by the noise of its poses, where that is less."""
_AS_STRAIGHT = 0.9  # share of the path that is left without noise, from which noise does not matter


def travelled(T_world_sensor: Poses) -> NDArray[np.float64]:
    """Distance travelled until each pose in metres, of shape (n,).

    Poses that are NaN add nothing. Where noise makes a large part of the path, as where a robot
    stands for long, it adds nothing either: between poses less than `JITTER` from each other the
    way is straight then; where most steps are noise, six times as far as the poses shake.
    """
    positions = T_world_sensor[:, :3, 3]
    lengths = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    distance = np.append(0.0, np.cumsum(np.nan_to_num(lengths, nan=0.0)))[: len(positions)]
    shaking = min(6.0 * _shaking(positions), 10.0 * JITTER)
    known = lengths[np.isfinite(lengths)]
    least = max(JITTER, shaking if len(known) and np.median(known) < shaking / 2.0 else 0.0)
    if not (lengths < least).any():
        return distance
    far, last, before = [0], positions[0].tolist(), positions[0].tolist()
    for i, position in enumerate(positions.tolist()):
        if not math.dist(position, last) < least:  # a distance to NaN is none
            if not math.dist(position, before) < least:
                far.append(max(i - 1, 0))  # it leaves where it stood by this step alone
            far.append(i)
            last = position
        before = position
    ends = [*far, len(positions) - 1]
    ways = np.linalg.norm(np.diff(positions[ends], axis=0), axis=1)
    straight = np.append(0.0, np.cumsum(np.nan_to_num(ways, nan=0.0)))
    if straight[-1] > _AS_STRAIGHT * distance[-1]:
        return distance
    return np.asarray(np.interp(distance, distance[ends], straight))


def _shaking(positions: NDArray[np.float64]) -> float:
    """Standard deviation in metres, along an axis, of the noise of positions of shape (n, 3)."""
    bends = np.linalg.norm(np.diff(positions, n=2, axis=0), axis=1)
    known = bends[np.isfinite(bends)]
    # The difference of differences has six times the variance, and its median is 1.54 of it.
    return float(np.median(known)) / (1.54 * 6.0**0.5) if len(known) else 0.0


def window_ends(T_world_sensor: Poses, length: float) -> NDArray[np.intp]:
    """Index of the end of the sub-trajectory of `length` metres from each pose, of shape (n,).

    It is the first pose further along the path, as in KITTI's development kit; -1 where the path
    ends before, or where a pose on the way is NaN.
    """
    distance = travelled(T_world_sensor)
    ends = np.searchsorted(distance, distance + length, side="right")
    missing = np.concatenate([[0], np.cumsum(np.isnan(T_world_sensor[:, 0, 0]))])
    starts = np.arange(len(ends))
    inside = ends < len(ends)
    ends[~inside] = -1
    whole = missing[ends + 1] == missing[starts]
    return np.where(inside & whole, ends, -1)


def _window_motions(
    T_ref_sensor: Poses, T_odom_sensor: Poses, starts: NDArray[np.intp], ends: NDArray[np.intp]
) -> tuple[Poses, Poses]:
    """Motions dGt and dEst over windows from `starts` to `ends`, each of shape (m, 4, 4)."""
    d_gt = invert(T_ref_sensor[starts]) @ T_ref_sensor[ends]
    d_est = invert(T_odom_sensor[starts]) @ T_odom_sensor[ends]
    return d_gt, d_est


def sub_trajectory_rte(
    T_ref_sensor: Poses,
    T_odom_sensor: Poses,
    length: float,
    lost: NDArray[np.bool_] | None = None,
    ends: NDArray[np.intp] | None = None,
) -> NDArray[np.float64]:
    """Relative translation error of the sub-trajectory that starts at every frame, of shape (n,).

    The error ``y_ij`` of frame i with parameter set j in Koide et al., *Adaptive Hyperparameter
    Tuning for Black-box LiDAR Odometry*, IROS 2021: with the motions d from the first frame of the
    sub-trajectory to its last, ``100 / L * ||trans(inv(d_est) d_ref)||``, in percent of the length.
    See `sub_trajectory_vectors`.
    """
    vectors = sub_trajectory_vectors(T_ref_sensor, T_odom_sensor, length, lost, ends)
    return np.asarray(np.linalg.norm(vectors, axis=1))


def sub_trajectory_vectors(
    T_ref_sensor: Poses,
    T_odom_sensor: Poses,
    length: float,
    lost: NDArray[np.bool_] | None = None,
    ends: NDArray[np.intp] | None = None,
) -> NDArray[np.float64]:
    """Error vector at the end of the sub-trajectory that starts at every frame, of shape (n, 3).

    In percent of `length`, which is in metres, in the frame of the sub-trajectory's start: NaN for
    frames without a full sub-trajectory, infinity for those whose sub-trajectory contains a scan
    that is `lost`, of shape (n,), or poses that are not finite. Poses are of shape (n, 4, 4), those
    of the reference NaN where there is none. `ends` are those of `window_ends`, if they are known.
    """
    ends = window_ends(T_ref_sensor, length) if ends is None else ends
    starts = np.flatnonzero(ends >= 0)
    ends = ends[starts]
    vectors = np.full((len(T_ref_sensor), 3), np.nan)
    with np.errstate(invalid="ignore"):
        d_gt, d_est = _window_motions(T_ref_sensor, T_odom_sensor, starts, ends)
        vectors[starts] = 100.0 / length * (d_est - d_gt)[:, :3, 3]
    # Only the reference may be unknown. An odometry whose poses are not finite has lost track.
    vectors[starts[~np.isfinite(vectors[starts]).all(axis=1)]] = np.inf
    if lost is not None:
        # The step that failed ends at its frame: a window that starts there is sound.
        failures = np.cumsum(lost)
        vectors[starts[failures[ends] > failures[starts]]] = np.inf
    return vectors


def sub_trajectory_turns(
    T_ref_sensor: Poses, T_odom_sensor: Poses, length: float
) -> NDArray[np.float64]:
    """Rotation error of the sub-trajectory from every frame in degrees a metre, or NaN, (n,)."""
    ends = window_ends(T_ref_sensor, length)
    starts = np.flatnonzero(ends >= 0)
    d_gt, d_est = _window_motions(T_ref_sensor, T_odom_sensor, starts, ends[starts])
    turns = np.full(len(T_ref_sensor), np.nan)
    turns[starts] = np.degrees(rotation_angle(invert(d_est) @ d_gt)) / length
    return turns


def height_error(T_ref_sensor: Poses, T_odom_sensor: Poses, length: float) -> float:
    """Mean drift along the reference's z axis over sub-trajectories, in percent, or NaN."""
    vectors = sub_trajectory_vectors(T_ref_sensor, T_odom_sensor, length)
    known = np.isfinite(vectors).all(axis=1)
    if not known.any():
        return np.nan
    heights = np.einsum("ij,ij->i", T_ref_sensor[known, 2, :3], vectors[known])
    return float(np.abs(heights).mean())


class KittiError(NamedTuple):
    """Mean errors over sub-trajectories of several lengths."""

    translation: float = np.nan  # percent; NaN when the path is shorter than every length
    rotation: float = np.nan  # degrees a metre
    lengths: tuple[float, ...] = ()  # metres, those for which there was a sub-trajectory
    n: int = 0  # number of sub-trajectories

    @classmethod
    def pooled(cls, errors: Sequence["KittiError"]) -> "KittiError":
        """The mean over the sub-trajectories of several paths, as the benchmark takes it."""
        known = [error for error in errors if error.n]
        if not known:
            return cls()
        n = [error.n for error in known]
        means = [np.average([e[i] for e in known], weights=n) for i in (0, 1)]
        lengths = sorted({length for error in known for length in error.lengths})
        return cls(float(means[0]), float(means[1]), tuple(lengths), sum(n))


def kitti_error(
    T_ref_sensor: Poses,
    T_odom_sensor: Poses,
    lengths: Sequence[float] = KITTI_LENGTHS,
    stride: int = 10,
) -> KittiError:
    """Error of KITTI's odometry benchmark (Geiger et al., CVPR 2012) over lengths in metres.

    A sub-trajectory starts every `stride` frames.
    """
    translations, rotations, used = [], [], []
    for length in lengths:
        ends = window_ends(T_ref_sensor, length)[::stride]
        starts = np.arange(len(T_ref_sensor))[::stride][ends >= 0]
        ends = ends[ends >= 0]
        if not len(starts):
            continue
        d_gt, d_est = _window_motions(T_ref_sensor, T_odom_sensor, starts, ends)
        T = invert(d_est) @ d_gt
        translations.append(np.linalg.norm(T[:, :3, 3], axis=1) / length)
        rotations.append(rotation_angle(T) / length)
        used.append(length)
    if not used:
        return KittiError()
    translation, rotation = np.concatenate(translations), np.concatenate(rotations)
    means = 100.0 * float(np.mean(translation)), float(np.degrees(np.mean(rotation)))
    return KittiError(*means, tuple(used), len(translation))


def absolute_errors(T_ref_sensor: Poses, T_odom_sensor: Poses) -> NDArray[np.float64]:
    """Distances in metres after alignment, of shape (n,); NaN for poses without reference (NaN).

    After the least-squares alignment of the positions (Umeyama, PAMI 1991).
    """
    known = ~np.isnan(T_ref_sensor[:, 0, 0])
    ref, odom = (T[:, :3, 3] - T[known, :3, 3].mean(axis=0) for T in (T_ref_sensor, T_odom_sensor))
    R_ref_odom = nearest_rotation(odom[known], ref[known])
    return np.asarray(np.linalg.norm(ref - odom @ R_ref_odom.T, axis=1))


def absolute_error(T_ref_sensor: Poses, T_odom_sensor: Poses) -> float:
    """Absolute pose error: root mean square of `absolute_errors`, as ``evo_ape -a`` has it."""
    return float(np.sqrt(np.nanmean(absolute_errors(T_ref_sensor, T_odom_sensor) ** 2)))


def relative_error(T_ref_sensor: Poses, T_odom_sensor: Poses) -> float:
    """Relative pose error: root mean square of the steps' translation errors, in metres.

    As ``evo_rpe`` computes it by default: from each frame to the next. Steps without reference
    (NaN) do not count.
    """
    E = invert(steps(T_ref_sensor)) @ steps(T_odom_sensor)
    known = ~np.isnan(E[:, 0, 0])
    return float(np.sqrt(np.mean(np.sum(E[known, :3, 3] ** 2, axis=1))))


FAILURE = 30.0  # percent; a lost track and every larger error count as this
LOST_ABOVE = 5.0  # percent; an odometry with a larger mean error does not track


def cap(errors: NDArray[np.floating]) -> NDArray[np.float64]:
    """Bound errors in percent by `FAILURE`, so that one lost track does not hide all others."""
    return np.minimum(errors.astype(np.float64), FAILURE)


def worst_tenth(logs: NDArray[np.float64]) -> float:
    """Mean over the worst tenth of the segments' logarithms of the ratio to the fixed set's error.

    It is the conditional value at risk: where a tenth is no whole number, a segment counts in part.
    """
    share = max(1.0, WORST * len(logs))
    counts = np.clip(share - np.arange(len(logs)), 0.0, 1.0)
    return float(np.sort(logs)[::-1] @ counts / share)


def span(T_ref_sensor: Poses, length: float) -> int:
    """Median number of frames in a sub-trajectory of a length; a shorter path counts whole."""
    ends = window_ends(T_ref_sensor, length)
    starts = np.flatnonzero(ends >= 0)
    return int(np.median(ends[starts] - starts)) if len(starts) else max(1, len(ends))
