"""Expected loss: one number by which all ways to adapt are compared with the fixed set."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import worst_tenth
from adaptune.model.paired import ERROR_FLOOR
from adaptune.study.driven import MIN_RECORDINGS

RISK = 0.5
"""Weight of the worst tenth."""
BLOCK = 2
"""Consecutive stretches that a bootstrap draws together."""
RESAMPLES = 500
"""Of a bootstrap."""

Logs = NDArray[np.float64]
"""Logarithms of the ratio to the fixed set's error, a number for each stretch."""


class Figures(NamedTuple):
    """What is expected of a way to adapt: ratios to the fixed set's error."""

    loss: float  # see `expected_loss`
    geometric: float  # geometric mean over the stretches
    low: float  # 95 % interval of it
    high: float
    worst_tenth: float  # geometric mean over the worst tenth
    worst: float
    n_stretches: int
    n_recordings: int


def log_ratios(
    errors: NDArray[np.float64], fixed: NDArray[np.float64], stretch: NDArray[np.intp]
) -> Logs:
    """Logarithm of the ratio to the fixed set's error on each stretch, by rising number.

    Parameters
    ----------
    errors, fixed
        Capped errors in percent, of shape (n_frames,).
    stretch
        Number of each frame's stretch, of shape (n_frames,).
    """
    _, number = np.unique(stretch, return_inverse=True)
    n_frames = np.bincount(number)
    means, of_fixed = (np.bincount(number, e) / n_frames + ERROR_FLOOR for e in (errors, fixed))
    return np.asarray(np.log(means / of_fixed))


def expected_loss(logs: Logs, recordings: Sequence[str]) -> float:
    """Mean logarithm, plus half the mean of the worst tenth, plus one standard error.

    The fixed set has 0. Worst stretches that are better than the fixed set's are no merit. One
    stretch shows nothing: the loss is infinite, unless it does as the fixed set does.

    Parameters
    ----------
    logs
        A number for each stretch.
    recordings
        Name of each stretch's recording, in order along it.
    """
    if not logs.any():
        return 0.0
    risk = RISK * max(0.0, worst_tenth(logs))
    return float(logs.mean() + risk + standard_error(logs, recordings))


def standard_error(logs: Logs, recordings: Sequence[str]) -> float:
    """Of the mean: clustered by recording, or of a block bootstrap where recordings are few."""
    if len(logs) < 2:
        return np.inf
    _, number = np.unique(np.asarray(recordings), return_inverse=True)
    n = int(number.max()) + 1
    if n >= MIN_RECORDINGS:
        sums = np.bincount(number, logs - logs.mean())
        return float(np.sqrt(sums @ sums * n / (n - 1)) / len(logs))
    # Means of few vary too little.
    scale = np.sqrt(len(logs) / (len(logs) - 1))
    # Of two or three stretches, nearly all resamples are alike.
    independent = float(logs.std(ddof=1) / np.sqrt(len(logs)))
    return max(independent, float(scale * _resampled_means(logs, number).std()))


def _resampled_means(logs: Logs, number: NDArray[np.intp], seed: int = 0) -> NDArray[np.float64]:
    """Means of a circular block bootstrap, whose blocks are of one recording."""
    following = np.arange(1, len(logs) + 1)
    for recording in np.unique(number):
        of = np.flatnonzero(number == recording)
        following[of] = np.roll(of, -1)
    n_blocks = -(-len(logs) // BLOCK)
    drawn = np.random.default_rng(seed).integers(0, len(logs), (RESAMPLES, n_blocks))
    return np.asarray((logs[drawn] + logs[following[drawn]]).mean(axis=1) / BLOCK)


def interval_of(logs: Logs, recordings: Sequence[str]) -> tuple[float, float]:
    """95 % interval of the mean: Student's, with as many degrees of freedom as there are units.

    A unit is a recording where there are enough of them, else a stretch.
    """
    if len(logs) < 2:
        return -np.inf, np.inf
    from scipy import stats

    n_recordings = len(set(recordings))
    units = n_recordings if n_recordings >= MIN_RECORDINGS else len(logs)
    margin = stats.t.ppf(0.975, units - 1) * standard_error(logs, recordings)
    return float(logs.mean() - margin), float(logs.mean() + margin)


def figures(logs: Logs, recordings: Sequence[str]) -> Figures:
    """All that is said of a way to adapt."""
    low, high = interval_of(logs, recordings)
    ratios = (logs.mean(), low, high, worst_tenth(logs), logs.max())
    geometric, low, high, tenth, worst = (float(np.exp(ratio)) for ratio in ratios)
    loss, n_recordings = expected_loss(logs, recordings), len(set(recordings))
    return Figures(loss, geometric, low, high, tenth, worst, len(logs), n_recordings)
