"""Does adapting pay in a place that was not trained on? Told from the archive, without a run.

Each training sequence is left out in turn. A fixed set and the selection rules are fitted on the
others; on the one left out they are given the errors that were recorded for the sets they choose,
period by period.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from threadpoolctl import threadpool_limits

from adaptune import report
from adaptune.archive import Archive
from adaptune.descriptor import averaged
from adaptune.descriptor.pca import ScaledPCA
from adaptune.errors import AdaptuneError
from adaptune.metrics import bootstrap, cap, span
from adaptune.model import (
    RULES,
    ErrorModel,
    ModelError,
    PairedExpectedRatio,
    Rule,
    Settings,
    TrainingData,
    fusion,
)
from adaptune.model.base import complementary, mean_errors
from adaptune.model.fusion import PairedFusion
from adaptune.model.paired import ERROR_FLOOR, Near
from adaptune.sequence.views import origin, places
from offline.fusion import Drive, drive, error_vectors, periods
from offline.objective import weighted
from offline.offline_study import OfflineStudy
from offline.search import owner

MIN_SEQUENCES = 6
"""Fewer say too little about places they are not to advise for adapting."""
NO_WORSE = 1.05
"""A rule may not have more than this much of the fixed set's error on any sequence left out."""
TINY = 1e-6
"""Percent, which is no error: what has none can still be compared."""
MOST_SETS = 6
"""Complementary sets whose worth is told."""
SHARPNESS = (6.0, 12.0, 24.0, 48.0)
"""What `tune` chooses from; of equally good ones the first."""
BANK_SHARPNESS = (12.0, 48.0)
HEDGES = (0.0, 0.25, 0.5)
BANK_LIMITS = (6.0, 18.0)
"""What `tune_bank` chooses from, every one with every other."""
BANK = "bank"
"""The mode in which a bank is driven."""
BANK_SIZE = 4
"""Its members, unless the study says otherwise."""
BANK_SIZES = (2, 3, 4, 5, 6)
"""Those that a study may ask for."""
BANK_FRAMES = 1000
"""Nearest frames of each sequence: products of errors take more to be known than their means."""


