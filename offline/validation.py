"""Does adapting pay in a place that was not trained on? Told from the archive, without a run.

Each training sequence is left out in turn. A fixed set and the selection rules are fitted on the
others; on the one left out they are given the errors that were recorded for the sets they choose,
period by period.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from adaptune import report
from adaptune.archive import Archive
from adaptune.descriptor import ScaledPCA, averaged
from adaptune.errors import AdaptuneError
from adaptune.metrics import cap
from adaptune.model import RULES, ErrorModel, Rule, TrainingData
from adaptune.model.base import mean_errors
from adaptune.study import Study, origin
from offline.objective import weighted

MIN_SEQUENCES = 6
"""Fewer say too little about places they are not to advise for adapting."""
NO_WORSE = 1.05
"""A rule may not have more than this much of the fixed set's error on any sequence left out."""


class ValidationError(AdaptuneError):
    """A study that cannot be validated."""


@dataclass(frozen=True, eq=False)
class LabelledSequence:
    """The frames of a sequence that have a sub-trajectory.

    Attributes
    ----------
    name : str
    period : ndarray of shape (n,)
        Whole periods since the first scan: in each, one selection holds.
    descriptors : ndarray of shape (n, n_features)
    errors : ndarray of shape (n, n_sets)
        Percent, infinite where the track was lost.
    blocks : tuple of int, optional
        Lengths of the descriptors; one when left out.
    baseline : ndarray of shape (n,), optional
        Errors of the baseline, which may break limits; those of the first set when left out.
    values : ndarray of shape (n_sets,), optional
        By what the fixed set is chosen; the mean capped error when left out.
    """

    name: str
    period: NDArray[np.int64]
    descriptors: NDArray[np.float32]
    errors: NDArray[np.float32]
    blocks: tuple[int, ...] | None = None
    baseline: NDArray[np.float64] | None = None
    values: NDArray[np.float64] | None = None


class LeftOut(NamedTuple):
    """What happened on one sequence that was left out.

    Attributes
    ----------
    name : str
    errors : dict
        For every mode the capped error in percent at each frame, of shape (n,).
    adapted : dict
        For every rule the share of periods in which it did not choose the fixed set.
    """

    name: str
    errors: dict[str, NDArray[np.float64]]
    adapted: dict[str, float]


@dataclass
class Validation:
    """All sequences left out, and what to make of it.

    Attributes
    ----------
    left_out : list of LeftOut
    ratios : dict
        For every mode its mean error over the fixed set's, a number for each sequence.
    """

    left_out: list[LeftOut]
    ratios: dict[str, NDArray[np.float64]] = field(init=False)

    def __post_init__(self) -> None:
        modes = list(self.left_out[0].errors)
        fixed = np.array([s.errors["fixed"].mean() for s in self.left_out])
        self.ratios = {
            mode: np.array([s.errors[mode].mean() for s in self.left_out]) / fixed for mode in modes
        }

    def summary(self, mode: str) -> dict[str, float]:
        """Geometric mean, 95 % interval, worst and arithmetic ratio to the fixed set.

        The interval is Student's, of the logarithms: it speaks of other sequences like these.
        """
        logs = np.log(self.ratios[mode])
        margin = stats.t.ppf(0.975, len(logs) - 1) * stats.sem(logs)
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

    def verdict(self, rule: str) -> str:
        """What to do, in a sentence or two."""
        s = self.summary(rule)
        worst = self.left_out[int(np.argmax(self.ratios[rule]))].name
        share = 100 * np.mean([left_out.adapted.get(rule, 0.0) for left_out in self.left_out])
        ratio = (
            f"over {len(self.left_out)} sequences left out it has {s['geometric']:.2f} times the "
            f"fixed set's error in geometric mean (95 % interval {s['low']:.2f}-{s['high']:.2f}), "
            f"adapting {share:.0f} % of the time"
        )
        if s["worst"] > NO_WORSE:
            return f"Do not adapt by `{rule}`: {s['worst']:.2f} times on {worst}; {ratio}."
        if len(self.left_out) < MIN_SEQUENCES:
            return f"Too few sequences to advise for `{rule}`: {ratio}."
        if s["high"] >= 1.0:
            return f"Nothing shows that `{rule}` pays, nor that it harms: {ratio}."
        return f"Adapt by `{rule}`: {ratio}, and on none more than {s['worst']:.2f} times."


