"""A bank: instances with different parameters, and the weighted mean of their motions."""

import logging
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from functools import cached_property
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import small_gicp
from numpy.typing import NDArray

from adaptune.bank.members import Agreement, spread
from adaptune.bank.rest import Backoff
from adaptune.errors import OdometryError
from adaptune.geometry import Poses, invert, rectify, squared_ranges
from adaptune.odometry.base import (
    WITHOUT_POSE,
    MemberState,
    Motions,
    OdometryInstance,
    Registration,
    Usage,
)
from adaptune.odometry.factory import Factory
from adaptune.odometry.prepared import PreparedScan
from adaptune.recording.scan import Scan
from adaptune.space import ODOMETRY, ParameterSet, Selection


class PastScan(NamedTuple):
    """A scan with its pose and its motion."""

    scan: PreparedScan
    T_odom_sensor: Poses
    T_previous_current: Poses | None


class Successor:
    """A new instance that builds its map on the scans of the last seconds before it takes over."""

    def __init__(self, odometry: OdometryInstance, past: Iterable[PastScan]):
        self.odometry = odometry
        self.waiting = deque(past)
        self._start(self.waiting.popleft())

    def submit(self) -> None:
        """Begin to register the next of the scans that wait."""
        self._submitted = self.waiting.popleft()
        self.odometry.submit(self._submitted.scan.by(self.odometry))

    def collect(self) -> None:
        """Wait for its pose."""
        if not np.isfinite(self.odometry.collect().T_odom_sensor).all():
            # It begins without a past.
            self._start(self.waiting.pop() if self.waiting else self._submitted)
            self.waiting.clear()

    def _start(self, past: PastScan) -> None:
        prepared = past.scan.by(self.odometry)
        self.odometry.start(prepared, past.T_odom_sensor, past.T_previous_current)


# How well motions place the newest scan on the scans before it: what tells a lost member.

N_POINTS = 2000  # about as many points of the newest scan are placed
CUT_OFF = 1.0  # metres that a distance counts at most: what was hidden before tells nothing
KEPT = 2.0  # seconds for which scans are kept
_CELL = 0.25
"""Metres between points of the scans before. Without thinning, rings on the ground, which stand
still whatever the sensor does, would outnumber the rest."""
_NEAR = 1.0  # metres within which points may be the robot's own


class ShortRegistrations:
    """Mean distances of the newest scan from earlier ones: an `Alignment`, worked out if asked."""

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
        means = []
        for T, n in zip(T_then_now, ago, strict=True):
            then = self._clouds[-1 - n] if n < len(self._clouds) else None
            if then is None or not len(points) or not len(then.thinned):
                continue
            placed = points @ T[:, :3, :3].swapaxes(-1, -2) + T[:, None, :3, 3]
            distances, _ = then.tree.query(placed, distance_upper_bound=CUT_OFF)
            means.append(np.minimum(distances, CUT_OFF).mean(axis=1))
        return np.asarray(np.mean(means, axis=0) if means else np.full(T_then_now.shape[1], np.inf))


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
        from scipy.spatial import cKDTree  # takes long to import

        return cKDTree(self.thinned)


# Members of a bank that do not keep up with the sensor.


class Clock(NamedTuple):
    """What tells the time, and waits; both in seconds."""

    now: Callable[[], float]
    sleep: Callable[[float], None]


CLOCK = Clock(time.perf_counter, time.sleep)  # the machine's

MAX_LATE_SECONDS = 5.0  # a member that is late at every scan for so many seconds is removed
_INTERVALS = 11  # newest intervals between scans whose median says when the next scan is due
_POLL = 0.005  # seconds from one look at a member to the next