Interval = tuple[float, float] | None
"""The ends, where they can be told."""


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
    own : ndarray of shape (n_sets,), optional
        Sets that were searched for on this very place, or a view of it, and on no other: who has
        not been there does not know them.
    block : int
        Frames that a sub-trajectory takes.
    vectors : ndarray of shape (n, n_sets, 3), optional
        The errors as vectors, see `adaptune.model.TrainingData`; without them, and `drive`, there
        is no bank.
    drive : Drive, optional
        With all frames.
    """

    name: str
    period: NDArray[np.int64]
    descriptors: NDArray[np.float32]
    errors: NDArray[np.float32]
    blocks: tuple[int, ...] | None = None
    baseline: NDArray[np.float64] | None = None
    values: NDArray[np.float64] | None = None
    own: NDArray[np.bool_] | None = None
    block: int = 1
    vectors: NDArray[np.float32] | None = None
    drive: Drive | None = None


class LeftOut(NamedTuple):
    """What happened on one sequence that was left out.

    Attributes
    ----------
    name : str
    errors : dict
        For every mode the capped error in percent at each frame, of shape (n,).
    adapted : dict
        For every rule the share of periods in which it did not choose the fixed set; of a bank,
        the share of the weight that others had.
    familiarity : ndarray of shape (n,)
        See `Selection`; NaN without a rule that tells it.
    portfolio : ndarray of shape (MOST_SETS,)
        Mean error in percent if of 1, 2, ... complementary sets the best were always known.
    block : int
        Frames that a sub-trajectory takes.
    """

    name: str
    errors: dict[str, NDArray[np.float64]]
    adapted: dict[str, float]
    familiarity: NDArray[np.float64]
    portfolio: NDArray[np.float64]
    block: int = 1

    def interval(self, mode: str) -> Interval:
        """95 % interval of the ratio to the fixed set's error, see `bootstrap`.

        It speaks of this drive, and tells nothing of other places.
        """
        intervals = bootstrap(self.errors[mode], self.errors["fixed"], self.block)
        return intervals and intervals[1]


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
        means = {
            mode: np.array([s.errors[mode].mean() for s in self.left_out]) + TINY for mode in modes
        }
        self.ratios = {mode: mean / means["fixed"] for mode, mean in means.items()}

    @property
    def modes(self) -> list[str]:
        """A bank, if one was driven, and the rules."""
        return [mode for mode in (BANK, *RULES) if mode in self.ratios]

    @property
    def default(self) -> str:
        """The first of them."""
        return self.modes[0] if self.modes else next(iter(RULES))

    def summary(self, mode: str) -> dict[str, float]:
        """Geometric mean, 95 % interval, worst and arithmetic ratio to the fixed set.

        The interval is Student's, of the logarithms: it speaks of other sequences like these.
        """
        logs = np.log(self.ratios[mode])
        margin = _margin(logs)
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
        """Ratio to the fixed set's error, in geometric mean, if the best of K sets were known.

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
        worst = self.left_out[int(np.argmax(self.ratios[rule]))].name
        share = 100 * np.mean([left_out.adapted.get(rule, 0.0) for left_out in self.left_out])
        ratio = (
            f"over {len(self.left_out)} sequences left out it has {s['geometric']:.2f} times the "
            f"fixed set's error in geometric mean (95 % interval {s['low']:.2f}-{s['high']:.2f}), "
            + (
                f"others than the fixed set having {share:.0f} % of the weight"
                if rule == BANK
                else f"adapting {share:.0f} % of the time"
            )
        )
        if not any(left_out.adapted.get(rule, 1.0) for left_out in self.left_out):
            return f"`{rule}` kept the fixed set: what it was fitted on did not show that it pays."
        if s["worst"] > NO_WORSE:
            return f"Do not adapt by `{rule}`: {s['worst']:.2f} times on {worst}; {ratio}."
        if len(self.left_out) < MIN_SEQUENCES:
            return f"Too few sequences to advise for `{rule}`: {ratio}."
        if s["high"] >= 1.0:
            return f"Nothing shows that `{rule}` pays, nor that it harms: {ratio}."
        return f"Adapt by `{rule}`: {ratio}, and on none more than {s['worst']:.2f} times."


def _margin(logs: NDArray[np.float64]) -> float:
    """Half of the 95 % interval of the mean, Student's."""
    return float(stats.t.ppf(0.975, len(logs) - 1) * stats.sem(logs))


class Validated(NamedTuple):
    """What `validate` found.

    Attributes
    ----------
    validation : Validation
    rows : list of dict
        Ratio to the fixed set's error of every mode on every sequence left out.
    learning, banks : list of dict
        See `learning_curve` and `bank_curve`; empty where they were not asked for.
    """

    validation: Validation
    rows: list[dict[str, Any]]
    learning: list[dict[str, Any]]
    banks: list[dict[str, Any]]


