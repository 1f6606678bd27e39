"""A bank: instances with different parameters, and the weighted mean of their motions."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, mean_motion, rectify
from adaptune.odometry.base import Motions, OdometryError, Recorded, Registration, Usage, WarmUp
from adaptune.odometry.warm_up import Make, PreparedScan, RecentScans
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet

TRUST = 0.3
"""By how much the vote of a bank's first member exceeds its weight where members disagree."""


class Bank(Recorded):
    """Several instances, each with its own parameters and each on every scan.

    The pose moves by the weighted mean of their motions. A member whose motion departs from those
    of the others by more than a lost track is left out of the mean. Where two or more agree, the
    others restart on the scans of the last seconds.

    Parameters
    ----------
    make
        Makes instances.
    sets
        Parameter sets by trial number. The first is the fixed one: it begins with all the weight,
        and its vote counts more than its weight where members disagree.
    warm_up
        Which scans a member sees when it restarts.
    lost_track
        Metres a second by which motions may differ and agree.

    Attributes
    ----------
    restarts : int
        How often a member was restarted.
    """

    def __init__(
        self, make: Make, sets: Mapping[int, ParameterSet], warm_up: WarmUp, lost_track: float = 3.0
    ):
        self.trials = tuple(sets)
        self.restarts = 0
        self._members = [make(dict(parameters)) for parameters in sets.values()]
        self._T_previous_current = np.tile(np.eye(4), (len(sets), 1, 1))
        self._weights = np.eye(len(sets))[0]
        self._lost_track = lost_track
        self._recent = RecentScans(warm_up, self._members[0])

    @property
    def faults(self) -> list[str]:
        return [fault for member in self._members for fault in member.faults]

    @property
    def usage(self) -> Usage:
        return Usage.total((member.usage for member in self._members), sum)

    @property
    def motions(self) -> Motions:
        # Of a member before it was restarted.
        members = dict(zip(self.trials, self._T_previous_current, strict=True))
        return super().motions._replace(members=members)

    def prepare(self, scan: Scan) -> PreparedScan:
        return PreparedScan.by(self._members[0], scan)

    def apply(self, selection: Selection) -> None:
        # Members without a weight get 0.
        weights = {selection.trial: 1.0} if selection.weights is None else selection.weights
        if unknown := sorted(set(weights) - set(self.trials)):
            held, others = (", ".join(map(str, trials)) for trials in (self.trials, unknown))
            raise OdometryError(f"the bank holds trials {held}, not {others}")
        self._weights = np.array([weights.get(trial, 0.0) for trial in self.trials], np.float64)

    def start(
        self, prepared: PreparedScan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        for member in self._members:
            member.start(prepared.prepared, T_odom_sensor, T_previous_current)
        self._T_previous_current = self._member_motions()
        self._recent.start(prepared, T_odom_sensor, T_previous_current)

    def submit(self, prepared: PreparedScan) -> None:
        self._submitted = prepared
        for member in self._members:
            member.submit(prepared.prepared)

    def collect(self) -> Registration:
        prepared = self._submitted
        registrations = [member.collect() for member in self._members]
        self._T_previous_current = T_previous_current = self._member_motions()
        seconds = (prepared.stamp - self._recent.last.scan.stamp) * 1e-9
        agreeing = agreement(T_previous_current, self._weights, self._lost_track * seconds)
        if not agreeing.any():
            return Registration(np.full((4, 4), np.nan), registered=False)
        shares = share(self._weights, agreeing)[agreeing]
        T_moved = mean_motion(T_previous_current[agreeing], shares)
        T_odom_sensor = rectify(self._recent.last.T_odom_sensor @ T_moved)
        self._recent.add(prepared, T_odom_sensor)
        for i in np.flatnonzero(~agreeing):
            # A single member may be the only one that is not lost.
            if agreeing.sum() > 1 or not np.isfinite(T_previous_current[i]).all():
                self._recent.replay_to(self._members[i]).catch_up()
                self.restarts += 1
        registered = np.array([registration.registered for registration in registrations])
        return Registration(T_odom_sensor, bool(registered[agreeing].any()))

    def close(self) -> None:
        for member in self._members:
            member.close()

    def _member_motions(self) -> Poses:
        return np.array([member.motions.T_previous_current for member in self._members])


def agreement(
    T_previous_current: Poses, weights: NDArray[np.float64], bound: float | NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which members agree: those near the motion that has the most votes near it.

    Parameters
    ----------
    T_previous_current
        Motions over a scan, of shape (..., n_members, 4, 4); NaN where there is none.
    weights
        Of shape (..., n_members). The first member's vote counts `TRUST` more.
    bound
        Metres by which two motions may differ and agree, of shape (..., 1, 1).

    Returns
    -------
    ndarray of shape (..., n_members)
        All False if there is no motion at all.
    """
    moved = T_previous_current[..., :3, 3]
    known = np.asarray(np.isfinite(T_previous_current).all(axis=(-2, -1)))
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(moved[..., :, None, :] - moved[..., None, :, :], axis=-1)
    near = np.asarray((apart <= bound) & known[..., None, :] & known[..., :, None])
    # Among members without weight, two that agree outvote one.
    votes = weights + 1e-9
    votes[..., 0] += TRUST
    heard = (near * votes[..., None, :]).sum(axis=-1)
    most = heard.argmax(axis=-1)[..., None, None]
    return np.asarray(np.take_along_axis(near, most, -2)[..., 0, :])


def share(weights: NDArray[np.float64], agreeing: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Weights of the members that agree; equal if they have none. Of shape (..., n_members)."""
    shares = np.where(agreeing, weights, 0.0)
    return np.where(shares.any(axis=-1, keepdims=True), shares, agreeing.astype(np.float64))
