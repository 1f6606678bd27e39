"""Fewer training frames, so that a selection costs less."""

from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from adaptune.model.file import ErrorModel


def thin(model: ErrorModel, max_frames: int) -> ErrorModel:
    """Keep frames that cover what all frames look like.

    Each sequence keeps its share of `max_frames`, at least one: the frame nearest to the
    sequence's mean, then always the one that is farthest from those kept (Gonzalez, *Clustering to
    minimize the maximum intercluster distance*, 1985). No frame that is left out is then further
    from one that is kept than twice the least possible distance.

    Errors are taken as they are: what is rare in a place that looks alike all along may be lost,
    and what is rare to look at counts for more. `docs/method.md` tells what that costs.

    Parameters
    ----------
    model
        Of all frames.
    max_frames
        How many to keep, over all sequences.
    """
    if len(model.sequence) <= max_frames:
        return model
    frames = covering(model.pca().transform(model.descriptors), model.sequence, max_frames)
    return replace(
        model,
        descriptors=model.descriptors[frames],
        sequence=model.sequence[frames],
        errors=model.errors[frames],
    )


def covering(
    features: NDArray[np.float64], sequence: NDArray[np.intp], max_frames: int
) -> NDArray[np.intp]:
    """Numbers of the frames that `thin` keeps, rising.

    Parameters
    ----------
    features
        What each frame looks like, of shape (n_frames, n_features).
    sequence
        Number of each frame's sequence, of shape (n_frames,).
    max_frames
        How many to keep, of `n_frames` at most.
    """
    kept = []
    for s in np.unique(sequence):
        members = np.flatnonzero(sequence == s)
        share = max(1, max_frames * len(members) // len(sequence))
        kept.append(members[_cover(features[members], share)])
    return np.sort(np.concatenate(kept))


@numba.njit(cache=True)
def _cover(X: NDArray[np.float64], n: int) -> NDArray[np.intp]:
    """Choose `n` rows, each the farthest from those before; of equally far ones the first."""
    mean = np.zeros(X.shape[1])
    for row in X:
        mean += row / len(X)
    nearest = np.full(len(X), np.inf)
    chosen = np.empty(n, np.intp)
    newest = mean
    for i in range(n):
        best, at = (np.inf if i == 0 else -1.0), 0
        for row in range(len(X)):
            distance = 0.0
            for f in range(X.shape[1]):
                distance += (X[row, f] - newest[f]) ** 2
            if i > 0:
                nearest[row] = min(nearest[row], distance)
            if (distance < best) if i == 0 else (nearest[row] > best):
                best, at = (distance if i == 0 else nearest[row]), row
        chosen[i] = at
        newest = X[at]
    return chosen
