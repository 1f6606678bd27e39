"""What the best choice in hindsight would have had, from trials on the test sequences."""

import numpy as np

from adaptune.metrics import cap
from adaptune.study.oracle_runs import OracleErrors
from online.comparison_row import ORACLES, ComparisonRow
from online.statistics import JudgedModes


def oracle_rows(
    judged: JudgedModes, oracle: OracleErrors, fixed: int, period: float
) -> list[ComparisonRow]:
    """Rows of the best set of the sequence, and of the best set of every period.

    Half of what one set errs on a short stretch is chance, so the latter is out of reach.

    Parameters
    ----------
    judged
        The modes on the sequence.
    oracle
        Errors of some sets there.
    fixed
        Trial number of the fixed set; without its trial, nothing is known.
    period
        Seconds between selections.
    """
    yardstick = judged.rows[0].yardstick
    rte = next(row.rte for row in judged.rows if row.mode == yardstick)
    errors = cap(oracle.errors)
    known = ~np.isnan(errors).any(axis=1)
    if rte is None or fixed not in oracle.trials or not known.any():
        return []
    errors, stamps = errors[known], oracle.stamps[known]
    _, number = np.unique((stamps - oracle.stamps[0]) // int(period * 1e9), return_inverse=True)
    sums = np.stack([np.bincount(number, of) for of in errors.T], axis=1)
    best = errors.mean(axis=0).min(), sums.min(axis=1).sum() / len(errors)
    # Trials restart at the reference, and replays do not: only the ratio carries over.
    of_fixed = max(float(errors[:, oracle.trials.index(fixed)].mean()), 1e-12)
    return [
        ComparisonRow(
            judged.name, mode, rte * of / of_fixed, of / of_fixed, 0, 0, 0, yardstick=yardstick
        )
        for mode, of in zip(ORACLES, map(float, best), strict=True)
    ]
