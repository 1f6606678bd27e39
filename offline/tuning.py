"""Choice of a bank's members, and of the rules' settings, on the training sequences."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from adaptune.metrics import cap
from adaptune.model import BankRule, BankSettings, PairedExpectedRatio, PairedSettings, TrainingData
from adaptune.model.bank_weights import (
    MemberWeights,
    NearProducts,
    bank_weights,
    choose_members,
    smooth_weights,
)
from adaptune.study.driven import MIN_SEQUENCES
from offline.labelled import LabelledData, LabelledSequence, comparable, periods

if TYPE_CHECKING:
    from adaptune.descriptor.pca import ScaledPCA

MIN_OTHERS = MIN_SEQUENCES - 1
"""As many remain where one of them is left out: what holds for the study holds there, too."""
NO_WORSE = 1.05
"""Largest ratio to the fixed set's error that is allowed on a sequence left out."""
TINY = 1e-6
"""Percent, added to mean errors so that errors of zero can be compared."""
SHARPNESS = (6.0, 12.0, 24.0, 48.0)
"""`tune` chooses one of these; of equally good ones the first."""
BANK_FRAMES = 1000
"""Nearest frames of each sequence in a bank: products of errors need more frames than means do."""
BANK_SETTINGS = [
    [
        BankSettings(sharpness=sharpness, min_fixed_share=share, clip=clip, n_frames=BANK_FRAMES)
        for sharpness in (12.0, 48.0)
        for share in (0.0, 0.25, 0.5)
    ]
    for clip in (6.0, 18.0)
]
"""`tune_bank` chooses one of these; the lists share their clip."""
DO_NOT_ADAPT = PairedSettings(adapt=False)
NO_BANK = BankSettings(adapt=False)


def interval_margin(logs: NDArray[np.float64]) -> float:
    """Half of the 95 % interval of the mean, Student's."""
    from scipy import stats

    return float(stats.t.ppf(0.975, len(logs) - 1) * stats.sem(logs))


def tune(data: LabelledData, fewest: int = MIN_SEQUENCES) -> PairedSettings:
    """Choose the settings of the paired rule, leaving each of these sequences out in turn.

    Among the settings with which the rule was nowhere worse than `NO_WORSE` times the fixed set,
    the least geometric mean wins, if its 95 % interval lies below 1. If it does not, or no settings
    are left, or there are fewer than `fewest` sequences, the rule does not adapt.

    Parameters
    ----------
    data
        The sequences that the rule will be fitted on, and no others.
    fewest
        `MIN_OTHERS` where one sequence of a study is left out.
    """
    folds = data.folds()
    if len(folds) < fewest:
        return DO_NOT_ADAPT
    # The matrices are small: more threads would mostly wait for each other.
    with threadpool_limits(1, "blas"):
        best = _paying(np.array([_paired_logs(sequence, others) for sequence, others in folds]))
    return DO_NOT_ADAPT if best is None else PairedSettings(sharpness=SHARPNESS[best])


def _paying(logs: NDArray[np.float64]) -> int | None:
    """Of settings that are nowhere worse than `NO_WORSE` those with the least mean, if that pays.

    Parameters
    ----------
    logs
        Logarithms of ratios to the fixed set's error, of shape (n_sequences, n_settings).
    """
    means = np.where(logs.max(axis=0) <= np.log(NO_WORSE), logs.mean(axis=0), np.inf)
    best = int(np.argmin(means))
    return best if means[best] + interval_margin(logs[:, best]) < 0.0 else None


def _paired_logs(sequence: LabelledSequence, others: LabelledData) -> list[float]:
    """With each of `SHARPNESS`, logarithm of the ratio to the fixed set's error."""
    sequence, others = comparable(sequence, others)
    data, pca = others.training_data()
    rule = PairedExpectedRatio().fit(data)
    first, period = periods(sequence.period)
    near = rule.near(pca.transform(sequence.descriptors[first]))
    capped = cap(sequence.errors)
    fixed = capped[:, data.sets.column(data.fixed)].mean() + TINY
    logs = []
    for sharpness in SHARPNESS:
        chosen = data.sets.columns(rule.choices(near, PairedSettings(sharpness=sharpness)))
        errors = capped[np.arange(len(capped)), chosen[period]]
        logs.append(float(np.log((errors.mean() + TINY) / fixed)))
    return logs


def choose_bank(data: LabelledData, fixed: int, size: int) -> list[int]:
    """Choose a bank's members, the fixed set first, see `choose_members`."""
    vectors, errors = zip(*((s.vectors, s.errors) for s in data.sequences), strict=True)
    return choose_members(vectors, errors, data.sets, fixed, size)


def tune_bank(
    data: LabelledData, members: Sequence[int], fixed: int, fewest: int = MIN_SEQUENCES
) -> BankSettings:
    """Choose how a bank's weights are found, leaving each of these sequences out in turn.

    The criterion is that of `tune`.

    Parameters
    ----------
    data
        See `tune`.
    members
        Trial numbers of the bank's members, chosen on these sequences; the first counts as the
        fixed one.
    fixed
        Trial number of the fixed set, which the bank is compared with.
    fewest
        See `tune`.
    """
    folds = data.folds()
    if len(folds) < fewest or len(members) < 2:
        return NO_BANK
    with threadpool_limits(1, "blas"):
        logs = np.array([_bank_logs(one, others, members, fixed) for one, others in folds])
    best = _paying(logs)
    tried = [settings for of_clip in BANK_SETTINGS for settings in of_clip]
    return NO_BANK if best is None else tried[best]


def _bank_logs(
    sequence: LabelledSequence, others: LabelledData, members: Sequence[int], fixed: int
) -> list[float]:
    """With each of `BANK_SETTINGS`, logarithm of the ratio to the fixed set's error."""
    data, pca = others.training_data()
    of_fixed = cap(sequence.errors[:, others.sets.column(fixed)]).mean() + TINY
    data = bank_data(others, data, members)
    logs = []
    for of_clip in BANK_SETTINGS:
        near = bank_evidence(sequence, data, pca, of_clip[0])
        for settings in of_clip:
            errors = bank_errors(sequence, weights_along(near, settings))
            logs.append(float(np.log((errors.mean() + TINY) / of_fixed)))
    return logs


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


def weights_along(near: NearProducts, settings: BankSettings) -> MemberWeights:
    """Smoothed weights along a sequence."""
    weights, _ = bank_weights(near, settings)
    return MemberWeights(near.members, smooth_weights(weights, near.evidence.familiarity))


def bank_errors(sequence: LabelledSequence, weights: MemberWeights) -> NDArray[np.float64]:
    """Capped errors of a simulated bank on the frames that have a sub-trajectory."""
    assert sequence.simulation is not None
    errors = sequence.simulation.errors(weights)
    return errors[~np.isnan(errors)]
