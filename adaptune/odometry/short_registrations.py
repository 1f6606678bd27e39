"""How well motions place the newest scan on the scans before it: what tells a lost member."""

from collections import deque
from functools import cached_property
from typing import Any

import numpy as np
import small_gicp
from numpy.typing import NDArray

from adaptune.geometry import Poses, squared_ranges

N_POINTS = 2000
"""About as many points of the newest scan are placed."""
CUT_OFF = 1.0
"""Metres that a distance counts at most: what was hidden before tells nothing."""
KEPT = 2.0
"""Seconds for which scans are kept."""
_CELL = 0.25
"""Metres between points of the scans before. Without thinning, rings on the ground, which stand
still whatever the sensor does, would outnumber the rest."""
_NEAR = 1.0
"""Metres within which points may be the robot's own."""


class ShortRegistrations:
    """Mean distances of the newest scan from earlier ones, where motions place it.

    Scans are only kept. Work is done where somebody asks. Calling it gives what
    `adaptune.odometry.agreement.Alignment` describes.
    """

    def __init__(self) -> None:
        self._clouds: deque[_Cloud] = deque()

    def start(self, stamp: int, points: NDArray[np.float32]) -> None:
        """Forget all scans and begin with this one."""
        self._clouds = deque([_Cloud(stamp, points)])

    def add(self, stamp: int, points: NDArray[np.float32]) -> None:
        """Add the newest scan, of shape (n, 3), and its stamp in nanoseconds."""
        self._clouds.append(_Cloud(stamp, points))
        while len(self._clouds) > 2 and stamp - self._clouds[0].stamp > KEPT * 1e9:
            self._clouds.popleft()

    def __call__(self, T_then_now: Poses, ago: tuple[int, ...]) -> NDArray[np.float64]:
        """Mean distances of shape (n_members,), see `Alignment`."""
        thinned = self._clouds[-1].thinned
        points = thinned[:: max(1, len(thinned) // N_POINTS)]
        found = [np.full(T_then_now.shape[1], np.inf)]
        for T, n in zip(T_then_now, ago, strict=True):
            then = self._clouds[-1 - n] if n < len(self._clouds) else None
            if then is None or not len(points) or not len(then.thinned):
                continue
            placed = points @ T[:, :3, :3].swapaxes(-1, -2) + T[:, None, :3, 3]
            distances, _ = then.tree.query(placed, distance_upper_bound=CUT_OFF)
            found.append(np.minimum(distances, CUT_OFF).mean(axis=1))
        return np.asarray(np.mean(found[1:] or found, axis=0))


class _Cloud:
    """A scan, thinned and searched only where it is asked for."""

    def __init__(self, stamp: int, points: NDArray[np.float32]):
        self.stamp, self._points = stamp, points

    @cached_property
    def thinned(self) -> NDArray[np.float64]:
        """A point in each cell of the scan, of shape (n, 3)."""
        points = self._points[squared_ranges(self._points) > _NEAR**2].astype(np.float64)
        if not len(points):
            return points
        return np.asarray(small_gicp.voxelgrid_sampling(points, _CELL).points()[:, :3])

    @cached_property
    def tree(self) -> Any:
        """What finds the nearest of its thinned points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.thinned)
