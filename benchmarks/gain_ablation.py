"""The rules of `gain.py` without one ingredient after the other, and fitted on less."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Self
from unittest.mock import patch

import numpy as np
from gain_modes import Errors, constantly, print_summary
from numpy.typing import NDArray

from adaptune.metrics import cap
from adaptune.model import (
    RULES,
    PairedExpectedRatio,
    PairedSettings,
    Rule,
    TrainingData,
    make_rule,
    weights,
)
from adaptune.model.rules import Evidence, Near, complementary
from adaptune.selection import Selection
from offline.labelled import LabelledData, LabelledSequence
from offline.leave_one_out import Maker, Validation, leave_one_out
from offline.tuning import bank_data, bank_errors, bank_evidence, choose

Take = Callable[[TrainingData], TrainingData]


class OfLess(Rule):
    """A rule that is fitted on a part of the training data."""

    def __init__(self, rule: Rule, less: Take):
        self.rule, self.less = rule, less

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`."""
        self.rule.fit(self.less(data))
        return self

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Rule.predict`."""
        return self.rule.predict(feature)

    def select(self, feature: NDArray[np.float64]) -> Selection:
        """See `Rule.select`."""
        return self.rule.select(feature)


def thinned(data: TrainingData, every: int) -> TrainingData:
    """Keep some of the frames."""
    kept = slice(None, None, every)
    return replace(
        data,
        features=data.features[kept],
        sequence=data.sequence[kept],
        errors=data.errors[kept],
    )


def with_gaps(data: TrainingData, share: float) -> TrainingData:
    """Keep a share of the pairs of a sequence and a set, the fixed set everywhere.

    The candidates stay those without gaps. Otherwise a set with gaps would be none.
    """
    errors, rng = data.errors.copy(), np.random.default_rng(0)
    for s in np.unique(data.sequence):
        never = rng.random(len(data.sets)) >= share
        never[data.sets.column(data.fixed)] = False
        errors[np.ix_(data.sequence == s, never)] = np.nan
    return replace(data, errors=errors, candidates=tuple(complementary(data, 3)))


def less(data: LabelledData) -> None:
    """Leave each sequence out in turn, with less known of the others."""

    def maker(name: str, take: Take, every: int = 1) -> Maker:
        def make(others: LabelledData) -> Rule:
            settings = choose(others, 0).one_set if name == "adaptive" else PairedSettings()
            of_less = {"n_frames": max(1, settings.n_frames // every)}
            return OfLess(make_rule(name, settings.model_copy(update=of_less)), take)

        return make

    makers: dict[str, Maker] = {}
    for name in RULES:
        for every in (1, 2, 4, 10):
            kept = partial(thinned, every=every)
            makers[f"{name}, one frame in {every}"] = maker(name, kept, every)
        for share in (0.75, 0.5, 0.25):
            kept = partial(with_gaps, share=share)
            makers[f"{name}, {share:.0%} of the pairs"] = maker(name, kept)
    print_summary(leave_one_out(data, makers, bank=0), makers)


def familiar(evidence: Evidence) -> Evidence:
    """The same evidence, of scans that look as familiar as can be."""
    return evidence._replace(familiarity=np.ones_like(evidence.familiarity))


class Unafraid(PairedExpectedRatio):
    """Takes any place for familiar."""

    def near(self, features: NDArray[np.float64]) -> Near:
        """See `PairedExpectedRatio.near`."""
        near = super().near(features)
        return near._replace(evidence=familiar(near.evidence))


class Between(PairedExpectedRatio):
    """Knows each set, except the fixed one, by its neighbours alone.

    So would a rule that chooses between the sets that were run.
    """

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`."""
        super().fit(data)
        unit, candidates = data.sets.unit, data.sets.columns(self.candidates_)
        squared = ((unit[:, None] - unit[candidates]) ** 2).sum(axis=2)
        nearest = np.where(squared > 0.0, squared, np.inf).min(axis=0)
        # The set itself would be nearer than any other.
        kernel = np.exp(-0.5 * (squared - nearest) / self.settings.width**2)
        kernel[squared == 0.0] = 0.0
        alone = (cap(data.errors) @ (kernel / kernel.sum(axis=0))).astype(np.float32)
        fixed = candidates == data.sets.column(data.fixed)
        self.errors_ = np.where(fixed, self.errors_, alone)
        return self


def makers() -> dict[str, Maker]:
    """By name, how to make the paired rule without one ingredient after the other."""
    tuned: dict[str, PairedSettings] = {}

    def maker(make: type[PairedExpectedRatio] = PairedExpectedRatio, **changed: Any) -> Maker:
        def with_its_settings(others: LabelledData) -> Rule:
            names = " ".join(other.name for other in others.sequences)
            if names not in tuned:
                tuned[names] = choose(others, 0).one_set
            settings = tuned[names]
            # A rule that does not adapt keeps the fixed set, unless its sharpness is given.
            if settings.adapt or "sharpness" in changed:
                settings = settings.model_copy(update={"adapt": True} | changed)
            return make(settings)

        return with_its_settings

    undoubting: dict[str, Any] = {
        "n_sets": None,
        "sharpness": 12.0,
        "caution": 0.0,
        "threshold": 0.0,
    }
    return {
        "adaptive": maker(),
        "without caution": maker(caution=0.0),
        "two standard errors": maker(caution=2.0),
        "without smoothing": maker(width=1e-3),
        "two sets": maker(n_sets=2),
        "all sets": maker(n_sets=None),
        "the 30 nearest frames": maker(n_frames=30),
        "without threshold": maker(threshold=0.0),
        "familiar everywhere": maker(Unafraid),
        "sharpness 12": maker(sharpness=12.0),
        "sharpness 48": maker(sharpness=48.0),
        "all sets, without doubt": maker(**undoubting),
        "by their neighbours alone": maker(Between, **undoubting),
    }


def ablate(data: LabelledData, size: int) -> None:
    """Leave each sequence out in turn, and from the rules one ingredient after the other."""
    left_out = leave_one_out(data, makers(), bank=0).left_out
    for of, (sequence, others) in zip(left_out, data.folds(), strict=True):
        of.errors.update(banks(sequence, others, size))
    validation = Validation(left_out)
    print_summary(validation, [mode for mode in validation.ratios if mode != "baseline"])


def banks(sequence: LabelledSequence, others: LabelledData, size: int) -> Errors:
    """Errors of a bank on the sequence left out, and without one ingredient after the other."""
    data, pca = others.training_data()
    chosen = choose(others, size, one_set=False)
    members, settings = chosen.members, chosen.bank
    of_members = bank_data(others, data, members)

    def simulated(
        all_familiar: bool = False,
        smoothing: int = weights.SMOOTHING,
        **changed: Any,
    ) -> NDArray[np.float64]:
        # A bank without less expected loss is not used.
        if not settings.adapt:
            return cap(sequence.errors[:, data.sets.column(data.fixed)])
        its = settings.model_copy(update=changed)
        near = bank_evidence(sequence, of_members, pca, its)
        if all_familiar:
            near = near._replace(evidence=familiar(near.evidence))
        with patch.object(weights, "SMOOTHING", smoothing):
            return bank_errors(sequence, near, its)

    found = {
        "bank": simulated(),
        "bank, sequences weigh the same": simulated(sharpness=0.0),
        "bank, sharpness 12": simulated(sharpness=12.0),
        "bank, sharpness 48": simulated(sharpness=48.0),
        "bank, nothing kept": simulated(min_fixed_share=0.0),
        "bank, half kept": simulated(min_fixed_share=0.5),
        "bank, familiar everywhere": simulated(all_familiar=True),
        "bank, the 100 nearest frames": simulated(n_frames=100),
        "bank, clip 6": simulated(clip=6.0),
        "bank, clip 18": simulated(clip=18.0),
        "bank, errors count in full": simulated(clip=1e9),
        "bank, weights as they are": simulated(even=0.0),
        "bank, no live evidence": simulated(prior_windows=1e9),
        "bank, live evidence alone": simulated(prior_windows=1e-9),
        "bank, weights of each second": simulated(smoothing=1),
        "bank, weights of 20 seconds": simulated(smoothing=20),
    }
    return found | constantly(sequence, members)
