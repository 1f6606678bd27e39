"""Choice of what is driven: the fixed set, one set at a time, or a bank, and with what settings.

All are compared by their expected loss on evidence that is left out, see `offline.expected_loss`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from adaptune.metrics import cap, window_ends
from adaptune.model import BankRule, BankSettings, PairedExpectedRatio, PairedSettings, TrainingData
from adaptune.model.bank_weights import (
    POOL,
    MemberWeights,
    NearProducts,
    bank_weights,
    choose_members,
    smooth_weights,
)
from adaptune.model.base import complementary, mean_errors
from adaptune.model.costs import Spending
from adaptune.model.paired import BASELINE
from adaptune.study.config import MOST_MEMBERS
from adaptune.study.driven import BANK, ONE_SET, RELIES_ON_LIVE
from offline.expected_loss import Figures, expected_loss, figures, log_ratios
from offline.labelled import LabelledData, LabelledSequence, comparable, periods

if TYPE_CHECKING:
    from adaptune.descriptor.pca import ScaledPCA

PAIRED_SETTINGS = [
    PairedSettings(n_sets=n_sets, sharpness=sharpness)
    for n_sets in (2, 3, 5)
    for sharpness in (6.0, 12.0, 24.0, 48.0)
]
"""One set at a time is driven with one of these; of equally good ones the first."""
BANK_FRAMES = 1000
"""Nearest frames of each stretch in a bank: products of errors need more frames than means do."""
BANK_SETTINGS = [
    BankSettings(
        sharpness=sharpness,
        min_fixed_share=share,
        prior_windows=windows,
        clip=clip,
        n_frames=BANK_FRAMES,
    )
    for clip in (6.0, 18.0)
    for sharpness in (12.0, 48.0)
    for share, windows in ((0.0, 3.0), (0.0, 10.0), (0.25, 3.0), (0.75, 10.0))
]
"""A bank is driven with one of these; of equally good ones the first."""
MOST_FOLDS = 12
"""So many folds at most compare ways to adapt where evidence is left out already."""
ELSEWHERE, AS_MANY = float(np.log(0.8)), 2
"""The loss of banks elsewhere, and as how many stretches it counts: few stretches show little."""
ROUNDING = 1e-6
"""A smaller loss, or gain, is one of rounding."""
DO_NOT_ADAPT = PairedSettings(adapt=False)
NO_BANK = BankSettings(adapt=False)

Chooser = Callable[[LabelledData, int, int, Spending | None], list[int]]
"""Chooses a bank's members on sequences, for a fixed set, so many, for what they may cost."""


class Policy(NamedTuple):
    """What is driven."""

    one_set: PairedSettings  # adapts if that has less expected loss than the fixed set
    bank: BankSettings  # adapts if that has the least expected loss of all
    members: list[int]  # of the bank; trial numbers, the fixed set's first
    # By `BANK` and `ONE_SET`, what is expected with the best settings; empty where there is too
    # little to compare.
    expected: dict[str, Figures]


def choose(
    data: LabelledData,
    bank: int | Sequence[int],
    by_recording: bool | None = None,
    most: int | None = None,
    one_set: bool = True,
    fixed: int | None = None,
) -> Policy:
    """Choose what is driven, leaving one recording or stretch after the other out.

    Parameters
    ----------
    data
        What the rules will be fitted on, and nothing else.
    bank
        Number of a bank's members, or their trial numbers; no bank is considered with 0, nor
        without recorded motions.
    by_recording
        See `LabelledData.folds`.
    most
        Number of folds at most, evenly chosen.
    one_set
        Whether one set at a time is considered.
    fixed
        Trial number of the fixed set, `LabelledData.fixed` by default.
    """
    folds = data.folds(by_recording)
    if most is not None and len(folds) > most:
        folds = [folds[i] for i in np.linspace(0, len(folds) - 1, most).round().astype(int)]
    fixed = data.fixed() if fixed is None else fixed
    choosers = _choosers(bank, data) if _has_motions(data) else {}
    one_set = one_set and _may_measure(data, fixed)
    banks = {way: make(data, fixed) for way, make in choosers.items()}
    banks = {way: members for way, members in banks.items() if len(members) > 1}
    members = next(iter(banks.values()), [])
    recordings: list[str] = []
    logs: list[NDArray[np.float64]] = []
    # The matrices are small: more threads would mostly wait for each other.
    with threadpool_limits(1, "blas"):
        for left_out, others in folds:
            of_fold = _logs(left_out, others, {way: choosers[way] for way in banks}, one_set)
            logs.append(of_fold)
            recordings += [left_out.recording] * len(of_fold)
    if len(recordings) < 2 or not logs[0].shape[1]:
        unknown = BankSettings(adapt=RELIES_ON_LIVE and len(members) > 1)
        return Policy(DO_NOT_ADAPT, unknown, members, {})
    return least_loss(
        np.concatenate(logs), recordings, banks, len(PAIRED_SETTINGS) if one_set else 0
    )


