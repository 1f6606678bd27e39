"""A few parameter sets that complement each other."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adaptune.metrics import cap
from adaptune.model.base import mean_errors
from adaptune.model.file import ErrorModel


def complementary(
    errors: NDArray[np.floating], sequence: NDArray[np.intp], fixed: int, size: int
) -> list[int]:
    """Choose sets so that at every training frame one of them does well.

    Greedily, beginning with the fixed set: each next one lowers the mean error most if the best of
    the chosen ones could be known at every frame.

    Parameters
    ----------
    errors
        Percent, of shape (n_frames, n_sets); NaN where a set was never run, where it lowers
        nothing.
    sequence
        Number of each frame's sequence, of shape (n_frames,).
    fixed
        The fixed set.
    size
        How many to choose; fewer where more would lower nothing.

    Returns
    -------
    list of int
        Numbers of the sets, the fixed one first.
    """
    capped = np.where(np.isnan(errors), np.inf, cap(errors))
    chosen = [fixed]
    least = capped[:, fixed]
    while len(chosen) < size:
        means = mean_errors(np.minimum(capped, least[:, None]), sequence)
        best = int(np.argmin(means))
        # A set that is chosen already, as the fixed one, lowers nothing.
        if not means[best] < means[fixed]:
            break
        chosen.append(best)
        least = np.minimum(least, capped[:, best])
    return chosen


def portfolio(model: ErrorModel, size: int) -> list[int]:
    """Choose complementary sets of a model, the fixed one first; see `complementary`."""
    return complementary(model.errors, model.sequence, model.fixed, size)


def restrict(model: ErrorModel, chosen: list[int]) -> ErrorModel:
    """Make a model of some of the sets only, the first of which counts as the fixed one."""
    return replace(
        model, sets=[model.sets[i] for i in chosen], errors=model.errors[:, chosen], fixed=0
    )
