"""Choice of the fixed set: the least bound of its error within a budget of CPU time.

All sets are compared with the baseline in pairs: by their mean errors over blocks of `PER_BLOCK`
sub-trajectories. `docs/research/price.md` has what other rules give.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.metrics import LOST_ABOVE
from adaptune.model.rules import BASELINE, ROUNDING

PER_BLOCK = 2.0
"""Sub-trajectories in a block: errors of neighbouring frames share most of theirs."""
SURE = 0.95
"""Confidence, on one side, with which a set is worse than the baseline."""
ONE_RECORDING = 2.0
"""Standard errors from the mean logarithm to the bound where there is one recording, whose blocks
say little of other drives; of several recordings, one."""
ONE_BLOCK = 0.3
"""Standard error of that logarithm where there is one block."""
FLOOR = 0.05
"""Share of the baseline's mean error that is added to both errors of a ratio."""
USUAL_BUDGET = 2.0
"""Times the baseline's cost that a set may cost where the user names no budget."""
EDGE = 1.1
"""A bound of the cost that no user named is soft: what exceeds it by no larger factor is within,
because the machine's load makes as much."""
MOST_OF_PERIOD = 0.5
"""Share of the time from scan to scan that a scan may take: some take more than the mean."""
LEAST_COST = 1.0
"""Milliseconds of CPU time a scan; less is nothing, and mostly noise."""
FINALISTS = 4
"""Sets within the budget that drive whole recordings."""
OTHERS = 2
"""Sets at no more than the baseline's cost, and at any, that do so, too."""
LOST = 0.5
"""Share of the clipped error, as the mean of a block, above which track counts as lost there."""


class NothingUsableError(AdaptuneError):
    """No parameter set gives poses."""

    exit_code = 1


class BlockErrors(NamedTuple):
    """What is known of some sets: errors in blocks, costs, and restarts by the health check."""

    trials: Sequence[int]  # their numbers; a baseline is among them
    # (n_blocks, n_trials): mean clipped error in percent, or another objective over a recording
    errors: NDArray[np.float64]
    sequence: NDArray[np.intp]  # (n_blocks,): number of each block's recording
    costs: NDArray[np.float64]  # (n_trials,): ms of CPU time a scan; NaN if unknown
    restarts: NDArray[np.float64]  # (n_trials,): infinite for a set that failed
    period: float = np.inf  # milliseconds from scan to scan
    # (n_blocks, n_trials): mean rotation errors, where they are known: a short sub-trajectory hides
    # a heading that drifts.
    turns: NDArray[np.float64] | None = None
    defaults: Sequence[int] = (BASELINE,)  # trials of the odometries' own parameters
    lost_above: float = LOST_ABOVE  # mean error of a set that does not keep track

    @property
    def baseline(self) -> int:
        """Column of the baseline; of several odometries', that with the least error in time."""
        own = [k for k, trial in enumerate(self.trials) if trial in self.defaults]
        if len(own) < 2:
            return own[0]
        means, _ = mean_and_error(self.errors[:, own], self.sequence)
        late = self.costs[own] > MOST_OF_PERIOD * self.period
        rank = np.lexsort((means, late, ~np.isfinite(self.restarts[own])))
        return own[int(rank[0])]

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

    def tracked(self) -> Self:
        """The same of recordings on which some set keeps track."""
        of = self.sequence
        least = {s: self.errors[of == s].mean(axis=0).min() for s in np.unique(of)}
        kept = np.array([least[s] <= self.lost_above for s in of], bool)
        turns = None if self.turns is None else self.turns[kept]
        return self._replace(errors=self.errors[kept], sequence=of[kept], turns=turns)

    def logs(self) -> NDArray[np.float64]:
        """Logarithms of the ratio to the baseline's error in blocks, of shape `errors`."""
        base = self.errors[:, [self.baseline]]
        floor = max(FLOOR * float(mean_and_error(base, self.sequence)[0][0]), 1e-9)
        with np.errstate(invalid="ignore"):  # a set that failed may have an infinite objective
            return np.asarray(np.log(self.errors + floor) - np.log(base + floor))


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
    with np.errstate(invalid="ignore"):
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


def surely_restarted(blocks: BlockErrors) -> NDArray[np.bool_]:
    """Which sets the health check surely restarts more often than the baseline; or that failed.

    Of so many restarts of both, each is either's with the same chance. Returns shape (n_trials,).
    """
    from scipy import stats  # slow to import

    usable = np.isfinite(blocks.restarts)
    n, base = np.where(usable, blocks.restarts, 0.0), blocks.restarts[blocks.baseline]
    if not np.isfinite(base):
        return ~usable
    chance = stats.binom.sf(np.round(n) - 1, np.round(n + base), 0.5)
    return np.asarray(~usable | ((n > base) & (chance < 1.0 - SURE)))


