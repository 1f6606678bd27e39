"""Validate a study: find whether adapting would pay in places that it was not trained on."""

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from adaptune.archive import Archive
from adaptune.model import ErrorModel, ModelError
from adaptune.report import tables
from adaptune.report.paper import draw_chart
from adaptune.study.inputs import check_model
from adaptune.study.references import estimates_beside_intervals
from adaptune.study.study import Driven, driven
from offline.campaign import rivalry
from offline.charts import stretch_chart
from offline.config import OfflineStudy
from offline.labelled import LabelledData, labelled_data
from offline.leave_one_out import PAIRED, Interval, Validation, ValidationError, leave_one_out

_log = logging.getLogger(__name__)


class Validated(NamedTuple):
    """Result of `validate`."""

    validation: Validation
    # Ratio to the fixed set's error of every mode on every sequence left out.
    rows: list[dict[str, Any]]
    # Sentences: what `adaptune online` will drive, its estimate, and what reference judged it.
    verdicts: list[str]


def validate(
    study: OfflineStudy,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Validated:
    """Validate the selection rules on a study's training sequences.

    Parameters
    ----------
    study
        A study that the offline stage has finished. Its folder receives ``validation`` (CSV, JSON
        and a picture) and ``stretches`` (CSV, JSON), and its model the summary.
    progress
        Called about every fold.

    Raises
    ------
    ModelError
        If there is no model yet, or it is not this study's.
    ValidationError
        If there is only one stretch.
    """
    model = _checked_model(study)
    data = _labelled(study, model)
    online = driven(study, model)
    considered = study.mechanism == "bank" and PAIRED in study.rules
    bank = _bank(study, model) if considered else 0
    try:
        validation = leave_one_out(data, None, partial(progress, "parts left out"), bank)
    except ValidationError as error:
        raise ValidationError(f"{error}. {online.words}") from error
    rows = _rows(validation, _rate(data))
    tables.write_rows(study.folder, "validation", rows)
    stretches = _stretch_rows(validation)
    tables.write_rows(study.folder, "stretches", stretches)
    if (chart := stretch_chart(stretches)) is not None:
        draw_chart(study.folder / "validation.png", chart)
    summaries = {mode: validation.summary(mode) for mode in validation.modes}
    replace(model, validation=summaries).save(study.model_path)
    said = [*_verdicts(study, online, validation), *_rivalry(study, data)]
    said += estimates_beside_intervals(study, study.training)
    return Validated(validation, rows, said)


def _bank(study: OfflineStudy, model: ErrorModel) -> int | list[int]:
    """How many members a bank has where a sequence is left out, or which."""
    switching = study.config.online.switching
    return switching.size if switching.sets is None else model.bank


def _rivalry(study: OfflineStudy, data: LabelledData) -> list[str]:
    bounds = data.bounds()
    best = min(bounds, key=lambda n: bounds[n])
    said = rivalry(study.config.offline, data.whole(), best, data.fixed())
    return [] if said is None else [said]


def _verdicts(study: OfflineStudy, online: Driven, validation: Validation) -> list[str]:
    """What `adaptune online` will drive, then the estimate for it, then for what else it drives."""
    said = [online.words]
    if "adaptive" in study.rules:
        said += [validation.verdict(PAIRED), *validation.against_rivals()]
    said.append(baseline_in_words(validation))
    if "paper" not in study.rules:
        return said
    if study.mechanism == "bank":
        why = "`online` lets it choose among the bank's members, here it chooses among all sets"
        return [*said, f"`paper` has no verdict: {why}."]
    return [*said, validation.verdict("paper")]


def baseline_in_words(validation: Validation) -> str:
    """How the baseline compares; the study's own fixed set is another than those compared with."""
    s = validation.summary("baseline")
    better = ": there the baseline is better" if s["high"] < 1.0 else ""
    return (
        f"The baseline has {s['geometric']:.2f} times the error of the sets that are chosen "
        f"without what is left out, over {len(validation.recordings)} stretches (95 % interval "
        f"{s['low']:.2f}-{s['high']:.2f}){better}."
    )


def _labelled(study: OfflineStudy, model: ErrorModel) -> LabelledData:
    """The labelled data set of the sets that were run on all training sequences."""
    complete = np.flatnonzero(~np.isnan(model.errors).any(axis=0))
    sets = model.sets.subset([model.sets.trials[column] for column in complete])
    run = {name: list(sets) for name in model.sequences}
    archive = Archive(study.folder / "trials")
    data = labelled_data(
        archive,
        run,
        sets,
        study.config,
        study.window,
        study.sequences.recorded_in,
        study.odometry,
    )
    if not set(data.whole()) - {0} and model.fixed != 0:
        _log.warning(
            "the candidates for the fixed set have no whole runs with this health check: with a "
            "sequence left out, it is chosen by trials alone; run `adaptune offline` again"
        )
    return data


def _checked_model(study: OfflineStudy) -> ErrorModel:
    path = study.model_path
    model = ErrorModel.load(path)
    length = study.config.sub_trajectory
    check_model(study, model.sequences, model.provenance)
    model.check_study(study.odometry.identity, study.odometry.space, length, path)
    if (study.training, study.window) != (model.sequences, model.window):
        raise ModelError(
            f"{path}: was fitted to other training sequences or descriptors than the study's; run "
            f"`adaptune offline` again"
        )
    return model


def _rate(data: LabelledData) -> float:
    """Scans a second."""
    stamps = [s.simulation.stamps for s in data.sequences if s.simulation is not None]
    seconds = sum(float(of[-1] - of[0]) * 1e-9 for of in stamps)
    return sum(map(len, stamps)) / seconds if seconds else np.nan


def _rows(validation: Validation, rate: float) -> list[dict[str, Any]]:
    """Ratios to the fixed set's error, intervals of the default rule's, and costs.

    Parameters
    ----------
    validation
        What was left out.
    rate
        Scans a second, by which costs become cores.
    """
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
    costs = {mode: validation.cost(mode) for mode in ["fixed", *modes]}
    if np.isfinite(list(costs.values())).any():
        add("ms a scan", costs["fixed"], costs, None)
        cores = {mode: 1e-3 * rate * cost for mode, cost in costs.items()}
        add("cores", cores["fixed"], cores, None)
    summaries = {mode: validation.summary(mode) for mode in modes}
    for key in ("geometric", "arithmetic", "worst_tenth", "worst"):
        ends = summaries[default]["low"], summaries[default]["high"]
        of = {mode: summaries[mode][key] for mode in modes}
        add(key.replace("_", " "), None, of, ends if key == "geometric" else None)
    return rows


def _stretch_rows(validation: Validation) -> list[dict[str, Any]]:
    """Mean error of the fixed set, and ratios to it, on each stretch."""
    logs = {mode: of for mode, of in validation.logs.items() if mode != "fixed"}
    rows: list[dict[str, Any]] = []
    for one in validation.left_out:
        for number in np.unique(one.stretches):
            fixed = one.errors["fixed"][one.stretches == number]
            rows.append(
                {"recording": one.name, "stretch": int(number), "fixed [%]": float(fixed.mean())}
                | {mode: float(np.exp(of[len(rows)])) for mode, of in logs.items()}
            )
    return rows
