"""Direct registrations over some metres: how the sensor moved, measured without ground truth.

The newest scan is registered to one about ten metres before it, by GICP (Segal et al., RSS 2009) on
small_gicp (Koide, JOSS 2024). No error adds up over the scans in between.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert, rectify, rotation_angle, squared_ranges
from adaptune.recording.compensation import compensate
from adaptune.recording.scan import Scan

LENGTHS = (10.0, 5.0)  # metres of a hop: the second where the first is rejected, as in narrow caves
NOISE = 0.02  # metres by which a registration is wrong, about
NEW_GUESS = 0.3  # metres between guesses that are worth a registration each
MIN_INLIERS = 0.35
"""Least share of points near a point of the other scan; a registration with fewer is rejected."""
DEGENERATE = 0.01
"""A direction is unknown if its information is less than this share of the best direction's. It is
at most 0.006 along a smooth corridor without ends, and at least 0.02 on open ground."""
SHOWN = 0.7  # least share of a way that a registration has to tell
_FULL_TURN = 10.0
"""Metres at which a difference in rotation counts as one in translation, in radians."""
_MIN_RANGE = 1.0
_MIN_POINTS = 100  # points; small_gicp crashes on an empty target, and three points always converge
REACHES, OFFLINE_REACHES = (1.0,), (2.0, 0.5)
"""Metres of the greatest distance of correspondences, one registration after the other; the second
where there is time for two."""
CLOUD, OFFLINE_CLOUD = (0.5, 10, 4000), (0.25, 20, 10**9)
"""Metres between points of a cloud, neighbours that give a point's covariance, and points above
which it becomes coarser, as along wide roads; the second where there is time for it."""
_ITERATIONS = 20
_OF_A_PLANE = 0.5
"""Information that small_gicp ascribes to a pair of points along their plane; there is none."""


class Hop(NamedTuple):
    """A registration that was accepted."""

    T_start_end: Poses
    # Of shape (3, 3): keeps of a vector in the start's frame what the registration can tell.
    projection: NDArray[np.float64]
    inliers: float = 1.0  # share of points near a point of the other scan

    def shows(self, way: NDArray[np.float64]) -> bool:
        """Whether it tells how far the sensor moved along a way of shape (3,); no tunnel does."""
        return float(np.linalg.norm(self.projection @ way)) > SHOWN * float(np.linalg.norm(way))


class Hops(NamedTuple):
    """Hops along a sequence, in order of time."""

    start: NDArray[np.intp]  # (n,): frames
    end: NDArray[np.intp]
    T_start_end: Poses  # (n, 4, 4)
    projection: NDArray[np.float64]  # (n, 3, 3): see `Hop`

    def part(self, first: int, stop: int) -> "Hops":
        """Those between the frames from `first` to before `stop`, whose numbers begin anew."""
        inside = (self.start >= first) & (self.end < stop)
        kept = Hops._make(array[inside] for array in self)
        return kept._replace(start=kept.start - first, end=kept.end - first)

    @classmethod
    def of(cls, hops: Sequence[tuple[int, int, Hop]]) -> "Hops":
        """Gather hops with their frames."""
        T_start_end = np.array([hop.T_start_end for *_, hop in hops]).reshape(-1, 4, 4)
        projection = np.array([hop.projection for *_, hop in hops]).reshape(-1, 3, 3)
        start, end = (np.array([hop[i] for hop in hops], np.intp) for i in (0, 1))
        return cls(start, end, T_start_end, projection)


class HopCloud:
    """A scan, prepared for registrations when it is first needed.

    It is motion-compensated by the motion from the scan before, or to the next one where that is
    known, of shape (4, 4), which took so many seconds; 0 for no compensation.
    """

    def __init__(
        self,
        scan: Scan,
        T_previous_current: Poses,
        seconds: float,
        fineness: tuple[float, int, int] = CLOUD,
    ):
        self._scan: Scan | None = scan
        self._fineness = fineness
        self._motion = T_previous_current, seconds
        self._cloud: Any = None

    def moved(self, T_current_next: Poses, seconds: float) -> None:
        """Learn the motion to the next scan; it counts if the scan was not needed before."""
        self._motion = T_current_next, seconds

    @property
    def is_prepared(self) -> bool:
        """Whether `prepared` costs nothing."""
        return self._scan is None

    @property
    def prepared(self) -> Any:
        """Cloud with covariances, and its tree; None if there are too few points."""
        if self._scan is not None:
            self._cloud, self._scan = _prepare(self._scan, *self._motion, self._fineness), None
        return self._cloud


def _prepare(
    scan: Scan, T_previous_current: Poses, seconds: float, fineness: tuple[float, int, int]
) -> Any:
    import small_gicp  # takes long to import

    if seconds > 0.0:
        scan = compensate(scan, T_previous_current, seconds)
    points = scan.points[squared_ranges(scan.points) >= _MIN_RANGE**2].astype(np.float64)
    if len(points) < _MIN_POINTS:
        return None
    cell, neighbours, most = fineness
    size = small_gicp.voxelgrid_sampling(points, cell).size() if len(points) > most else 0
    cell *= max(1.0, size / most) ** 0.5
    cloud, tree = small_gicp.preprocess_points(
        points, downsampling_resolution=cell, num_neighbors=neighbours, num_threads=1
    )
    return (cloud, tree) if cloud.size() >= _MIN_POINTS else None


def register(
    start: HopCloud,
    end: HopCloud,
    guesses: Iterable[Poses],
    min_inliers: float = MIN_INLIERS,
    reaches: Sequence[float] = REACHES,
    iterations: int = _ITERATIONS,
) -> Hop | None:
    """Register two scans; the first guess that leads to a sound registration wins.

    Guesses are of ``T_start_end``, each of shape (4, 4). Sound is one with a share of
    `min_inliers` of its points near a point of the other scan; None if none is.
    """
    if start.prepared is None or end.prepared is None:
        return None
    import small_gicp

    (target, tree), (source, _) = start.prepared, end.prepared
    for T_start_end in guesses:
        for reach in reaches:
            result = small_gicp.align(
                *(target, source, tree),
                init_T_target_source=T_start_end,
                max_correspondence_distance=reach,
                max_iterations=iterations,
                num_threads=1,
            )
            T_start_end = result.T_target_source  # noqa: PLW2901
        T = rectify(result.T_target_source)
        if np.isfinite(T).all() and result.num_inliers >= min_inliers * source.size():
            projection = T[:3, :3] @ _known_directions(result) @ T[:3, :3].T
            return Hop(T, projection, result.num_inliers / source.size())
    return None


def apart(T: Poses, other: Poses) -> float:
    """How far two motions are apart, in metres; a radian counts as much as ten metres."""
    moved = invert(other) @ T
    return float(np.linalg.norm(moved[:3, 3]) + _FULL_TURN * rotation_angle(moved))


def _known_directions(result: Any) -> NDArray[np.float64]:
    """Projection, in the end's frame, on the directions of translation that are well determined."""
    information = np.asarray(result.H)
    of_rotation = information[:3, :3] + 1e-9 * np.eye(3)
    # What is known of the translation if the rotation is not.
    marginal = information[3:, 3:] - information[3:, :3] @ np.linalg.solve(
        of_rotation, information[:3, 3:]
    )
    values, vectors = np.linalg.eigh(marginal)
    beyond_planes = values - _OF_A_PLANE * result.num_inliers
    known = vectors[:, beyond_planes >= DEGENERATE * values[-1]]
    return np.asarray(known @ known.T)