def validate(
    study: OfflineStudy,
    curve: bool = False,
    sizes: bool = False,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Validated:
    """Validate the selection rules on a study's training sequences.

    Parameters
    ----------
    study
        A study that the offline stage has finished; its folder receives ``validation.csv``,
        ``validation.json`` and ``validation.png``, and its model what was found.
    curve
        Tell, too, what fewer training sequences would gain: ``learning.csv``, ``learning.json``.
    sizes
        Tell, too, what banks of other sizes would gain: ``banks.csv``, ``banks.json``.
    progress
        Told what is done, and about every sequence.

    Raises
    ------
    ModelError
        If there is no model yet, or it is not this study's.
    ValidationError
        If there is but one training sequence.
    """
    path = study.folder / "model.npz"
    model = ErrorModel.load(path)
    model.check_study(study.odometry.identity, study.odometry.space, path)
    if (study.training, study.window) != (model.sequences, model.window):
        raise ModelError(
            f"{path}: was fitted to other training sequences or descriptors than the study's; run "
            f"`adaptune offline` again"
        )
    sequences, sets, everywhere = labelled_sequences(study, model)
    switching = study.config.online.switching
    named = switching.sets is not None and set(model.bank) <= set(everywhere)
    members = [everywhere.index(i) for i in model.bank] if named else switching.size
    validation = leave_one_out(
        sequences,
        sets,
        progress=lambda i, n: progress("sequences left out", i, n),
        bank=members,
    )
    rows = _rows(validation)
    report.write_rows(study.folder, "validation", rows)
    learning = []
    if curve:
        learning = learning_curve(
            sequences,
            sets,
            progress=lambda i, n: progress("learning curve", i, n),
            bank=members,
        )
        report.write_rows(study.folder, "learning", learning)
    banks = []
    if sizes:
        banks = bank_curve(sequences, sets, lambda i, n: progress("sizes of banks", i, n))
        report.write_rows(study.folder, "banks", banks)
    report.draw_validation(
        study.folder / "validation.png",
        study.name,
        validation.ratios,
        [s.name for s in validation.left_out],
        *_by_familiarity(validation),
        validation.portfolio(),
        learning,
        banks,
    )
    found = {mode: validation.summary(mode) for mode in validation.modes}
    replace(model, validation=found).save(study.folder / "model.npz")
    return Validated(validation, rows, learning, banks)


def _rows(validation: Validation) -> list[dict[str, Any]]:
    """Ratios to the fixed set's error; beside the default rule's their intervals."""
    default = validation.default
    modes = [mode for mode in validation.ratios if mode != "fixed"]
    rows: list[dict[str, Any]] = []

    def add(name: str, fixed: float | None, of: dict[str, float], interval: Interval) -> None:
        rows.append({"left out": name, "fixed [%]": fixed})
        for mode in modes:
            rows[-1][mode] = of[mode]
            if mode == default:
                ends = interval and f"{interval[0]:.2f}-{interval[1]:.2f}"
                rows[-1][f"{mode}, 95 %"] = ends

    for i, sequence in enumerate(validation.left_out):
        of = {mode: float(validation.ratios[mode][i]) for mode in modes}
        add(sequence.name, sequence.errors["fixed"].mean(), of, sequence.interval(default))
    summaries = {mode: validation.summary(mode) for mode in modes}
    for key in ("geometric", "arithmetic", "worst"):
        ends = summaries[default]["low"], summaries[default]["high"]
        of = {mode: summaries[mode][key] for mode in modes}
        add(key, None, of, ends if key == "geometric" else None)
    return rows


def _by_familiarity(validation: Validation) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Familiarity of every frame left out, and its error by the default rule over the fixed's."""
    rule = validation.default
    familiarity = np.concatenate([s.familiarity for s in validation.left_out])
    ratio = np.concatenate(
        [
            (s.errors[rule] + ERROR_FLOOR) / (s.errors["fixed"] + ERROR_FLOOR)
            for s in validation.left_out
        ]
    )
    return familiarity, ratio


def learning_curve(
    sequences: Sequence[LabelledSequence],
    sets: NDArray[np.float64],
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda *_: None,
    bank: int | Sequence[int] = BANK_SIZE,
) -> list[dict[str, Any]]:
    """What a bank, or if there is none the paired rule, gains with fewer training sequences.

    Each sequence is left out in turn, and the rule and its settings are fitted on some of the
    others, drawn by chance.

    Returns
    -------
    list of dict
        For each number of training sequences the ratio to the error of the set that is fixed on
        the same ones: geometric mean with its 95 % interval (Student's, over sequences), and the
        worst.
    """
    folds = _folds(sequences)
    most = len(folds) - 1
    # Only one of them is told.
    alone = not bank or sequences[0].drive is None
    rules = {"paired": _maker("paired")} if alone else {}
    sizes = sorted({n for n in (3, 5, 8, 11, 16, 24, 32) if n < most} | {most})
    rows = []
    for i, size in enumerate(sizes):
        rng = np.random.default_rng((seed, size))
        left_out = []
        for j, (sequence, others) in enumerate(folds):
            progress(i * len(folds) + j, len(sizes) * len(folds))
            names = sorted({origin(other.name) for other in others})
            drawn = set(rng.choice(names, size, replace=False))
            some = [other for other in others if origin(other.name) in drawn]
            left_out.append(_leave_out(sequence, some, sets, rules, bank))
        validation = Validation(left_out)
        rows.append({"sequences": size} | validation.summary(validation.default))
    progress(len(sizes) * len(folds), len(sizes) * len(folds))
    return rows


def bank_curve(
    sequences: Sequence[LabelledSequence],
    sets: NDArray[np.float64],
    progress: Callable[[int, int], None] = lambda *_: None,
) -> list[dict[str, Any]]:
    """What banks gain by their number of instances, each sequence left out in turn.

    Returns
    -------
    list of dict
        For each of `BANK_SIZES`, of which there are sets, the ratio to the fixed set's error:
        geometric mean with its 95 % interval (Student's, over sequences), arithmetic, worst.
    """
    few = [size for size in BANK_SIZES if size <= len(sets)]
    rows = []
    for i, size in enumerate(few):

        def told(j: int, n: int, i: int = i) -> None:
            progress(i * n + j, len(few) * n)

        validation = leave_one_out(sequences, sets, {}, told, size)
        rows.append({"instances": size} | validation.summary(BANK))
    return rows


def labelled_sequences(
    study: OfflineStudy, model: ErrorModel
) -> tuple[list[LabelledSequence], NDArray[np.float64], list[int]]:
    """The training sequences of a model from the archive, and of which sets they tell.

    Only of sets that were run on all sequences: others have no error to be looked up.

    Returns
    -------
    sequences : list of LabelledSequence
    sets : ndarray of shape (n_sets, n_parameters)
        In the unit cube.
    everywhere : list of int
        Their numbers in the model.
    """
    archive = Archive(study.folder / "trials")
    period = study.config.online.period
    everywhere = np.flatnonzero(~np.isnan(model.errors).any(axis=0)).tolist()
    numbers = [model.trials[i] for i in everywhere]
    for name in model.sequences:
        if missing := set(numbers) - set(archive.finished(name)):
            raise ModelError(
                f"{archive.folder}: lacks trial {min(missing)} on {name}, which the model was "
                f"fitted to; run `adaptune offline` again"
            )
    members = _eligible(study, model, everywhere)
    owners = [owner(study.config.offline, model.sequences, n) for n in numbers]
    objective = study.config.offline.objective[0]
    sequences = []
    for name in model.sequences:
        frames = archive.read_frames(name)
        errors = archive.read_errors(name, numbers)
        labelled = ~np.isnan(errors).all(axis=1)
        described = averaged(frames.descriptors, frames.stamps, model.window, period)
        values = [weighted(objective, archive.finished(name)[n].metrics) for n in numbers]
        length = study.config.sub_trajectory
        vectors = np.full((int(labelled.sum()), len(numbers), 3), np.nan, np.float32)
        for i in members:
            trial = archive.read(name, numbers[i])
            vectors[:, i] = error_vectors(frames, trial, length)[labelled]
        driven = drive(
            archive,
            name,
            frames,
            numbers,
            described,
            period,
            length,
            study.config.lost_track,
        )
        sequences.append(
            LabelledSequence(
                name,
                driven.period[labelled],
                described[labelled],
                errors[labelled],
                tuple(frames.blocks.values()),
                archive.read(name, 0).errors[labelled],
                np.array(values),
                np.array([other is not None and origin(other) == origin(name) for other in owners]),
                span(frames.T_ref_sensor, length),
                vectors,
                driven,
            )
        )
    return sequences, model.space.to_unit([model.sets[i] for i in everywhere]), everywhere


def _eligible(study: OfflineStudy, model: ErrorModel, everywhere: list[int]) -> list[int]:
    """Which of the sets may be in a bank; to read the poses of thousands would take long."""
    means = mean_errors(model.errors[:, everywhere], model.sequence)
    # With a sequence left out, others than now may be among the best.
    best = np.argsort(means, kind="stable")[: 2 * fusion.POOL].tolist()
    named = [model.number(n) for n in study.config.online.switching.sets or ()]
    return sorted({*best, *(everywhere.index(n) for n in named if n in everywhere)})


Maker = Callable[[Sequence[LabelledSequence], NDArray[np.float64]], Rule]
"""Makes a rule, with settings chosen on the sequences that it will be fitted on."""


def _maker(name: str) -> Maker:
    def make(others: Sequence[LabelledSequence], sets: NDArray[np.float64]) -> Rule:
        return RULES[name](tune(others, sets) if name == "paired" else Settings(), 0.0)

    return make


def leave_one_out(
    sequences: Sequence[LabelledSequence],
    sets: NDArray[np.float64],
    rules: Mapping[str, Maker] | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
    bank: int | Sequence[int] = BANK_SIZE,
) -> Validation:
    """Leave each sequence out in turn, with all views of it.

    Parameters
    ----------
    sequences
        All with errors of the same sets.
    sets
        The parameter sets in the unit cube, of shape (n_sets, n_parameters).
    rules
        By name, how to make each; when left out, those of `adaptune.model.RULES` with settings that
        `tune` chooses anew on the other sequences.
    progress
        Told about every sequence.
    bank
        How many members a bank has, or numbers of their sets, the first of which counts as the
        fixed one; no bank is driven with 0, nor without what it takes to drive one.

    Raises
    ------
    ValidationError
        If there are fewer than two sequences.
    """
    if len({origin(s.name) for s in sequences}) < 2:
        raise ValidationError(
            "training: one sequence cannot be validated, for nothing remains to train on when it "
            "is left out; add sequences"
        )
    if rules is None:
        rules = {name: _maker(name) for name in RULES}
    left_out = []
    folds = _folds(sequences)
    for i, (sequence, others) in enumerate(folds):
        progress(i, len(folds))
        left_out.append(_leave_out(sequence, others, sets, rules, bank))
    progress(len(folds), len(folds))
    return Validation(left_out)


def _folds(
    sequences: Sequence[LabelledSequence],
) -> list[tuple[LabelledSequence, list[LabelledSequence]]]:
    """Each sequence, and those that are not views of it.

    Views themselves are not left out: they say nothing new of the place that they are of.
    """
    return [
        (sequence, [other for other in sequences if origin(other.name) != sequence.name])
        for sequence in sequences
        if origin(sequence.name) == sequence.name
    ]


def training_data(
    sequences: Sequence[LabelledSequence], sets: NDArray[np.float64]
) -> tuple[TrainingData, ScaledPCA]:
    """What rules learn from these sequences, and how to describe a scan for them."""
    descriptors = np.concatenate([s.descriptors for s in sequences])
    errors = np.concatenate([s.errors for s in sequences])
    number = np.repeat(places([s.name for s in sequences]), [len(s.errors) for s in sequences])
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
    rules: Mapping[str, Maker],
    bank: int | Sequence[int],
) -> LeftOut:
    n_sets = len(sets)
    sequence, others, sets = _comparable(sequence, others, sets)
    data, pca = training_data(others, sets)
    features = pca.transform(sequence.descriptors)
    capped = cap(sequence.errors)
    first, period = periods(sequence.period)
    frames = np.arange(len(capped))
    baseline = capped[:, 0] if sequence.baseline is None else cap(sequence.baseline)
    errors = {"baseline": baseline, "fixed": capped[:, data.fixed]}
    chosen: dict[str, NDArray[np.intp]] = {}
    familiarity = np.full(len(first), np.nan)
    for name, make in rules.items():
        rule = make(others, sets).fit(data)
        selections = [rule.select(features[i]) for i in first]
        chosen[name] = np.array([selection.set_index for selection in selections])
        errors[name] = capped[frames, chosen[name][period]]
        if not np.isnan(selections[0].familiarity):
            familiarity = np.array([selection.familiarity for selection in selections])
    adapted = {name: float(np.mean(of_rule != data.fixed)) for name, of_rule in chosen.items()}
    if bank and sequence.drive is not None:
        if not isinstance(bank, int) and len(sets) < n_sets:
            bank = len(bank)
        errors[BANK], adapted[BANK] = _driven(sequence, others, sets, data, pca, bank)
    errors["oracle, sequence"] = capped[:, int(np.argmin(capped.mean(axis=0)))]
    of_periods = np.array([capped[period == p].mean(axis=0) for p in range(len(first))])
    errors["oracle, period"] = capped[frames, of_periods.argmin(axis=1)[period]]
    few = complementary(data.errors, data.sequence, data.fixed, MOST_SETS)
    least = np.minimum.accumulate(of_periods[:, few], axis=1)[period].mean(axis=0)
    portfolio = least[np.minimum(np.arange(MOST_SETS), len(few) - 1)]
    return LeftOut(sequence.name, errors, adapted, familiarity[period], portfolio, sequence.block)


