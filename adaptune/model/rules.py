"""What selection rules learn from, and what they have in common."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.live.hops import HopSquares
from adaptune.metrics import cap
from adaptune.space import ParameterSets, Selection

if TYPE_CHECKING:
    from adaptune.model.weights import BankSettings

NOVEL_SIMILARITY = 0.1
"""Similarity below which the nearest training frames count less and less."""
_QUANTILES = 10
"""Of the distances of each training sequence's frames from the other sequences."""


class NearFrames(NamedTuple):
    """The training frames nearest to some scans."""

    # (n_scans, n_near): for each training sequence, numbers of its frames that are nearest to each
    # scan.
    numbers: tuple[NDArray[np.intp], ...]
    squared: NDArray[np.float64]  # (n_scans, n_sequences): mean squared distance of these frames
    # (n_scans,): share of the training frames that are farther from the other sequences than each
    # scan is from all of them; NaN of a single sequence, which has no others.
    similarity: NDArray[np.float64]

    @property
    def trust(self) -> NDArray[np.float64]:
        """How far they count for each scan, from 0 to 1: fully where similarity is unknown."""
        return np.asarray(np.fmin(1.0, self.similarity / NOVEL_SIMILARITY))

    def weights(self, sharpness: float) -> NDArray[np.float64]:
        """Weights of the training sequences: the nearer their frames, the larger.

        Returns shape (n_scans, n_sequences): each row adds up to 1.
        """
        # Where the median is zero, every sequence has the very same place in it.
        spread = np.median(self.squared, axis=1, keepdims=True)
        spread[spread == 0.0] = 1.0
        least = self.squared.min(axis=1, keepdims=True)
        weights = np.exp(-sharpness * (self.squared - least) / spread)
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def means(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Mean over the near frames of every sequence.

        There is one value for each training frame, of shape (n_frames, ...).

        Returns shape (n_scans, n_sequences, ...).
        """
        means = np.empty((*self.squared.shape, *values.shape[1:]))
        for s, frames in enumerate(self.numbers):
            # All frames are near to every scan: the mean is the same.
            same = frames.strides[0] == 0
            near = values[frames[:1]] if same else values[frames]
            means[:, s] = near.mean(axis=1, dtype=np.float64)
        return means


class NearestFrames:
    """Finds the training frames that are nearest to scans."""

    def __init__(self, n_frames: int):
        self.n_frames = n_frames

    def fit(self, features: NDArray[np.float64], sequence: NDArray[np.intp]) -> Self:
        """Learn from the training frames.

        Features are of shape (n_frames, n_features).
        """
        self.members_ = [np.flatnonzero(sequence == s) for s in np.unique(sequence)]
        self.features_ = [features[members] for members in self.members_]
        self.distances_ = self._distances_between_sequences()
        return self

    def near(self, features: NDArray[np.float64]) -> NearFrames:
        """Find the frames that are nearest to scans.

        Features are of shape (n_scans, n_features).
        """
        squared = np.empty((len(features), len(self.members_)))
        numbers = []
        for s, (members, own) in enumerate(zip(self.members_, self.features_, strict=True)):
            squared[:, s], nearest = _nearest(own, features, self.n_frames)
            numbers.append(members[nearest])
        similarity = np.full(len(features), np.nan)
        if len(self.distances_):
            below = np.searchsorted(self.distances_, squared.min(axis=1), side="left")
            similarity = 1.0 - below / len(self.distances_)
        return NearFrames(tuple(numbers), squared, similarity)

    def _distances_between_sequences(self) -> NDArray[np.float64]:
        """Sorted distances of training frames from the other sequences, as many of each."""
        if len(self.members_) < 2:
            return np.empty(0)
        some = [features[:: max(1, len(features) // _QUANTILES)] for features in self.features_]
        number = np.repeat(np.arange(len(some)), [len(features) for features in some])
        queries = np.concatenate(some)
        squared = np.full(len(queries), np.inf)
        for s, features in enumerate(self.features_):
            others = number != s
            found, _ = _nearest(features, queries[others], self.n_frames)
            squared[others] = np.minimum(squared[others], found)
        at = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
        return np.sort(
            np.concatenate([np.quantile(squared[number == s], at) for s in range(len(some))])
        )


def _nearest(
    features: NDArray[np.float64], queries: NDArray[np.float64], n: int
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Mean squared distance of the `n` frames nearest to each query, and their numbers."""
    from scipy.spatial.distance import cdist  # not needed to load a model

    squared = cdist(queries, features, "sqeuclidean")
    if n >= len(features):
        everything = np.broadcast_to(np.arange(len(features)), squared.shape)
        return squared.mean(axis=1), everything
    nearest = np.argpartition(squared, n - 1, axis=1)[:, :n]
    return np.take_along_axis(squared, nearest, axis=1).mean(axis=1), nearest


ROUNDING = 1e-9
"""By how much a sum of costs may exceed a budget."""


class SetCost(NamedTuple):
    """Milliseconds of CPU time a scan."""

    register: float
    prepare: float
    preparation: int  # sets with the same number share prepared scans

    @property
    def alone(self) -> float:
        """Of one instance."""
        return self.register + self.prepare


@dataclass(frozen=True)
class Costs:
    """What sets cost, as it was measured in the trials."""

    # By trial number; infinite where a set is not usable.
    sets: Mapping[int, SetCost]
    evidence: float  # milliseconds of CPU time a scan that live evidence takes

    def alone(self, trial: int) -> float:
        """Milliseconds of CPU time a scan of one instance, no live evidence; NaN if unknown."""
        return self.sets[trial].alone if trial in self.sets else np.nan

    def without(self, trials: Collection[int]) -> "Costs":
        """The same where some trials are not usable."""
        none = {n: SetCost(np.inf, np.inf, -1) for n in trials}
        return replace(self, sets={**self.sets, **none})

    def usable(self, trial: int) -> bool:
        """Whether the odometry works with a set."""
        return not np.isinf(self.alone(trial))

    def adaptive(self, trials: Iterable[int]) -> float:
        """Milliseconds of CPU time a scan of several instances together, with live evidence.

        Instances with the same preparation share prepared scans.
        """
        known = [self.sets.get(trial, SetCost(np.nan, np.nan, -1)) for trial in trials]
        prepare: dict[int, float] = {}
        for cost in known:
            prepare[cost.preparation] = max(cost.prepare, prepare.get(cost.preparation, 0.0))
        return sum(cost.register for cost in known) + sum(prepare.values()) + self.evidence

    def allow(self, members: Iterable[int], budget: float | None) -> bool:
        """Whether a bank keeps to a budget, if there is one; of unknown cost, none does."""
        return budget is None or self.adaptive(members) <= budget + ROUNDING


def allowed_sets(
    costs: Costs | None, budget: float | None, sets: Iterable[int], fixed: int
) -> tuple[int, ...] | None:
    """The usable sets that a budget allows one at a time, the fixed one included; None for all."""
    if costs is None:
        return None
    return tuple(t for t in sets if t == fixed or (costs.usable(t) and costs.allow([t], budget)))


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Errors of parameter sets on the frames of several sequences: what a rule is fitted to.

    Attributes
    ----------
    features
        Averaged descriptors, scaled, of shape (n_frames, n_features): what `Rule.select` gets.
    sequence
        Number of each frame's segment, of shape (n_frames,).
    errors
        Sub-trajectory RTE in percent, of shape (n_frames, n_sets), infinite where the track was
        lost, NaN where the set was not run. Take `adaptune.metrics.cap` before a mean.
    sets
        Parameters by trial number, in the order of the columns of `errors`.
    fixed
        Trial number of the fixed set.
    candidates
        Trial numbers of the sets to choose among, the fixed one included; any if None.
    vectors
        Errors of the candidates as vectors in the frame of the sub-trajectory's start, of shape
        (n_frames, n_candidates, 3), not finite where the track was lost.
    allowed
        Trial numbers of the usable sets that a budget allows; all if None.
    costs
        What the sets cost; None if it was not measured.
    """

    features: NDArray[np.float64]
    sequence: NDArray[np.intp]
    errors: NDArray[np.float32]
    sets: ParameterSets
    fixed: int
    candidates: tuple[int, ...] | None = None
    vectors: NDArray[np.float32] | None = None
    allowed: tuple[int, ...] | None = None
    costs: Costs | None = None

    def allows(self) -> NDArray[np.bool_]:
        """Which sets may be chosen: candidates that the budget allows, of shape (n_sets,)."""
        allowed = np.ones(len(self.sets), np.bool_)
        for some in (self.candidates, self.allowed):
            if some is not None:
                allowed &= np.isin(self.sets.trials, some)
        return allowed


def mean_errors(errors: NDArray[np.floating], sequence: NDArray[np.intp]) -> NDArray[np.float64]:
    """Mean clipped error of every set; each sequence has the same weight.

    Errors are percent, of shape (n_frames, n_sets), NaN where a set was not run.

    Returns shape (n_sets,): percent. Frames without an error do not count. Where a set has no
    error on a whole sequence, its mean is infinite: sequences differ more than sets do, so means
    over different sequences cannot be compared.
    """
    clipped = cap(errors)
    means = []
    for s in np.unique(sequence):
        of_sequence = clipped[sequence == s]
        known = ~np.isnan(of_sequence)
        if known.all():
            means.append(of_sequence.mean(axis=0))
            continue
        number = known.sum(axis=0)
        total = np.where(known, of_sequence, 0.0).sum(axis=0)
        means.append(np.where(number > 0, total / np.maximum(number, 1), np.inf))
    return np.asarray(np.mean(means, axis=0))


def best_sets(
    errors: NDArray[np.floating], sequence: NDArray[np.intp], sets: ParameterSets
) -> list[int]:
    """Trial numbers by rising `mean_errors`, without those that were not run on every sequence."""
    means = mean_errors(errors, sequence)
    return [sets.trials[c] for c in np.argsort(means, kind="stable") if means[c] < np.inf]


def complementary(
    data: TrainingData, size: int, allow: Callable[[list[int]], bool] = lambda _: True
) -> list[int]:
    """Choose sets so that at every training frame one does well: trials, the fixed set's first.

    The search is greedy and begins with the fixed set. Each next set is the one that lowers the
    mean error most if the best of the chosen sets were known at every frame.

    `size` sets, or fewer where another one would lower nothing, or `allow` refuses them, as they
    cost too much. A set that was not run on every sequence is not chosen.
    """
    everywhere = np.isfinite(mean_errors(data.errors, data.sequence)) & data.allows()
    clipped = np.where(np.isnan(data.errors) | ~everywhere, np.inf, cap(data.errors))
    chosen = [data.fixed]
    least = cap(data.errors[:, data.sets.column(data.fixed)])
    while len(chosen) < size:
        means = mean_errors(np.minimum(clipped, least[:, None]), data.sequence)
        now = means[data.sets.column(data.fixed)]
        means = np.where([allow([*chosen, trial]) for trial in data.sets], means, np.inf)
        best = int(np.argmin(means))
        # A set that is chosen already lowers nothing.
        if not means[best] < now:
            break
        chosen.append(data.sets.trials[best])
        least = np.minimum(least, clipped[:, best])
    return chosen


class Evidence(NamedTuple):
    """What the drive has told so far."""

    # By trial, what was measured of sets that have done worse than predicted, in percent.
    worse: Callable[[], Mapping[int, float]] = dict
    # What was measured of some members of a bank, by trial.
    squares: Callable[[Collection[int]], HopSquares | None] = lambda _: None
    # Of a bank's members, those that work where a place is so familiar, and so much is predicted of
    # the fixed set, in percent.
    at_work: Callable[[Sequence[int], float, float], Sequence[int]] = lambda members, *_: members


NOTHING = Evidence()
"""Before a drive, or without one."""


class Rule(ABC):
    """A way to choose a parameter set for a scan; see `adaptune.model.registry`."""

    # What it selects, in a sentence.
    sentence: ClassVar[str] = "what a rule of the user's selects"
    # Whether the fixed set is kept for scans of another sensor than in training.
    needs_known_sensor: ClassVar[bool] = False
    # Whether it gives weights to the members of a bank where one runs; others choose among them.
    gives_weights: ClassVar[bool] = False

    @classmethod
    def of(cls, bank: "BankSettings | None") -> "Rule":  # noqa: ARG003 - for those that need it
        """Make the rule: with settings of a bank if it gives weights to one, else for one set."""
        return cls()

    @abstractmethod
    def fit(self, data: TrainingData) -> Self:
        """Learn, and compute whatever does not depend on the scan."""

    @abstractmethod
    def select(self, feature: NDArray[np.float64], evidence: Evidence = NOTHING) -> Selection:
        """Choose a set, or weights, for one scan's scaled descriptor of shape (n_features,)."""


ERROR_FLOOR = 0.02
"""Percent, added to both errors of a ratio so that none is divided by zero."""
BASELINE = 0
"""Trial number of the baseline; of several odometries, that of the first."""
N_FRAMES = 300
"""Nearest frames of each sequence."""
SHARPNESS = 6.0
"""How fast a sequence's weight falls with the distance of its nearest frames."""


class FixedSet(Rule):
    """Keep the fixed set; where it does worse than predicted, the baseline may take its place.

    See "One set" in ``docs/method.md``. The farther a scan is from all training, the less the two
    predictions differ, and of equals the baseline is taken. It counts if it was run on every
    sequence, and the budget allows it.
    """

    needs_known_sensor = True

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`."""
        self.data_ = data
        usable = np.isfinite(mean_errors(data.errors, data.sequence)) & data.allows()
        has_baseline = BASELINE in data.sets and usable[data.sets.column(BASELINE)]
        self.trials_ = list(dict.fromkeys([data.fixed, BASELINE] if has_baseline else [data.fixed]))
        self.errors_ = cap(data.errors[:, data.sets.columns(self.trials_)])
        self.nearest_ = NearestFrames(N_FRAMES).fit(data.features, data.sequence)
        return self

    def select(self, feature: NDArray[np.float64], evidence: Evidence = NOTHING) -> Selection:
        """See `Rule.select`."""
        near = self.nearest_.near(feature[None])
        (predicted,) = np.einsum("qs,qsj->qj", near.weights(SHARPNESS), near.means(self.errors_))
        fixed = float(predicted[0])
        predicted = fixed + near.trust[0] * (predicted - fixed)
        errors = dict(zip(self.trials_, predicted.tolist(), strict=True))
        trial, measured = self.data_.fixed, evidence.worse()
        if trial in measured:
            errors |= {t: error for t, error in measured.items() if t in errors}
            trial = min(errors, key=lambda t: (errors[t], t != BASELINE))
        return Selection(
            trial,
            self.data_.sets[trial],
            predicted_error=float(predicted[self.trials_.index(trial)]),
            predicted_fixed=fixed,
            similarity=float(near.similarity[0]),
        )
