"""The statistic of pairs: how the errors of two runs on the same frames compare, and how surely."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

MIN_BLOCKS = 4
"""Blocks of a recording: with fewer, an interval means nothing."""
MIN_RECORDINGS = 6
"""With as many, what differs between recordings counts, and with fewer what differs along them."""
ERROR_FACTOR = 1.5
"""By how much more than estimated an estimated reference may err."""
_LEAST = 1e-12
Interval = tuple[float, float] | None
"""Ends of an interval, where it is known."""


class Pair(NamedTuple):
    """The errors of two runs on the same frames of a recording, or of a part of it."""

    errors: NDArray[np.float64]  # (2, n): percent, of a run and of the one to compare with
    block: int = 1  # frames of a sub-trajectory: errors of so many neighbours overlap
    recording: str = ""  # the parts of one recording share its name
    reference_error: float | None = None  # percent, of an estimated reference


class Ratio(NamedTuple):
    """The ratio of the errors of two runs, over several recordings their geometric mean."""

    value: float
    interval: Interval = None
    error: float = math.inf  # standard error of its logarithm, without the reference's


def ratio(pairs: Sequence[Pair], share: float = 0.05) -> Ratio:
    """Ratio of the mean errors, and an interval that misses the truth in a `share` of cases.

    The standard error of its logarithm comes from moving blocks (Künsch, Annals of Statistics
    1989) of the difference between both runs. Its expectation is set right for errors of
    sub-trajectories that overlap, and the interval is Student's, so it holds for few blocks, too.

    With `MIN_RECORDINGS` recordings or more, the interval speaks of others like these. With fewer
    it speaks of these, and there is none unless each pair has `MIN_BLOCKS` blocks. What an
    estimated reference may err is added to it. Where all errors are equal, the ratio is surely 1.
    """
    logs, errors, freedom = np.array([along(pair) for pair in pairs]).T
    found = pooled(logs, errors, freedom, [pair.recording for pair in pairs], share)
    if found.interval is not None:
        low, high = np.mean([_of_reference(pair) for pair in pairs], axis=0)
        ends = found.interval[0] * math.exp(low), found.interval[1] * math.exp(high)
        found = found._replace(interval=ends)
    return found


def pooled(
    logs: NDArray[np.float64],
    errors: NDArray[np.float64],
    freedom: NDArray[np.float64],
    recordings: Sequence[str],
    share: float = 0.05,
) -> Ratio:
    """The geometric mean of ratios, given their logarithms, of shape (n,), and how sure these are.

    That is their standard errors, their degrees of freedom (0 where an interval would mean
    nothing), and the names of their recordings. See `ratio`.
    """
    from scipy.special import stdtrit  # slow to import

    mean = float(logs.mean())
    _, place = np.unique(np.asarray(recordings), return_inverse=True)
    n = int(place.max()) + 1
    if n >= MIN_RECORDINGS:
        sums = np.bincount(place, logs - mean)
        error, free = math.sqrt(float(sums @ sums) * n / (n - 1)) / len(logs), n - 1.0
    else:
        error, free = joined(errors / len(logs), freedom)
    if free == 0.0:
        return Ratio(math.exp(mean), None, error)
    margin = 0.0 if error == 0.0 else min(error * float(stdtrit(free, 1.0 - share / 2.0)), 700.0)
    return Ratio(math.exp(mean), (math.exp(mean - margin), math.exp(mean + margin)), error)


def in_cell(ends: Interval, digits: int = 2) -> str:
    """An interval in a table; without a spread, both sides are the same run."""
    if ends is None or not math.isfinite(ends[1]):
        return "too few"
    if ends == (1.0, 1.0):
        return "the same"
    return f"{ends[0]:.{digits}f}-{ends[1]:.{digits}f}"


def joined(errors: ArrayLike, freedom: ArrayLike) -> tuple[float, float]:
    """Standard error of a sum, and its degrees of freedom (Welch and Satterthwaite)."""
    variances, each = np.square(np.asarray(errors, float)), np.asarray(freedom, float)
    total = float(variances.sum())
    if total == 0.0:
        return 0.0, math.inf
    if not (each.all() and math.isfinite(total)):
        return math.sqrt(total), 0.0
    return math.sqrt(total), float(total**2 / (variances**2 / each).sum())


def of_segments(logs: NDArray[np.float64], recordings: Sequence[str]) -> Ratio:
    """The geometric mean of ratios on segments, given their logarithms and their recordings.

    A unit of evidence is a recording where there are `MIN_RECORDINGS`, else a segment.
    """
    n = len(logs)
    spread = float(logs.std(ddof=1)) if n > 1 else math.inf
    return pooled(logs, np.full(n, spread), np.full(n, (n - 1.0) / n), recordings)


def interval_of_mean(errors: NDArray[np.float64], block: int, own: float | None) -> Interval:
    """95 % interval of a mean error; `own` is that of the reference.

    What that errs adds to the error of the run if both have nothing to do with each other, and
    hides a part of it if they share it. Both ends are as unsure as that and chance together make
    them, whose logarithms add in quadrature.
    """
    found = ratio([Pair(np.stack([errors, np.ones_like(errors)]), block)])
    if found.interval is None or own is None:
        return found.interval
    mean, by_chance = found.value, math.log(found.interval[1] / found.value)
    least, most = _without(mean, ERROR_FACTOR * own), math.hypot(mean, ERROR_FACTOR * own)
    low = mean * math.exp(-math.hypot(by_chance, math.log(mean / least))) if least else 0.0
    return low, mean * math.exp(math.hypot(by_chance, math.log(most / mean)))


def along(pair: Pair) -> tuple[float, float, float]:
    """The logarithm of a ratio along a recording, its standard error and its degrees of freedom."""
    n, block = pair.errors.shape[1], pair.block
    means = np.maximum(pair.errors.mean(axis=1, keepdims=True), _LEAST)
    log = float(np.log(means[0, 0] / means[1, 0]))
    if (pair.errors[0] == pair.errors[1]).all():
        return 0.0, 0.0, math.inf
    if n < 2 * block:
        return log, math.inf, 0.0
    first, second = pair.errors / means
    sums = np.concatenate([[0.0], np.cumsum(first - second)])
    variance = float(np.mean(((sums[block:] - sums[:-block]) / block) ** 2))
    # Means of blocks vary less about the mean of all than about the truth; and of errors over
    # windows, each shares a part with those of the next block.
    expected = (1.0 - block / n) * (2.0 * block**2 + 1.0) / (3.0 * block**2)
    free = 1.5 * (n / block - 1.0) if n >= MIN_BLOCKS * block else 0.0
    return log, math.sqrt(variance * block / n / expected), free


def _of_reference(pair: Pair) -> tuple[float, float]:
    """By how much the reference's own error may move the logarithm of a ratio, down and up.

    Taken out of both errors, ratios lie further from 1. If one run errs as the reference does, as
    one that averages motions may, that part of its error is not seen.
    """
    mine, other = np.maximum(pair.errors.mean(axis=1), _LEAST).tolist()
    if pair.reference_error is None or (pair.errors[0] == pair.errors[1]).all():
        return 0.0, 0.0
    own, seen = ERROR_FACTOR * pair.reference_error, mine / other
    further = seen
    if seen != 1.0:
        mine_true, other_true = _without(mine, own), _without(other, own)
        # Nothing of the other one's error may be its own.
        far = 0.0 if seen < 1.0 else math.inf
        further = mine_true / other_true if other_true else far
    ends = further / seen, math.hypot(mine, own) / mine, other / math.hypot(other, own)
    low = min(1.0, *ends)
    return math.log(low) if low else -math.inf, math.log(max(1.0, *ends))


def _without(mean: float, own: float) -> float:
    return math.sqrt(max(mean**2 - own**2, 0.0))