def _comparable(
    sequence: LabelledSequence, others: Sequence[LabelledSequence], sets: NDArray[np.float64]
) -> tuple[LabelledSequence, list[LabelledSequence], NDArray[np.float64]]:
    """All of it for those sets only that were run on the sequence left out: others tell nothing.

    Nor for those that nobody would know who has not been there.
    """
    run = ~np.isnan(sequence.errors).any(axis=0)
    if sequence.own is not None:
        run &= ~sequence.own
    if run.all():
        return sequence, list(others), sets
    few = [
        replace(
            s,
            errors=s.errors[:, run],
            values=None if s.values is None else s.values[run],
            vectors=None if s.vectors is None else s.vectors[:, run],
            drive=None if s.drive is None else s.drive.of(np.flatnonzero(run)),
        )
        for s in (sequence, *others)
    ]
    return few[0], [s for s in few[1:] if not np.isnan(s.errors).all()], sets[run]


def tune(sequences: Sequence[LabelledSequence], sets: NDArray[np.float64]) -> Settings:
    """Choose the settings of the paired rule, leaving each of these sequences out in turn.

    Of the settings with which it was nowhere worse than `NO_WORSE` times the fixed set, those
    with the least geometric mean, if its 95 % interval lies below 1; if not, or where there are
    none, or fewer than `MIN_SEQUENCES` sequences, those with which it always takes the fixed set.

    Parameters
    ----------
    sequences
        Those that the rule will be fitted on, and no others.
    sets
        The parameter sets in the unit cube, of shape (n_sets, n_parameters).
    """
    folds = _folds(sequences)
    if len(folds) < MIN_SEQUENCES:
        return Settings(n_sets=1)
    # The matrices are small: more threads would mostly wait for each other.
    with threadpool_limits(1, "blas"):
        best = _paying(np.array([_tried(sequence, others, sets) for sequence, others in folds]))
    return Settings(n_sets=1) if best is None else Settings(sharpness=SHARPNESS[best])


