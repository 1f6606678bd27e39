"""The comparison over all sequences."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import MIN_BLOCKS, RESAMPLES, resampled_means, worst_tenth
from adaptune.study.driven import MIN_RECORDINGS, PER_STRETCH
from online.comparison_row import (
    ALL,
    NO_DIFFERENCE,
    ORACLES,
    ComparisonRow,
    Ratio,
    StandardErrors,
)
from online.statistics import ERROR_FACTOR, JudgedModes, allowing_for, mean_of

SEED = 0
"""Of the resampling."""
LEAST_STRETCHES = 10
"""With fewer, there is no worst tenth."""


def pooled(
    judged: Sequence[JudgedModes], oracles: Sequence[ComparisonRow] = ()
) -> list[ComparisonRow]:
    """For every mode the mean errors over all sequences, and the geometric mean of the ratios.

    Parameters
    ----------
    judged
        The sequences; those without a reference do not count.
    oracles
        Rows of the best set in hindsight, where it is known.
    """
    known = [one for one in judged if one.rows[0].rte is not None]
    modes = [row.mode for row in known[0].rows]
    made = [_pooled(mode, known) for mode in modes]
    in_hindsight = [
        _mean_row(mode, rows)
        for mode in ORACLES
        if len(rows := [row for row in oracles if row.mode == mode]) == len(known)
    ]
    return [*with_gaps(made, in_hindsight), *in_hindsight]


def _pooled(mode: str, judged: Sequence[JudgedModes]) -> ComparisonRow:
    rows = [row for one in judged for row in one.rows if row.mode == mode]
    recordings = len({one.recording or one.name for one in judged})
    row = replace(_mean_row(mode, rows), recordings=recordings)
    if mode == row.yardstick:
        return row
    ends = [row.ratio_interval for row in rows if row.ratio_interval is not None]
    logs = _of_stretches(judged, mode)
    enough = len(logs) >= LEAST_STRETCHES
    return replace(
        row,
        ratio_interval=ratio_to(judged, mode).interval,
        worst_tenth=float(np.exp(worst_tenth(logs))) if enough else None,
        stretches=len(logs),
        better=sum(row.ratio < 1.0 - NO_DIFFERENCE for row in rows if row.ratio is not None),
        worse=sum(row.ratio > 1.0 + NO_DIFFERENCE for row in rows if row.ratio is not None),
        surely_better=sum(high < 1.0 for _, high in ends) if ends else None,
        surely_worse=sum(low > 1.0 for low, _ in ends) if ends else None,
    )


def _mean_row(mode: str, rows: Sequence[ComparisonRow]) -> ComparisonRow:
    """Means of what was measured, and sums of what was counted."""
    ratios = [row.ratio for row in rows if row.ratio is not None]
    return ComparisonRow(
        ALL,
        mode,
        mean_of([row.rte for row in rows]),
        float(np.exp(np.mean(np.log(np.maximum(ratios, 1e-12))))),
        sum(row.restarts for row in rows),
        sum(row.switches for row in rows),
        sum(row.poor_scans for row in rows),
        standard=StandardErrors.pooled([row.standard for row in rows if row.standard]),
        yardstick=rows[0].yardstick,
        estimated=mean_of([row.estimated for row in rows]),
        lost_seconds=sum(row.lost_seconds for row in rows),
        reference=" and ".join(sorted({row.reference for row in rows})),
        cpu_ms=mean_of([row.cpu_ms for row in rows]),
        cores=mean_of([row.cores for row in rows]),
        memory_mb=max((m for row in rows if (m := row.memory_mb) is not None), default=None),
        repeats=rows[0].repeats,
    )


def ratio_to(judged: Sequence[JudgedModes], mode: str, other: str | None = None) -> Ratio:
    """Geometric mean of the ratios of two modes' errors, and its interval.

    The 95 % interval comes from a paired block bootstrap. With `MIN_RECORDINGS` recordings or more,
    recordings are drawn, too, and it speaks of others like these. With fewer it speaks of these,
    and there is none unless each holds `MIN_BLOCKS` blocks. (The parts of one recording are one.)
    Means of few recordings vary too little in a bootstrap, hence the factor. What an estimated
    reference errs is allowed for as on a sequence.

    Parameters
    ----------
    judged
        Sequences with a reference.
    mode, other
        Of which the errors are compared; with the yardstick's by default.
    """
    pairs = [(one.pair(mode, other), one.block) for one in judged]
    value = float(np.exp(np.mean([_log(errors) for errors, _ in pairs])))
    place = np.unique([one.recording or one.name for one in judged], return_inverse=True)[1]
    n, rng, scale = int(place.max()) + 1, np.random.default_rng(SEED), 1.0
    if n < MIN_RECORDINGS and any(e.shape[1] < MIN_BLOCKS * block for e, block in pairs):
        return Ratio(value)
    logs = np.array([_resampled_logs(errors, block, rng) for errors, block in pairs])
    counts = np.bincount(place).astype(float)
    sums = np.zeros((n, RESAMPLES))
    np.add.at(sums, place, logs)
    if n >= MIN_RECORDINGS:
        drawn = rng.integers(0, n, (n, RESAMPLES))
        means = sums[drawn, rng.integers(0, RESAMPLES, (n, RESAMPLES))].sum(axis=0)
        means /= counts[drawn].sum(axis=0)
        scale = float(np.sqrt(n / (n - 1)))
    else:
        means = sums.sum(axis=0) / counts.sum()
    low, high = means.mean() + scale * (np.percentile(means, [2.5, 97.5]) - means.mean())
    reference_errors = [one.rows[0].reference_error for one in judged]
    wider = np.mean(
        [_allowed(errors, own) for (errors, _), own in zip(pairs, reference_errors, strict=True)], 0
    )
    return Ratio(value, (float(np.exp(low + wider[0])), float(np.exp(high + wider[1]))))


def _log(errors: NDArray[np.float64]) -> float:
    """Logarithm of the ratio of two mean errors, from their values of shape (2, n)."""
    mine, others = np.maximum(errors.mean(axis=1), 1e-12)
    return float(np.log(mine / others))


def _resampled_logs(
    errors: NDArray[np.float64], block: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Logarithms of the ratio in resamples of one sequence, of shape (RESAMPLES,)."""
    means = np.maximum(resampled_means(errors, min(block, errors.shape[1]), rng), 1e-12)
    return np.asarray(np.log(means[0] / means[1]))