# How wrong the members of a bank were over the last hops, and what that says of their weights.

SECONDS, METRES = 30.0, 30.0
"""A hop counts as long as it is no older, or no farther behind, than this."""
CLIP = 5.0
"""Percent of a hop by which a member may differ from the best one, for weights: beyond that it is
lost, and how far says nothing more."""


class HopErrors(NamedTuple):
    """Errors over some hops, the newest last."""

    # (n_hops, n_members, 3): percent of the hop, in the frame of its start; NaN where a member gave
    # no pose.
    errors: NDArray[np.float64]
    start: NDArray[np.float64]  # (n_hops,): metres driven at the start of each hop
    end: NDArray[np.float64]  # (n_hops,): and at its end
    seconds: NDArray[np.float64]  # (n_hops,): time of its end

    def with_hop(
        self, errors: NDArray[np.float64], start: float, end: float, seconds: float
    ) -> "HopErrors":
        """Add a hop, and drop those that no longer count."""
        added = HopErrors(
            np.concatenate([self.errors, errors[None]]),
            np.append(self.start, start),
            np.append(self.end, end),
            np.append(self.seconds, seconds),
        )
        return added.recent(end, seconds)

    def filled(self, members: NDArray[np.bool_]) -> "HopErrors":
        """Let members, of shape (n_members,), be as wrong as the worst where they gave no pose."""
        lengths = np.linalg.norm(self.errors, axis=-1)
        missing = np.isnan(lengths)
        worst = np.where(missing, -1.0, lengths).argmax(axis=1)
        of_worst = self.errors[np.arange(len(worst)), worst][:, None]
        gaps = (missing & members)[..., None]
        return self._replace(errors=np.where(gaps, of_worst, self.errors))

    def recent(self, metres: float, seconds: float) -> "HopErrors":
        """Those that count when so much was driven, at this time."""
        kept = (seconds - self.seconds <= SECONDS) | (metres - self.start <= METRES)
        return HopErrors(*(array[kept] for array in self))


