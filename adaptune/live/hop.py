"""Direct registrations over some metres: how the sensor moved, measured without ground truth.

The newest scan is registered to one about ten metres before it, by GICP (Segal et al., RSS 2009) on
small_gicp (Koide, JOSS 2024). No error adds up over the scans in between.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, rectify, squared_ranges
from adaptune.sequence.compensation import compensate
from adaptune.sequence.scan import Scan

LENGTHS = (10.0, 5.0)
"""Metres of a hop: the second where the first is rejected, as in narrow caves."""
NOISE = 0.02
"""Metres by which a registration is wrong, about."""
MIN_INLIERS = 0.35
"""Least share of points near a point of the other scan; a registration with fewer is rejected."""
DEGENERATE = 0.002
"""A direction is unknown if its information is less than this share of the best direction's."""
_CELL, _NEIGHBOURS, _MIN_RANGE = 0.25, 20, 1.0
_FEWEST = 100
"""Points; small_gicp crashes on an empty target, and three points always converge."""
_REACHES = (2.0, 0.5)
"""Metres of the greatest distance of correspondences, one registration after the other."""
_ITERATIONS = 20
_OF_A_PLANE = 0.5
"""Information that small_gicp ascribes to a pair of points along their plane; there is none."""


class Hop(NamedTuple):
    """A registration that was accepted."""

    T_start_end: Poses
    # Of shape (3, 3): keeps of a vector in the start's frame what the registration can tell.
    projection: NDArray[np.float64]


class Hops(NamedTuple):
    """Hops along a sequence, in order of time."""

    start: NDArray[np.intp]  # (n,): frames
    end: NDArray[np.intp]
    T_start_end: Poses  # (n, 4, 4)
    projection: NDArray[np.float64]  # (n, 3, 3): see `Hop`

    def hop(self, i: int) -> Hop:
        """One of them."""
        return Hop(self.T_start_end[i], self.projection[i])

    def part(self, first: int, stop: int) -> "Hops":
        """Those between the frames from `first` to before `stop`, whose numbers begin anew."""
        inside = (self.start >= first) & (self.end < stop)
        return Hops(
            self.start[inside] - first,
            self.end[inside] - first,
            self.T_start_end[inside],
            self.projection[inside],
        )

    @classmethod
    def of(cls, hops: Sequence[tuple[int, int, Hop]]) -> "Hops":
        """Gather hops with their frames."""
        start, end = (np.array([hop[i] for hop in hops], np.intp) for i in (0, 1))
        found = [[hop[0] for *_, hop in hops], [hop[1] for *_, hop in hops]]
        T, projection = (
            np.array(arrays).reshape(-1, n, n) for arrays, n in zip(found, (4, 3), strict=True)
        )
        return cls(start, end, T, projection)


class HopCloud:
    """A scan, prepared for registrations when it is first needed.

    Parameters
    ----------
    scan
        The scan.
    T_previous_current
        The sensor's motion from the scan before, or to the next one where that is known, of shape
        (4, 4), for motion compensation.
    seconds
        How long that motion took; 0 for no compensation.
    """

    def __init__(self, scan: Scan, T_previous_current: Poses, seconds: float):
        self._scan: Scan | None = scan
        self._motion = T_previous_current, seconds
        self._cloud: Any = None

    def moved(self, T_current_next: Poses, seconds: float) -> None:
        """Learn the motion to the next scan; it counts if the scan was not needed before."""
        self._motion = T_current_next, seconds

    @property
    def prepared(self) -> Any:
        """Cloud with covariances, and its tree; None if there are too few points."""
        if self._scan is not None:
            self._cloud, self._scan = _prepare(self._scan, *self._motion), None
        return self._cloud


def _prepare(scan: Scan, T_previous_current: Poses, seconds: float) -> Any:
    import small_gicp  # takes long to import

    if seconds > 0.0:
        scan = compensate(scan, T_previous_current, seconds)
    points = scan.points[squared_ranges(scan.points) >= _MIN_RANGE**2].astype(np.float64)
    if len(points) < _FEWEST:
        return None
    cloud, tree = small_gicp.preprocess_points(
        points, downsampling_resolution=_CELL, num_neighbors=_NEIGHBOURS, num_threads=1
    )
    return (cloud, tree) if cloud.size() >= _FEWEST else None


def register(
    start: HopCloud, end: HopCloud, guesses: Iterable[Poses], min_inliers: float = MIN_INLIERS
) -> Hop | None:
    """Register two scans; the first guess that leads to a sound registration wins.

    Parameters
    ----------
    start, end
        The scans.
    guesses
        Of ``T_start_end``, each of shape (4, 4).
    min_inliers
        Least share of points near a point of the other scan.

    Returns
    -------
    Hop or None
        None if all of them are rejected.
    """
    if start.prepared is None or end.prepared is None:
        return None
    (target, tree), (source, _) = start.prepared, end.prepared
    for guess in guesses:
        result = _align(target, source, tree, guess)
        T = rectify(result.T_target_source)
        if np.isfinite(T).all() and result.num_inliers >= min_inliers * source.size():
            return Hop(T, T[:3, :3] @ _known_directions(result) @ T[:3, :3].T)
    return None


def _align(target: Any, source: Any, tree: Any, T_target_guess: Poses) -> Any:
    import small_gicp

    for reach in _REACHES:
        result = small_gicp.align(
            *(target, source, tree),
            init_T_target_source=T_target_guess,
            max_correspondence_distance=reach,
            max_iterations=_ITERATIONS,
            num_threads=1,
        )
        T_target_guess = result.T_target_source
    return result


def _known_directions(result: Any) -> NDArray[np.float64]:
    """Projection, in the end's frame, on the directions of translation that are well determined.

    Parameters
    ----------
    result
        What small_gicp found.
    """
    information = np.asarray(result.H)
    of_rotation = information[:3, :3] + 1e-9 * np.eye(3)
    # What is known of the translation if the rotation is not.
    marginal = information[3:, 3:] - information[3:, :3] @ np.linalg.solve(
        of_rotation, information[:3, 3:]
    )
    values, vectors = np.linalg.eigh(marginal)
    found = values - _OF_A_PLANE * result.num_inliers
    known = vectors[:, found >= DEGENERATE * values[-1]]
    return np.asarray(known @ known.T)