def _paying(logs: NDArray[np.float64]) -> int | None:
    """Of settings that are nowhere worse than `NO_WORSE` those with the least mean, if that pays.

    Parameters
    ----------
    logs
        Logarithms of ratios to the fixed set's error, of shape (n_sequences, n_settings).
    """
    means = np.where(logs.max(axis=0) <= np.log(NO_WORSE), logs.mean(axis=0), np.inf)
    best = int(np.argmin(means))
    return best if means[best] + _margin(logs[:, best]) < 0.0 else None


def _tried(
    sequence: LabelledSequence, others: Sequence[LabelledSequence], sets: NDArray[np.float64]
) -> list[float]:
    """With each of `SHARPNESS`, logarithm of the ratio to the fixed set's error."""
    sequence, others, sets = _comparable(sequence, others, sets)
    data, pca = training_data(others, sets)
    rule = PairedExpectedRatio().fit(data)
    first, period = periods(sequence.period)
    near = rule.near(pca.transform(sequence.descriptors[first]))
    capped = cap(sequence.errors)
    logs = []
    for sharpness in SHARPNESS:
        rule.settings = Settings(sharpness=sharpness)
        best, _ = rule.best(near)
        chosen = rule.candidates_[best]
        errors = capped[np.arange(len(capped)), chosen[period]]
        # A millionth of a percent is no error, and no fixed set better than another.
        logs.append(float(np.log((errors.mean() + TINY) / (capped[:, data.fixed].mean() + TINY))))
    return logs


