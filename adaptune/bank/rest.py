"""How long members of a bank rest that are lost again and again."""

import numpy as np
from numpy.typing import NDArray

FIRST = 10.0  # seconds
FORGIVEN = 60.0  # seconds at work after which the next rest is as short as the first


class Backoff:
    """Lets members that are lost again and again rest for `FIRST`, 2, 4, 8 ... times as long.

    The first loss in a row costs no rest. Masks are of shape (n_members,), times in seconds.
    """

    def __init__(self, n_members: int):
        self._losses = np.zeros(n_members, np.intp)  # in a row
        self._until = np.full(n_members, -np.inf)  # since when it works, or will

    def lose(self, members: NDArray[np.bool_], now: float) -> None:
        """Note that members are lost."""
        losses = np.where(now - self._until < FORGIVEN, self._losses, 0) + 1
        rests = np.where(losses < 2, 0.0, FIRST * 2.0 ** (losses - 2))
        self._losses = np.where(members, losses, self._losses)
        self._until = np.where(members, now + rests, self._until)

    def resting(self, now: float) -> NDArray[np.bool_]:
        """Which members rest."""
        return now < self._until
