"""Validate a study: find whether adapting would pay in places that it was not trained on.

Recordings or segments are left out in turn. A fixed set, and what is driven instead of it, are
chosen on the rest. On what is left out, the errors that were recorded for the sets they choose are
looked up, period by period; no odometry runs.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system.progress import Progress, unseen
from adaptune.errors import AdaptuneError
from adaptune.metrics import cap
from adaptune.model import ErrorModel, ModelError
from adaptune.model.registry import ADAPTIVE, RULES, STANDBY, call_user_code, rule_class, selected
from adaptune.model.rules import BASELINE, ERROR_FLOOR
from adaptune.paired import MIN_BLOCKS, MIN_RECORDINGS, Pair, in_cell, ratio
from adaptune.report import tables
from adaptune.report.drawing import draw_chart
from adaptune.runs.archive import Archive
from adaptune.study.driven import PER_SEGMENT, driven, expected_in_words
from adaptune.study.references import estimates_in_words, estimates_of
from offline.bank_choice import (
    MOST_FOLDS,
    Figures,
    bank_errors,
    choose,
    figures,
    log_ratios,
)
from offline.charts import segment_chart
from offline.config import OfflineStudy
from offline.labelled import (
    LabelledData,
    LabelledSequence,
    labelled_data,
    periods,
    with_vectors,
)
from offline.whole import in_whole_drives

BANK_SIZE = 4
"""Its members, unless the study says otherwise."""


class ValidationError(AdaptuneError):
    """A study that cannot be validated."""


class LeftOut(NamedTuple):
    """What happened on one recording, or segment of it, that was left out."""

    name: str
    recording: str  # that it is a part of
    segment: NDArray[np.intp]  # (n,): of each frame
    span: int  # frames of a sub-trajectory
    # For every mode the clipped error in percent at each frame, of shape (n,).
    errors: dict[str, NDArray[np.float64]]
    # For every rule the share of periods in which it did not choose the fixed set; of a bank, the
    # share of the weight that the other members had.
    adapted: dict[str, float]
    # For every mode the milliseconds of CPU time a scan that it costs; NaN if it is unknown.
    costs: Mapping[str, float]


def joined(parts: Sequence[LeftOut]) -> LeftOut:
    """Segments of a recording that were left out, as one."""
    if len(parts) == 1:
        return parts[0]
    n_frames = [len(part.segment) for part in parts]

    def mean(values: Sequence[Mapping[str, float]]) -> dict[str, float]:
        return {
            mode: float(np.average([of_part[mode] for of_part in values], weights=n_frames))
            for mode in _of_all(values)
        }

    return parts[0]._replace(
        segment=np.concatenate([part.segment for part in parts]),
        errors={
            mode: np.concatenate([part.errors[mode] for part in parts])
            for mode in _of_all([part.errors for part in parts])
        },
        adapted=mean([part.adapted for part in parts]),
        costs=mean([part.costs for part in parts]),
    )


def _of_all(parts: Sequence[Mapping[str, object]]) -> list[str]:
    """The modes that are known of every part, in the order of the first."""
    return [mode for mode in parts[0] if all(mode in one for one in parts)]


@dataclass
class Validation:
    """All that was left out, and the conclusion."""

    left_out: list[LeftOut]  # one of each recording
    # For every mode its mean error over the fixed set's, a number for each recording.
    ratios: dict[str, NDArray[np.float64]] = field(init=False)
    # For every mode the logarithm of its ratio to the fixed set's error on each segment.
    logs: dict[str, NDArray[np.float64]] = field(init=False)
    recordings: list[str] = field(init=False)  # of each segment

    def __post_init__(self) -> None:
        modes = _of_all([one.errors for one in self.left_out])
        means = {
            mode: np.array([s.errors[mode].mean() for s in self.left_out]) + ERROR_FLOOR
            for mode in modes
        }
        self.ratios = {mode: mean / means["fixed"] for mode, mean in means.items()}
        self.logs = {
            mode: np.concatenate(
                [log_ratios(s.errors[mode], s.errors["fixed"], s.segment) for s in self.left_out]
            )
            for mode in modes
        }
        self.recordings = [s.recording for s in self.left_out for _ in np.unique(s.segment)]

    @property
    def modes(self) -> list[str]:
        """`ADAPTIVE`, and the other rules."""
        others = [mode for mode in self.left_out[0].adapted if mode != ADAPTIVE]
        return [mode for mode in (ADAPTIVE, *others) if mode in self.ratios]

    def figures(self, mode: str, other: str = "fixed") -> Figures:
        """What is expected of a mode elsewhere, compared with another one."""
        return figures(self.logs[mode] - self.logs[other], self.recordings)

    def cost(self, mode: str) -> float:
        """Mean cost of a mode in milliseconds of CPU time a scan; NaN if it is unknown."""
        return float(np.mean([one.costs.get(mode, np.nan) for one in self.left_out]))

    def summary(self, mode: str) -> dict[str, float]:
        """Its figures, and the ratio of the mean errors."""
        mean, fixed = (
            np.mean([s.errors[m].mean() for s in self.left_out]) for m in (mode, "fixed")
        )
        of_mode = self.figures(mode)._asdict()
        numbers = {key: float(value) for key, value in of_mode.items() if not key.startswith("n_")}
        return numbers | {"arithmetic": float((mean + ERROR_FLOOR) / (fixed + ERROR_FLOOR))}

    def verdict(self, rule: str) -> str:
        """What to expect of a rule, in a sentence."""
        expected = expected_in_words(self.figures(rule)._asdict())
        share = 100 * np.mean([left_out.adapted.get(rule, 0.0) for left_out in self.left_out])
        if not share:
            return (
                f"`{rule}` kept the fixed set on each part that was left out. So there is no "
                f"estimate of its gain."
            )
        how = f"adapting {share:.0f} % of the time"
        if rule == ADAPTIVE:
            how = f"with {share:.0f} % of the weight on other sets than fixed"
        return f"`{rule}`: {expected}, {how}."


def leave_one_out(
    data: LabelledData,
    progress: Progress = unseen,
    bank: int = BANK_SIZE,
    rules: Sequence[str] = tuple(RULES),
    among_members: bool = False,
) -> Validation:
    """Leave each recording or segment out in turn.

    What is driven is chosen anew on the rest, by the loss with which a study chooses it. So the
    figures are those of the choice, and not of what was best in hindsight.

    `bank` is the number of a bank's members, 0 for none; `rules` are names, see
    `adaptune.model.registry`, which select among the bank's members where `online` lets them do so.
    There is a ValidationError if there are fewer than two folds.
    """
    by_recording = len(data.recordings) >= MIN_RECORDINGS
    folds = data.folds(by_recording)
    if len(folds) < 2:
        length = data.sequences[0].simulation.length
        raise ValidationError(
            f"training: there is one segment only, or every segment passes within {length:g} m of "
            f"all others, so nothing remains to train on when it is left out. Record "
            f"{2 * PER_SEGMENT * length:g} m or more that do not stay in one place, add "
            f"recordings, or lower sub_trajectory (two segments are {2 * PER_SEGMENT} "
            f"sub-trajectories)"
        )
    parts: dict[str, list[LeftOut]] = {}
    for i, (left_out, others) in enumerate(folds):
        progress("parts left out", i, len(folds))
        part = leave_out(left_out, others, bank, by_recording, rules, among_members)
        parts.setdefault(part.name, []).append(part)
    progress("parts left out", len(folds), len(folds))
    return Validation([joined(of_recording) for of_recording in parts.values()])


def leave_out(
    sequence: LabelledSequence,
    others: LabelledData,
    bank: int,
    by_recording: bool,
    rules: Sequence[str] = tuple(RULES),
    among_members: bool = False,
) -> LeftOut:
    """Fit on the others, and look up what happens on what is left out; see `leave_one_out`."""
    fitted = data, pca = others.training_data()
    features = pca.transform(sequence.descriptors)
    clipped = cap(sequence.errors)
    fixed = clipped[:, data.sets.column(data.fixed)]
    first, period = periods(sequence.period)
    frames = np.arange(len(clipped))
    errors, adapted = {"baseline": clipped[:, data.sets.column(BASELINE)], "fixed": fixed}, {}
    chosen = choose(others, bank, by_recording, MOST_FOLDS)
    alone, costs, members = others.costs.alone, dict[str, float](), tuple(chosen.members)
    of_bank, some = data, members or (data.fixed,)
    if among_members:
        vectors = others.vectors(members) if members else None
        of_bank = replace(data, candidates=some, vectors=vectors)
    for name in (name for name in rules if name not in (ADAPTIVE, STANDBY)):
        rule = call_user_code(rule_class(name).of, None)
        call_user_code(rule.fit, of_bank)
        trials = [selected(rule, data.sets, features[i]).trial for i in first]
        errors[name] = clipped[frames, data.sets.columns(trials)[period]]
        adapted[name] = float(np.mean([trial != data.fixed for trial in trials]))
        costs[name] = float(np.mean([alone(trial) for trial in trials]))
        if among_members and members:  # all of them run
            costs[name] = others.costs.adaptive(members)
    costs |= {"baseline": alone(0), "fixed": alone(data.fixed), ADAPTIVE: alone(data.fixed)}
    errors[ADAPTIVE], adapted[ADAPTIVE] = fixed, 0.0
    if len(members) > 1:
        simulated = bank_errors(sequence, others, fitted, members, [chosen.bank])
        errors[ADAPTIVE], weights = next(simulated)
        adapted[ADAPTIVE] = float(1.0 - weights[:, 0].mean())
        costs[ADAPTIVE] = others.costs.adaptive(members)
    # The best set in hindsight.
    errors["oracle, sequence"] = clipped[:, int(np.argmin(clipped.mean(axis=0)))]
    about = (sequence.name, sequence.recording, sequence.segment, sequence.span)
    return LeftOut(*about, errors, adapted, costs)


class Validated(NamedTuple):
    """Result of `validate`."""

    validation: Validation
    # Ratio to the fixed set's error of every mode on every sequence left out.
    rows: list[dict[str, Any]]
    # Sentences: what `adaptune online` will drive, its estimate, and what reference judged it.
    verdicts: list[str]


def validate(study: OfflineStudy, progress: Progress = unseen) -> Validated:
    """Validate the selection rules on a study's training sequences.

    The study's folder receives ``validation`` (CSV, JSON and a picture) and ``segments`` (CSV,
    JSON). There is a ModelError if there is no model yet, or it is not this study's; a
    ValidationError if there is only one segment.
    """
    model = study.model()
    if (study.training, study.window) != (model.sequences, model.window):
        raise ModelError(
            f"{study.model_path}: was fitted to other training sequences or descriptors than the "
            f"study's; run `adaptune offline` again"
        )
    data = _labelled(study, model)
    online = driven(model, study.config.online, study.odometry, study.mechanism)
    bank = study.config.online.switching.size if study.mechanism == "bank" else 0
    among_members = bank > 0 and not study.odometry.description.live
    try:
        validation = leave_one_out(data, progress, bank, study.rules, among_members)
    except ValidationError as error:
        raise ValidationError(f"{error}. {online}") from error
    rows = _rows(validation)
    tables.write_rows(study.folder, "validation", rows)
    segments = _segment_rows(validation)
    tables.write_rows(study.folder, "segments", segments)
    if (chart := segment_chart(segments)) is not None:
        draw_chart(chart, *(study.folder / f"validation.{kind}" for kind in ("png", "svg")))
    said = [online, *_verdicts(study.rules, bank > 0, validation)]
    estimates = estimates_of(study.sequences, study.training)
    said += estimates_in_words(estimates, model.length)
    return Validated(validation, rows, said)


def _verdicts(rules: Collection[str], bank: bool, validation: Validation) -> list[str]:
    """The estimate for what `adaptune online` will drive, then for what else it drives."""
    said = []
    if bank and ADAPTIVE in rules:
        said.append(validation.verdict(ADAPTIVE))
    said.append(baseline_in_words(validation))
    others = [name for name in rules if name not in (ADAPTIVE, STANDBY)]
    return [*said, *map(validation.verdict, others)]


def baseline_in_words(validation: Validation) -> str:
    """How the baseline compares; the study's own fixed set is another than those compared with."""
    s, parts = validation.summary("baseline"), f"{len(validation.recordings)} segments"
    if s["low"] == s["high"]:
        return f"Without what is left out, the baseline is chosen each time, over {parts}."
    better = ": there the baseline is better" if s["high"] < 1.0 else ""
    return (
        f"The baseline has {s['geometric']:.2f} times the error of the sets that are chosen "
        f"without what is left out, over {parts} (95 % interval "
        f"{in_cell((s['low'], s['high']))}){better}."
    )