def choose_bank(sequences: Sequence[LabelledSequence], fixed: int, size: int) -> list[int]:
    """Choose a bank's members, the fixed set first, see `adaptune.model.fusion.bank`."""
    vectors = [s.vectors for s in sequences if s.vectors is not None]
    return fusion.bank(vectors, [s.errors for s in sequences], fixed, size)


def tune_bank(
    sequences: Sequence[LabelledSequence],
    sets: NDArray[np.float64],
    members: Sequence[int],
    fixed: int,
) -> Settings:
    """Choose how a bank's weights are found, leaving each of these sequences out in turn.

    By the same criterion as `tune`; where nothing keeps it, the fixed set has all the weight.

    Parameters
    ----------
    sequences, sets
        See `tune`.
    members
        Numbers of the bank's sets, chosen on these sequences; the first counts as the fixed one.
    fixed
        Number of the fixed set, that the bank is compared with.
    """
    folds = _folds(sequences)
    if len(folds) < MIN_SEQUENCES or len(members) < 2:
        return Settings(hedge=1.0)
    with threadpool_limits(1, "blas"):
        logs = np.array(
            [_bank_tried(sequence, others, sets, members, fixed) for sequence, others in folds]
        )
    best = _paying(logs)
    tried = [settings for of_limit in _BANK_SETTINGS for settings in of_limit]
    return Settings(hedge=1.0) if best is None else tried[best]