def least_loss(
    logs: NDArray[np.float64],
    recordings: Sequence[str],
    banks: Mapping[str, list[int]],
    n_single: int,
) -> Policy:
    """The settings with the least loss, of one set at a time and of a bank.

    Parameters
    ----------
    logs
        Of shape (n_stretches, n_single + len(banks) * len(BANK_SETTINGS)).
    recordings
        Of each stretch.
    banks
        By way to choose them, the members of each bank.
    n_single
        How many of the columns are about one set at a time.
    """
    losses = np.array([expected_loss(column, recordings) for column in logs.T])
    losses[~(np.abs(losses) > ROUNDING)] = 0.0
    if RELIES_ON_LIVE:
        losses[n_single:] = _with_elsewhere(losses[n_single:], len(logs))
    expected: dict[str, Figures] = {}
    one_set, bank, members = DO_NOT_ADAPT, NO_BANK, next(iter(banks.values()), [])
    if n_single:
        best = int(np.argmin(losses[:n_single]))
        expected[ONE_SET] = figures(logs[:, best], recordings)
        if losses[best] < 0.0:
            one_set = PAIRED_SETTINGS[best]
    if banks:
        best = n_single + int(np.argmin(losses[n_single:]))
        expected[BANK] = figures(logs[:, best], recordings)
        way, which = divmod(best - n_single, len(BANK_SETTINGS))
        members = list(banks.values())[way]
        if losses[best] < min(0.0, losses[:n_single].min(initial=0.0)):
            bank = BANK_SETTINGS[which]
    return Policy(one_set, bank, members, expected)


def _with_elsewhere(losses: NDArray[np.float64], n_stretches: int) -> NDArray[np.float64]:
    """Expected losses of banks, drawn to what they are elsewhere; one that never adapts has 0."""
    drawn = (n_stretches * losses + AS_MANY * ELSEWHERE) / (n_stretches + AS_MANY)
    return np.where(losses == 0.0, 0.0, drawn)


def _has_motions(data: LabelledData) -> bool:
    return all(s.simulation is not None for s in data.sequences)


def _may_measure(data: LabelledData, fixed: int) -> bool:
    """Whether the budget allows live evidence beside the fixed set."""
    if data.costs is None or data.budget is None:
        return True
    return Spending(data.costs, data.budget).allows([fixed])


def _choosers(
    bank: int | Sequence[int], data: LabelledData
) -> dict[str, Callable[[LabelledData, int], list[int]]]:
    """By name, the ways to choose a bank's members."""
    if not isinstance(bank, int):
        named = list(bank)
        return {"named": lambda *_: named}
    if bank < 2:
        return {}

    def of_size(
        way: Chooser, size: int = bank, spending: Spending | None = None
    ) -> Callable[[LabelledData, int], list[int]]:
        return lambda data, fixed: way(data, fixed, size, spending)

    if data.costs is None or data.budget is None:
        return {name: of_size(way) for name, way in WAYS.items()}
    # A budget may be spent on more members, on dearer ones, or on those that gain most for it.
    spending = Spending(data.costs, data.budget)
    thrifty = spending._replace(thrifty=True)
    ways = {
        f"{name}, {n}": of_size(way, n, spending)
        for name, way in WAYS.items()
        for n in dict.fromkeys((bank, MOST_MEMBERS))
    }
    return ways | {"thrifty": of_size(cancelling_members, MOST_MEMBERS, thrifty)}