class Lateness:
    """Collects the poses of members that are in time, and does not wait for the others.

    A member in another process has until the next scan is due. One that needs longer is late: it
    has no motion over that scan, and takes part again as soon as it is done. Scans come `rate`
    times as fast as recorded; if that is None, the bank waits for everybody. `scans` counts at how
    many scans each member was late; members are `removed` that were always late, `away` while they
    restart, `resting` as the bank says before each scan, `absent` without a motion over the newest.
    All are of shape (n_members,).
    """

    def __init__(
        self,
        members: Sequence[OdometryInstance],
        names: Sequence[str],
        rate: float | None,
        clock: Clock = CLOCK,
    ):
        n = len(members)
        self.scans = np.zeros(n, np.intp)
        self.removed, self.resting, self.absent, self.away = np.zeros((4, n), np.bool_)
        self._members, self._names, self._rate = members, names, rate
        self._clock = clock
        self._owing = np.zeros(n, np.bool_)
        self._behind = np.zeros(n)  # seconds for which each member has been late
        self._intervals: deque[float] = deque(maxlen=_INTERVALS)
        # The bank's pose at the last scan that each member was given.
        self._T_odom_given = np.tile(np.eye(4), (n, 1, 1))

    def begin(self) -> None:
        """A scan is there: take what came late. Members that still work are absent."""
        self._begun = self._clock.now()
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
        """The poses of all members, `interval` seconds after the last; NaN if not in time."""
        self._intervals.append(interval)
        registrations = [WITHOUT_POSE] * len(self._members)
        for i in order:
            left = self._begun + median(self._intervals) / (self._rate or 1.0) - self._clock.now()
            if not self.absent[i] and (self._rate is None or self._members[i].ready(left)):
                self._behind[i] = 0.0
                registrations[i] = self._members[i].collect()
            else:
                self._owing[i] |= not self.absent[i]
                if not (self.removed[i] or self.resting[i] or self.away[i]):
                    self._note(i, interval)
        if not any(np.isfinite(r.T_odom_sensor).all() for r in registrations):
            first = self._first(self._owing & ~self.absent)
            if first is not None:
                self._owing[first], self._behind[first] = False, 0.0
                registrations[first] = self._members[first].collect()
        return registrations

    def _note(self, i: int, interval: float) -> None:
        self.scans[i] += 1
        # Another member of its process may be at work.
        self._behind[i] += interval if self._owing[i] else 0.0
        # Somebody has to go on.
        if self._behind[i] >= MAX_LATE_SECONDS and self.removed.sum() < len(self._members) - 1:
            self.removed[i] = True
            what = "%s was late for %g s; the bank goes on without it"
            _log.warning(what, self._names[i], MAX_LATE_SECONDS)

    def motion(self, i: int, T_odom_previous: Poses) -> Poses:
        """Motion of member `i` over the newest scan, of shape (4, 4); NaN if it is absent or late.

        Where it has missed scans, it moved as the bank did, whose last pose is `T_odom_previous`.
        """
        if self.absent[i] or self._owing[i]:
            return np.full((4, 4), np.nan)
        T_moved, T_given = self._members[i].motions.T_previous_current, self._T_odom_given[i]
        if np.array_equal(T_given, T_odom_previous):
            return T_moved
        return np.asarray(invert(T_odom_previous) @ T_given @ T_moved)

    def given(self, T_odom_sensor: Poses) -> None:
        """Take note of the bank's pose at a scan that all present members were given."""
        self._T_odom_given[~self.absent] = T_odom_sensor

    def back(self, i: int, T_odom_sensor: Poses) -> None:
        """A member has restarted, and seen the scan of this pose of the bank's."""
        self.away[i] = False
        self._T_odom_given[i] = T_odom_sensor

    @property
    def behind(self) -> NDArray[np.bool_]:
        """Members that are late, or were removed, of shape (n_members,)."""
        return self._owing | self.removed

    @property
    def working(self) -> NDArray[np.bool_]:
        """Members that cannot be restarted now, of shape (n_members,)."""
        return self._owing | self.absent | self.away


CATCH_UP = 3  # scans of the past that a member that restarts sees with every new scan, in real time

_log = logging.getLogger(__name__)


