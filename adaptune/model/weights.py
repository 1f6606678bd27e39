"""Weights of the members of a bank, whose motions are averaged."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
)

from adaptune.live.hops import HopSquares, blend
from adaptune.metrics import FAILURE
from adaptune.model.rules import (
    ERROR_FLOOR,
    N_FRAMES,
    NOTHING,
    SHARPNESS,
    Evidence,
    FixedSet,
    NearestFrames,
    NearFrames,
    Rule,
    TrainingData,
)
from adaptune.space import ParameterSets, Selection

UNFAMILIAR_PRIOR_SHARE = 0.2
"""Share of the prior's windows that remain where a scan is unlike all training."""
UNTRIED_MEAN_SQUARE = 4.0
"""Mean square of a member that nobody has tried, in that of the first one."""
EVEN_SHARE = 0.5
"""Added to the members' mean squares, as a share of their harmonic mean, for weights that are more
even."""
MEMBER_CLIP = 6.0
"""Where members are chosen, `clip_errors` clips at this many times the fixed set's."""


class BankSettings(BaseModel):
    """Settings of a bank's weights."""

    # A file of another version may hold more.
    model_config = ConfigDict(extra="ignore", frozen=True)

    # How fast a sequence's weight falls with the distance of its nearest frames.
    sharpness: Annotated[NonNegativeFloat, Field(allow_inf_nan=False)] = 12.0
    # Nearest frames of each segment: products of errors need more of them than means do.
    n_frames: PositiveInt = 1000
    # Minimum share of the weight that the fixed set keeps where nothing was measured.
    min_fixed_share: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    # How many windows of live evidence the training counts as.
    prior_windows: Annotated[PositiveFloat, Field(allow_inf_nan=False)] = 3.0
    # Errors are clipped at this many times the fixed set's root mean square in the sequence: a
    # member that has lost track is left out of the mean, and does not cost what it would alone.
    clip: Annotated[PositiveFloat, Field(allow_inf_nan=False)] = 18.0
    # How many of the last members rest where the training knows the place.
    reserve: NonNegativeInt = 0


class NearProducts(NamedTuple):
    """Products of errors on the training frames nearest to some scans."""

    members: tuple[int, ...]  # trial numbers
    frames: NearFrames
    # (n_scans, n_sequences, n_members, n_members): mean products of the members' errors, percent
    # squared.
    products: NDArray[np.float64]
    fixed: NDArray[np.float64]  # (n_scans, n_sequences): mean squared error of the fixed set

    def of(self, members: Collection[int]) -> "NearProducts":
        """Those of some of the members."""
        kept = [i for i, trial in enumerate(self.members) if trial in members]
        products = self.products[:, :, kept][..., kept]
        return self._replace(members=tuple(self.members[i] for i in kept), products=products)