def _logs(
    left_out: LabelledSequence,
    others: LabelledData,
    choosers: Mapping[str, Callable[[LabelledData, int], list[int]]],
    one_set: bool,
) -> NDArray[np.float64]:
    """Logarithms of ratios to the fixed set's error, on a fold.

    Returns
    -------
    ndarray of shape (n_stretches, n_ways)
        First those of one set at a time with each of `PAIRED_SETTINGS`, then those of each bank
        with each of `BANK_SETTINGS`.
    """
    left_out, others = comparable(left_out, others)
    data, pca = others.training_data()
    fixed = cap(left_out.errors[:, data.sets.column(data.fixed)])
    columns = []
    if one_set:
        columns += list(_paired_errors(left_out, data, pca))
    known: dict[tuple[int, ...], list[NDArray[np.float64]]] = {}
    for make in choosers.values():
        found = [trial for trial in make(others, data.fixed) if trial in data.sets]
        # Whatever the order of the others is, they are the same bank.
        members = (*found[:1], *sorted(found[1:]))
        if members not in known and len(members) < 2:
            known[members] = [fixed] * len(BANK_SETTINGS)
        elif members not in known:
            of_bank = bank_data(others, data, members)
            known[members] = list(_bank_errors(left_out, of_bank, pca))
        columns += known[members]
    if not columns:
        return np.empty((len(np.unique(left_out.stretch)), 0))
    return np.stack([log_ratios(e, fixed, left_out.stretch) for e in columns], axis=1)


def _bank_errors(
    left_out: LabelledSequence, of_bank: TrainingData, pca: "ScaledPCA"
) -> Iterator[NDArray[np.float64]]:
    """Capped errors of a bank with each of `BANK_SETTINGS`."""
    near: dict[tuple[float, int], NearProducts] = {}
    votes: MemberWeights | None = None
    for settings in BANK_SETTINGS:
        key = _evidence(settings)
        if key not in near:
            # Settings that share what is near follow each other: one at a time is kept.
            near = {key: bank_evidence(left_out, of_bank, pca, settings)}
        weights = weights_along(left_out, near[key], settings)
        # Who agrees takes long to find, and hangs on the settings but little.
        votes = weights if votes is None else votes
        yield on_labelled(left_out, simulated_with(left_out, weights, votes))


def _evidence(settings: BankSettings) -> tuple[float, int]:
    """The settings on which `bank_evidence` depends."""
    return settings.clip, settings.n_frames


def _paired_errors(
    left_out: LabelledSequence, data: TrainingData, pca: "ScaledPCA"
) -> Iterator[NDArray[np.float64]]:
    """Capped errors of one set at a time with each of `PAIRED_SETTINGS`."""
    most = max(settings.n_sets or 1 for settings in PAIRED_SETTINGS)
    rule = PairedExpectedRatio(PairedSettings(n_sets=most)).fit(data)
    first, period = periods(left_out.period)
    near = rule.near(pca.transform(left_out.descriptors[first]))
    capped = cap(left_out.errors)
    for settings in PAIRED_SETTINGS:
        # The complementary sets are chosen one after the other: the first of them are those of
        # fewer sets.
        few = near._replace(errors=near.errors[..., : settings.n_sets])
        chosen = data.sets.columns(rule.choices(few, settings))
        yield capped[np.arange(len(capped)), chosen[period]]


def cancelling_members(
    data: LabelledData, fixed: int, size: int, spending: Spending | None = None
) -> list[int]:
    """Choose a bank's members, the fixed set first, whose errors cancel: see `choose_members`."""
    vectors, errors = [], []
    for s in data.sequences:
        for number in np.unique(s.stretch):
            frames = s.stretch == number
            vectors.append({trial: of_trial[frames] for trial, of_trial in s.vectors.items()})
            errors.append(s.errors[frames])
    return choose_members(vectors, errors, data.sets, fixed, size, spending)