class Bank(OdometryInstance):
    """Several instances, each with its own parameters and each on every scan.

    The pose moves by the weighted mean of the motions of members that agree, see `Agreement`. The
    others restart on as many of the last seconds' scans as they need (`warm_up`), at most once a
    second, and so do members that a fault has ended, or that have rested. One that is lost again
    within a minute rests first, see `Backoff`. `restarts` counts how often a member was restarted.

    Parameters
    ----------
    sets
        Parameter sets by trial number. The first is the fixed one: it begins with all the weight.
    lost_track
        Metres a second by which motions may never differ and agree.
    cores
        That the members may use, if `make` is a factory, see `spread`. The motions are the same.
    rate
        See `Lateness`; members that restart see scans of the past `CATCH_UP` at a time then.
    """

    def __init__(
        self,
        make: Callable[[ParameterSet], OdometryInstance],
        sets: Mapping[int, ParameterSet],
        lost_track: float = 3.0,
        cores: int = 1,
        rate: float | None = None,
        clock: Clock = CLOCK,
    ):
        self.trials = tuple(sets)
        self.restarts = 0
        given = [dict(parameters) for parameters in sets.values()]
        if isinstance(make, Factory):
            self._members = spread(make, given, cores)
        else:
            self._members = [make(parameters) for parameters in given]
        self._T_previous_current = np.tile(np.eye(4), (len(sets), 1, 1))
        # Members in processes of their own register while those of this process do.
        self._isolated_first = sorted(range(len(sets)), key=lambda i: not self._members[i].isolated)
        self._names = [
            f"trial {trial}" + (f" ({given[ODOMETRY]})" if ODOMETRY in given else "")
            for trial, given in sets.items()
        ]
        self._warned_of: dict[int, None] = {}  # in the order in which they ended
        self._known_faults = [0] * len(sets)  # of each member, when it last worked
        self.late = Lateness(self._members, self._names, rate, clock)
        self._rate = rate
        # In real time, there is no time for scans of the past.
        self.rewinds = rate is None
        self._returning: list[Successor] = []
        self._weights = np.eye(len(sets))[0]
        self._agreement = Agreement(len(sets), lost_track)
        self._short = ShortRegistrations()
        self._in_doubt = False
        self._states: dict[int, MemberState] = {}
        self._asked, self._resting, self._waking = np.zeros((3, len(sets)), np.bool_)
        self._losses = Backoff(len(sets))
        self._first: dict[Hashable, OdometryInstance] = {}
        self._past: list[PastScan] = []  # of the last seconds

    @property
    def faults(self) -> list[str]:
        # Those of members that the bank goes on without explain nothing, unless none is left.
        left = [i for i in range(len(self._members)) if i not in self._warned_of]
        return [f for i in left or self._warned_of for f in self._members[i].faults]

    @property
    def usage(self) -> Usage:
        return Usage.total(member.usage for member in self._members)

    @property
    def motions(self) -> Motions:
        # Of a member before it was restarted.
        members = dict(zip(self.trials, self._T_previous_current, strict=True))
        return self._last_motion.motions._replace(members=members, states=self._states)

    def prepare(self, scan: Scan) -> PreparedScan:
        prepared = PreparedScan(scan, self._first)
        resting = self._resting | self._losses.resting(scan.stamp * 1e-9)
        resting = self._resting if resting.all() else resting  # somebody has to go on
        self._waking = (self._waking | self.late.resting) & ~resting
        self.late.resting = resting
        self.late.begin()
        for member in self._present:
            prepared.by(member)
        return prepared

    @property
    def _present(self) -> list[OdometryInstance]:
        """Members that take the next scan; those in other processes come first."""
        return [self._members[i] for i in self._isolated_first if not self.late.absent[i]]

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
        self._in_doubt = selection.in_doubt
        self._asked = np.isin(self.trials, list(selection.restart))
        self._resting = np.isin(self.trials, list(selection.resting))

    def start(
        self, prepared: PreparedScan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self.late.resting = self._resting
        self._losses = Backoff(len(self.trials))
        self._returning.clear()
        self.late.away[:] = False
        self.late.begin()
        for member in self._present:
            member.start(prepared.by(member), T_odom_sensor, T_previous_current)
        self.late.given(T_odom_sensor)
        self._T_previous_current = self._member_motions(T_odom_sensor)
        self._agreement.start()
        self._short.start(prepared.stamp, prepared.scan.points)
        self._past = [PastScan(prepared, T_odom_sensor, T_previous_current)]
        self._last_motion.start(T_odom_sensor, T_previous_current)
        self._tell_states(~self.late.absent)
        self._asked[:] = False
        # Those that still work on a scan begin when they are done.
        self._waking = self.late.absent & ~self._resting
        self._tell()

    def submit(self, prepared: PreparedScan) -> None:
        # One that was woken after this scan was prepared begins with the next one.
        woken = self._waking & ~self.late.absent
        self._waking &= ~woken
        # Those that work go first: before they begin, the woken ones cannot go on in their place.
        self.late.absent |= woken
        self._lose(self._asked, prepared.stamp)
        self.late.absent &= ~woken
        self._restart(woken)
        self._asked[:] = False
        self._submitted = prepared
        for member in self._present:
            member.submit(prepared.by(member))

    def _collect(self) -> Registration:
        scan, before = self._submitted, self._past[-1]
        seconds = (scan.stamp - before.scan.stamp) * 1e-9
        registrations = self.late.collect(self._isolated_first[::-1], seconds)
        self._tell()
        T_previous_current = self._member_motions(before.T_odom_sensor)
        self._T_previous_current = T_previous_current
        self._short.add(scan.stamp, scan.scan.points)
        agreeing = self._agreement.judge(
            T_previous_current, seconds, self._weights, self._short, self._in_doubt
        )
        self._tell_states(agreeing)
        if not agreeing.any():
            return WITHOUT_POSE
        T_odom_sensor = rectify(before.T_odom_sensor @ self._agreement.T_previous_current)
        T_before_now = invert(before.T_odom_sensor) @ T_odom_sensor
        self._past.append(PastScan(scan, T_odom_sensor, T_before_now))
        self._past = self._last(max(member.warm_up for member in self._members))
        self.late.given(T_odom_sensor)
        self._catch_up()
        self._lose(self._agreement.due, scan.stamp)
        registered = np.array([registration.registered for registration in registrations])
        return Registration(T_odom_sensor, bool(registered[agreeing].any()))

    def close(self) -> None:
        for member in self._members:
            member.close()

    def _tell_states(self, counts: NDArray[np.bool_]) -> None:
        """Note what each member did over the newest scan; of those in the mask, motions count."""
        self._states = dict.fromkeys(self.trials, "lost")
        late, rests = self.late.behind, self.late.resting
        masks: list[tuple[MemberState, NDArray[np.bool_]]]
        masks = [("late", late), ("rests", rests), ("works", counts)]
        for state, mask in masks:
            self._states |= {self.trials[i]: state for i in np.flatnonzero(mask)}

    def _member_motions(self, T_odom_previous: Poses) -> Poses:
        return np.array([self.late.motion(i, T_odom_previous) for i in range(len(self._members))])

    def _lose(self, members: NDArray[np.bool_], stamp: int) -> None:
        """Restart members that are lost, or let them rest first."""
        now = stamp * 1e-9
        self._losses.lose(members & ~self.late.working, now)
        self._restart(members & ~self._losses.resting(now))

    def _restart(self, members: NDArray[np.bool_]) -> None:
        """Restart members at the bank's pose, but for those that have given up or are late."""
        members = members & ~np.array([member.given_up for member in self._members])
        members &= ~self.late.working
        due = [self._members[i] for i in self._isolated_first if members[i]]
        successors = [Successor(member, self._last(member.warm_up)) for member in due]
        # Somebody has to go on meanwhile.
        if self._rate is None or (self.late.absent | members).all():
            # Those at the end register while those at the beginning do.
            while waiting := [successor for successor in successors if successor.waiting]:
                for successor in waiting:
                    successor.submit()
                for successor in reversed(waiting):
                    successor.collect()
            for i in np.flatnonzero(members).tolist():
                self.late.back(i, self._past[-1].T_odom_sensor)
        else:
            self._returning += successors
            self.late.away |= members
            self.late.absent |= members
        self.restarts += int(members.sum())
        self._agreement.restarted(members)
        self._tell()

    def _last(self, seconds: float) -> list[PastScan]:
        """The scans of the last seconds, at least the newest one."""
        begin = self._past[-1].scan.stamp - round(1e9 * seconds)  # no float holds stamps
        return [past for past in self._past if past.scan.stamp >= begin]

    def _catch_up(self) -> None:
        """Let those that restart see the newest scan, and one of them scans of the past."""
        for successor in self._returning:
            successor.waiting.append(self._past[-1])
        if not self._returning or self._returning[0].odometry.busy:
            return
        first = self._returning[0]
        for _ in range(CATCH_UP):
            if first.waiting:
                first.submit()
                first.collect()
        if not first.waiting:
            i = self._members.index(first.odometry)
            self.late.back(i, self._past[-1].T_odom_sensor)
            self._agreement.restarted(np.arange(len(self._members)) == i)
            del self._returning[0]

    def _tell(self) -> None:
        """Log which members have ended, or are back, since this was last called."""
        for i, (name, member) in enumerate(zip(self._names, self._members, strict=True)):
            if self.late.resting[i]:
                continue
            # One that has not begun yet, or that waits for its turn, has not failed.
            new = member.faults[self._known_faults[i] :]
            if member.ended and new and i not in self._warned_of:
                self._warned_of[i] = None
                _log.warning("%s ended: %s; the bank goes on without it", name, new[-1])
            elif not member.ended:
                self._known_faults[i] = len(member.faults)
                if i in self._warned_of:
                    del self._warned_of[i]
                    _log.warning("%s is back", name)
