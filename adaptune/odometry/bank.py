"""A bank: instances with different parameters, and the weighted mean of their motions."""

import logging
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, rectify
from adaptune.odometry.agreement import Agreement
from adaptune.odometry.base import (
    LastMotion,
    Motions,
    OdometryError,
    OdometryInstance,
    Registration,
    Usage,
    WarmUp,
)
from adaptune.odometry.lateness import Lateness
from adaptune.odometry.member_process import spread
from adaptune.odometry.pool import Factory
from adaptune.odometry.preparations import Preparations, PreparedScan
from adaptune.odometry.short_registrations import ShortRegistrations
from adaptune.odometry.warm_up import Make, RecentScans, Successor, catch_up_together
from adaptune.pooled_space import ODOMETRY
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet

CATCH_UP = 3
"""Scans of the past that a member that restarts sees with every new scan, in real time."""

_log = logging.getLogger(__name__)


class Bank(OdometryInstance):
    """Several instances, each with its own parameters and each on every scan.

    The pose moves by the weighted mean of the motions of members that agree, see `Agreement`. The
    others restart on the scans of the last seconds, at most once a second. So does a member that a
    fault has ended, until it has had too many of them: it costs its weight, and nothing else.
    Members that rest see no scans; when they are to work again, they begin on those of the last
    seconds, too.

    Parameters
    ----------
    make
        Makes instances.
    sets
        Parameter sets by trial number. The first is the fixed one: it begins with all the weight.
    warm_up
        Which scans a member sees when it restarts.
    lost_track
        Metres a second by which motions may never differ and agree.
    cores
        That the members may use, if `make` is a factory, see `spread`. The motions are the same.
    rate
        Times as fast as recorded at which scans come: members that are late are not waited for,
        see `Lateness`, and those that restart see scans of the past `CATCH_UP` at a time. None
        waits for all.

    Attributes
    ----------
    restarts : int
        How often a member was restarted.
    late : Lateness
        Which members were late.
    """

    def __init__(
        self,
        make: Make,
        sets: Mapping[int, ParameterSet],
        warm_up: WarmUp,
        lost_track: float = 3.0,
        cores: int = 1,
        rate: float | None = None,
    ):
        self.trials = tuple(sets)
        self.restarts = 0
        given = [dict(parameters) for parameters in sets.values()]
        self._members = (
            spread(make, given, cores)
            if isinstance(make, Factory)
            else [make(parameters) for parameters in given]
        )
        self._T_previous_current = np.tile(np.eye(4), (len(sets), 1, 1))
        # Members in processes of their own register while those of this process do.
        self._apart_first = sorted(range(len(sets)), key=lambda i: not self._members[i].apart)
        self._names = [
            f"trial {trial}" + (f" ({of[ODOMETRY]})" if ODOMETRY in of else "")
            for trial, of in sets.items()
        ]
        self._told: set[int] = set()
        self.late = Lateness(self._members, self._names, rate)
        self._rate = rate
        # In real time, there is no time for scans of the past.
        self.rewinds = rate is None
        self._returning: list[Successor] = []
        self._weights = np.eye(len(sets))[0]
        self._agreement = Agreement(len(sets), lost_track)
        self._short = ShortRegistrations()
        self._lost = False
        self._asked, self._resting, self._waking = np.zeros((3, len(sets)), np.bool_)
        self._preparations = Preparations()
        self._recent = RecentScans(warm_up)
        self._last_motion = LastMotion()

    @property
    def faults(self) -> list[str]:
        return [fault for member in self._members for fault in member.faults]

    @property
    def dead(self) -> frozenset[int]:
        """Trial numbers of the members that a fault has ended, and that are not back yet."""
        of_members = zip(self.trials, self._members, self.late.resting, strict=True)
        return frozenset(t for t, member, rests in of_members if member.ended and not rests)

    @property
    def usage(self) -> Usage:
        return Usage.total((member.usage for member in self._members), sum)

    @property
    def motions(self) -> Motions:
        # Of a member before it was restarted.
        members = dict(zip(self.trials, self._T_previous_current, strict=True))
        return self._last_motion.motions._replace(members=members)

    def prepare(self, scan: Scan) -> PreparedScan:
        prepared = self._preparations.of(scan)
        self.late.resting = self._resting
        self.late.begin()
        for member in self._present:
            prepared.by(member)
        return prepared

    @property
    def _present(self) -> list[OdometryInstance]:
        """Members that take the next scan; those apart come first."""
        return [self._members[i] for i in self._apart_first if not self.late.absent[i]]

    def apply(self, selection: Selection) -> None:
        # Members without a weight get 0.
        weights = {selection.trial: 1.0} if selection.weights is None else selection.weights
        if unknown := sorted(set(weights) - set(self.trials)):
            held, others = (", ".join(map(str, trials)) for trials in (self.trials, unknown))
            raise OdometryError(
                f"the bank holds trials {held}, not {others}: select among its members, or make it "
                f"with these trials"
            )
        self._weights = np.array([weights.get(trial, 0.0) for trial in self.trials], np.float64)
        self._lost = selection.lost
        self._asked = np.isin(self.trials, list(selection.restart))
        self._resting = np.isin(self.trials, list(selection.resting))
        self._waking = (self._waking | self.late.resting) & ~self._resting

    def start(
        self, prepared: PreparedScan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self.late.resting = self._resting
        self.late.settle()
        self._returning.clear()
        for member in self._present:
            member.start(prepared.by(member), T_odom_sensor, T_previous_current)
        self._T_previous_current = self._member_motions(T_odom_sensor)
        self.late.given(T_odom_sensor)
        self._agreement.start()
        self._short.start(prepared.stamp, prepared.scan.points)
        self._recent.start(prepared, T_odom_sensor, T_previous_current)
        self._last_motion.start(T_odom_sensor, T_previous_current)
        self._asked[:] = self._waking[:] = False
        self._tell()

    def submit(self, prepared: PreparedScan) -> None:
        # One that was woken after this scan was prepared begins with the next one.
        woken = self._waking & ~self.late.absent
        self._waking &= ~woken
        # Those that work go first: before they begin, the woken ones cannot go on in their place.
        self.late.absent |= woken
        self._restart(self._asked)
        self.late.absent &= ~woken
        self._restart(woken)
        self._asked[:] = False
        self._submitted = prepared
        for member in self._present:
            member.submit(prepared.by(member))

    def collect(self) -> Registration:
        scan, before = self._submitted, self._recent.last
        seconds = (scan.stamp - before.scan.stamp) * 1e-9
        registrations = self.late.collect(self._apart_first[::-1], seconds)
        self._tell()
        T_previous_current = self._member_motions(before.T_odom_sensor)
        self._T_previous_current = T_previous_current
        self._short.add(scan.stamp, scan.scan.points)
        agreeing = self._agreement.judge(
            T_previous_current, seconds, self._weights, self._short, self._lost
        )
        if not agreeing.any():
            T_odom_sensor = np.full((4, 4), np.nan)
            self._last_motion.move(T_odom_sensor)
            return Registration(T_odom_sensor, registered=False)
        T_moved = self._agreement.T_previous_current
        T_odom_sensor = rectify(self._recent.last.T_odom_sensor @ T_moved)
        self._recent.add(scan, T_odom_sensor)
        self.late.given(T_odom_sensor)
        self._last_motion.move(T_odom_sensor)
        self._catch_up()
        self._restart(self._agreement.due)
        registered = np.array([registration.registered for registration in registrations])
        return Registration(T_odom_sensor, bool(registered[agreeing].any()))

    def close(self) -> None:
        for member in self._members:
            member.close()

    def _member_motions(self, T_odom_previous: Poses) -> Poses:
        return np.array([self.late.motion(i, T_odom_previous) for i in range(len(self._members))])

    def _restart(self, members: NDArray[np.bool_]) -> None:
        """Restart members at the bank's pose, but for those that have given up or are late."""
        members = members & ~np.array([member.given_up for member in self._members])
        members &= ~self.late.working
        due = [self._members[i] for i in self._apart_first if members[i]]
        successors = [self._recent.replay_to(member) for member in due]
        # Somebody has to go on meanwhile.
        if self._rate is None or (self.late.absent | members).all():
            catch_up_together(successors)
            for i in np.flatnonzero(members).tolist():
                self.late.back(i, self._recent.last.T_odom_sensor)
        else:
            self._returning += successors
            self.late.away |= members
            self.late.absent |= members
        self.restarts += int(members.sum())
        self._agreement.restarted(members)
        self._tell()

    def _catch_up(self) -> None:
        """Let those that restart see the newest scan, and one of them scans of the past."""
        for one in self._returning:
            one.waiting.append(self._recent.last)
        if not self._returning or self._returning[0].odometry.busy:
            return
        first = self._returning[0]
        first.catch_up(CATCH_UP)
        if not first.waiting:
            i = self._members.index(first.odometry)
            self.late.back(i, self._recent.last.T_odom_sensor)
            self._agreement.restarted(np.arange(len(self._members)) == i)
            del self._returning[0]

    def _tell(self) -> None:
        """Log which members have ended, or are back, since this was last called."""
        for i, (name, member) in enumerate(zip(self._names, self._members, strict=True)):
            if self.late.resting[i]:
                continue
            if member.ended and i not in self._told:
                self._told.add(i)
                why = member.faults[-1] if member.faults else "it was closed"
                _log.warning("%s ended: %s; the bank goes on without it", name, why)
            elif not member.ended and i in self._told:
                self._told.remove(i)
                _log.warning("%s is back", name)
