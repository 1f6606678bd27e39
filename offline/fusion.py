"""A bank on a training sequence, told from what its members did there alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive, Frames, Trial
from adaptune.geometry import Poses, invert, mean_motion, steps
from adaptune.metrics import cap, sub_trajectory_rte, sub_trajectory_vectors
from adaptune.odometry.bank import agreement, share


def error_vectors(frames: Frames, trial: Trial, length: float) -> NDArray[np.float32]:
    """Errors of a trial as vectors, see `sub_trajectory_vectors`.

    Of a trial that was run in pieces (``offline.runs: episodes``), or several times, they point
    where those of the pieces joined, or of the first run, do, and are as long as its errors.

    Returns
    -------
    ndarray of shape (n_frames, 3)
    """
    T_odom_sensor = _joined(frames, trial)
    vectors = sub_trajectory_vectors(frames.T_ref_sensor, T_odom_sensor, length, trial.restarted)
    vectors[np.isinf(trial.errors)] = np.inf
    lengths = np.linalg.norm(vectors, axis=1)
    finite = np.isfinite(lengths) & (lengths > 0.0)
    vectors[finite] *= (trial.errors[finite] / lengths[finite])[:, None]
    return vectors.astype(np.float32)


def _anew(frames: Frames, trial: Trial) -> NDArray[np.bool_]:
    """At which frames but the first a trial began anew at the reference."""
    anew = (trial.T_odom_sensor == frames.T_ref_sensor).all(axis=(1, 2))
    anew[0] = False
    return np.asarray(anew)


def _joined(frames: Frames, trial: Trial) -> Poses:
    """Poses of a trial, the reference's motion standing in where a piece of it began."""
    T_odom_sensor = trial.T_odom_sensor.copy()
    for i in np.flatnonzero(_anew(frames, trial) & ~trial.restarted):
        T_ref_step = invert(frames.T_ref_sensor[i - 1]) @ frames.T_ref_sensor[i]
        T_joined = T_odom_sensor[i - 1] @ T_ref_step @ invert(T_odom_sensor[i])
        if np.isfinite(T_joined).all():
            T_odom_sensor[i:] = T_joined @ T_odom_sensor[i:]
    return T_odom_sensor


def periods(period: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First frame of every period, and number of every frame's period among them.

    Parameters
    ----------
    period
        Whole periods since the first scan, of shape (n_frames,).
    """
    _, first, number = np.unique(period, return_index=True, return_inverse=True)
    return first, number


@dataclass(frozen=True, eq=False)
class Drive:
    """What it takes to drive a bank along a sequence again, without any odometry.

    Attributes
    ----------
    stamps : ndarray of shape (n_frames,)
        Nanoseconds.
    T_ref_sensor : ndarray of shape (n_frames, 4, 4)
    descriptors : ndarray of shape (n_frames, n_features)
        Averaged.
    period : ndarray of shape (n_frames,)
        Whole periods since the first scan.
    length : float
        Metres of a sub-trajectory.
    lost_track : float
        Metres a second.
    motions : callable
        Of some sets, by number, the motions over every scan but the first, of shape
        (n_frames - 1, n_sets, 4, 4), see `recorded_motions`.
    """

    stamps: NDArray[np.int64]
    T_ref_sensor: Poses
    descriptors: NDArray[np.float32]
    period: NDArray[np.int64]
    length: float
    lost_track: float
    motions: Callable[[Sequence[int]], Poses]

    def of(self, some: NDArray[np.intp]) -> Self:
        """The same with some of the sets only, whose numbers are then those in `some`."""
        motions = self.motions
        return replace(self, motions=lambda members: motions([int(some[i]) for i in members]))

    def errors(self, members: Sequence[int], weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Capped errors of a bank at every frame, NaN without a sub-trajectory.

        Parameters
        ----------
        members
            Numbers of the sets, the fixed one first.
        weights
            Of shape (n_periods, n_members).
        """
        T_previous_current = self.motions(members)
        T_ref_step = steps(self.T_ref_sensor)
        bounds = self.lost_track * np.diff(self.stamps) * 1e-9
        of_steps = weights[periods(self.period)[1][1:]]
        agreeing = agreement(T_previous_current, of_steps, bounds[:, None, None])
        none = np.asarray(~agreeing.any(axis=1))
        believed = np.where(agreeing[..., None, None], T_previous_current, np.eye(4))
        moved = mean_motion(believed, share(of_steps, agreeing | none[:, None]))
        moved[none] = np.where(np.isnan(T_ref_step[none]), np.eye(4), T_ref_step[none])
        # Unknown is not lost.
        lost = np.linalg.norm((moved - T_ref_step)[:, :3, 3], axis=1) > bounds
        T_odom_sensor = np.empty_like(self.T_ref_sensor)
        T_odom_sensor[0] = np.eye(4)
        for i, T in enumerate(moved):
            T_odom_sensor[i + 1] = T_odom_sensor[i] @ T
        lost = np.concatenate([[False], lost])
        return cap(sub_trajectory_rte(self.T_ref_sensor, T_odom_sensor, self.length, lost))


def recorded_motions(frames: Frames, trials: Sequence[Trial], lost_track: float) -> Poses:
    """Motions over every scan but the first, as trials were recorded to make them.

    Where one lost track, how it went wrong was not recorded: its motion is made to be far from the
    true one, and from that of all others that lost track there. Where a piece of a trial began
    (``offline.runs: episodes``) the motion is not known.

    Parameters
    ----------
    frames
        Of the sequence.
    trials
        On it.
    lost_track
        Metres a second.

    Returns
    -------
    ndarray of shape (n_frames - 1, n_trials, 4, 4)
        NaN where it is not known.
    """
    T_ref_step = steps(frames.T_ref_sensor)
    bounds = lost_track * np.diff(frames.stamps) * 1e-9
    motions = np.empty((len(bounds), len(trials), 4, 4))
    for k, trial in enumerate(trials):
        T = steps(trial.T_odom_sensor)
        anew = _anew(frames, trial)[1:]
        lost = trial.restarted[1:]
        T[anew & ~lost] = np.nan
        T[lost] = T_ref_step[lost]
        T[lost, 0, 3] += (4.0 + 2.0 * k) * bounds[lost]
        motions[:, k] = T
    return motions


def drive(
    archive: Archive,
    name: str,
    frames: Frames,
    numbers: Sequence[int],
    described: NDArray[np.float32],
    period: float,
    length: float,
    lost_track: float,
) -> Drive:
    """What it takes to drive a bank of an archive's sets along a sequence.

    Parameters
    ----------
    archive, name
        Where the trials are, and the sequence.
    frames
        Of the sequence.
    numbers
        Of the trials, in the order in which sets are numbered.
    described
        Averaged descriptors.
    period
        Seconds.
    length, lost_track
        See `Drive`.
    """

    def motions(members: Sequence[int]) -> Poses:
        key = tuple(members)
        if key not in kept:
            # Those of one bank after the other are asked for, each many times.
            kept.clear()
            trials = [archive.read(name, numbers[i]) for i in members]
            kept[key] = recorded_motions(frames, trials, lost_track)
        return kept[key]

    kept: dict[tuple[int, ...], Poses] = {}
    since = (frames.stamps - frames.stamps[0]) * 1e-9
    return Drive(
        frames.stamps,
        frames.T_ref_sensor,
        described,
        (since // period).astype(np.int64),
        length,
        lost_track,
        motions,
    )
