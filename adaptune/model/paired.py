"""Selection by the paired expected ratio."""

from collections.abc import Mapping
from typing import Annotated, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat, PositiveInt

from adaptune.metrics import FAILURE
from adaptune.model.base import Rule, TrainingData, complementary, mean_errors
from adaptune.model.evidence import NOVEL, Evidence, NearestFrames
from adaptune.selection import Selection

ERROR_FLOOR = 0.02
"""Percent, added to both errors of a ratio so that none is divided by zero."""
BASELINE = 0
"""Trial number of the baseline; of several odometries, that of the first."""


class PairedSettings(BaseModel):
    """Settings of the paired rule."""

    # A file of a later version may hold more.
    model_config = ConfigDict(extra="ignore", frozen=True)

    adapt: bool = True  # if not, the rule keeps the fixed set as long as that does as predicted
    # Number of complementary sets to choose among, the fixed one included; all sets if None.
    # Candidates that the training data name come first.
    n_sets: PositiveInt | None = 3
    # How fast a sequence's weight falls with the distance of its nearest frames.
    sharpness: Annotated[NonNegativeFloat, Field(allow_inf_nan=False)] = 6.0
    # Standard deviation of the Gaussian over parameter sets, in the unit cube.
    width: Annotated[PositiveFloat, Field(allow_inf_nan=False)] = 0.12
    n_frames: PositiveInt = 300  # nearest frames of each sequence
    # Logarithm of the ratio below which a set is preferred to the fixed one.
    threshold: Annotated[float, Field(le=0.0, allow_inf_nan=False)] = -0.1
    # Standard errors, estimated from how much the sequences differ, that are added to a ratio.
    caution: Annotated[NonNegativeFloat, Field(allow_inf_nan=False)] = 0.5


class Near(NamedTuple):
    """Errors on the training frames nearest to some scans."""

    evidence: Evidence
    # (n_scans, n_sequences, n_candidates): mean error of every candidate, and of the baseline, in
    # percent, mixed with that of its neighbours.
    errors: NDArray[np.float64]
    fixed: NDArray[np.float64]  # (n_scans, n_sequences): mean error of the fixed set


class Ratios(NamedTuple):
    """Ratios of errors to the fixed set's."""

    expected: NDArray[np.float64]  # (n_scans, n_candidates)
    cautious: NDArray[np.float64]  # the same with `caution` standard errors added
    # (n_scans, n_sequences): of the training sequences, adding up to 1.
    weights: NDArray[np.float64]