class HopSquares(NamedTuple):
    """Mean products of the errors of members over hops."""

    products: NDArray[np.float64]  # (n_members, n_members): percent squared
    noise: float  # percent squared: what of each of them is the registrations' own
    windows: float  # number of hops that share no part of the path


def hop_squares(hops: HopErrors) -> HopSquares | None:
    """Mean products of the errors over hops; None if there is no hop.

    The registration's error is common to all members. It adds the same to all products, so it
    does not change the minimum-variance weights.
    """
    n_hops = len(hops.errors)
    if not n_hops:
        return None
    length = hops.end - hops.start
    errors, missing = clip_to_best(hops.errors)
    products = np.einsum("hix,hjx->ij", errors, errors) / n_hops
    products += np.diag(missing.mean(axis=0)) * CLIP**2
    noise = float(((100.0 * NOISE / length) ** 2).mean())
    return HopSquares(products, noise, windows(hops.start, hops.end))


def windows(start: NDArray[np.float64], end: NDArray[np.float64]) -> float:
    """How many segments of a path, from metres to metres, amount to as much without overlap."""
    order = np.argsort(start)
    start, end = start[order], end[order]
    length = float((end - start).mean())
    reached = np.maximum.accumulate(end)
    new = np.maximum(0.0, end[1:] - np.maximum(start[1:], reached[:-1]))
    return max(1.0, (float(end[0] - start[0]) + float(new.sum())) / length)


def clip_to_best(errors: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Clip errors at `CLIP` from those of the member with the least error of each hop.

    They are of shape (n_hops, n_members, 3), NaN where a member gave no pose. Returned are the
    errors, the best member's where there was none, and where there was none.
    """
    missing = np.asarray(~np.isfinite(errors).all(axis=-1))
    known = np.where(missing[..., None], np.nan, errors)
    known[missing.all(axis=1)] = 0.0
    best = np.nanargmin(np.linalg.norm(known, axis=-1), axis=1)
    centre = known[np.arange(len(known)), best][:, None]
    offsets = np.where(missing[..., None], 0.0, known - centre)
    lengths = np.linalg.norm(offsets, axis=-1, keepdims=True)
    return centre + offsets * np.minimum(1.0, CLIP / np.maximum(lengths, 1e-9)), missing


def blend(
    prior: NDArray[np.float64], prior_windows: float, hops: HopSquares | None
) -> NDArray[np.float64]:
    """Mean products of a prior and of what was measured, each weighted by its number of windows.

    What is measured is scaled to the prior: only how members compare counts, as in the prior, and
    not how hard the place is for all of them. Without the registrations' own part, the harmonic
    means of the members' squares are then the same. Products are of shape (n_members, n_members).
    """
    if hops is None:
        return prior
    squares = hops.products.diagonal()
    # Registrations that are as wrong as the members say little; never divide by nothing.
    own = np.maximum(squares - hops.noise, 0.25 * squares) + 1e-12
    scale = (1.0 / own).mean() / (1.0 / np.maximum(prior.diagonal(), 1e-12)).mean()
    total = prior_windows + hops.windows
    return np.asarray((prior_windows * prior + hops.windows * scale * hops.products) / total)
