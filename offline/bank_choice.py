"""Choice of a bank: its members, and the settings of its weights.

Banks are compared by their expected loss on what is left out, see `expected_loss`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from adaptune.metrics import cap, worst_tenth
from adaptune.model import BankRule, BankSettings, TrainingData
from adaptune.model.rules import BASELINE, ERROR_FLOOR, complementary
from adaptune.model.weights import bank_weights, choose_members
from adaptune.paired import of_segments
from offline.choice import allowed_cost
from offline.labelled import LabelledData, LabelledSequence, periods

if TYPE_CHECKING:
    from adaptune.model.knn import ScaledPCA


WORST_TENTH_WEIGHT = 0.5
"""Weight of the worst tenth."""

Logs = NDArray[np.float64]
"""Logarithms of the ratio to the fixed set's error, a number for each segment."""


class Figures(NamedTuple):
    """What is expected of a way to adapt: ratios to the fixed set's error."""

    loss: float  # see `expected_loss`
    geometric: float  # geometric mean over the segments
    low: float  # 95 % interval of it
    high: float
    worst_tenth: float  # geometric mean over the worst tenth
    worst: float
    n_segments: int
    n_recordings: int
    error: float  # standard error of the logarithm of the geometric mean


def log_ratios(
    errors: NDArray[np.float64], fixed: NDArray[np.float64], segment: NDArray[np.intp]
) -> Logs:
    """Logarithm of the ratio to the fixed set's error on each segment, by rising number.

    Errors are clipped, in percent, of shape (n_frames,); `segment` has each frame's number.
    """
    _, number = np.unique(segment, return_inverse=True)
    n_frames = np.bincount(number)
    means, of_fixed = (np.bincount(number, e) / n_frames + ERROR_FLOOR for e in (errors, fixed))
    return np.asarray(np.log(means / of_fixed))


def expected_loss(logs: Logs, recordings: Sequence[str]) -> float:
    """Mean logarithm, plus half the mean of the worst tenth, plus one standard error.

    The fixed set has 0. Worst segments that are better than the fixed set's are no merit. One
    segment shows nothing: the loss is infinite, unless it does as the fixed set does.

    There is a number for each segment, and the name of its recording, in order along it.
    """
    if not logs.any():
        return 0.0
    risk = WORST_TENTH_WEIGHT * max(0.0, worst_tenth(logs))
    return float(logs.mean() + risk + of_segments(logs, recordings).error)


def figures(logs: Logs, recordings: Sequence[str]) -> Figures:
    """All that is said of a way to adapt."""
    geometric, ends, error = of_segments(logs, recordings)
    tenth, worst = (float(np.exp(ratio)) for ratio in (worst_tenth(logs), logs.max()))
    loss, n = expected_loss(logs, recordings), len(set(recordings))
    return Figures(loss, geometric, *(ends or (0.0, np.inf)), tenth, worst, len(logs), n, error)


BANK_SETTINGS = [
    BankSettings(min_fixed_share=share, prior_windows=windows)
    for share, windows in ((0.0, 3.0), (0.0, 10.0), (0.25, 3.0), (0.75, 10.0))
]
"""A bank is driven with one of these; of equally good ones the first."""
MOST_FOLDS = 12
"""So many folds at most compare ways to adapt where something is left out already."""
ROUNDING = 1e-6
"""A smaller loss, or gain, is one of rounding."""


class Policy(NamedTuple):
    """A bank."""

    bank: BankSettings
    members: list[int]  # trial numbers, the fixed set's first; none where no bank is possible
    # What is expected of it; None where there is too little to compare.
    expected: Figures | None


def choose(
    data: LabelledData,
    bank: int,
    by_recording: bool | None = None,
    most: int | None = None,
) -> Policy:
    """Choose a bank, leaving one recording or segment after the other out.

    Parameters
    ----------
    data
        What the rules will be fitted on, and nothing else.
    bank
        Number of a bank's members; no bank is considered with 0.
    by_recording
        See `LabelledData.folds`.
    most
        Number of folds at most, evenly chosen.
    """
    if bank < 2:
        return Policy(BANK_SETTINGS[0], [], None)
    folds = data.folds(by_recording)
    if most is not None and len(folds) > most:
        folds = [folds[i] for i in np.linspace(0, len(folds) - 1, most).round().astype(int)]
    fixed = data.fixed()
    made = {chooser: chooser(data, fixed, bank) for chooser in MEMBER_CHOOSERS}
    choosers = [chooser for chooser, members in made.items() if len(members) > 1]
    if not choosers:
        return Policy(BANK_SETTINGS[0], [], None)
    banks = [made[chooser] for chooser in choosers]
    recordings: list[str] = []
    logs: list[NDArray[np.float64]] = []
    # The matrices are small: more threads would mostly wait for each other.
    with threadpool_limits(1, "blas"):
        for left_out, others in folds:
            fixed = others.fixed()
            banks_there = [chooser(others, fixed, bank) for chooser in choosers]
            logs.append(_logs(left_out, others, banks_there))
            recordings += [left_out.recording] * len(logs[-1])
    if len(recordings) < 2:
        return Policy(BANK_SETTINGS[0], banks[0], None)
    return least_loss(np.concatenate(logs), recordings, banks)


