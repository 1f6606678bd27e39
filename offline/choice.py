"""Choice of the fixed set: not shown to be worse than the baseline, then good, then cheap.

All sets are compared with the baseline, which is trial 0, in pairs: by their mean errors over
blocks of `PER_BLOCK` sub-trajectories.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.metrics import resampled_means
from adaptune.model.rules import BASELINE, ROUNDING

PER_BLOCK = 2.0
"""Sub-trajectories in a block: errors of neighbouring frames share most of theirs."""
SURE = 0.95
"""Confidence, on one side, with which a set is worse than the baseline."""
STANDARD_ERRORS = 1.0
"""Of the logarithm of the ratio to the baseline's error, by which a set has to be better."""
ONE_RECORDING = 2.0
"""The same where there is one recording: it says little of others."""
FLOOR = 0.05
"""Share of the baseline's mean error that is added to both errors of a ratio."""
COST_CLASS = 1.1
"""Costs that differ by no larger factor, about, are the same: the machine's load makes as much."""
MOST_OF_PERIOD = 0.5
"""Share of the time from scan to scan that a scan may take: some take more than the mean."""
LEAST_COST = 1.0
"""Milliseconds of CPU time a scan; less is nothing, and mostly noise."""
AS_GOOD = 1.03
"""Sets whose bounds differ by no larger factor are as good as each other."""
FINALISTS = 4
"""Sets at no more than the baseline's cost that drive whole recordings."""
DEARER = 2
"""Sets at more than that, each better than all cheaper ones, that do so, too."""


class NothingUsableError(AdaptuneError):
    """No parameter set gives poses."""

    exit_code = 1


class BlockErrors(NamedTuple):
    """What is known of some sets: errors in blocks, costs, and restarts by the health check."""

    trials: Sequence[int]  # their numbers; the baseline is among them
    # (n_blocks, n_trials): mean capped error in percent, or another objective over a recording
    errors: NDArray[np.float64]
    sequence: NDArray[np.intp]  # (n_blocks,): number of each block's recording
    costs: NDArray[np.float64]  # (n_trials,): ms of CPU time a scan; NaN if unknown
    restarts: NDArray[np.float64]  # (n_trials,): infinite for a set that failed
    period: float = np.inf  # milliseconds from scan to scan
    # (n_blocks, n_trials): mean rotation errors, where they are known: a short sub-trajectory hides
    # a heading that drifts.
    turns: NDArray[np.float64] | None = None

    @property
    def baseline(self) -> int:
        """Column of the baseline."""
        return list(self.trials).index(BASELINE)

    def some(self, trials: Sequence[int]) -> Self:
        """The same of some trials."""
        columns = [list(self.trials).index(trial) for trial in trials]
        return self._replace(
            trials=list(trials),
            errors=self.errors[:, columns],
            costs=self.costs[columns],
            restarts=self.restarts[columns],
            turns=None if self.turns is None else self.turns[:, columns],
        )

    def without(self, block: int) -> Self:
        """The same without a block."""
        kept = np.arange(len(self.errors)) != block
        turns = None if self.turns is None else self.turns[kept]
        return self._replace(errors=self.errors[kept], sequence=self.sequence[kept], turns=turns)