def _labelled(study: OfflineStudy, model: ErrorModel) -> LabelledData:
    """The labelled data set of the sets that did not fail."""
    archive = Archive(study.folder / "trials")
    data = labelled_data(study, archive, model.sets).usable()
    return with_vectors(in_whole_drives(data, archive, study.config.offline), archive)


def _rows(validation: Validation) -> list[dict[str, Any]]:
    """Ratios to the fixed set's error, intervals of the default rule's, and costs."""
    modes = [mode for mode in validation.ratios if mode != "fixed"]

    def row(
        name: str,
        fixed: float | None,
        values: Mapping[str, float],
        interval: str | None = None,
    ) -> dict[str, Any]:
        found: dict[str, Any] = {"left out": name, "fixed [%]": fixed}
        for mode in modes:
            found[mode] = values[mode]
            if mode == ADAPTIVE:
                found[f"{mode}, 95 %"] = interval
        return found

    rows = []
    for i, sequence in enumerate(validation.left_out):
        ratios = {mode: float(validation.ratios[mode][i]) for mode in modes}
        errors, fixed = sequence.errors[ADAPTIVE], sequence.errors["fixed"]
        # It is about this sequence, and says nothing about other places.
        interval = in_cell(ratio([Pair(np.stack([errors, fixed]), sequence.span)]).interval)
        rows.append(row(sequence.name, fixed.mean(), ratios, interval))
    costs = {mode: validation.cost(mode) for mode in ["fixed", *modes]}
    if np.isfinite(list(costs.values())).any():
        rows.append(row("cost [ms]", costs["fixed"], costs))
    summaries = {mode: validation.summary(mode) for mode in modes}
    for key in ("geometric", "arithmetic", "worst_tenth", "worst"):
        values = {mode: summaries[mode][key] for mode in modes}
        of_mean = key == "geometric"
        few = len(validation.recordings) < MIN_BLOCKS
        ends = None if few else (summaries[ADAPTIVE]["low"], summaries[ADAPTIVE]["high"])
        rows.append(row(key.replace("_", " "), None, values, in_cell(ends) if of_mean else None))
    return rows


def _segment_rows(validation: Validation) -> list[dict[str, Any]]:
    """Mean error of the fixed set, and ratios to it, on each segment."""
    logs = {mode: of for mode, of in validation.logs.items() if mode != "fixed"}
    rows: list[dict[str, Any]] = []
    for one in validation.left_out:
        for number in np.unique(one.segment):
            fixed = one.errors["fixed"][one.segment == number]
            rows.append(
                {"recording": one.name, "segment": int(number), "fixed [%]": float(fixed.mean())}
                | {mode: float(np.exp(of[len(rows)])) for mode, of in logs.items()}
            )
    return rows