def least_loss(
    logs: NDArray[np.float64], recordings: Sequence[str], banks: Sequence[list[int]]
) -> Policy:
    """The bank, and its settings, with the least loss.

    `logs` is of shape (n_segments, len(banks) * len(BANK_SETTINGS)): those of each bank.
    `banks` has the members of each.
    """
    losses = np.array([expected_loss(own, recordings) for own in logs.T])
    losses[~(np.abs(losses) > ROUNDING)] = 0.0
    best = int(np.argmin(losses))
    way, which = divmod(best, len(BANK_SETTINGS))
    return Policy(BANK_SETTINGS[which], banks[way], figures(logs[:, best], recordings))


def _logs(
    left_out: LabelledSequence, others: LabelledData, banks: Sequence[list[int]]
) -> NDArray[np.float64]:
    """Logarithms of ratios to the fixed set's error, on a fold.

    Returns shape (n_segments, n_ways): those of each bank with each of `BANK_SETTINGS`.
    """
    fitted = data, _ = others.training_data()
    clipped, segment = cap(left_out.errors), left_out.segment
    fixed = clipped[:, data.sets.column(data.fixed)]
    errors = []
    known: dict[tuple[int, ...], list[NDArray[np.float64]]] = {}
    for bank in banks:
        # Whatever the order of the others is, they are the same bank.
        members = (*bank[:1], *sorted(bank[1:]))
        if members not in known and len(members) < 2:
            known[members] = [fixed] * len(BANK_SETTINGS)
        elif members not in known:
            simulated = bank_errors(left_out, others, fitted, members, BANK_SETTINGS)
            known[members] = [of_bank for of_bank, _ in simulated]
        errors += known[members]
    return np.array([log_ratios(one, fixed, segment) for one in errors]).T


def bank_errors(
    left_out: LabelledSequence,
    others: LabelledData,
    fitted: tuple[TrainingData, "ScaledPCA"],
    members: Sequence[int],
    settings: Sequence[BankSettings],
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Simulate a bank on what is left out, with one settings after the other.

    They have the same `clip` and `n_frames`. Its weights are fitted to the others, whose
    `LabelledData.training_data` is given.

    Yields clipped errors on the labelled frames, of shape (n,), and weights (n_periods, n_members).
    """
    data, pca = fitted
    simulation, members = left_out.simulation, tuple(members)
    vectors = others.vectors(members)
    of_bank = replace(data, fixed=members[0], candidates=members, vectors=vectors)
    scans = pca.transform(simulation.descriptors[periods(simulation.period)[0]])
    near, hops = BankRule(settings[0]).fit(of_bank).near(scans), simulation.squares(members)
    agreeing: NDArray[np.bool_] | None = None
    for one in settings:
        weights, _ = bank_weights(near, one, hops)
        # Who agrees takes long to find, and hangs on the settings but little.
        agreeing = simulation.agreeing(members, weights) if agreeing is None else agreeing
        yield simulation.errors(members, weights, agreeing)[left_out.known], weights


def cancelling_members(data: LabelledData, fixed: int, size: int) -> list[int]:
    """Choose a bank's members, the fixed set first, whose errors cancel: see `choose_members`."""
    pool = data.member_pool(fixed)
    return choose_members(data.vectors(pool), data.segments(), pool, size, data.can_pay)


def complementary_members(data: LabelledData, fixed: int, size: int) -> list[int]:
    """Choose a bank's members, the fixed set first, one of which does well at every frame.

    They are sought among the best sets, see `complementary`. Where another one would lower nothing,
    the best of the others fill the bank.
    """
    pool, number = data.member_pool(fixed), data.segments()
    errors = data.errors()[:, data.sets.columns(pool)]
    few = TrainingData(np.empty((len(errors), 0)), number, errors, data.sets.subset(pool), fixed)
    chosen = complementary(few, size, data.can_pay)
    for trial in pool:
        if len(chosen) < size and trial not in chosen and data.can_pay([*chosen, trial]):
            chosen.append(trial)
    return chosen


MEMBER_CHOOSERS = (cancelling_members, complementary_members)
"""The ways to choose a bank's members."""


def reserve(members: Sequence[int], data: LabelledData) -> list[int]:
    """What a bank has besides, for places that training does not know: the baseline.

    There is none if it is a member already, was not run on every sequence, or costs too much.
    """
    known = BASELINE in data.sets and all(BASELINE in s.vectors for s in data.sequences)
    if len(members) < 2 or BASELINE in members or not known:
        return []
    return [BASELINE] if data.can_pay([*members, BASELINE]) else []


def recommends_bank(data: LabelledData, chosen: Policy, fixed: int) -> bool:
    """Whether a bank is recommended, and not the fixed set.

    It is where it has less expected loss, and is within the budget of a set; or where the fixed
    set is restarted along its whole drives, whatever the bank costs.
    """
    if chosen.expected is None or len(chosen.members) < 2 or not chosen.expected.loss < -ROUNDING:
        return False
    blocks = data.driven_blocks()
    most = allowed_cost(data.budget, float(blocks.costs[blocks.baseline]))
    restarts = blocks.restarts[list(blocks.trials).index(fixed)]
    return data.costs.adaptive(chosen.members) <= most or bool(restarts > 0.0)