class PairedExpectedRatio(Rule):
    """Compare every set with the fixed one on the same frames, and choose by the expected ratio.

    For each training sequence, the rule divides a set's mean error on the frames nearest to the
    scan by the fixed set's on the same frames. Sequences are weighted by how near those frames
    are, neighbouring sets share their evidence, and a set must promise enough to replace the fixed
    one. A rare failure weighs as much as it costs, and what makes a sequence hard for all sets
    cancels out.

    The rule chooses among sets that were run on every sequence, unless the data name candidates;
    other sets count as neighbours. A sequence on which neither a set nor a close one was run does
    not speak for it: its ratio counts as 1.

    The farther a scan is from all training sequences, compared with how far these are from each
    other, the more every ratio is drawn to 1. Beyond all of them the rule takes the fixed set.

    Where a set does worse than predicted, what was measured of it counts instead. Then the baseline
    is a candidate, too: in a place unlike all training, it is the best guess there is.

    Parameters
    ----------
    settings
        `offline.tuning` chooses them on the training sequences.
    switch_cost
        What a switch must promise besides, as a share of the fixed set's error.
    """

    gated = True

    def __init__(self, settings: PairedSettings | None = None, switch_cost: float = 0.0):
        self.settings = settings or PairedSettings()
        self.switch_cost = switch_cost

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`."""
        self.data_ = data
        self.candidates_ = self._candidates()
        self._known = self._with_baseline()
        self._fixed_at = self.candidates_.index(data.fixed)
        self.fixed_errors_ = data.fixed_errors
        self.errors_ = self._mixed_errors()
        self.nearest_ = NearestFrames(self.settings.n_frames).fit(data.features, data.sequence)
        return self

    def _candidates(self) -> tuple[int, ...]:
        data, n_sets = self.data_, self.settings.n_sets
        if not self.settings.adapt:
            return (data.fixed,)
        if data.candidates is not None:
            return data.candidates
        if n_sets is None:
            complete = np.isfinite(mean_errors(data.errors, data.sequence)) & data.allows()
            complete[data.sets.column(data.fixed)] = True
            return tuple(data.sets.trials[c] for c in np.flatnonzero(complete))
        return tuple(complementary(data, n_sets))

    def _with_baseline(self) -> tuple[int, ...]:
        """The candidates, and behind them the baseline if it is none of them but may be chosen."""
        data = self.data_
        if BASELINE in self.candidates_ or BASELINE not in data.sets:
            return self.candidates_
        column = data.sets.column(BASELINE)
        was_run = np.isfinite(mean_errors(data.errors[:, [column]], data.sequence)).all()
        may_be = was_run and data.allows()[column]
        return (*self.candidates_, BASELINE) if may_be else self.candidates_

    def _mixed_errors(self) -> NDArray[np.float32]:
        """Error of the candidates and the baseline on every frame, mixed with their neighbours'.

        They are mixed before ratios are taken, for a ratio of means is linear in its numerator.
        """
        data = self.data_
        unit = data.sets.unit
        columns = data.sets.columns(self._known)
        squared = ((unit[:, None] - unit[columns]) ** 2).sum(axis=2)
        kernel = np.exp(-0.5 * squared / self.settings.width**2)
        kernel /= kernel.sum(axis=0)
        errors = np.minimum(data.errors, np.float32(FAILURE))
        # Where a set was not run, the fixed one's error makes it neither better nor worse.
        fixed = self.fixed_errors_[:, None].astype(np.float32)
        return np.asarray(np.where(np.isnan(errors), fixed, errors) @ kernel.astype(np.float32))

    def near(self, features: NDArray[np.float64]) -> Near:
        """Find the errors on the training frames nearest to scans.

        Parameters
        ----------
        features
            Of shape (n_scans, n_features).
        """
        evidence = self.nearest_.about(features)
        fixed = evidence.means(self.fixed_errors_)
        return Near(evidence, evidence.means(self.errors_), fixed)

    def choices(self, near: Near, settings: PairedSettings) -> list[int]:
        """Trial number of the best candidate for each scan, by other settings than those fitted.

        The settings may differ in `sharpness`, `threshold` and `caution`.
        """
        ratios = self._ratios(near, settings)
        best = _best(ratios.cautious[:, : len(self.candidates_)], self._fixed_at, settings)
        return [self.candidates_[position] for position in best]

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Rule.predict`.

        For the fixed set too, this is the mixed ratio times its error; `select` returns the error
        itself.
        """
        near = self.near(feature[None])
        predicted = np.full(len(self.data_.sets), np.inf)
        expected, _, weights = _expected_ratios(near, self.settings)
        n = len(self.candidates_)
        columns = self.data_.sets.columns(self.candidates_)
        predicted[columns] = expected[0, :n] * float(weights[0] @ near.fixed[0])
        return predicted

    def select(
        self,
        feature: NDArray[np.float64],
        current: int | None = None,
        measured: Mapping[int, float] | None = None,
    ) -> Selection:
        """See `Rule.select`.

        Parameters
        ----------
        feature
            The scan's scaled descriptor, of shape (n_features,).
        current
            Trial number of the set that the odometry has now.
        measured
            By trial number, errors in percent of sets that did worse than predicted.
        """
        measured = measured or {}
        near = self.near(feature[None])
        (expected,), (cautious,), (weights,) = self._ratios(near, self.settings)
        (best,) = _best(cautious[None, : len(self.candidates_)], self._fixed_at, self.settings)
        fixed = float(weights @ near.fixed[0])
        if self._known[best] in measured:
            errors = dict(zip(self._known, (cautious * fixed).tolist(), strict=True))
            errors.update(measured)
            # Far from all training, all ratios are 1.
            of_known = [(errors[trial], trial != BASELINE) for trial in self._known]
            best = min(range(len(of_known)), key=of_known.__getitem__)
        familiarity = float(near.evidence.familiarity[0])
        at = self._known.index(current) if current in self._known else None
        # In a place unlike all training, a switch back to the fixed set need not pay. Nor need a
        # switch away from a set that is expected to be worse than the fixed one.
        weighs = self.settings.adapt and self.switch_cost > 0.0 and not familiarity < NOVEL
        weighs = weighs and current not in measured
        if weighs and at is not None and cautious[best] + self.switch_cost >= cautious[at] <= 1.0:
            best = at
        trial = self._known[best]
        return Selection(
            trial,
            self.data_.sets[trial],
            predicted_error=float(expected[best]) * fixed,
            predicted_fixed=fixed,
            familiarity=familiarity,
            n_sequences=float(1.0 / (weights @ weights)),
        )

    def _ratios(self, near: Near, settings: PairedSettings) -> Ratios:
        """Ratios of all in `near` to the fixed set's error."""
        ratios = _expected_ratios(near, settings)
        # Neither mixing nor caution is for the set that all are compared with.
        ratios.expected[:, self._fixed_at] = ratios.cautious[:, self._fixed_at] = 1.0
        return ratios


def _expected_ratios(near: Near, settings: PairedSettings) -> Ratios:
    """Ratio of every candidate's error to the fixed set's."""
    ratio = (near.errors + ERROR_FLOOR) / (near.fixed[..., None] + ERROR_FLOOR)
    weights = near.evidence.weights(settings.sharpness)
    expected = np.einsum("qs,qsc->qc", weights, ratio)
    variance = np.einsum("qs,qsc->qc", weights, (ratio - expected[:, None]) ** 2)
    # One over the number of sequences that this rests on. The fewer they are, the less they show
    # how much they differ: one alone is taken to differ as much as all sequences do.
    share = (weights**2).sum(axis=1)[:, None]
    error = np.sqrt(share * (variance + share * ratio.var(axis=1)))
    trust = near.evidence.trust[:, None]
    expected = 1.0 + trust * (expected - 1.0)
    return Ratios(expected, expected + trust * settings.caution * error, weights)


def _best(
    cautious: NDArray[np.float64], fixed_at: int, settings: PairedSettings
) -> NDArray[np.intp]:
    """Position of the best candidate for each scan, of shape (n_scans,)."""
    worth = np.log(cautious.min(axis=1)) < settings.threshold
    return np.where(worth, cautious.argmin(axis=1), fixed_at)
