"""Leave each training sequence out in turn, to find whether adapting pays in other places.

A fixed set and the selection rules are fitted on the other sequences. On the one left out, the
errors that were recorded for the sets they choose are looked up, period by period; no odometry
runs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.descriptor.pca import ScaledPCA
from adaptune.errors import AdaptuneError
from adaptune.metrics import bootstrap, cap
from adaptune.model import RULES, PairedSettings, Rule, TrainingData, make_rule
from adaptune.model.base import complementary
from adaptune.study.driven import MIN_SEQUENCES
from offline.labelled import LabelledData, LabelledSequence, comparable, periods
from offline.tuning import (
    MIN_OTHERS,
    NO_WORSE,
    TINY,
    bank_data,
    bank_errors,
    bank_evidence,
    choose_bank,
    interval_margin,
    tune,
    tune_bank,
    weights_along,
)

MOST_SETS = 6
"""Complementary sets whose worth is reported."""
PAIRED = RULES[0]
"""The mode that `adaptune online` drives: a bank, if one is simulated, or one set at a time."""
ONE_SET = "one set"
"""Beside a bank, the mode with one set at a time."""
BANK_SIZE = 4
"""Its members, unless the study says otherwise."""

Interval = tuple[float, float] | None
"""The ends, where they are known."""
Progress = Callable[[int, int], None]
"""Called with how much is done, and how much there is."""
Maker = Callable[[LabelledData], Rule]
"""Makes a rule, with settings chosen on the sequences that it will be fitted on."""


class ValidationError(AdaptuneError):
    """A study that cannot be validated."""


class LeftOut(NamedTuple):
    """What happened on one sequence that was left out."""

    name: str
    # For every mode the capped error in percent at each frame, of shape (n,).
    errors: dict[str, NDArray[np.float64]]
    # For every rule the share of periods in which it did not choose the fixed set; of a bank, the
    # share of the weight that the other members had.
    adapted: dict[str, float]
    familiarity: NDArray[np.float64]  # (n,): see `Selection`; NaN where no rule computes it
    # (MOST_SETS,): mean error in percent if the best of 1, 2, ... complementary sets were always
    # known.
    portfolio: NDArray[np.float64]
    block: int = 1  # frames of a sub-trajectory

    def interval(self, mode: str) -> Interval:
        """95 % interval of the ratio to the fixed set's error, see `bootstrap`.

        It is about this sequence, and says nothing about other places.
        """
        intervals = bootstrap(self.errors[mode], self.errors["fixed"], self.block)
        return intervals and intervals[1]


@dataclass
class Validation:
    """All sequences left out, and the conclusion."""

    left_out: list[LeftOut]
    bank: bool = False  # whether a bank was simulated
    # For every mode its mean error over the fixed set's, a number for each sequence.
    ratios: dict[str, NDArray[np.float64]] = field(init=False)

    def __post_init__(self) -> None:
        modes = list(self.left_out[0].errors)
        means = {
            mode: np.array([s.errors[mode].mean() for s in self.left_out]) + TINY for mode in modes
        }
        self.ratios = {mode: mean / means["fixed"] for mode, mean in means.items()}

    @property
    def modes(self) -> list[str]:
        """`PAIRED`, and what it is compared with."""
        return [mode for mode in dict.fromkeys((PAIRED, ONE_SET, *RULES)) if mode in self.ratios]

    @property
    def default(self) -> str:
        """The first of them."""
        return (*self.modes, RULES[0])[0]

    def summary(self, mode: str) -> dict[str, float]:
        """Geometric mean, 95 % interval, worst and arithmetic ratio to the fixed set.

        The interval is Student's, of the logarithms: it is about other sequences like these.
        """
        logs = np.log(self.ratios[mode])
        margin = interval_margin(logs)
        low, high = logs.mean() - margin, logs.mean() + margin
        mean, fixed = (
            np.mean([s.errors[m].mean() for s in self.left_out]) for m in (mode, "fixed")
        )
        return {
            "geometric": float(np.exp(logs.mean())),
            "low": float(np.exp(low)),
            "high": float(np.exp(high)),
            "worst": float(self.ratios[mode].max()),
            "arithmetic": float(mean / fixed),
        }

    def portfolio(self) -> NDArray[np.float64]:
        """Geometric mean of the ratio to the fixed set's error if the best of K sets were known.

        Returns
        -------
        ndarray of shape (MOST_SETS,)
            For K = 1 (the fixed set), 2, ...
        """
        fixed = np.array([s.errors["fixed"].mean() for s in self.left_out]) + TINY
        portfolios = np.array([s.portfolio for s in self.left_out]) + TINY
        return np.asarray(np.exp(np.log(portfolios / fixed[:, None]).mean(axis=0)))

    def verdict(self, rule: str) -> str:
        """What to do, in a sentence or two."""
        s = self.summary(rule)
        weighs = self.bank and rule == PAIRED
        what = f"`{rule}` with the bank" if weighs else f"`{rule}`"
        worst = self.left_out[int(np.argmax(self.ratios[rule]))].name
        share = 100 * np.mean([left_out.adapted.get(rule, 0.0) for left_out in self.left_out])
        weight = f"{share:.0f} % of the weight on other members than the fixed set"
        ratio = (
            f"over {len(self.left_out)} sequences left out it has {s['geometric']:.2f} times the "
            f"fixed set's error in geometric mean (95 % interval {s['low']:.2f}-{s['high']:.2f}), "
            + (f"with {weight}" if weighs else f"adapting {share:.0f} % of the time")
        )
        if not any(left_out.adapted.get(rule, 1.0) for left_out in self.left_out):
            return (
                f"{what} kept the fixed set wherever a sequence was left out: the others did not "
                f"show that it pays; so there is no estimate of it."
            )
        if s["worst"] > NO_WORSE:
            return f"Do not adapt by {what}: {s['worst']:.2f} times on {worst}; {ratio}."
        if len(self.left_out) < MIN_SEQUENCES:
            return f"Too few sequences to advise for {what}: {ratio}."
        if s["high"] >= 1.0:
            return f"Nothing shows that {what} pays, nor that it harms: {ratio}."
        return f"Adapt by {what}: {ratio}, and on none more than {s['worst']:.2f} times."


def leave_one_out(
    data: LabelledData,
    rules: Mapping[str, Maker] | None = None,
    progress: Progress = lambda *_: None,
    bank: int | Sequence[int] = BANK_SIZE,
) -> Validation:
    """Leave each sequence out in turn, with all views of it.

    Parameters
    ----------
    data
        The training sequences.
    rules
        By name, how to make each; when left out, those of `adaptune.model.RULES` with settings that
        `tune` chooses again on the other sequences.
    progress
        Called about every sequence.
    bank
        Number of a bank's members, or their trial numbers, the first of which counts as the fixed
        one. No bank is simulated with 0, nor without recorded motions.

    Raises
    ------
    ValidationError
        If there are fewer than two sequences.
    """
    folds = data.folds()
    if len(folds) < 2:
        raise ValidationError(
            "training: one sequence cannot be validated, for nothing remains to train on when it "
            "is left out; add sequences"
        )
    left_out = []
    for i, (sequence, others) in enumerate(folds):
        progress(i, len(folds))
        left_out.append(
            leave_out(sequence, others, tuned_rules() if rules is None else rules, bank)
        )
    progress(len(folds), len(folds))
    return Validation(left_out, bool(bank) and data.sequences[0].simulation is not None)


def tuned_rules() -> dict[str, Maker]:
    """How to make each of `adaptune.model.RULES`, with settings chosen on what it is fitted on."""

    def paper(_: LabelledData) -> Rule:
        return make_rule("paper", PairedSettings())

    return {PAIRED: lambda data: make_rule(PAIRED, tune(data, MIN_OTHERS)), "paper": paper}


def leave_out(
    sequence: LabelledSequence,
    others: LabelledData,
    rules: Mapping[str, Maker],
    bank: int | Sequence[int],
) -> LeftOut:
    """Fit on the other sequences, and look up what happens on the one left out."""
    n_sets = len(others.sets)
    sequence, others = comparable(sequence, others)
    data, pca = others.training_data()
    features = pca.transform(sequence.descriptors)
    capped = cap(sequence.errors)
    fixed = capped[:, data.sets.column(data.fixed)]
    first, period = periods(sequence.period)
    frames = np.arange(len(capped))
    baseline = capped[:, 0] if sequence.baseline is None else cap(sequence.baseline)
    errors, adapted = {"baseline": baseline, "fixed": fixed}, {}
    familiarity = np.full(len(first), np.nan)
    for name, make in rules.items():
        rule = make(others).fit(data)
        selections = [rule.select(features[i]) for i in first]
        chosen = data.sets.columns([selection.trial for selection in selections])
        errors[name] = capped[frames, chosen[period]]
        adapted[name] = float(np.mean([selection.trial != data.fixed for selection in selections]))
        if not np.isnan(selections[0].familiarity):
            familiarity = np.array([selection.familiarity for selection in selections])
    if bank and sequence.simulation is not None:
        if not isinstance(bank, int) and len(data.sets) < n_sets:
            bank = len(bank)
        # Where the bank is not shown to pay, one set at a time is driven.
        instead = errors.pop(PAIRED, fixed), adapted.pop(PAIRED, 0.0)
        if PAIRED in rules:
            errors[ONE_SET], adapted[ONE_SET] = instead
        simulated = _simulate(sequence, others, data, pca, bank)
        errors[PAIRED], adapted[PAIRED] = simulated or instead
    errors["oracle, sequence"] = capped[:, int(np.argmin(capped.mean(axis=0)))]
    of_periods = np.array([capped[period == p].mean(axis=0) for p in range(len(first))])
    errors["oracle, period"] = capped[frames, of_periods.argmin(axis=1)[period]]
    few = data.sets.columns(complementary(data, MOST_SETS))
    least = np.minimum.accumulate(of_periods[:, few], axis=1)[period].mean(axis=0)
    portfolio = least[np.minimum(np.arange(MOST_SETS), len(few) - 1)]
    return LeftOut(sequence.name, errors, adapted, familiarity[period], portfolio, sequence.block)


def _simulate(
    sequence: LabelledSequence,
    others: LabelledData,
    data: TrainingData,
    pca: ScaledPCA,
    bank: int | Sequence[int],
) -> tuple[NDArray[np.float64], float] | None:
    """A bank's errors on the sequence left out, and the weight that the fixed set did not have.

    None if it was not shown to pay.
    """
    members = choose_bank(others, data.fixed, bank) if isinstance(bank, int) else bank
    settings = tune_bank(others, members, data.fixed, MIN_OTHERS)
    if not settings.adapt:
        return None
    near = bank_evidence(sequence, bank_data(others, data, members), pca, settings)
    weights = weights_along(near, settings)
    return bank_errors(sequence, weights), float(1.0 - weights.weights[:, 0].mean())
