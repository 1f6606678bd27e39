"""The comparison of baseline, fixed and adaptive on the replayed sequences."""

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import LOST_ABOVE, worst_tenth
from adaptune.model import ErrorModel, rules
from adaptune.model.registry import ADAPTIVE
from adaptune.paired import Ratio, ratio
from adaptune.reference.judge import StandardErrors
from adaptune.report import tables as report
from adaptune.runs.files import StoredReplayError
from adaptune.runs.record import NO_RUN
from adaptune.space import ODOMETRY
from adaptune.study.config import ALSO
from adaptune.study.driven import PER_SEGMENT, lost_in_words
from adaptune.study.references import estimates_of
from adaptune.study.study import Study
from online.modes import BASELINE, EVEN, FIXED, WITHOUT_MODEL, Replays, sequences_without_model
from online.reference import read_contradictions, read_reference
from online.statistics import (
    ALL,
    NO_DIFFERENCE,
    ORACLE,
    ComparisonRow,
    JudgedModes,
    compare_modes,
    mean_of,
    oracle_row,
)
from online.tables import tables
from online.verdict import adapts, called, choices, decided, late, own_parameters, remarks, verdict

_log = logging.getLogger(__name__)


class ComparedModes(NamedTuple):
    """What is compared."""

    sequences: tuple[str, ...]
    modes: tuple[str, ...]  # replayed on all of them, in the order of `MODES`
    unfinished: tuple[str, ...]  # sequences that are not compared, for want of replays
    words: list[str]  # sentences about what is not shown because it is missing


def compared_modes(replays: Replays) -> ComparedModes:
    """Find what was replayed on all test sequences, or without a model.

    Raises
    ------
    StoredReplayError
        If the fixed set was replayed on none of them, and the untrained bank neither.
    """
    study, setup, names = replays.study, replays.setup, replays.study.config.test
    made = {name: replays.made(name) for name in sequences_without_model(study.config)}
    every = {mode for modes in made.values() for mode in modes}
    if names and "fixed" in every:
        modes = replace(setup, also=ALSO).modes
        asked, option = setup.modes, ""
        due = every.intersection(("fixed", BASELINE, *setup.rules))
    else:
        modes, asked, option = WITHOUT_MODEL, WITHOUT_MODEL, " --untrained"
        due = set(WITHOUT_MODEL)
    finished = [name for name, there in made.items() if due.issubset(there)]
    # No mode is everywhere: those with the fixed set are compared.
    finished = finished or [name for name in names if "fixed" in made[name]]
    if not finished and not names:
        raise StoredReplayError("test: name at least one sequence to compare on")
    if not finished:
        for mode in WITHOUT_MODEL if replays.model is None else (FIXED,):
            replays.read(names[0], mode)  # or an error
    compared = tuple(mode for mode in modes if all(mode in made[n] for n in finished))
    unfinished = tuple(name for name in made if name not in finished)
    missing = {m: [n for n in made if m not in made[n]] for m in asked}
    where = ", ".join(f"`{mode}` on {' and '.join(on)}" for mode, on in missing.items() if on)
    words = (
        f"Not compared, because replays are missing: {where}; `adaptune online{option}` makes them."
    )
    others: dict[tuple[str, str], list[str]] = {}
    for mode, on in missing.items():
        for name in on:
            if why := replays.changes(name, mode):
                others.setdefault((name, why), []).append(f"`{mode}`")
    for (name, why), those in others.items():
        which = f"last replay of {' and '.join(those)} was made from other inputs"
        _log.warning("%s: the %s: %s", name, which, why)
    return ComparedModes(tuple(finished), compared, unfinished, [words] if where else [])


AS_WRONG = 0.5
"""Share of the baseline's error in training from which an estimated reference can rank no sets."""
LEAST_SEGMENTS = 10
"""With fewer, there is no worst tenth."""


def pooled(
    judged: Sequence[JudgedModes], oracles: Sequence[ComparisonRow] = ()
) -> list[ComparisonRow]:
    """For every mode the mean errors over all sequences, and the geometric mean of the ratios.

    Sequences without a reference do not count. `oracles` are rows of the best set in hindsight.
    """
    known = [one for one in judged if one.rows[0].rte is not None]
    modes = [row.mode for row in known[0].rows]
    made = [_pooled(mode, known) for mode in modes]
    return [*made, _mean_row(ORACLE, oracles)] if len(oracles) == len(known) else made


def _pooled(mode: str, judged: Sequence[JudgedModes]) -> ComparisonRow:
    rows = [row for one in judged for row in one.rows if row.mode == mode]
    row = _mean_row(mode, rows)
    if mode == row.yardstick:
        return row
    logs = _of_segments(judged, mode)
    enough = len(logs) >= LEAST_SEGMENTS
    return replace(
        row,
        ratio_interval=ratio_to(judged, mode).interval,
        worst_tenth=float(np.exp(worst_tenth(logs))) if enough else None,
        better=sum(row.ratio < 1.0 - NO_DIFFERENCE for row in rows if row.ratio is not None),
        worse=sum(row.ratio > 1.0 + NO_DIFFERENCE for row in rows if row.ratio is not None),
    )


