"""The labelled data set: what the archive holds about every training sequence."""

from collections import defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, lru_cache, partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system.machine import shared_cores
from adaptune.bank.members import LEVER, RESTART, Agreement, share
from adaptune.bank.rest import Backoff
from adaptune.geometry import Poses, invert, mean_motion, rectify, rotation_angle, steps
from adaptune.live.evidence import SPACING, USUAL_SHARE
from adaptune.live.hops import HopErrors, Hops, HopSquares, hop_squares
from adaptune.metrics import (
    LOST_ABOVE,
    cap,
    span,
    sub_trajectory_rte,
    sub_trajectory_vectors,
    travelled,
    window_ends,
)
from adaptune.model import ModelError, TrainingData
from adaptune.model.descriptor import averaged
from adaptune.model.rules import (
    BASELINE,
    ROUNDING,
    Costs,
    SetCost,
    allowed_sets,
    best_sets,
)
from adaptune.odometry.factory import Factory
from adaptune.odometry.health import Guard, HealthCheck
from adaptune.paired import MIN_RECORDINGS
from adaptune.recording.scan import segment_numbers
from adaptune.runs.archive import PREPARE_MS, REGISTER_MS, Archive, Trial, TrialSummary
from adaptune.space import ParameterSets
from adaptune.study.driven import PER_SEGMENT
from offline.choice import (
    MOST_OF_PERIOD,
    PER_BLOCK,
    BlockErrors,
    Front,
    NothingUsableError,
    affordable,
    choose,
    finalists,
    front,
)
from offline.config import OfflineStudy
from offline.objective import weighted

if TYPE_CHECKING:
    from adaptune.model.knn import ScaledPCA


MEMBER_POOL_SIZE = 64
"""A bank's members are searched for among this many of the best sets."""
MISFIT_PER_METRE = 0.25
"""By how much farther a scan is from the one before, about, in a metre by which it is misplaced."""