def validate(
    study: Study, progress: Callable[[int, int], None] = lambda *_: None
) -> tuple[Validation, list[dict[str, Any]]]:
    """Validate the selection rules on a study's training sequences.

    Parameters
    ----------
    study
        A study that the offline stage has finished; its folder receives ``validation.csv`` and
        ``validation.json``.
    progress
        Told about every sequence.

    Returns
    -------
    validation : Validation
    rows : list of dict
        Ratio to the fixed set's error of every mode on every sequence left out.

    Raises
    ------
    ModelError
        If there is no model yet.
    ValidationError
        If there is but one training sequence.
    """
    model = ErrorModel.load(study.folder / "model.npz")
    archive = Archive(study.folder / "trials")
    numbers = model.provenance["trials"]
    objective = study.config.offline.objective[0]
    sequences = []
    for name in model.sequences:
        frames = archive.read_frames(name)
        errors = archive.read_errors(name, numbers)
        labelled = ~np.isnan(errors).all(axis=1)
        described = averaged(
            frames.descriptors, frames.stamps, model.window, study.config.online.period
        )
        blocks = tuple(frames.blocks.values())
        since = (frames.stamps[labelled] - frames.stamps[0]) * 1e-9
        period = (since // study.config.online.period).astype(np.int64)
        values = [weighted(objective, archive.finished(name)[n].metrics) for n in numbers]
        sequences.append(
            LabelledSequence(
                name,
                period,
                described[labelled],
                errors[labelled],
                blocks,
                archive.read(name, 0).errors[labelled],
                np.array(values),
            )
        )
    validation = leave_one_out(sequences, model.space.to_unit(model.sets), progress=progress)
    rows: list[dict[str, Any]] = []
    for i, sequence in enumerate(validation.left_out):
        rows.append({"left out": sequence.name, "fixed [%]": sequence.errors["fixed"].mean()})
        rows[-1] |= {m: float(r[i]) for m, r in validation.ratios.items() if m != "fixed"}
    for key in ("geometric", "arithmetic", "worst"):
        row: dict[str, Any] = {"left out": f"{key}", "fixed [%]": None}
        row |= {m: validation.summary(m)[key] for m in validation.ratios if m != "fixed"}
        rows.append(row)
    report.write_rows(study.folder, "validation", rows)
    return validation, rows


def leave_one_out(
    sequences: Sequence[LabelledSequence],
    sets: NDArray[np.float64],
    rules: dict[str, Callable[[], Rule]] | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> Validation:
    """Leave each sequence out in turn, with all views of it.

    Parameters
    ----------
    sequences
        All with errors of the same sets.
    sets
        The parameter sets in the unit cube, of shape (n_sets, n_parameters).
    rules
        By name, how to make each; those of `adaptune.model.RULES` when left out.
    progress
        Told about every sequence.

    Raises
    ------
    ValidationError
        If there are fewer than two sequences.
    """
    groups = dict.fromkeys(origin(s.name) for s in sequences)
    if len(groups) < 2:
        raise ValidationError(
            "training: one sequence cannot be validated, for nothing remains to train on when it "
            "is left out; add sequences"
        )
    left_out = []
    # Views say nothing new of the place that they are of.
    seen = [s for s in sequences if s.name in groups]
    for i, sequence in enumerate(seen):
        progress(i, len(seen))
        others = [s for s in sequences if origin(s.name) != sequence.name]
        left_out.append(_leave_out(sequence, others, sets, rules or RULES))
    progress(len(seen), len(seen))
    return Validation(left_out)


def training_data(
    sequences: Sequence[LabelledSequence], sets: NDArray[np.float64]
) -> tuple[TrainingData, ScaledPCA]:
    """What rules learn from these sequences, and how to describe a scan for them."""
    descriptors = np.concatenate([s.descriptors for s in sequences])
    errors = np.concatenate([s.errors for s in sequences])
    number = np.repeat(np.arange(len(sequences)), [len(s.errors) for s in sequences])
    pca = ScaledPCA(blocks=sequences[0].blocks).fit(descriptors)
    values = [
        mean_errors(s.errors, np.zeros(len(s.errors), np.intp)) if s.values is None else s.values
        for s in sequences
    ]
    fixed = int(np.argmin(np.mean(values, axis=0)))
    return TrainingData(pca.transform(descriptors), number, errors, sets, fixed), pca


def _leave_out(
    sequence: LabelledSequence,
    others: Sequence[LabelledSequence],
    sets: NDArray[np.float64],
    rules: dict[str, Callable[[], Rule]] | dict[str, type[Rule]],
) -> LeftOut:
    data, pca = training_data(others, sets)
    features = pca.transform(sequence.descriptors)
    capped = cap(sequence.errors)
    _, first, period = np.unique(sequence.period, return_index=True, return_inverse=True)
    frames = np.arange(len(capped))
    baseline = capped[:, 0] if sequence.baseline is None else cap(sequence.baseline)
    errors = {"baseline": baseline, "fixed": capped[:, data.fixed]}
    adapted = {}
    for name, make in rules.items():
        rule = make().fit(data)
        chosen = np.array([rule.select(features[i]).set_index for i in first])
        errors[name] = capped[frames, chosen[period]]
        adapted[name] = float(np.mean(chosen != data.fixed))
    errors["oracle, sequence"] = capped[:, int(np.argmin(capped.mean(axis=0)))]
    best = np.array([capped[period == p].mean(axis=0).argmin() for p in range(len(first))])
    errors["oracle, period"] = capped[frames, best[period]]
    return LeftOut(sequence.name, errors, adapted)