def _mean_row(mode: str, rows: Sequence[ComparisonRow]) -> ComparisonRow:
    ratios, runs = [row.ratio for row in rows if row.ratio is not None], [row.run for row in rows]
    summed = ("restarts", "lost_seconds")
    of_all = {name: sum(getattr(run, name) for run in runs) for name in summed}
    of_all["cpu_ms"] = mean_of([run.cpu_ms for run in runs])
    of_all["memory_mb"] = max((m for run in runs if (m := run.memory_mb) is not None), default=None)
    return ComparisonRow(
        ALL,
        mode,
        mean_of([row.rte for row in rows]),
        float(np.exp(np.mean(np.log(np.maximum(ratios, 1e-12))))),
        NO_RUN.model_copy(update=of_all),
        sum(row.switches for row in rows),
        standard=StandardErrors.pooled([row.standard for row in rows if row.standard]),
        yardstick=rows[0].yardstick,
        estimated=mean_of([row.estimated for row in rows]),
        reference=" and ".join(sorted({row.reference for row in rows})),
    )


def ratio_to(judged: Sequence[JudgedModes], mode: str, other: str | None = None) -> Ratio:
    """Ratio of two modes' errors over sequences; `other` is by default the yardstick."""
    return ratio([one.pair(mode, other) for one in judged])


