"""One turn of a LiDAR."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Scan:
    """A point cloud in the sensor's frame.

    Attributes
    ----------
    stamp : int
        Nanoseconds, at the scan's start.
    points : ndarray of shape (n, 3)
        float32 metres, finite. There may be none.
    times : ndarray of shape (n,), optional
        float32 seconds since `stamp` at which each point was measured.
    """

    stamp: int
    points: NDArray[np.float32]
    times: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.points)