def bounds(blocks: BlockErrors) -> NDArray[np.float64]:
    """Upper bound of the ratio of each set's error to the baseline's, of shape (n_trials,).

    It is the geometric mean over blocks, and a standard error above. Recordings count the same, and
    may differ: of several, the standard error is theirs, unless that of blocks is larger; of one,
    see `ONE_RECORDING`. It is infinite for sets that are not admissible: they failed, were surely
    restarted more often than the baseline (whoever takes their parameters elsewhere has no health
    check), or are surely worse, also in rotation.
    """
    mean, error = mean_and_error(logs := blocks.logs(), blocks.sequence)
    error[~np.isfinite(error)] = ONE_BLOCK
    numbers = np.unique(blocks.sequence)
    if len(numbers) == 1:
        error *= ONE_RECORDING
    else:
        means = np.array([logs[blocks.sequence == s].mean(axis=0) for s in numbers])
        with np.errstate(invalid="ignore"):
            error = np.fmax(error, means.std(axis=0, ddof=1) / np.sqrt(len(numbers)))
    error[blocks.baseline] = 0.0
    with np.errstate(invalid="ignore", over="ignore"):
        bound = np.exp(mean + error)
    usable = np.isfinite(bound) & ~surely_restarted(blocks) & ~surely_worse(blocks)
    if blocks.turns is not None:
        usable &= ~surely_worse(blocks._replace(errors=blocks.turns))
    return np.where(usable, bound, np.inf)


def why_not(blocks: BlockErrors, trial: int, fixed: int) -> str:
    """Why `choose` prefers the fixed set to another one, in words."""
    k, own = list(blocks.trials).index(trial), blocks.baseline
    if surely_restarted(blocks)[k]:
        n, base = (f"{blocks.restarts[column]:g}" for column in (k, own))
        return f"the health check restarts it more often ({n} against {base} of the baseline)"
    for what, errors in (("", blocks.errors), (" in rotation", blocks.turns)):
        if errors is not None and surely_worse(blocks._replace(errors=errors))[k]:
            return f"it is surely worse than the odometry's own parameters{what} on a recording"
    bound = bounds(blocks)
    mine, other = (f"{bound[list(blocks.trials).index(one)]:.3f}" for one in (trial, fixed))
    return f"its error is less sure (by its bound {mine} times the baseline's, against {other})"


def choose(blocks: BlockErrors, budget: float | None = None) -> int:
    """Trial number of the fixed set: that with the least bound within a budget, see `affordable`.

    There is an AdaptuneError if no set keeps to the budget, a NothingUsableError if none can be
    chosen.
    """
    bound = _within(blocks, budget)
    if not np.isfinite(bound).any():
        raise NothingUsableError(
            f"odometry: none of {len(blocks.trials)} parameter sets gives poses for nearly all "
            f"scans of every training sequence, so none can be chosen (`adaptune trials` lists "
            f"their faults): mend the odometry, or narrow the ranges of the parameters "
            f"(odometry.parameters)"
        )
    return blocks.trials[int(np.argmin(bound))]


def _within(blocks: BlockErrors, budget: float | None) -> NDArray[np.float64]:
    """The bounds of sets within a budget, of shape (n_trials,), infinite for others.

    Where it allows none that is admissible, those that are usable count by their error. Where no
    set keeps track, errors say little of sets: such recordings do not count, and if there are no
    others, the baseline is kept.
    """
    few, tracked = affordable(blocks, budget), blocks.tracked()
    usable, own = few & np.isfinite(blocks.restarts), blocks.baseline
    if not len(tracked.errors) and usable[own]:
        return np.where(np.arange(len(few)) == own, 1.0, np.inf)
    bound = np.full(len(few), np.inf)
    if len(tracked.errors):
        bound = np.where(few, bounds(tracked), np.inf)
    if np.isfinite(bound).any():
        return bound
    mean, _ = mean_and_error(blocks.errors, blocks.sequence)
    return np.where(usable, mean, np.inf)