def _of_segments(judged: Sequence[JudgedModes], mode: str) -> NDArray[np.float64]:
    """Logarithms of the ratio on each segment: as many whole ones as a sequence has, or one."""
    found = []
    for one in judged:
        pair = one.pair(mode)
        n = max(1, pair.errors.shape[1] // (PER_SEGMENT * one.block))
        parts = np.array_split(pair.errors, n, axis=1)
        found += [ratio([pair._replace(errors=part)]).value for part in parts]
    return np.log(found)


NONE = "none"
"""Advised where track is lost."""


class Comparison(NamedTuple):
    """What `compare` has found."""

    # A row for every sequence and mode; over several sequences, a row for every mode follows.
    rows: list[ComparisonRow]
    verdict: list[str]  # sentences: what to do, and why
    details: list[str]  # sentences: what must be known to trust it
    advised: str = ""  # the mode to drive, or `NONE`; empty where nobody can say
    unfinished: Sequence[str] = ()  # sequences that are not compared, for want of replays
    front: Sequence[dict[str, Any]] = ()  # what may be driven, see `choices`
    model: ErrorModel | None = None  # of the replays


def compare(study: Study) -> Comparison:
    """Compare the replays that were made, see `compared_modes`, and write tables.

    ``comparison`` in the study's folder receives ``comparison.csv`` and ``.json``, and the tables
    as Markdown (``tables.md``).

    Raises
    ------
    StoredReplayError
        If that of the fixed set is missing, or one is damaged, or of another recording or
        configuration.
    ModeError
        If the model was fitted for another budget, or another bank.
    """
    replays = Replays.of(study)
    compared = compared_modes(replays)
    names, modes = compared.sequences, compared.modes
    model = _driven_model(replays, modes)
    judged: list[JudgedModes] = []
    oracles: list[ComparisonRow] = []
    wrong: list[str] = []
    periods: dict[str, float] = {}  # milliseconds from scan to scan
    for name in names:
        read = {mode: replays.read(name, mode) for mode in modes}
        reference = read_reference(study, name)
        stamps = next(iter(read.values())).trajectory.stamps
        if len(stamps) > 1 and study.config.online.real_time is None:
            periods[name] = 1e-6 * float(np.median(np.diff(stamps)))
        wrong += [f"On {name}, {what}." for what in read_contradictions(study, name)]
        of_modes = compare_modes(name, read, reference)
        judged.append(of_modes._replace(recording=study.sequences.recorded_in(name)))
        if model is not None:
            errors = study.archive("oracle").errors_of(name, model.sets)
            if (row := oracle_row(judged[-1], errors, model.fixed)) is not None:
                oracles.append(row)
    rows = _rows(judged, oracles)
    obstacle = replays.setup.obstacle(ADAPTIVE) if ADAPTIVE not in modes else ""
    length = study.config.sub_trajectory
    recommended = FIXED if model is None else model.recommended
    best = decided(rows, recommended)
    said, advised = wrong[:1], "" if best is None else best.mode
    if not said and best is not None:
        said = _lost(study, rows, best)
        advised = NONE if said else advised
    front = choices(rows, _front(study, model), advised, obstacle)
    if advised != NONE:
        tried = 0 if model is None else len(model.sets)
        whose = {} if model is None else _odometries(model)
        said += verdict(rows, length, recommended, front, obstacle, tried, whose)
        said += late(rows, advised, periods)
        if model is not None:
            said += _lost_in_training(model, whose) + _of_estimates(study, model)
        said += _not_driven(replays, compared)
    details = [w for w in (*wrong, *remarks(rows), *compared.words) if w not in said]
    folder = study.folder / "comparison"
    report.write_rows(folder, "comparison", [row.columns() for row in rows])
    report.write_tables(folder, study.name, tables(rows, length), [*said, *details])
    return Comparison(rows, said, details, advised, compared.unfinished, front, model)


def _odometries(model: ErrorModel) -> dict[str, str]:
    """Of several odometries, those that baseline and fixed set drive."""
    both = {BASELINE: model.sets[rules.BASELINE], FIXED: model.sets[model.fixed]}
    return {mode: str(one[ODOMETRY]) for mode, one in both.items() if ODOMETRY in one}


def _lost(study: Study, rows: Sequence[ComparisonRow], best: ComparisonRow) -> list[str]:
    """Where what is advised has lost its way, and the likeliest cause."""
    of_best = [row for row in rows if row.mode == best.mode and row.sequence != ALL]
    errors = {row.sequence: row.rte for row in of_best if row.rte is not None}
    faults = [row.run.fault for row in of_best if row.rte and row.rte > LOST_ABOVE]
    said = lost_in_words(study, called(best.mode), errors, faults)
    return [*said, "Until then, rely on none."] if said else []


def _driven_model(replays: Replays, modes: Sequence[str]) -> ErrorModel | None:
    """The model, if anything was driven with it; else it recommends nothing."""
    if replays.model is None or set(modes) <= set(WITHOUT_MODEL):
        return None
    replays.setup.check(replays.study.model_path)
    return replays.model


def _not_driven(replays: Replays, compared: ComparedModes) -> list[str]:
    """Why what training recommends is not compared, unless it is not possible."""
    mode = FIXED if replays.model is None else replays.model.recommended
    if replays.model is None or mode in compared.modes or replays.setup.obstacle(mode):
        return []
    if not replays.study.config.test:
        return [f"Training recommends {called(mode)}: to compare it, name a test (test:)."]
    return compared.words


def _lost_in_training(model: ErrorModel, odometries: Mapping[str, str]) -> list[str]:
    """Where baseline and fixed set lost track in training, which decides more than how well."""
    found = dict[int, list[str]]()
    for number, name in enumerate(model.sequences):
        rows = model.sequence == number
        means = rules.mean_errors(model.errors[rows], model.sequence[rows])
        for trial, mean in zip(model.sets, means, strict=True):
            if trial in (rules.BASELINE, model.fixed) and LOST_ABOVE < mean < np.inf:
                found.setdefault(trial, []).append(f"{name} (RTE {mean:.1f} %)")
    who = {model.fixed: called(FIXED), rules.BASELINE: own_parameters(odometries)}
    said = [f"{who[trial]} lost track on {', '.join(on)}" for trial, on in found.items()]
    return [f"In training, {', and '.join(said)}."] if said else []


def _of_estimates(study: Study, model: ErrorModel) -> list[str]:
    """Where the references of training are estimated, and no better than the errors to compare."""
    estimates = estimates_of(study.sequences, study.training)
    wrong = [one.error(model.length) for one in estimates.values()]
    means = dict(zip(model.sets, rules.mean_errors(model.errors, model.sequence), strict=True))
    if len(wrong) < len(study.training):
        return []  # the others rank them
    error, own = np.mean(wrong), means.get(rules.BASELINE, np.nan)
    if not error >= AS_WRONG * own:
        return []
    return [
        f"Doubt this: the estimated reference of training is wrong by {error:.2f} %, where the "
        f"odometry's own parameters have {own:.2f} %, so it can hardly rank sets; record a longer "
        f"drive, or name a reference."
    ]


def _front(study: Study, model: ErrorModel | None) -> list[dict[str, Any]]:
    """What CPU time buys in the training of this model; nothing where that is not known."""
    path = study.folder / "front.json"
    if model is None or not path.exists():
        return []
    try:
        rows: list[dict[str, Any]] = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        what = f"{path}: is damaged ({error}); run `adaptune offline` again"
        raise StoredReplayError(what) from error
    return rows


def _rows(judged: Sequence[JudgedModes], oracles: Sequence[ComparisonRow]) -> list[ComparisonRow]:
    """The rows of each sequence, and if there are several, those over all."""
    rows = [row for one in judged for row in one.rows]
    known = [one for one in judged if one.rows[0].rte is not None]
    if not known:
        return rows
    if len(judged) > 1:
        last = pooled(judged, oracles)
    else:
        last, rows = [*rows, *oracles], []
    # All are compared with the baseline, and what adapts with even weights, on the same frames.
    modes = {row.mode for row in last}
    for row in last:
        others = [BASELINE, *[EVEN] * adapts(row.mode)] if row.mode in judged[0].errors else []
        of = {other: ratio_to(known, row.mode, other) for other in others if other in modes}
        rows.append(replace(row, against=of))
    return rows
