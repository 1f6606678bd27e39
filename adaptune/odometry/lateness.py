"""Members of a bank that do not keep up with the sensor."""

import logging
import time
from collections import deque
from collections.abc import Sequence
from statistics import median

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert
from adaptune.odometry.base import OdometryInstance, Registration

ALWAYS = 5.0
"""A member that is late at every scan for so many seconds is removed."""
_INTERVALS = 11
"""Newest intervals between scans whose median says when the next scan is due."""
_POLL = 0.005
"""Seconds from one look at a member to the next."""

_log = logging.getLogger(__name__)


class Lateness:
    """Collects the poses of members that are in time, and does not wait for the others.

    A member in another process has until the next scan is due. One that needs longer is late: it
    has no motion over that scan, and takes part again as soon as it is done. Members of this
    process are never late, for everything waits for them.

    Parameters
    ----------
    members, names
        Of the bank.
    rate
        Times as fast as recorded at which scans come; None if the bank waits for everybody.

    Attributes
    ----------
    scans : ndarray of shape (n_members,)
        At how many scans each member was late.
    removed : ndarray of shape (n_members,)
        Members that were always late: they take no part any more.
    away : ndarray of shape (n_members,)
        Members that are restarting.
    resting : ndarray of shape (n_members,)
        Members that are given no scans; the bank says which, before each scan.
    absent : ndarray of shape (n_members,)
        Members that have no motion over the newest scan.
    """

    def __init__(
        self, members: Sequence[OdometryInstance], names: Sequence[str], rate: float | None
    ):
        n = len(members)
        self.scans = np.zeros(n, np.intp)
        self.removed, self.resting, self.absent, self.away = np.zeros((4, n), np.bool_)
        self._members, self._names, self._rate = members, names, rate
        self._owing = np.zeros(n, np.bool_)
        self._behind = np.zeros(n)  # seconds for which each member has been late
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)
        # The bank's pose at the last scan that each member was given.
        self._T_odom_given = np.tile(np.eye(4), (n, 1, 1))

    def settle(self) -> None:
        """Wait for all that is owed, as before everybody starts again."""
        for i in np.flatnonzero(self._owing & ~self.removed).tolist():
            self._members[i].collect()
        self._owing[:] = self.away[:] = False
        self.absent = self.removed | self.resting

    def begin(self) -> None:
        """A scan is there: take what came late. Members that still work are absent."""
        self._begun = time.perf_counter()
        if self._rate is None:
            self.absent = self.resting.copy()
            return
        for i in np.flatnonzero(self._owing).tolist():
            if self._members[i].ready(0.0):
                self._members[i].collect()
                self._owing[i] = False
        busy = [member.busy for member in self._members]
        self.absent = self._owing | self.removed | self.resting | self.away | np.array(busy)
        if self.absent.all() and (first := self._first(self._owing)) is not None:
            self._members[first].collect()
            self._owing[first] = self.absent[first] = False

    def _first(self, owing: NDArray[np.bool_]) -> int | None:
        """Wait for the first of these members that are not removed; None if there are none."""
        members = np.flatnonzero(owing & ~self.removed).tolist()
        while members:
            for i in members:
                if self._members[i].ready(_POLL):
                    return int(i)
        return None

    def collect(self, order: Sequence[int], interval: float) -> list[Registration]:
        """The poses of all members; NaN for those that are absent, or late.

        Parameters
        ----------
        order
            Numbers of the members, in the order in which they are collected.
        interval
            Seconds from the scan before to this one.
        """
        self._intervals.append(interval)
        found = [Registration(np.full((4, 4), np.nan), registered=False)] * len(self._members)
        for i in order:
            if self._is_in_time(i):
                self._behind[i] = 0.0
                found[i] = self._members[i].collect()
            else:
                self._owing[i] |= not self.absent[i]
                self._note(i, interval)
        if not any(np.isfinite(one.T_odom_sensor).all() for one in found):
            first = self._first(self._owing & ~self.absent)
            if first is not None:
                self._owing[first], self._behind[first] = False, 0.0
                found[first] = self._members[first].collect()
        return found

    def _is_in_time(self, i: int) -> bool:
        if self.absent[i] or self._rate is None:
            return not self.absent[i]
        left = self._begun + median(self._intervals) / self._rate - time.perf_counter()
        return self._members[i].ready(left)

    def _note(self, i: int, interval: float) -> None:
        if self.removed[i] or self.resting[i] or self.away[i]:
            return
        self.scans[i] += 1
        # Another member of its process may be at work.
        self._behind[i] += interval if self._owing[i] else 0.0
        # Somebody has to go on.
        if self._behind[i] >= ALWAYS and self.removed.sum() < len(self._members) - 1:
            self.removed[i] = True
            what = "%s was late for %g s; the bank goes on without it"
            _log.warning(what, self._names[i], ALWAYS)

    def motion(self, i: int, T_odom_previous: Poses) -> Poses:
        """A member's motion over the newest scan, of shape (4, 4); NaN if it is absent or late.

        Where the member has missed scans, it moved there as the bank did.

        Parameters
        ----------
        i
            Number of the member.
        T_odom_previous
            The bank's pose at the scan before.
        """
        if self.absent[i] or self._owing[i]:
            return np.full((4, 4), np.nan)
        T_moved = self._members[i].motions.T_previous_current
        T_given = self._T_odom_given[i]
        if self._rate is None or np.array_equal(T_given, T_odom_previous):
            return T_moved
        missed: Poses = invert(T_odom_previous) @ T_given
        return np.asarray(missed @ T_moved)

    def given(self, T_odom_sensor: Poses) -> None:
        """Take note of the bank's pose at a scan that all present members were given."""
        if self._rate is not None:
            self._T_odom_given[~self.absent] = T_odom_sensor

    def back(self, i: int, T_odom_sensor: Poses) -> None:
        """A member has restarted, and seen the scan of this pose of the bank's."""
        self.away[i] = False
        self._T_odom_given[i] = T_odom_sensor

    @property
    def working(self) -> NDArray[np.bool_]:
        """Members that cannot be restarted now, of shape (n_members,)."""
        return self._owing | self.absent | self.away