def _allowed(errors: NDArray[np.float64], reference_error: float | None) -> tuple[float, float]:
    """By how much the reference's own error may move the logarithm of a ratio, down and up."""
    if reference_error is None:
        return 0.0, 0.0
    mine, other = errors.mean(axis=1).tolist()
    ratio, error = mine / max(other, 1e-12), ERROR_FACTOR * reference_error
    _, (low, high) = allowing_for((mine, mine), (ratio, ratio), other, error)
    with np.errstate(divide="ignore"):
        return float(np.log(low / ratio)), float(np.log(high / ratio))


def _of_stretches(judged: Sequence[JudgedModes], mode: str) -> NDArray[np.float64]:
    """Logarithms of the ratio on each stretch: as many whole ones as a sequence has, or one."""
    found = []
    for one in judged:
        errors = one.pair(mode)
        n = max(1, errors.shape[1] // (PER_STRETCH * one.block))
        found += [_log(part) for part in np.array_split(errors, n, axis=1)]
    return np.array(found)


def with_gaps(
    rows: Sequence[ComparisonRow], oracles: Sequence[ComparisonRow]
) -> list[ComparisonRow]:
    """Fill in the share of what the best set of each sequence gains over the fixed set."""
    best = {row.mode: row.rte for row in oracles}.get(ORACLES[0])
    others: Mapping[str, float | None] = {row.mode: row.rte for row in rows}
    fixed = others.get("fixed")
    if best is None or fixed is None or best >= fixed:
        return list(rows)
    return [
        replace(row, gap_closed=(fixed - row.rte) / (fixed - best))
        if row.rte is not None and row.mode != "fixed"
        else row
        for row in rows
    ]