def error_vectors(T_ref_sensor: Poses, trial: Trial, length: float) -> NDArray[np.float32]:
    """Errors of a trial as vectors, see `sub_trajectory_vectors`.

    Their lengths are the trial's errors; of several runs, their directions are the first one's.

    Returns shape (n_frames, 3).
    """
    vectors = sub_trajectory_vectors(T_ref_sensor, trial.T_odom_sensor, length)
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
    T_ref_counted: Poses  # (n_frames, 4, 4): NaN where nothing is driven, or does not count
    descriptors: NDArray[np.float32]  # (n_frames, n_features): averaged
    period: NDArray[np.int64]  # (n_frames,): whole periods since the first scan
    length: float  # metres of a sub-trajectory
    lost_track: float  # metres a second
    hops: Hops  # measured without the odometry's errors
    # The motions of some sets, by trial numbers, over every scan but the first, of shape (n_frames
    # - 1, n_sets, 4, 4), see `recorded_motions`.
    motions: Callable[[tuple[int, ...]], Poses]
    ends_of_whole: NDArray[np.intp] | None = None  # `ends`, where it is a part of a simulation
    health: HealthCheck = field(default_factory=HealthCheck)  # of the bank as a whole
    _kept: dict[tuple[int, ...], list[HopSquares | None]] = field(default_factory=dict, init=False)

    @cached_property
    def ends(self) -> NDArray[np.intp]:
        """Last frame of the sub-trajectory from each frame on, of shape (n_frames,); -1: none."""
        if self.ends_of_whole is not None:
            return self.ends_of_whole
        return window_ends(self.T_ref_counted, self.length)

    def squares(self, members: tuple[int, ...]) -> list[HopSquares | None]:
        """What is measured of members before the first frame of each period."""
        if members in self._kept:
            return self._kept[members]
        start, end, T_start_end, projection = self.hops
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
        self._kept[members] = [
            hop_squares(
                HopErrors(*(array[end < frame] for array in hops)).recent(
                    float(metres[frame]), float(seconds[frame])
                )
            )
            for frame in periods(self.period)[0]
        ]
        return self._kept[members]

    def agreeing(self, members: tuple[int, ...], votes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Over which scans each member agrees with the others, of shape (n_frames - 1, n_members).

        Members vote with weights of shape (n_periods, n_members). The reference takes the place of
        the short registrations. A bank restarts a member that was lost, where it may be lost again:
        it is away until it may restart once more, or has rested, see `Backoff`, or the health check
        restarts the whole bank.
        """
        T_previous_current = self.motions(members)
        agreement, guard = Agreement(len(members), self.lost_track), Guard(self.health)
        agreeing = np.zeros(T_previous_current.shape[:2], bool)
        weights, now = self._of_steps(votes), 0.0
        back, losses = np.full(len(members), -np.inf), Backoff(len(members))
        for i, seconds in enumerate(np.diff(self.stamps) * 1e-9):
            now += seconds
            away = (now < back) | losses.resting(now)
            lost = np.isnan(T_previous_current[i, :, 0, 0]) & ~away
            T = np.where((lost | away)[:, None, None], np.nan, T_previous_current[i])
            alignment = partial(self._misplaced, i + 1)
            agreeing[i] = agreement.judge(T, seconds, weights[i], alignment)
            if guard.check(agreement.T_previous_current, seconds) is None:
                losses.lose(lost | (agreement.due & ~away), now)
                back[lost] = now + RESTART
                agreement.restarted(agreement.due)
            else:
                agreement.start()
                back, losses = np.full(len(members), -np.inf), Backoff(len(members))
        return agreeing

    def healthy(self, T_previous_current: Poses) -> Poses:
        """Motions of shape (n_frames - 1, 4, 4) as the health check lets them be, see `Tracker`.

        Where there is none (NaN), or an impossible one, the last healthy motion goes on.
        """
        guard, found = Guard(self.health), T_previous_current.copy()
        for i, seconds in enumerate(np.diff(self.stamps) * 1e-9):
            if guard.check(found[i], seconds) is not None:
                T_previous_healthy, T_healthy = guard.go_on(seconds)
                found[i] = T_previous_healthy @ T_healthy
        return found

    def _of_steps(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights at every scan but the first, of shape (n_frames - 1, n_members)."""
        return weights[periods(self.period)[1][1:]]

    def _misplaced(
        self, frame: int, T_then_now: Poses, ago: tuple[int, ...]
    ) -> NDArray[np.float64]:
        """What short registrations would find at a frame, see `Alignment`."""
        T_ref_now = self.T_ref_sensor[frame]
        T_ref = np.array([invert(self.T_ref_sensor[frame - n]) @ T_ref_now for n in ago])
        T = invert(T_ref)[:, None] @ T_then_now
        misplaced = np.linalg.norm(T[..., :3, 3], axis=-1) + LEVER * rotation_angle(T)
        found = np.minimum(1.0, MISFIT_PER_METRE * misplaced).mean(axis=0)
        return np.asarray(np.where(np.isnan(found), np.inf, found))

    def errors(
        self,
        members: tuple[int, ...],
        weights: NDArray[np.float64],
        agreeing: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.float64]:
        """Clipped errors of a bank at every frame, NaN without a sub-trajectory.

        Weights are of shape (n_periods, n_members). Who agrees is found with the same weights when
        left out, see `agreeing`.
        """
        agreeing = self.agreeing(members, weights) if agreeing is None else agreeing
        none = np.asarray(~agreeing.any(axis=1))
        believed = np.where(agreeing[..., None, None], self.motions(members), np.eye(4))
        moved = mean_motion(believed, share(self._of_steps(weights), agreeing | none[:, None]))
        moved[none] = np.nan
        T_ref, T_odom = self.T_ref_counted, chained(self.healthy(moved))
        return cap(sub_trajectory_rte(T_ref, T_odom, self.length, ends=self.ends))


def chained(T_previous_current: Poses) -> Poses:
    """Poses of shape (n + 1, ..., 4, 4) from motions of shape (n, ..., 4, 4), from the identity."""
    T = np.empty((len(T_previous_current) + 1, *T_previous_current.shape[1:]))
    T[0] = np.eye(4)
    for i, motion in enumerate(T_previous_current):
        T[i + 1] = rectify(T[i] @ motion)
    return T


def recorded_motions(trials: Sequence[Trial]) -> Poses:
    """Motions over every scan but the first, as the trials recorded them.

    Where the health check restarted a set, its motion was impossible, and is not known.

    Returns shape (n_frames - 1, n_trials, 4, 4), NaN there, and where nothing is driven.
    """
    motions = np.stack([steps(trial.T_odom_sensor) for trial in trials], axis=1)
    motions[np.stack([trial.restarted[1:] > 0 for trial in trials], axis=1)] = np.nan
    return motions


MARGIN_FRAMES = 2
"""Frames that a part of a simulation is longer than its segment: a distance that is summed from
another frame may differ in its last bits, and a sub-trajectory then ends one frame later."""


def segments(
    simulation: BankSimulation, known: NDArray[np.intp], n: float = PER_SEGMENT
) -> NDArray[np.intp]:
    """Number of each labelled frame's segment along the reference, of shape (n,).

    `known` has the numbers of these frames. What is driven without interruption is cut into pieces
    of `n` sub-trajectories; the last one joins the one before if it is shorter than half of that.
    """
    number = np.zeros(len(known), np.intp)
    size, distance = n * simulation.length, travelled(simulation.T_ref_sensor)
    counted = np.cumsum(np.isnan(simulation.T_ref_counted[:, 0, 0]))[known]
    following = 0
    for drive in np.split(np.arange(len(known)), np.flatnonzero(np.diff(counted)) + 1):
        if not len(drive):
            continue
        metres = distance[known[drive]] - distance[known[drive[0]]]
        n_pieces = max(1, int(metres[-1] / size + 0.5))
        number[drive] = following + np.minimum((metres / size).astype(np.intp), n_pieces - 1)
        following += n_pieces
    return number


def block_means(errors: NDArray[np.floating], block: NDArray[np.intp]) -> NDArray[np.float64]:
    """Mean clipped errors of shape (n_blocks, n_sets) from those at frames, by their blocks."""
    _, first = np.unique(block, return_index=True)
    sums = np.add.reduceat(cap(errors), first)
    return np.asarray(sums / np.diff([*first, len(errors)])[:, None])


@dataclass(frozen=True, eq=False)
class LabelledSequence:
    """The frames of a sequence that have a sub-trajectory, and the errors of sets there."""

    name: str
    recording: str  # that it is, or is a part of
    simulation: BankSimulation  # of all frames
    known: NDArray[np.intp]  # (n,): numbers of the labelled ones
    segment: NDArray[np.intp]  # (n,): number of each frame's segment
    # (n, n_sets): percent, infinite where the track was lost, NaN where a set never gave a pose.
    errors: NDArray[np.float32]
    blocks: Mapping[str, int]  # by name, in order, the lengths of the descriptors
    # By trial number (n, 3): errors of the best sets as vectors, see `adaptune.model.TrainingData`.
    vectors: Mapping[int, NDArray[np.float32]] = field(default_factory=dict)
    # (n,): number of each frame's block, see `offline.choice`.
    block: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    # (n_sets,): the objective that chooses the fixed set, unless it is the errors' mean.
    values: NDArray[np.float64] | None = None
    span: int = 1  # frames of a sub-trajectory
    elevation: float = np.nan  # degrees, see `adaptune.model.descriptor.lowest_elevation`
    # (n_sets,): how often the health check restarted each set, infinite if it failed
    restarts: NDArray[np.float64] | None = None
    turns: NDArray[np.float64] | None = None  # (n, n_sets): degrees a metre, where they are known
    # The same of all frames, from drives of the whole recording, see `LabelledData.driven`.
    whole: "LabelledSequence | None" = None

    @cached_property
    def period(self) -> NDArray[np.int64]:
        """Whole periods since the first scan, of shape (n,): in each, one selection holds."""
        return self.simulation.period[self.known]

    @cached_property
    def descriptors(self) -> NDArray[np.float32]:
        """Averaged descriptors, of shape (n, n_features)."""
        return self.simulation.descriptors[self.known]

    @property
    def ends(self) -> NDArray[np.intp]:
        """Last frames of the sub-trajectories, of shape (n,)."""
        return self.simulation.ends[self.known]

    @property
    def seconds(self) -> NDArray[np.float64]:
        """When the frames are, from the first scan, of shape (n,)."""
        return np.asarray(1e-9 * (self.simulation.stamps[self.known] - self.simulation.stamps[0]))

    @property
    def positions(self) -> NDArray[np.float64]:
        """Where the frames are in metres, of shape (n, 3)."""
        return self.simulation.T_ref_sensor[self.known, :3, 3]

    def near(self, left_out: "LabelledSequence") -> NDArray[np.bool_]:
        """Which frames must not be known where others of the same recording are left out.

        That is each frame within the length of a sub-trajectory of where these are, and each whose
        sub-trajectory overlaps one of theirs.
        """
        from scipy.spatial import cKDTree  # slow to import

        path, length = cKDTree(left_out.positions), self.simulation.length
        near = path.query(self.positions)[0] <= length
        if self.name == left_out.name:
            before = self.ends < left_out.known.min()
            found = near | ~(before | (self.known > left_out.ends.max()))
        else:
            # Another part of it counts frames in another way.
            at_ends = self.simulation.T_ref_sensor[self.ends, :3, 3]
            found = near | (path.query(at_ends)[0] <= length)
        return np.asarray(found)

    def frames(self, kept: NDArray[np.bool_]) -> "LabelledSequence":
        """The same with some of the frames."""
        if kept.all():
            return self
        known, turns, whole = self.known[kept], self.turns, self.whole
        return replace(
            self,
            known=known,
            segment=self.segment[kept],
            errors=self.errors[kept],
            vectors={trial: vectors[kept] for trial, vectors in self.vectors.items()},
            block=self.block[kept],
            turns=None if turns is None else turns[kept],
            whole=whole and whole.frames(np.isin(whole.known, known)),
        )

    def in_blocks(self) -> NDArray[np.float64]:
        """Mean clipped errors, of shape (n_blocks, n_sets), or the objective, (1, n_sets)."""
        if self.values is not None:
            return self.values[None]
        return block_means(self.errors, self.block)

    def part(self) -> "LabelledSequence":
        """The same with the part of the simulation that its frames take."""
        simulation, first = self.simulation, int(self.known.min())
        stop = min(int(self.ends.max()) + 1 + MARGIN_FRAMES, len(simulation.stamps))
        frames = slice(first, stop)
        ends = simulation.ends[frames] - first
        ends[(simulation.ends[frames] < 0) | (ends >= stop - first)] = -1
        part = replace(
            simulation,
            stamps=simulation.stamps[frames],
            T_ref_sensor=simulation.T_ref_sensor[frames],
            T_ref_counted=simulation.T_ref_counted[frames],
            # Noise counts by the whole path: of a part, windows might end elsewhere.
            ends_of_whole=ends,
            descriptors=simulation.descriptors[frames],
            period=simulation.period[frames],
            hops=simulation.hops.part(first, stop),
            motions=lambda members: simulation.motions(members)[first : stop - 1],
        )
        return replace(self, simulation=part, known=self.known - first)

    def subset(self, columns: NDArray[np.intp]) -> "LabelledSequence":
        """The same with some of the sets."""
        return replace(
            self,
            errors=self.errors[:, columns],
            values=None if self.values is None else self.values[columns],
            restarts=None if self.restarts is None else self.restarts[columns],
        )


class LabelledData(NamedTuple):
    """Labelled sequences, all with errors of the same sets."""

    sequences: Sequence[LabelledSequence]
    sets: ParameterSets  # the columns of their errors
    costs: Costs = Costs({}, np.nan)  # of the sets, as far as they are known
    # Milliseconds of CPU time a scan that may be spent, live evidence included.
    budget: float | None = None
    cores: int = 1  # that a bank may use
    driven: Sequence[int] = ()  # finalists: trial numbers, the columns of drives of the whole
    beside: Costs | None = None  # as they were measured side by side in these drives

    def subset(self, trials: Sequence[int]) -> "LabelledData":
        """The same with some of the sets."""
        columns = self.sets.columns(trials)
        few = [s.subset(columns) for s in self.sequences]
        return self._replace(sequences=few, sets=self.sets.subset(trials))

    def usable(self) -> "LabelledData":
        """The same with the sets that did not fail; a NothingUsableError if the baseline did."""
        if not self.costs.usable(BASELINE):
            raise NothingUsableError(
                "the baseline fails where it begins within a recording, though not along a whole "
                "one; set offline.segments: all"
            )
        return self.subset([n for n in self.sets if self.costs.usable(n)])

    @property
    def recordings(self) -> list[str]:
        """The recordings; parts of one are none."""
        return list(dict.fromkeys(s.recording for s in self.sequences))

    def folds(
        self, by_recording: bool | None = None
    ) -> list[tuple[LabelledSequence, "LabelledData"]]:
        """Leave each recording out, or, by default below `MIN_RECORDINGS`, each segment.

        A segment is not left out if nothing far enough from it remains.
        """
        if by_recording is None:
            by_recording = len(self.recordings) >= MIN_RECORDINGS
        folds = []
        for whole in self.sequences:
            if by_recording:
                folds.append((whole, self.without(whole)))
                continue
            for number in np.unique(whole.segment):
                left = whole.frames(whole.segment == number)
                known = [
                    s if s.recording != whole.recording else s.frames(~s.near(left))
                    for s in self.sequences
                ]
                others = self._replace(sequences=[s for s in known if len(s.errors)])
                folds.append((left.part(), others))
        return [(left, others) for left, others in folds if others.sequences]

    def without(self, sequence: LabelledSequence) -> "LabelledData":
        """The other recordings."""
        others = [s for s in self.sequences if s.recording != sequence.recording]
        return self._replace(sequences=others)

    def segments(self) -> NDArray[np.intp]:
        """Number of every frame's segment, of shape (n_frames,)."""
        cuts = np.concatenate([s.segment for s in self.sequences])
        return segment_numbers(self.numbers(), cuts)

    def numbers(self) -> NDArray[np.intp]:
        """Number of every frame's sequence, of shape (n_frames,)."""
        return np.repeat(np.arange(len(self.sequences)), [len(s.errors) for s in self.sequences])

    def errors(self) -> NDArray[np.float32]:
        """Errors on the frames of all sequences, of shape (n_frames, n_sets)."""
        return np.concatenate([s.errors for s in self.sequences])

    def blocks(self) -> BlockErrors:
        """What the trials of all sets say."""
        return self._blocks(self.sequences, list(self.sets), self.costs)

    def _blocks(
        self, sequences: Sequence[LabelledSequence], trials: Sequence[int], costs: Costs
    ) -> BlockErrors:
        none, errors = np.zeros(len(trials)), [s.in_blocks() for s in sequences]
        turns = [
            block_means(s.turns, s.block)
            for s in sequences
            if s.turns is not None and s.values is None  # an objective has a value a recording
        ]
        return BlockErrors(
            trials,
            np.concatenate(errors),
            np.repeat(np.arange(len(errors)), [len(of) for of in errors]),
            np.array([costs.alone(trial) for trial in trials]),
            np.sum([none if s.restarts is None else s.restarts for s in sequences], axis=0),
            self.period,
            np.concatenate(turns) if len(turns) == len(errors) else None,
            self.sets.defaults if len(self.sets.space.baselines) > 1 else (BASELINE,),
            # Another objective is no error in percent.
            LOST_ABOVE if all(s.values is None for s in sequences) else np.inf,
        )

    def whole_blocks(self, trials: Collection[int]) -> BlockErrors:
        """What drives of whole recordings say, of those of some sets that have made them."""
        whole = [s.whole for s in self.sequences if s.whole is not None]
        if not (known := [n for n in self.driven if n in trials and n in self.sets]):
            return self.blocks().some(list(trials))
        return self._blocks(whole, self.driven, self.beside or self.costs).some(known)

    def finalists(self) -> list[int]:
        """Trials whose sets drive whole recordings, see `offline.choice.finalists`."""
        return finalists(self.blocks(), self.budget)

    def fixed(self) -> int:
        """Trial number of the fixed set within the budget, by finalists' whole drives."""
        return choose(self.driven_blocks(), self.budget)

    def front(self) -> Front:
        """What CPU time buys, by finalists' whole drives."""
        return front(self.driven_blocks(), self.budget)

    def driven_blocks(self) -> BlockErrors:
        """What finalists' whole drives say, or all trials where none of them is affordable."""
        blocks = self.blocks()
        few = finalists(blocks, self.budget)
        driven, cheap = self.whole_blocks(few), affordable(blocks, self.budget)
        if self.budget is not None and not (driven.costs <= self.budget).any():
            driven = self._replace(beside=None).whole_blocks(few)
        if not cheap[[blocks.trials.index(trial) for trial in driven.trials]].any():
            driven = blocks.some(few)  # with something left out, others may be finalists
        return driven

    def training_data(self) -> tuple[TrainingData, "ScaledPCA"]:
        """What selection rules are fitted to, and the transformation of descriptors for them."""
        from adaptune.model.knn import ScaledPCA  # takes long to import

        descriptors = np.concatenate([s.descriptors for s in self.sequences])
        pca = ScaledPCA(self.sequences[0].blocks.values())
        data = TrainingData(
            pca.fit(descriptors).transform(descriptors),
            self.segments(),
            self.errors(),
            self.sets,
            fixed := self.fixed(),
            allowed=allowed_sets(self.costs, self.budget, self.sets, fixed),
            costs=self.costs,
        )
        return data, pca

    def member_pool(self, fixed: int) -> list[int]:
        """Trials that the members of a bank are chosen from, the fixed set's first."""
        known = set.intersection(*(set(s.vectors) for s in self.sequences))
        best = best_sets(self.errors(), self.segments(), self.sets)[:MEMBER_POOL_SIZE]
        return [fixed, *(trial for trial in best if trial != fixed and trial in known)]

    def can_pay(self, members: Iterable[int]) -> bool:
        """Whether a bank of these trials stays within the budget, or without one, is in time."""
        most = self.cores * MOST_OF_PERIOD * self.period if self.budget is None else self.budget
        cost = self.costs.adaptive(members)
        return cost <= most + ROUNDING or (self.budget is None and np.isnan(cost))

    @property
    def period(self) -> float:
        """Milliseconds from scan to scan, the shortest of all recordings."""
        return min(1e-6 * float(np.median(np.diff(s.simulation.stamps))) for s in self.sequences)

    def vectors(self, members: Sequence[int]) -> NDArray[np.float32]:
        """Error vectors of some sets on the frames of all sequences, of shape (n, n_members, 3)."""
        return np.concatenate(
            [np.stack([s.vectors[trial] for trial in members], axis=1) for s in self.sequences]
        )


def periods(period: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First frame of every period, and number of every frame's period among them."""
    _, first, number = np.unique(period, return_index=True, return_inverse=True)
    return first, number


def mean_cost(trials: Sequence[TrialSummary], preparation: int) -> SetCost:
    """Mean cost of a set over the sequences that it was run on; infinite if it failed."""
    register, prepare = (
        float(np.mean([trial.others.get(key, np.nan) for trial in trials]))
        for key in (REGISTER_MS, PREPARE_MS)
    )
    failed = any(trial.failure for trial in trials)
    return SetCost(np.inf if failed else register, prepare, preparation)


def measured_costs(
    archive: Archive, names: Sequence[str], sets: ParameterSets, odometry: Factory
) -> Costs:
    """Mean costs of sets over sequences.

    Sets with the same preparation have the median of what it took in their trials: it is the same
    work, and differs with what else the machine did.
    """
    numbers: dict[Hashable, int] = {}
    costs: dict[int, SetCost] = {}
    known = defaultdict[int, list[float]](list)  # what each preparation took in trials that worked
    for trial in sets:
        trials = [archive.finished(name)[trial] for name in names]
        number = numbers.setdefault(odometry(sets[trial]).preparation, len(numbers))
        costs[trial] = cost = mean_cost(trials, number)
        if np.isfinite(cost.alone):
            known[number].append(cost.prepare)
    usual = {number: float(np.median(times)) for number, times in known.items()}
    found = {
        trial: cost._replace(prepare=usual.get(cost.preparation, cost.prepare))
        for trial, cost in sorted(costs.items(), key=lambda item: item[1].preparation)
    }
    every_second = float(np.mean([archive.read_frames(name).evidence_ms for name in names]))
    return Costs(found, USUAL_SHARE * every_second)


def labelled_data(study: OfflineStudy, archive: Archive, sets: ParameterSets) -> LabelledData:
    """Read the labelled data set of a study; there is a ModelError if a trial is missing."""
    sequences = []
    for name in study.training:
        if missing := set(sets) - set(archive.finished(name)):
            raise ModelError(
                f"{archive.folder}: lacks trial {min(missing)} on {name}, which the model was "
                f"fitted to; run `adaptune offline` again"
            )
        sequences.append(_labelled(study, archive, name, sets))
    costs = measured_costs(archive, study.training, sets, study.odometry)
    data = LabelledData(sequences, sets, costs, cores=len(shared_cores()))
    blocks = data.blocks()
    own = float(blocks.costs[blocks.baseline])
    return data._replace(budget=study.config.online.milliseconds(own))


def with_vectors(data: LabelledData, archive: Archive) -> LabelledData:
    """The same with error vectors of the sets that may be members of a bank."""
    best = best_sets(data.errors(), data.numbers(), data.sets)
    # With a sequence left out, others than now may be among the best. To read the poses of
    # thousands of trials would take long.
    eligible = {BASELINE, *best[: 2 * MEMBER_POOL_SIZE]}.intersection(best)
    sequences = []
    for s in data.sequences:
        T_ref_sensor, length = s.simulation.T_ref_counted, s.simulation.length
        vectors = {
            trial: error_vectors(T_ref_sensor, archive.read(s.name, trial), length)[s.known]
            for trial in eligible
        }
        sequences.append(replace(s, vectors=vectors))
    return data._replace(sequences=sequences)


def _labelled(
    study: OfflineStudy, archive: Archive, name: str, sets: ParameterSets
) -> LabelledSequence:
    """A labelled sequence without error vectors and drives of the whole."""
    config, frames = study.config, archive.read_frames(name)
    length, period = config.sub_trajectory, config.online.period
    errors = archive.read_errors(name, list(sets))
    # All trials know the same frames, but for those before an odometry's first pose.
    known = np.flatnonzero(~np.isnan(errors[:, ~np.isnan(errors).all(axis=0)]).any(axis=1))
    objective = config.offline.objective
    summaries = [archive.finished(name)[trial] for trial in sets]
    values = [np.inf if s.failure else weighted(objective, s.metrics) for s in summaries]
    restarts = [np.inf if s.failure else float(s.restarts) for s in summaries]
    read = cache(partial(archive.read, name))

    @lru_cache(maxsize=1)  # one bank after the other is asked for, each many times
    def motions(trials: tuple[int, ...]) -> Poses:
        return recorded_motions([read(trial) for trial in trials])

    simulation = BankSimulation(
        frames.stamps,
        frames.T_ref_sensor,
        frames.counted,
        averaged(frames.descriptors, frames.stamps, study.window, period),
        ((frames.stamps - frames.stamps[0]) * 1e-9 // period).astype(np.int64),
        length,
        config.lost_track,
        frames.hops,
        motions,
        health=config.health,
    )
    return LabelledSequence(
        name,
        study.sequences.recorded_in(name),
        simulation,
        known,
        segments(simulation, known),
        errors[known],
        frames.blocks,
        block=segments(simulation, known, PER_BLOCK),
        values=None if set(objective) == {"rte"} else np.array(values),
        span=span(frames.counted, length),
        restarts=np.array(restarts),
        elevation=float(np.nanmedian(frames.elevations)),
    )