class BankRule(Rule):
    """Weigh the members of a bank so that the mean of their motions has the least expected error.

    That is w'Sw while errors are small, where S_jk is the mean product of the errors of members j
    and k (Bates and Granger, Operational Research Quarterly 1969); see "Bank" and "Live evidence"
    in ``docs/method.md``.
    """

    sentence = "a bank, whose members are weighed once a second"
    needs_known_sensor = gives_weights = True

    @classmethod
    def of(cls, bank: BankSettings | None) -> Rule:
        """See `Rule.of`: where no bank runs, the fixed set is kept."""
        return cls(bank) if bank else FixedSet()

    def __init__(self, settings: BankSettings | None = None):
        self.settings = settings or BankSettings()

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`.

        There is a ValueError if the data name no members, the fixed set first, or hold no error
        vectors of them.
        """
        members = data.candidates
        if members is None or data.vectors is None or members[0] != data.fixed:
            raise ValueError("a bank needs members, the fixed set first, and their error vectors")
        self.data_ = data
        self.members_ = members
        self.products_ = np.empty((len(data.features), len(members), len(members)), np.float32)
        for s in np.unique(data.sequence):
            frames = data.sequence == s
            vectors, lost = clip_errors(data.vectors[frames], self.settings.clip)
            self.products_[frames] = np.einsum("ijx,ikx->ijk", vectors, vectors)
            self.products_[frames] += lost[:, :, None] ** 2 * np.eye(len(members))
        self.fixed_squares_ = self.products_[:, 0, 0].astype(np.float64)
        self.nearest_ = NearestFrames(self.settings.n_frames).fit(data.features, data.sequence)
        return self

    def near(self, features: NDArray[np.float64]) -> NearProducts:
        """Find the products of errors on the training frames nearest to scans.

        Features are of shape (n_scans, n_features).
        """
        frames = self.nearest_.near(features)
        products, fixed = frames.means(self.products_), frames.means(self.fixed_squares_)
        return NearProducts(self.members_, frames, products, fixed)

    def select(self, feature: NDArray[np.float64], evidence: Evidence = NOTHING) -> Selection:
        """See `Rule.select`."""
        near = self.near(feature[None])
        similarity = float(near.frames.similarity[0])
        members = evidence.at_work(self.members_, similarity, self.predicted_fixed(near))
        return self.weigh(near.of(members), evidence.squares(members))

    def predicted_fixed(self, near: NearProducts) -> float:
        """Root mean square of the fixed set's error that is expected for one scan, in percent."""
        (of_sequences,) = near.frames.weights(self.settings.sharpness)
        return float(np.sqrt(of_sequences @ near.fixed[0]))

    def weigh(self, near: NearProducts, hops: HopSquares | None) -> Selection:
        """Weigh members for one scan; the others get no weight.

        `hops` is what was measured of them, in their order; None if nothing was.
        """
        (weights,), (ratio,) = bank_weights(near, self.settings, [hops])
        fixed = self.predicted_fixed(near)
        of_members = dict.fromkeys(self.members_, 0.0)
        of_members |= dict(zip(near.members, weights.tolist(), strict=True))
        return weighted_selection(self.data_.sets, of_members)._replace(
            predicted_error=float(ratio) * fixed,
            predicted_fixed=fixed,
            similarity=float(near.frames.similarity[0]),
        )


class StandbyRule(BankRule):
    """The fixed set, whose bank joins in where something is measured to be wrong.

    While the other members rest, the weights are the fixed set's.
    """

    sentence = "the fixed set; where it does worse than predicted, a bank joins in"

    @classmethod
    def of(cls, bank: BankSettings | None) -> Rule:
        """See `Rule.of`: a bank that joins in counts near training frames as a single set does."""
        few = BankSettings(sharpness=SHARPNESS, n_frames=N_FRAMES, clip=MEMBER_CLIP)
        return cls(few) if bank else FixedSet()


def weighted_selection(sets: ParameterSets, weights: Mapping[int, float]) -> Selection:
    """A selection of a bank's weights; its set is that of the heaviest member."""
    heaviest = max(weights, key=weights.__getitem__)
    return Selection(heaviest, sets[heaviest], weights)


def bank_weights(
    near: NearProducts, settings: BankSettings, hops: Sequence[HopSquares | None]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights of the members, and the root mean square that is expected of their mean.

    `hops` is what was measured of the members before each scan. Weights are of shape (n_scans,
    n_members), ratios to the fixed set's root mean square of shape (n_scans,).
    """
    relative = near.products / (near.fixed + ERROR_FLOOR**2)[..., None, None]
    of_sequences = near.frames.weights(settings.sharpness)
    trust = near.frames.trust[:, None, None]
    learned = np.einsum("qs,qsjk->qjk", of_sequences, relative)
    learned = trust * learned + (1.0 - trust) * _untried(len(near.members))
    windows = settings.prior_windows * (
        UNFAMILIAR_PRIOR_SHARE + (1.0 - UNFAMILIAR_PRIOR_SHARE) * near.frames.trust
    )
    squares = np.array([blend(*of_scan) for of_scan in zip(learned, windows, hops, strict=True)])
    weights = np.array([minimum_variance_weights(of_scan) for of_scan in squares])
    measured = np.array([0.0 if one is None else one.windows for one in hops])
    kept = settings.min_fixed_share * windows / (windows + measured)
    weights *= (1.0 - kept)[:, None]
    weights[:, 0] += kept
    mean_square = np.einsum("qj,qjk,qk->q", weights, squares, weights)
    # Where the fixed set has no error, there is none to be gained on.
    of_fixed = np.maximum(squares[:, 0, 0], 1e-12)
    return weights, np.sqrt(mean_square / of_fixed)


def measured_weights(n_members: int, hops: HopSquares | None) -> NDArray[np.float64]:
    """Weights of members of which the training says nothing.

    Until something is measured, the first member has all the weight. From then on, the others get
    theirs as far as the measurements confirm them.

    Returns shape (n_members,).
    """
    if hops is None:
        return np.asarray(np.eye(n_members)[0])
    prior = _untried(n_members)
    return minimum_variance_weights(blend(prior, BankSettings().prior_windows, hops))


def _untried(n_members: int) -> NDArray[np.float64]:
    """Mean products of the errors of members of which the training says nothing."""
    return np.diag([1.0, *[UNTRIED_MEAN_SQUARE] * (n_members - 1)])


def clip_errors(
    vectors: NDArray[np.float32], clip: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Clip the errors on the frames of a sequence.

    Vectors are percent, of shape (n_frames, n_sets, 3), not finite where the track was lost. `clip`
    is in times the root mean square of the first set, which is the fixed one.

    Returns vectors of the same shape, zero where the track was lost, and what counts there instead,
    in no direction, of shape (n_frames, n_sets), zero elsewhere.
    """
    lengths = np.linalg.norm(vectors, axis=-1)
    lost = ~(lengths <= FAILURE)
    of_fixed = np.where(lost[:, 0], FAILURE, lengths[:, 0])
    most = clip * np.sqrt((of_fixed**2).mean() + ERROR_FLOOR**2)
    share = np.minimum(1.0, most / np.maximum(lengths, 1e-9))
    kept = np.where(lost[..., None], 0.0, vectors) * np.where(lost, 0.0, share)[..., None]
    return kept.astype(np.float32), np.where(lost, most, 0.0).astype(np.float32)


def minimum_variance_weights(squares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights w, none negative and adding up to 1, for which w'Sw is least.

    S is of shape (n, n), and made more even by `EVEN_SHARE`.

    Returns shape (n,).
    """
    n = len(squares)
    harmonic = 1.0 / (1.0 / np.maximum(squares.diagonal(), 1e-12)).mean()
    squares = squares + np.eye(n) * (
        EVEN_SHARE * harmonic + 1e-9 * squares.diagonal().max() + 1e-12
    )
    # Up to a factor they are those for which w'Sw - 2 sum w is least.
    weights = np.linalg.solve(squares, np.ones(n))
    if weights.min() < 0.0:
        from scipy.optimize import nnls  # not needed to load a model

        root = np.linalg.cholesky(squares)
        weights, _ = nnls(root.T, np.linalg.solve(root, np.ones(n)))
    return np.asarray(weights / weights.sum())


def choose_members(
    vectors: NDArray[np.float32],
    sequence: NDArray[np.intp],
    pool: Sequence[int],
    size: int,
    allow: Callable[[list[int]], bool] = lambda _: True,
) -> list[int]:
    """Choose sets whose errors cancel each other: trial numbers, the fixed set's first.

    The search is greedy and begins with the fixed set, the first of the pool. Each next member is
    the one that most lowers the mean over the sequences of the root mean square of a weighted mean,
    if the best weights in every sequence were known.

    `vectors` are the errors of the pool, of shape (n_frames, n_pool, 3); `sequence` has the number
    of each frame's, and `allow` says whether a bank may be of some trials.
    """
    squares = []
    for s in np.unique(sequence):
        few, lost = clip_errors(vectors[sequence == s], MEMBER_CLIP)
        rows = few.transpose(0, 2, 1).reshape(-1, len(pool)).astype(np.float64)
        products = (rows.T @ rows + np.diag((lost.astype(np.float64) ** 2).sum(axis=0))) / len(few)
        squares.append(products / (products[0, 0] + ERROR_FLOOR**2))
    chosen = [0]
    while len(chosen) < min(size, len(pool)):
        members = [pool[j] for j in chosen]
        rest = [j for j in range(len(pool)) if j not in chosen and allow([*members, pool[j]])]
        if not rest:
            break
        lowered = {j: _root_mean_square(squares, [*chosen, j]) for j in rest}
        chosen.append(min(lowered, key=lowered.__getitem__))
    return [pool[j] for j in chosen]


def _root_mean_square(squares: list[NDArray[np.float64]], members: list[int]) -> float:
    errors = []
    for products in squares:
        of_members = products[np.ix_(members, members)]
        weights = minimum_variance_weights(of_members)
        errors.append(np.sqrt(weights @ of_members @ weights))
    return float(np.mean(errors))
