"""Names of views of sequences."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

OF_VIEW = "+"
"""Joins the name of a sequence and the name of a view of it. No name of a user contains it."""


def origin(name: str) -> str:
    """Name of the sequence that a training sequence is, or is a view of."""
    return name.partition(OF_VIEW)[0]


def places(names: Sequence[str]) -> NDArray[np.intp]:
    """Number the places of sequences, of shape (n,): a view has the place of its origin."""
    number = {place: i for i, place in enumerate(dict.fromkeys(map(origin, names)))}
    return np.array([number[origin(name)] for name in names], np.intp)


def stretch_numbers(place: NDArray[np.intp], stretch: NDArray[np.intp]) -> NDArray[np.intp]:
    """Number stretches of all places from 0 on, of shape (n_frames,).

    Parameters
    ----------
    place
        Number of each frame's place, of shape (n_frames,).
    stretch
        Number of its stretch there, of shape (n_frames,).
    """
    _, number = np.unique(np.stack([place, stretch], axis=1), axis=0, return_inverse=True)
    return np.asarray(number.ravel())