def complementary_members(
    data: LabelledData, fixed: int, size: int, spending: Spending | None = None
) -> list[int]:
    """Choose a bank's members, the fixed set first, one of which does well at every frame.

    They are sought among the best sets, see `complementary`. Where another one would lower nothing,
    the best of the others fill the bank.
    """
    errors, number = np.concatenate([s.errors for s in data.sequences]), data.stretches()
    means = mean_errors(errors, number)
    best = [
        data.sets.trials[c] for c in np.argsort(means, kind="stable")[:POOL] if means[c] < np.inf
    ]
    pool = [t for t in best if t != fixed and all(t in s.vectors for s in data.sequences)]
    few = data.sets.subset([fixed, *pool])
    columns = data.sets.columns(few.trials)
    features = np.empty((len(errors), 0))
    of_few = TrainingData(features, number, errors[:, columns], few, fixed)
    chosen = complementary(of_few, size, spending)
    for trial in pool:
        fits = spending is None or spending.allows([*chosen, trial])
        if len(chosen) < size and trial not in chosen and fits:
            chosen.append(trial)
    return chosen


def reserve(members: Sequence[int], data: LabelledData) -> list[int]:
    """What a bank has besides, for places that training does not know: the baseline.

    What the odometry's authors chose is the best guess there, and live evidence tells whether it is
    right. There is none if it is a member already, was not run on every sequence, or costs too
    much.
    """
    known = all(BASELINE in s.vectors for s in data.sequences)
    if len(members) < 2 or BASELINE in members or not known:
        return []
    if data.costs is not None and data.budget is not None:
        allowed = Spending(data.costs, data.budget).allows([*members, BASELINE])
        return [BASELINE] if allowed else []
    return [BASELINE]


WAYS: dict[str, Chooser] = {
    "cancelling": cancelling_members,
    "complementary": complementary_members,
}
"""Ways to choose a bank's members."""


def bank_data(others: LabelledData, data: TrainingData, members: Sequence[int]) -> TrainingData:
    """What a bank's weights are fitted to."""
    vectors = others.vectors(members)
    return replace(data, fixed=members[0], candidates=tuple(members), vectors=vectors)


def bank_evidence(
    sequence: LabelledSequence, data: TrainingData, pca: "ScaledPCA", settings: BankSettings
) -> NearProducts:
    """What a rule that is fitted to `data` finds near to the first scan of every period."""
    assert sequence.simulation is not None
    first, _ = periods(sequence.simulation.period)
    rule = BankRule(settings).fit(data)
    return rule.near(pca.transform(sequence.simulation.descriptors[first]))


def weights_along(
    sequence: LabelledSequence, near: NearProducts, settings: BankSettings
) -> MemberWeights:
    """Smoothed weights along a sequence, by the training and by what is measured on the way."""
    assert sequence.simulation is not None
    weights, _ = bank_weights(near, settings, sequence.simulation.live(near.members))
    return MemberWeights(near.members, smooth_weights(weights))


def simulated(
    sequence: LabelledSequence, near: NearProducts, settings: BankSettings
) -> NDArray[np.float64]:
    """Capped errors of a simulated bank at the frames of a simulation that have a sub-trajectory.

    Parameters
    ----------
    sequence
        The sequence, whose simulation is run from end to end.
    near
        See `bank_evidence`.
    settings
        Of the bank's weights.
    """
    return simulated_with(sequence, weights_along(sequence, near, settings))


def simulated_with(
    sequence: LabelledSequence, weights: MemberWeights, votes: MemberWeights | None = None
) -> NDArray[np.float64]:
    """The same with weights that are given, and with those that vote about who agrees."""
    assert sequence.simulation is not None
    errors = sequence.simulation.errors(weights, votes)
    return errors[~np.isnan(errors)]


def bank_errors(
    sequence: LabelledSequence, near: NearProducts, settings: BankSettings
) -> NDArray[np.float64]:
    """Capped errors of a simulated bank on the labelled frames."""
    return on_labelled(sequence, simulated(sequence, near, settings))


def on_labelled(sequence: LabelledSequence, errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of the errors of a simulated bank, those on the labelled frames, of shape (n,)."""
    simulation, extent = sequence.simulation, sequence.extent
    if simulation is None or extent is None:
        return errors
    known = np.flatnonzero(window_ends(simulation.T_ref_sensor, simulation.length) >= 0)
    of_frames = np.full(len(simulation.stamps), np.nan)
    of_frames[known] = errors
    return of_frames[extent.frames]