def mean_and_error(
    values: NDArray[np.float64], sequence: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean over recordings, each with the same weight, and its standard error, from blocks.

    Values are of shape (n_blocks, n), the recordings' numbers of shape (n_blocks,).

    Returns shapes (n,) and (n,). One block shows no error: it is infinite.
    """
    _, number, count = np.unique(sequence, return_inverse=True, return_counts=True)
    weights = 1.0 / (len(count) * count[number])
    mean, n = weights @ values, len(values)
    if n < 2:
        return mean, np.full(values.shape[1], np.inf)
    with np.errstate(invalid="ignore"):  # a set that failed may have an infinite objective
        squares = weights[:, None] ** 2 * (values - mean) ** 2
    return mean, np.sqrt(squares.sum(axis=0) * n / (n - 1))


def surely_worse(blocks: BlockErrors) -> NDArray[np.bool_]:
    """Which sets are surely worse than the baseline, on all recordings or on one of them.

    Returns shape (n_trials,).
    """
    from scipy import stats  # slow to import

    with np.errstate(invalid="ignore"):
        more = blocks.errors - blocks.errors[:, [blocks.baseline]]
    worse = np.zeros(len(blocks.trials), bool)
    every = np.ones(len(more), bool)
    for rows in [every, *(blocks.sequence == s for s in np.unique(blocks.sequence))]:
        if (n := int(rows.sum())) > 1:
            mean, error = mean_and_error(more[rows], blocks.sequence[rows])
            worse |= mean - stats.t.ppf(SURE, n - 1) * error > 1e-9
    return worse


def bounds(blocks: BlockErrors, sure: bool = True) -> NDArray[np.float64]:
    """Upper bound of the error of each set in percent, of shape (n_trials,).

    It is the baseline's mean error times the geometric mean of the ratios to it in blocks, and if
    it is to be `sure`, a standard error above. It is infinite for sets that are not admissible:
    they failed, were restarted more often than the baseline (whoever takes its parameters elsewhere
    has no health check), or are surely worse, also in rotation.
    """
    n_errors = 0.0
    if sure:
        n_errors = ONE_RECORDING if len(np.unique(blocks.sequence)) == 1 else STANDARD_ERRORS
    base = blocks.errors[:, [blocks.baseline]]
    (mean,), _ = mean_and_error(base, blocks.sequence)
    with np.errstate(invalid="ignore"):
        floor = max(FLOOR * mean, 1e-9)
        logs = np.log(blocks.errors + floor) - np.log(base + floor)
        log, error = mean_and_error(logs, blocks.sequence)
        bound = mean * np.exp(log + n_errors * np.where(np.isfinite(error), error, 0.0))
    usable = np.isfinite(blocks.restarts) & np.isfinite(bound)
    usable &= blocks.restarts <= blocks.restarts[blocks.baseline]
    usable &= ~surely_worse(blocks)
    if blocks.turns is not None:
        usable &= ~surely_worse(blocks._replace(errors=blocks.turns))
    return np.where(usable, bound, np.inf)


def cost_classes(blocks: BlockErrors) -> NDArray[np.float64]:
    """Classes of costs, of shape (n_trials,): 0 for the baseline's; unknown costs count so."""
    classes = np.log(np.maximum(blocks.costs, LEAST_COST)) / np.log(COST_CLASS)
    return np.asarray(np.nan_to_num(np.round(classes - classes[blocks.baseline]), nan=0.0))


def choose(blocks: BlockErrors, budget: float | None = None, sure: bool = True) -> int:
    """Trial number of the fixed set.

    Of the admissible sets that cost no more than the baseline, or than a `budget` in milliseconds
    of CPU time a scan, it is the cheapest whose bound is nearly the least, see `bounds`. There is
    an AdaptuneError if no set keeps to the budget, a NothingUsableError if none can be chosen.
    """
    bound = _within(blocks, budget, sure)
    if not np.isfinite(bound).any():
        raise NothingUsableError(
            f"odometry: none of {len(blocks.trials)} parameter sets gives poses for nearly all "
            f"scans of every training sequence, so none can be chosen (`adaptune trials` lists "
            f"their faults): mend the odometry, or narrow the ranges of the parameters "
            f"(odometry.parameters)"
        )
    good, classes = np.flatnonzero(bound <= AS_GOOD * bound.min()), cost_classes(blocks)
    return blocks.trials[int(min(good, key=lambda k: (classes[k], bound[k])))]


def _within(blocks: BlockErrors, budget: float | None, sure: bool = True) -> NDArray[np.float64]:
    """The bounds of sets within a budget, of shape (n_trials,), infinite for others.

    Where the budget allows none that is admissible, those that are usable count by their error.
    """
    few = affordable(blocks, budget)
    bound = np.where(few, bounds(blocks, sure), np.inf)
    if np.isfinite(bound).any():
        return bound
    mean, _ = mean_and_error(blocks.errors, blocks.sequence)
    return np.where(few & np.isfinite(blocks.restarts), mean, np.inf)


def affordable(blocks: BlockErrors, budget: float | None) -> NDArray[np.bool_]:
    """Which sets cost no more than a budget, or than the baseline, of shape (n_trials,).

    What takes more than `MOST_OF_PERIOD`, and more than the baseline, may come too late. There is
    an AdaptuneError if no set keeps to the budget.
    """
    if budget is None:
        return cost_classes(blocks) <= 0.0
    in_time = max(MOST_OF_PERIOD * blocks.period, float(blocks.costs[blocks.baseline]))
    budget = min(budget, in_time)
    few = ~(blocks.costs > max(budget + ROUNDING, LEAST_COST))
    if not few.any():
        cheapest = int(np.argmin(blocks.costs))
        raise AdaptuneError(
            f"online.budget: {budget:g} ms of CPU time a scan is less than the cheapest of "
            f"{len(blocks.trials)} parameter sets takes, {blocks.costs[cheapest]:.1f} ms (trial "
            f"{blocks.trials[cheapest]}); allow more, or add cheaper sets (a coarser downsampling, "
            f"fewer iterations, another odometry)"
        )
    return np.asarray(few)


def front(blocks: BlockErrors) -> list[int]:
    """Trials by rising cost, each with clearly less error than all that cost less."""
    bound, classes = bounds(blocks, sure=False), cost_classes(blocks)
    trials, least = [], np.inf
    for k in np.lexsort((bound, classes)):
        if np.isfinite(bound[k]) and bound[k] * AS_GOOD < least:
            trials.append(blocks.trials[k])
            least = bound[k]
    return trials


def finalists(blocks: BlockErrors, budget: float | None = None) -> list[int]:
    """Trials whose sets drive whole recordings, the baseline's and the front's among them."""
    bound = _within(blocks, budget)
    order = [k for k in np.argsort(bound, kind="stable") if np.isfinite(bound[k])]
    best = [blocks.trials[k] for k in order[:FINALISTS]]
    allowed = dict(zip(blocks.trials, affordable(blocks, budget), strict=True))
    ranked = front(blocks)
    cheaper = [trial for trial in ranked if allowed[trial]]
    dearer = [trial for trial in ranked if not allowed[trial]]
    return list(dict.fromkeys([BASELINE, *best, *cheaper[-2:], *dearer[:DEARER]]))


def ratio_to_baseline(blocks: BlockErrors, trial: int) -> tuple[float, float, float]:
    """Ratio of a set's mean error to the baseline's, and the ends of its 95 % interval."""
    from scipy import stats  # slow to import

    column = list(blocks.trials).index(trial)
    more = blocks.errors[:, [column]] - blocks.errors[:, [blocks.baseline]]
    (mean,), (error,) = mean_and_error(more, blocks.sequence)
    base = mean_and_error(blocks.errors, blocks.sequence)[0][blocks.baseline]
    if len(more) < 2 or not base:
        return float(1.0 + mean / max(base, 1e-12)), np.nan, np.nan
    margin = float(stats.t.ppf(0.975, len(more) - 1) * error)
    low, value, high = (1.0 + (mean + by) / base for by in (-margin, 0.0, margin))
    return float(value), max(float(low), 0.0), float(high)


def left_out_ratio(
    blocks: BlockErrors, rule: Callable[[BlockErrors], int]
) -> tuple[float, float, float] | None:
    """Error of sets that a rule chooses without the block that they are tested on.

    Returns its ratio to the baseline's, and the ends of its 95 % interval; None of few blocks.
    """
    n = len(blocks.errors)
    if n < LEAST_BLOCKS:
        return None
    columns = [blocks.trials.index(rule(blocks.without(block))) for block in range(n)]
    chosen, base = blocks.errors[range(n), columns], blocks.errors[:, blocks.baseline]
    means = resampled_means(np.stack([chosen, base]), 1, np.random.default_rng(0))
    low, high = np.percentile(means[0] / np.maximum(means[1], 1e-12), [2.5, 97.5])
    return float(chosen.mean() / max(base.mean(), 1e-12)), float(low), float(high)


LEAST_BLOCKS = 6
"""With fewer, nothing is said of what is left out."""
