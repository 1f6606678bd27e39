"""A bank on a training sequence, simulated from the motions that its members made alone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive, Frames, Trial
from adaptune.bank.agreement import LEVER, Agreement, share
from adaptune.geometry import Poses, invert, mean_motion, rectify, rotation_angle, steps
from adaptune.live.evidence import SPACING
from adaptune.live.hops import HopErrors, Hops, LiveSquares, live_squares
from adaptune.metrics import cap, sub_trajectory_rte, sub_trajectory_vectors, travelled, window_ends
from adaptune.model.weights import MemberWeights
from adaptune.study.study import PER_STRETCH

SECONDS_UNTIL_NOTICED = 1.0
"""Seconds until a bank notices that a member has lost track."""
MISFIT_PER_METRE = 0.25
"""By how much farther a scan is from the one before, about, in a metre by which it is misplaced."""


def error_vectors(frames: Frames, trial: Trial, length: float) -> NDArray[np.float32]:
    """Errors of a trial as vectors, see `sub_trajectory_vectors`.

    Their lengths are the trial's errors. Where a trial was run several times, their directions are
    those of the first run.

    Returns shape (n_frames, 3).
    """
    T_ref_sensor, T_odom_sensor = frames.T_ref_sensor, trial.T_odom_sensor
    vectors = sub_trajectory_vectors(T_ref_sensor, T_odom_sensor, length, trial.restarted)
    vectors[np.isinf(trial.errors)] = np.inf
    lengths = np.linalg.norm(vectors, axis=1)
    finite = np.isfinite(lengths) & (lengths > 0.0)
    vectors[finite] *= (trial.errors[finite] / lengths[finite])[:, None]
    return vectors.astype(np.float32)


@dataclass(frozen=True, eq=False)
class BankSimulation:
    """What it takes to simulate a bank along a sequence, without any odometry."""

    stamps: NDArray[np.int64]  # (n_frames,): nanoseconds
    T_ref_sensor: Poses  # (n_frames, 4, 4)
    descriptors: NDArray[np.float32]  # (n_frames, n_features): averaged
    period: NDArray[np.int64]  # (n_frames,): whole periods since the first scan
    length: float  # metres of a sub-trajectory
    lost_track: float  # metres a second
    hops: Hops  # measured without the odometry's errors
    # The motions of some sets, by trial numbers, over every scan but the first, of shape (n_frames
    # - 1, n_sets, 4, 4), see `recorded_motions`.
    motions: Callable[[tuple[int, ...]], Poses]
    _agreeing: dict[tuple[tuple[int, ...], bytes], NDArray[np.bool_]] = field(
        default_factory=dict, init=False
    )
    _live: dict[tuple[int, ...], list[LiveSquares | None]] = field(default_factory=dict, init=False)

    def live(self, members: tuple[int, ...]) -> list[LiveSquares | None]:
        """What is measured of members before the first frame of each period."""
        if members not in self._live:
            self._live[members] = self._measured(members)
        return self._live[members]

    def _measured(self, members: tuple[int, ...]) -> list[LiveSquares | None]:
        first = np.unique(self.period, return_index=True)[1]
        start, end, T_start_end, projection = self.hops
        if not len(start):
            return [None] * len(first)
        T_previous_current = self.motions(members)
        known = np.asarray(np.isfinite(T_previous_current).all(axis=(-2, -1)))
        T_odom_sensor = chained(np.where(known[..., None, None], T_previous_current, np.eye(4)))
        moved = invert(T_odom_sensor[start]) @ T_odom_sensor[end]
        metres, seconds = travelled(self.T_ref_sensor), (self.stamps - self.stamps[0]) * 1e-9
        length = np.maximum(metres[end] - metres[start], SPACING)[:, None, None]
        wrong = moved[..., :3, 3] - T_start_end[:, None, :3, 3]
        errors = 100.0 / length * np.einsum("hij,hmj->hmi", projection, wrong)
        unknown = np.concatenate([np.zeros((1, len(members)), np.intp), np.cumsum(~known, axis=0)])
        errors[unknown[end] > unknown[start]] = np.nan
        hops = HopErrors(errors, metres[start], metres[end], seconds[end])
        found = []
        for frame in first:
            before = HopErrors(*(array[end < frame] for array in hops))
            found.append(live_squares(before.recent(float(metres[frame]), float(seconds[frame]))))
        return found

    def agreeing(self, votes: MemberWeights) -> NDArray[np.bool_]:
        """Over which scans each member agrees with the others, of shape (n_frames - 1, n_members).

        Members vote with the weights that are given. The reference takes the place of the short
        registrations: it tells a member that is lost from one that is sound.
        """
        key = votes.members, votes.weights.tobytes()
        if key not in self._agreeing:
            T_previous_current = self.motions(votes.members)
            agreement = Agreement(len(votes.members), self.lost_track)
            agreeing = np.zeros(T_previous_current.shape[:2], bool)
            of_steps = self._of_steps(votes)
            for i, seconds in enumerate(np.diff(self.stamps) * 1e-9):
                agreeing[i] = agreement.judge(
                    T_previous_current[i], seconds, of_steps[i], partial(self._misplaced, i + 1)
                )
                if agreeing[i].any():
                    agreement.restarted(agreement.due)
                else:
                    agreement.start()
            self._agreeing[key] = agreeing
        return self._agreeing[key]

    def _of_steps(self, weights: MemberWeights) -> NDArray[np.float64]:
        """Weights at every scan but the first, of shape (n_frames - 1, n_members)."""
        return weights.weights[np.unique(self.period, return_inverse=True)[1][1:]]

    def _misplaced(
        self, frame: int, T_then_now: Poses, ago: tuple[int, ...]
    ) -> NDArray[np.float64]:
        """What short registrations would find at a frame, see `Alignment`."""
        T_ref_now = self.T_ref_sensor[frame]
        T_ref = np.array([invert(self.T_ref_sensor[frame - n]) @ T_ref_now for n in ago])
        T = invert(T_ref)[:, None] @ T_then_now
        apart = np.linalg.norm(T[..., :3, 3], axis=-1) + LEVER * rotation_angle(T)
        found = np.minimum(1.0, MISFIT_PER_METRE * apart).mean(axis=0)
        return np.asarray(np.where(np.isnan(found), np.inf, found))

    def errors(
        self, weights: MemberWeights, votes: MemberWeights | None = None
    ) -> NDArray[np.float64]:
        """Capped errors of a bank at every frame, NaN without a sub-trajectory.

        Members vote about who agrees with `votes`; with `weights` when left out.
        """
        T_previous_current = self.motions(weights.members)
        agreeing = self.agreeing(weights if votes is None else votes)
        none = np.asarray(~agreeing.any(axis=1))
        believed = np.where(agreeing[..., None, None], T_previous_current, np.eye(4))
        moved = mean_motion(believed, share(self._of_steps(weights), agreeing | none[:, None]))
        return cap(sub_trajectory_rte(self.T_ref_sensor, chained(moved), self.length))


def chained(T_previous_current: Poses) -> Poses:
    """Poses of shape (n + 1, ..., 4, 4) from motions of shape (n, ..., 4, 4), from the identity."""
    T = np.empty((len(T_previous_current) + 1, *T_previous_current.shape[1:]))
    T[0] = np.eye(4)
    for i, motion in enumerate(T_previous_current):
        T[i + 1] = rectify(T[i] @ motion)
    return T


def recorded_motions(frames: Frames, trials: Sequence[Trial]) -> Poses:
    """Motions over every scan but the first, as the trials recorded them.

    Where a trial lost track, its motion was not recorded, and it started again at the reference. In
    a bank nobody knows at once: here it stands still for `SECONDS_UNTIL_NOTICED`, as all others do
    that lose track there, and then goes on.

    Returns shape (n_frames - 1, n_trials, 4, 4).
    """
    motions = np.empty((len(frames.stamps) - 1, len(trials), 4, 4))
    for k, trial in enumerate(trials):
        T = steps(trial.T_odom_sensor)
        T[_for_a_while(trial.restarted[1:], frames.stamps)] = np.eye(4)
        motions[:, k] = T
    return motions


def _for_a_while(lost: NDArray[np.bool_], stamps: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Steps that begin less than `SECONDS_UNTIL_NOTICED` after the begin of one that is lost."""
    begins = stamps[:-1]
    last = np.maximum.accumulate(np.where(lost, begins, np.iinfo(np.int64).min // 2))
    return np.asarray(begins - last < SECONDS_UNTIL_NOTICED * 1e9)


def motions_from_archive(
    archive: Archive, name: str, frames: Frames
) -> Callable[[tuple[int, ...]], Poses]:
    """Read the motions of trials on a sequence when they are asked for; see `BankSimulation`."""

    @cache
    def read(trial: int) -> Trial:
        return archive.read(name, trial)

    @lru_cache(maxsize=1)
    def motions(trials: tuple[int, ...]) -> Poses:
        # One bank after the other is asked for, each many times.
        return recorded_motions(frames, [read(trial) for trial in trials])

    return motions


# Stretches: recordings are cut into them, and one after the other is left out.


MARGIN_FRAMES = 2
"""Frames that a part of a simulation is longer than its stretch: a distance that is summed from
another frame may differ in its last bits, and a sub-trajectory then ends one frame later."""


class Extent(NamedTuple):
    """Where the labelled frames of a sequence are, and how far their sub-trajectories reach."""

    frames: NDArray[np.intp]  # (n,): their numbers among all frames of the sequence
    ends: NDArray[np.intp]  # (n,): last frames of their sub-trajectories
    # Metres: where these frames are, and where their sub-trajectories end, each of shape (n, 3).
    positions: NDArray[np.float64]
    end_positions: NDArray[np.float64]
    length: float  # of a sub-trajectory

    @classmethod
    def of(cls, T_ref_sensor: Poses, known: NDArray[np.bool_], length: float) -> Self:
        """The extent of the frames that are known to have errors.

        `T_ref_sensor` is of shape (n_frames, 4, 4), `known` of (n_frames,), `length` in metres.
        """
        frames = np.flatnonzero(known)
        ends = window_ends(T_ref_sensor, length)[frames]
        at = T_ref_sensor[:, :3, 3]
        return cls(frames, ends, at[frames], at[ends], length)

    def some(self, kept: NDArray[np.bool_]) -> Self:
        """The same of some of the frames."""
        return self._replace(
            frames=self.frames[kept],
            ends=self.ends[kept],
            positions=self.positions[kept],
            end_positions=self.end_positions[kept],
        )

    def near(self, left_out: "Extent", is_view: bool) -> NDArray[np.bool_]:
        """Which frames must not be known where others of the same recording are left out.

        That is each frame within the length of a sub-trajectory of where these are, and each whose
        sub-trajectory overlaps one of theirs.

        A view counts frames in another way, and may be played backwards.
        """
        from scipy.spatial import cKDTree  # slow to import

        path = cKDTree(left_out.positions)
        near = path.query(self.positions)[0] <= self.length
        if is_view:
            found = near | (path.query(self.end_positions)[0] <= self.length)
        else:
            before = self.ends < left_out.frames.min()
            found = near | ~(before | (self.frames > left_out.ends.max()))
        return np.asarray(found)


def cut(T_ref_sensor: Poses, extent: Extent) -> NDArray[np.intp]:
    """Number of each labelled frame's stretch along the reference, of shape (n,).

    The last piece joins the stretch before if it is shorter than half a stretch.
    """
    if not len(extent.frames):
        return np.empty(0, np.intp)
    size = PER_STRETCH * extent.length
    distance = travelled(T_ref_sensor)[extent.frames]
    distance -= distance[0]
    n_stretches = max(1, int(distance[-1] / size + 0.5))
    return np.minimum((distance / size).astype(np.intp), n_stretches - 1)


def stretches_of_view(
    view: Extent, recording: Extent, numbers: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Number of the stretch that each frame of a view shows, of shape (n,).

    It is that of the recording's nearest frame: a view shares the recording's reference.
    """
    from scipy.spatial import cKDTree

    return np.asarray(numbers[cKDTree(recording.positions).query(view.positions)[1]])


def part_of(simulation: BankSimulation, extent: Extent) -> tuple[BankSimulation, Extent]:
    """The part of a simulation that a stretch takes, and the stretch's extent in it."""
    first = int(extent.frames.min())
    stop = min(int(extent.ends.max()) + 1 + MARGIN_FRAMES, len(simulation.stamps))
    frames = slice(first, stop)

    def motions(members: tuple[int, ...]) -> Poses:
        return simulation.motions(members)[first : stop - 1]

    part = replace(
        simulation,
        stamps=simulation.stamps[frames],
        T_ref_sensor=simulation.T_ref_sensor[frames],
        descriptors=simulation.descriptors[frames],
        period=simulation.period[frames],
        hops=simulation.hops.part(first, stop),
        motions=motions,
    )
    return part, extent._replace(frames=extent.frames - first, ends=extent.ends - first)
