"""A bank on a training sequence, simulated from the motions that its members made alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive, Frames, Trial
from adaptune.geometry import Poses, invert, steps
from adaptune.metrics import cap, sub_trajectory_rte, sub_trajectory_vectors
from adaptune.model.bank_weights import MemberWeights
from adaptune.odometry.agreement import Agreement


def error_vectors(frames: Frames, trial: Trial, length: float) -> NDArray[np.float32]:
    """Errors of a trial as vectors, see `sub_trajectory_vectors`.

    Their lengths are the trial's errors. Where a trial was run in pieces
    (``offline.runs: episodes``) or several times, their directions are those of the joined pieces,
    or of the first run.

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


def _restarts(frames: Frames, trial: Trial) -> NDArray[np.bool_]:
    """At which frames but the first a trial started again at the reference."""
    restarts = (trial.T_odom_sensor == frames.T_ref_sensor).all(axis=(1, 2))
    restarts[0] = False
    return np.asarray(restarts)


def _joined(frames: Frames, trial: Trial) -> Poses:
    """Poses of a trial, joined by the reference's motion where a piece of it began."""
    T_odom_sensor = trial.T_odom_sensor.copy()
    for i in np.flatnonzero(_restarts(frames, trial) & ~trial.restarted):
        T_ref_step = invert(frames.T_ref_sensor[i - 1]) @ frames.T_ref_sensor[i]
        T_joined = T_odom_sensor[i - 1] @ T_ref_step @ invert(T_odom_sensor[i])
        if np.isfinite(T_joined).all():
            T_odom_sensor[i:] = T_joined @ T_odom_sensor[i:]
    return T_odom_sensor


@dataclass(frozen=True, eq=False)
class BankSimulation:
    """What it takes to simulate a bank along a sequence, without any odometry."""

    stamps: NDArray[np.int64]  # (n_frames,): nanoseconds
    T_ref_sensor: Poses  # (n_frames, 4, 4)
    descriptors: NDArray[np.float32]  # (n_frames, n_features): averaged
    period: NDArray[np.int64]  # (n_frames,): whole periods since the first scan
    length: float  # metres of a sub-trajectory
    lost_track: float  # metres a second
    # The motions of some sets, by trial numbers, over every scan but the first, of shape (n_frames
    # - 1, n_sets, 4, 4), see `recorded_motions`.
    motions: Callable[[tuple[int, ...]], Poses]

    def errors(self, weights: MemberWeights) -> NDArray[np.float64]:
        """Capped errors of a bank at every frame, NaN without a sub-trajectory."""
        T_previous_current = self.motions(weights.members)
        T_ref_step = steps(self.T_ref_sensor)
        seconds = np.diff(self.stamps) * 1e-9
        of_steps = weights.weights[np.unique(self.period, return_inverse=True)[1][1:]]
        agreement = Agreement(len(weights.members), self.lost_track)
        moved = np.empty_like(T_ref_step)
        for i, T in enumerate(T_previous_current):
            if agreement.judge(T, seconds[i], of_steps[i]).any():
                moved[i] = agreement.T_previous_current
                agreement.restarted(agreement.due)
            else:
                moved[i] = np.eye(4) if np.isnan(T_ref_step[i]).any() else T_ref_step[i]
                agreement.start()
        # Where the reference is unknown, nothing is lost.
        lost = np.linalg.norm((moved - T_ref_step)[:, :3, 3], axis=1) > self.lost_track * seconds
        T_odom_sensor = np.empty_like(self.T_ref_sensor)
        T_odom_sensor[0] = np.eye(4)
        for i, T in enumerate(moved):
            T_odom_sensor[i + 1] = T_odom_sensor[i] @ T
        lost = np.concatenate([[False], lost])
        return cap(sub_trajectory_rte(self.T_ref_sensor, T_odom_sensor, self.length, lost))


def recorded_motions(frames: Frames, trials: Sequence[Trial], lost_track: float) -> Poses:
    """Motions over every scan but the first, as the trials recorded them.

    Where a trial lost track, its motion was not recorded: the result is far from the true motion,
    and from that of all others that lost track there. Where a piece of a trial began
    (``offline.runs: episodes``) the motion is unknown.

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
        NaN where it is unknown.
    """
    T_ref_step = steps(frames.T_ref_sensor)
    bounds = lost_track * np.diff(frames.stamps) * 1e-9
    motions = np.empty((len(bounds), len(trials), 4, 4))
    for k, trial in enumerate(trials):
        T = steps(trial.T_odom_sensor)
        restarts = _restarts(frames, trial)[1:]
        lost = trial.restarted[1:]
        T[restarts & ~lost] = np.nan
        T[lost] = T_ref_step[lost]
        T[lost, 0, 3] += (4.0 + 2.0 * k) * bounds[lost]
        motions[:, k] = T
    return motions


def motions_from_archive(
    archive: Archive, name: str, frames: Frames, lost_track: float
) -> Callable[[tuple[int, ...]], Poses]:
    """Read the motions of trials on a sequence when they are asked for; see `BankSimulation`."""

    @cache
    def read(trial: int) -> Trial:
        return archive.read(name, trial)

    @lru_cache(maxsize=1)
    def motions(trials: tuple[int, ...]) -> Poses:
        # One bank after the other is asked for, each many times.
        return recorded_motions(frames, [read(trial) for trial in trials], lost_track)

    return motions