_BANK_SETTINGS = [
    [
        Settings(sharpness=sharpness, hedge=hedge, limit=limit, n_frames=BANK_FRAMES)
        for sharpness in BANK_SHARPNESS
        for hedge in HEDGES
    ]
    for limit in BANK_LIMITS
]


def _bank_tried(
    sequence: LabelledSequence,
    others: Sequence[LabelledSequence],
    sets: NDArray[np.float64],
    members: Sequence[int],
    fixed: int,
) -> list[float]:
    """With each of `_BANK_SETTINGS`, logarithm of the ratio to the fixed set's error."""
    data, pca = training_data(others, sets)
    of_fixed = cap(sequence.errors[:, fixed]).mean() + TINY
    logs = []
    for of_limit in _BANK_SETTINGS:
        rule, near = _fusion(sequence, others, data, pca, members, of_limit[0])
        for rule.settings in of_limit:
            errors = _bank_errors(sequence, members, _driven_with(rule, near))
            logs.append(float(np.log((errors.mean() + TINY) / of_fixed)))
    return logs


def _fusion(
    sequence: LabelledSequence,
    others: Sequence[LabelledSequence],
    data: TrainingData,
    pca: ScaledPCA,
    members: Sequence[int],
    settings: Settings,
) -> tuple[PairedFusion, Near]:
    """A rule that is fitted on the others, and what it finds near to this sequence's scans."""
    vectors = [s.vectors[:, members] for s in others if s.vectors is not None]
    rule = PairedFusion(settings).fit(
        replace(
            data,
            fixed=members[0],
            candidates=list(members),
            vectors=np.concatenate(vectors),
        )
    )
    assert sequence.drive is not None
    first, _ = periods(sequence.drive.period)
    return rule, rule.near(pca.transform(sequence.drive.descriptors[first]))


def _driven_with(rule: PairedFusion, near: Near) -> NDArray[np.float64]:
    """Weights along a sequence, of shape (n_periods, n_members)."""
    weights, _ = rule.weigh(near)
    return fusion.steady(weights, near.familiarity)


def _bank_errors(
    sequence: LabelledSequence, members: Sequence[int], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Capped errors of a bank on the frames that have a sub-trajectory."""
    assert sequence.drive is not None
    errors = sequence.drive.errors(members, weights)
    return errors[~np.isnan(errors)]


def _driven(
    sequence: LabelledSequence,
    others: Sequence[LabelledSequence],
    sets: NDArray[np.float64],
    data: TrainingData,
    pca: ScaledPCA,
    bank: int | Sequence[int],
) -> tuple[NDArray[np.float64], float]:
    """A bank on the sequence left out: its errors, and the weight that the fixed set had not."""
    members = choose_bank(others, data.fixed, bank) if isinstance(bank, int) else bank
    settings = tune_bank(others, sets, members, data.fixed)
    if settings.hedge == 1.0:
        return cap(sequence.errors[:, data.fixed]), 0.0
    rule, near = _fusion(sequence, others, data, pca, members, settings)
    weights = _driven_with(rule, near)
    return _bank_errors(sequence, members, weights), float(1.0 - weights[:, 0].mean())
