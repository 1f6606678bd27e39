"""How long members of a bank rest that were at work in vain."""

import numpy as np
from numpy.typing import NDArray

FIRST = 10.0  # seconds
FORGIVEN = 60.0  # seconds at work after which the next rest is as short as the first


class Backoff:
    """Lets members that fail again and again rest for `first`, 2, 4, 8 ... times as long.

    The first `free` failures in a row cost no rest. Masks are of shape (n_members,), times in
    seconds.
    """

    def __init__(self, n_members: int, first: float = FIRST, free: int = 0):
        self._first, self._free = first, free
        self._failures = np.zeros(n_members, np.intp)  # in a row
        self._until = np.full(n_members, -np.inf)  # since when it works, or will

    def fail(self, members: NDArray[np.bool_], now: float) -> None:
        """Members have failed."""
        failures = np.where(now - self._until < FORGIVEN, self._failures, 0) + 1
        doubled = failures - self._free - 1
        rests = np.where(doubled < 0, 0.0, self._first * 2.0**doubled)
        self._failures = np.where(members, failures, self._failures)
        self._until = np.where(members, now + rests, self._until)

    def resting(self, now: float) -> NDArray[np.bool_]:
        """Which members rest."""
        return now < self._until