def affordable(blocks: BlockErrors, budget: float | None) -> NDArray[np.bool_]:
    """Which sets cost no more than a budget in milliseconds of CPU time a scan.

    Without one, `USUAL_BUDGET` times the baseline's cost. What takes more than `MOST_OF_PERIOD`,
    and more than the baseline, may come too late. Unknown costs are within. There is an
    AdaptuneError if no set keeps to the budget.

    Returns shape (n_trials,).
    """
    base = max(float(blocks.costs[blocks.baseline]), LEAST_COST)
    most = min(allowed_cost(budget, base), max(MOST_OF_PERIOD * blocks.period, base))
    few = ~(blocks.costs > most + ROUNDING)
    if not few.any():
        cheapest = int(np.argmin(blocks.costs))
        raise AdaptuneError(
            f"online.budget (--budget): {budget:.3g} ms of CPU time a scan is less than the "
            f"cheapest of {len(blocks.trials)} parameter sets takes, "
            f"{blocks.costs[cheapest]:.1f} ms (trial {blocks.trials[cheapest]}); allow more, or "
            f"add cheaper sets (a coarser downsampling, fewer iterations, another odometry)"
        )
    return np.asarray(few)


def allowed_cost(budget: float | None, base: float) -> float:
    """Milliseconds of CPU time a scan that a set may cost, where the baseline's is `base`."""
    return EDGE * USUAL_BUDGET * base if budget is None else max(budget, LEAST_COST)


class Front(NamedTuple):
    """What CPU time buys: trial numbers."""

    own: int  # the baseline
    fixed: int  # the best within the budget
    equal_cost: int  # the best at no more than the baseline's cost
    any_cost: int  # the best at any cost that keeps up
    below: int  # the best where the soft edge of the budget lies as much below it


def front(blocks: BlockErrors, budget: float | None) -> Front:
    """The sets to choose among, each with the least bound within another budget."""
    base = float(blocks.costs[blocks.baseline])
    fixed, best = choose(blocks, budget), choose(blocks, np.inf)
    known = np.isfinite(base)
    equal = choose(blocks, EDGE * base) if known else fixed
    below = choose(blocks, USUAL_BUDGET * base / EDGE) if known and budget is None else fixed
    return Front(blocks.trials[blocks.baseline], fixed, equal, best, below)


def finalists(blocks: BlockErrors, budget: float | None = None) -> list[int]:
    """Trials whose sets drive whole recordings, the baseline among them."""
    base = float(blocks.costs[blocks.baseline])
    found = [blocks.trials[blocks.baseline]]
    for most, n in ((budget, FINALISTS), (EDGE * base, OTHERS), (np.inf, OTHERS)):
        if np.isnan(most or 0.0):
            continue
        bound = _within(blocks, most)
        order = [k for k in np.argsort(bound, kind="stable") if np.isfinite(bound[k])]
        found += [blocks.trials[k] for k in order[:n]]
    return list(dict.fromkeys(found))


SPREAD = 0.45
"""Standard deviation of the logarithm of a ratio from drive to drive with one robot, about."""
KNOWN_DRIVES = 8.0
"""Drives that this counts as where a study's own are few."""


class Elsewhere(NamedTuple):
    """Ratio of a set's error to the baseline's on another drive with this robot."""

    ratio: float
    low: float  # ends of the 95 % interval
    high: float


def elsewhere(blocks: BlockErrors, trial: int, bank: tuple[float, float] = (1.0, 0.0)) -> Elsewhere:
    """What to expect of a set on another drive with this robot, or of a bank.

    How much drives differ is learned from the recordings, as far as there are several. A bank is
    its ratio to the set's error, and the standard error of the ratio's logarithm.
    """
    from scipy import stats  # slow to import

    logs = blocks.logs()[:, [list(blocks.trials).index(trial)]] + np.log(bank[0])
    if trial == blocks.trials[blocks.baseline] and bank == (1.0, 0.0):
        return Elsewhere(1.0, 1.0, 1.0)
    (mean,), (error,) = mean_and_error(logs, blocks.sequence)
    error, of_bank = (e if np.isfinite(e) else ONE_BLOCK for e in (error, bank[1]))
    of = np.array([logs[blocks.sequence == s].mean() for s in np.unique(blocks.sequence)])
    freedom = KNOWN_DRIVES + len(of) - 1
    variance = (KNOWN_DRIVES * SPREAD**2 + ((of - mean) ** 2).sum()) / freedom
    margin = stats.t.ppf(0.975, freedom) * np.sqrt(variance + error**2 + of_bank**2)
    return Elsewhere(*(float(np.exp(mean + by)) for by in (0.0, -margin, margin)))
