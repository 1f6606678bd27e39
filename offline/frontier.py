"""Error against cost: of all sets, of banks, and of what is driven and its rivals."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import cap
from adaptune.model import BankSettings
from adaptune.model.rules import ERROR_FLOOR, Spending
from adaptune.space import ODOMETRY
from adaptune.study.config import MOST_MEMBERS
from adaptune.study.study import RIVALS
from offline.labelled import LabelledData, LabelledSequence, comparable
from offline.leave_one_out import PAIRED, Progress, Validation
from offline.pictures import CANCELLING, THRIFTY, Point
from offline.tuning import bank_data, bank_errors, bank_evidence, cancelling_members


def frontier(
    data: LabelledData,
    validation: Validation,
    settings: BankSettings | None,
    progress: Progress = lambda *_: None,
) -> list[Point]:
    """Cost and error of all sets, of banks of several sizes, and of the modes.

    A set's error is that of its trials. Banks and modes are chosen without what is left out. The
    fixed set's errors are those of the sets that are chosen so.

    Parameters
    ----------
    data
        With costs; without them there are no points.
    validation
        What was left out.
    settings
        Of the banks' weights; no banks if None.
    progress
        Called about every fold.
    """
    if data.costs is None:
        return []
    fixed = {one.name: _mean(one.errors["fixed"]) for one in validation.left_out}
    points = _sets(data, fixed)
    banks: dict[tuple[str, int], list[tuple[float, float, float]]] = {}
    folds = data.folds() if settings is not None else []
    for i, (left_out, others) in enumerate(folds):
        progress(i, len(folds))
        assert settings is not None
        for key, found in _banks(left_out, others, settings).items():
            banks.setdefault(key, []).append(found)
    progress(len(folds), len(folds))
    for (what, size), of in banks.items():
        costs, logs, weights = np.array(of).T
        ratio = float(np.exp(np.average(logs, weights=weights)))
        points.append(Point(what, str(size), float(costs.mean()), ratio))
    for mode in ("baseline", *RIVALS, "fixed", PAIRED):
        if mode in validation.ratios:
            ratio = float(np.exp(np.log(validation.ratios[mode]).mean()))
            points.append(Point(mode, mode, validation.cost(mode), ratio))
    # A set that was not run on every sequence, or whose cost is unknown, has no place among them.
    return [p for p in points if np.isfinite(p.cost) and np.isfinite(p.ratio)]


def _sets(data: LabelledData, fixed: Mapping[str, float]) -> list[Point]:
    assert data.costs is not None
    known = [s for s in data.sequences if s.name in fixed]
    logs = np.mean([_log_means(s) - np.log(fixed[s.name]) for s in known], axis=0)
    return [
        Point(
            str(data.sets[trial].get(ODOMETRY, "set")),
            str(trial),
            data.costs.alone(trial),
            float(np.exp(log)),
        )
        for trial, log in zip(data.sets, logs, strict=True)
    ]


def _log_means(sequence: LabelledSequence) -> NDArray[np.float64]:
    """Logarithm of every set's mean error on a sequence, of shape (n_sets,)."""
    return np.asarray(np.log(cap(sequence.errors).mean(axis=0) + ERROR_FLOOR))


def _mean(errors: NDArray[np.float64]) -> float:
    return float(errors.mean()) + ERROR_FLOOR


def _banks(
    left_out: LabelledSequence, others: LabelledData, settings: BankSettings
) -> dict[tuple[str, int], tuple[float, float, float]]:
    """By way and size, the cost of a bank, the logarithm of its ratio, and how many frames."""
    left_out, others = comparable(left_out, others)
    if left_out.simulation is None or others.costs is None:
        return {}
    data, pca = others.training_data()
    fixed = _mean(cap(left_out.errors[:, data.sets.column(data.fixed)]))
    spending = {CANCELLING: None, THRIFTY: Spending(others.costs, thrifty=True)}
    found = {}
    for what, how in spending.items():
        # Members are added one after the other: the first of them are those of a smaller bank.
        members = cancelling_members(others, data.fixed, MOST_MEMBERS, how)
        for size in range(2, len(members) + 1):
            few = members[:size]
            near = bank_evidence(left_out, bank_data(others, data, few), pca, settings)
            errors = bank_errors(left_out, near, settings)
            log = np.log(_mean(errors) / fixed)
            found[what, size] = others.costs.adaptive(few), float(log), float(len(errors))
    return found
