"""How accurate a reference is that came with a recording, by direct registrations of its scans."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses
from adaptune.live.along import hops_along
from adaptune.live.hop import LENGTHS as HOPS
from adaptune.live.hop import Hops
from adaptune.live.own_error import NEARLY, Link, OwnError, OwnErrors
from adaptune.metrics import cap, sub_trajectory_rte
from adaptune.sequence.scan import Scan
from adaptune.sequence.sequence import Sequence
from adaptune.trajectory import Trajectory

if TYPE_CHECKING:
    # It would import what estimates.
    from adaptune.reference.estimate import Advance


@dataclass(frozen=True, eq=False)
class MeasuredReference:
    """A reference at the scans' stamps, and registrations of the scans.

    Attributes
    ----------
    stamps : ndarray of shape (n,)
        Of the scans, in nanoseconds.
    T_ref_sensor : ndarray of shape (n, 4, 4)
        Poses of the reference; NaN where there is none.
    hops : Hops
        Direct registrations of the same scans.
    """

    stamps: NDArray[np.int64]
    T_ref_sensor: Poses
    hops: Hops

    def error(self, length: float) -> OwnError | None:
        """Mean error of the reference, in percent of the sub-trajectories' length.

        What the registrations themselves are wrong by is part of it. A registration is `HOPS`
        metres long at most; over less, the reference counts as wrong by as many metres.

        Parameters
        ----------
        length
            Metres of the sub-trajectories.

        Returns
        -------
        OwnError, optional
            None if the registrations that follow each other reach nowhere over the length.
        """
        longer = max(length, HOPS[0])
        metres, reach = self._metres(), 0.0
        part = np.cumsum(np.isnan(self.T_ref_sensor[:, 0, 0]))
        errors = OwnErrors(longer, whole=True)
        begun = None
        for i, (start, end) in enumerate(zip(self.hops.start, self.hops.end, strict=True)):
            if begun is None or part[start] != part[begun]:
                errors.interrupt()
                begun = start
            reach = max(reach, float(metres[end] - metres[begun]))
            errors.add(
                Link(
                    float(metres[start]),
                    float(metres[end]),
                    float(self.stamps[end]) * 1e-9,
                    self.T_ref_sensor[start],
                    self.T_ref_sensor[end],
                    self.hops.hop(i),
                )
            )
        found = errors.estimate() if reach >= NEARLY * longer else None
        scale = longer / length
        return None if found is None else OwnError(*(scale * value for value in found))

    def _metres(self) -> NDArray[np.float64]:
        """Metres driven until each end of a registration, of shape (n,); NaN elsewhere.

        Straight from one to the next: poses that are noisy make a longer path.
        """
        ends = np.unique(np.concatenate([self.hops.start, self.hops.end]))
        steps = np.linalg.norm(np.diff(self.T_ref_sensor[ends, :3, 3], axis=0), axis=1)
        metres = np.full(len(self.stamps), np.nan)
        metres[ends] = np.concatenate([np.zeros(min(len(ends), 1)), np.cumsum(steps)])
        return metres


def measure_reference(
    scans: Sequence, reference: Trajectory, advance: "Advance" = lambda *_: None
) -> MeasuredReference:
    """Register the scans of a recording to find how wrong its reference is.

    Parameters
    ----------
    scans
        The recording.
    reference
        Poses of its LiDAR.
    advance
        Called after every scan.
    """
    stamps, poses = [], []
    n = scans.n_messages

    def with_poses() -> Iterator[tuple[Scan, Poses]]:
        for scan in scans:
            stamps.append(scan.stamp)
            poses.append(_pose_at(reference, scan.stamp))
            yield scan, poses[-1]

    hops = hops_along(with_poses(), lambda done: advance(min(done, n), n))
    advance(len(stamps), len(stamps))
    return MeasuredReference(np.array(stamps, np.int64), np.array(poses).reshape(-1, 4, 4), hops)


def _pose_at(reference: Trajectory, stamp: int) -> Poses:
    """The pose at a stamp, of shape (4, 4), without a look at the whole trajectory."""
    after = int(np.searchsorted(reference.stamps, stamp))
    near = slice(max(after - 1, 0), after + 1)
    around = Trajectory(reference.stamps[near], reference.T_world_sensor[near], reference.max_gap)
    return np.asarray(around.at(np.array([stamp], np.int64))[0])


def mean_difference(T_one: Poses, T_other: Poses, length: float) -> float:
    """Mean RTE of one reference by another, in percent.

    Parameters
    ----------
    T_one, T_other
        Poses at the same stamps, each of shape (n, 4, 4); NaN where they are unknown.
    length
        Metres of the sub-trajectories.

    Returns
    -------
    float
        NaN where both together hold no sub-trajectory.
    """
    T_one, T_other = common_poses(T_one, T_other)
    errors = sub_trajectory_rte(T_one, T_other, length)
    errors = cap(errors[~np.isnan(errors)])
    return float(errors.mean()) if len(errors) else float("nan")


def common_poses(T_one: Poses, T_other: Poses) -> tuple[Poses, Poses]:
    """Two references, unknown wherever one of them is."""
    known = np.isfinite(T_one + T_other).all(axis=(1, 2), keepdims=True)
    one, other = (np.where(known, T, np.nan) for T in (T_one, T_other))
    return one, other
