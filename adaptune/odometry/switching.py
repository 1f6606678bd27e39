"""Other parameters on the way, for odometries that read them only when they begin.

Both ways are driven like an odometry that is `live`: a replay need not know which it has.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert, mean_motion, rectify
from adaptune.odometry.base import Box, OdometryError, Registration, WarmUp
from adaptune.odometry.isolation import Isolated
from adaptune.sequence import Imu, Scan
from adaptune.sequence.imu import joined
from adaptune.space import ParameterSet

Make = Callable[[ParameterSet], Box]
"""Makes a new instance with these parameters."""

TRUST = 0.3
"""By how much more than its weight the first instance of a bank is heard where they disagree."""


class Stamped(NamedTuple):
    """A prepared scan and its stamp in nanoseconds; the scan too, if it brings an IMU along."""

    stamp: int
    prepared: Any
    scan: Scan | None

    @classmethod
    def by(cls, box: Box, scan: Scan) -> "Stamped":
        """What a box makes of a scan."""
        return cls(scan.stamp, box.prepare(scan), scan if scan.imu is not None else None)


class _Past(NamedTuple):
    scan: Stamped
    T_odom_sensor: Poses
    T_previous_current: Poses | None

    @property
    def imu(self) -> Imu | None:
        return None if self.scan.scan is None else self.scan.scan.imu


class _Recent:
    """The last seconds of scans, with the poses that were given for them."""

    def __init__(self, warm_up: WarmUp, first: Box):
        self._warm_up = warm_up
        self._first = first
        self._past: deque[_Past] = deque()
        self._forgotten = 0

    def __bool__(self) -> bool:
        return bool(self._past)

    def begin(self, scan: Stamped, T_odom_sensor: Poses, motion: Poses | None) -> None:
        self._past.clear()
        self._past.append(_Past(scan, T_odom_sensor, motion))
        self._forgotten = 0

    def add(self, scan: Stamped, T_odom_sensor: Poses) -> None:
        T_previous_current = invert(self._past[-1].T_odom_sensor) @ T_odom_sensor
        self._past.append(_Past(scan, T_odom_sensor, T_previous_current))
        while len(self._past) > 1 and self._age(self._past[0]) > self._warm_up.seconds:
            self._past.popleft()
            self._forgotten += 1

    @property
    def last(self) -> _Past:
        return self._past[-1]

    @property
    def pose(self) -> Poses:
        return self._past[-1].T_odom_sensor

    def newcomer(self, box: Box) -> "_Newcomer":
        """Let a new instance begin with these scans."""
        _, full_rate, stride = self._warm_up
        seen: list[_Past] = []
        missed: list[Imu] = []
        for number, past in enumerate(self._past, self._forgotten):
            if self._age(past) <= full_rate or number % stride == 0:
                seen.append(self._catching_up(past, missed))
                missed = []
            elif seen and past.imu is not None:
                missed.append(past.imu)
        return _Newcomer(box, seen)

    def _catching_up(self, past: _Past, missed: list[Imu]) -> _Past:
        """A scan with what was measured since the last one that is seen."""
        scan = past.scan.scan
        if not missed or scan is None or scan.imu is None:
            return past
        scan = replace(scan, imu=joined([*missed, scan.imu]))
        return past._replace(scan=Stamped.by(self._first, scan))

    def warm_up(self, box: Box) -> Poses:
        """Let a new instance see these scans, and tell where it believes to be."""
        newcomer = self.newcomer(box)
        newcomer.go_on(len(self._past))
        return newcomer.T_own_sensor

    def _age(self, past: _Past) -> float:
        return (self._past[-1].scan.stamp - past.scan.stamp) * 1e-9


class _Newcomer:
    """A new instance on its way through scans of the past."""

    def __init__(self, box: Box, past: Iterable[_Past]):
        self.box = box
        self.waiting = deque(past)
        self._start(self.waiting.popleft())

    def go_on(self, n: int) -> None:
        """See at most `n` scans more."""
        for _ in range(min(n, len(self.waiting))):
            past = self.waiting.popleft()
            self.T_own_sensor = self.box.register(past.scan.prepared).T_odom_sensor
            if not np.isfinite(self.T_own_sensor).all():
                # It begins without a past.
                self._start(self.waiting.pop() if self.waiting else past)
                self.waiting.clear()
                return

    def _start(self, past: _Past) -> None:
        self.box.start(past.scan.prepared, past.T_odom_sensor, past.T_previous_current)
        self.T_own_sensor = past.T_odom_sensor


def _between(T_odom_sensor: Poses, T_own_sensor: Poses) -> Poses:
    """``T_odom_own``, exactly the identity where both are the same."""
    if np.array_equal(T_odom_sensor, T_own_sensor):
        return np.eye(4)
    return rectify(T_odom_sensor @ invert(T_own_sensor))


class HandOver:
    """An odometry that is replaced by a new instance when its parameters change.

    The new instance is warmed up on scans of the last seconds, from the pose and the motion that
    were given for the first of them. From then on its motions are chained on: no pose jumps. Its
    map is as old as the warm-up is long.

    Parameters
    ----------
    make
        Makes instances.
    parameters
        Those to begin with.
    warm_up
        Which scans it sees.
    beside
        How many of them it sees with every new scan, while the old instance still gives the poses;
        two at least, to catch up. With 0 it sees all at once, and the next scan waits.
    """

    def __init__(self, make: Make, parameters: ParameterSet, warm_up: WarmUp, beside: int = 0):
        self.parameters = dict(parameters)
        self._make = make
        self._beside = beside
        # What one instance has learnt from the first scan's layout must serve all.
        self._first = self._box = make(self.parameters)
        self._recent = _Recent(warm_up, self._first)
        self._present = self.parameters
        self._newcomer: _Newcomer | None = None
        self._T_odom_own = np.eye(4)

    def prepare(self, scan: Scan) -> Stamped:
        """See `Odometry.prepare`."""
        return Stamped.by(self._first, scan)

    def start(
        self, prepared: Stamped, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """See `Odometry.start`; one that is being warmed up takes over."""
        if self._newcomer is not None:
            self._box, self._present, self._newcomer = self._newcomer.box, self.parameters, None
        self._box.start(prepared.prepared, T_odom_sensor, T_previous_current)
        self._T_odom_own = np.eye(4)
        self._recent.begin(prepared, T_odom_sensor, T_previous_current)

    def register(self, prepared: Stamped) -> Registration:
        """See `Odometry.register`."""
        box, newcomer = self._box, self._newcomer
        # One in a process of its own works while the newcomer looks back.
        if isinstance(box, Isolated):
            box.request(prepared.prepared)
        if newcomer is not None:
            newcomer.go_on(self._beside - 1)
        T_own_sensor, registered = (
            box.result() if isinstance(box, Isolated) else box.register(prepared.prepared)
        )
        T_odom_sensor = self._T_odom_own @ T_own_sensor
        if np.isfinite(T_odom_sensor).all():
            self._recent.add(prepared, T_odom_sensor)
            if newcomer is not None:
                newcomer.waiting.append(self._recent.last)
                newcomer.go_on(1)
                if not newcomer.waiting:
                    self._take_over(newcomer)
        return Registration(T_odom_sensor, registered)

    def configure(self, parameters: ParameterSet) -> None:
        """Begin to replace the instance, unless it has or will have these parameters."""
        wanted = self.parameters | parameters
        if wanted == self.parameters:
            return
        self.parameters, self._newcomer = wanted, None
        if wanted == self._present:
            return
        box = self._make(wanted)
        if not self._recent:
            self._box, self._present = box, wanted
            return
        newcomer = self._recent.newcomer(box)
        if self._beside:
            self._newcomer = newcomer
        else:
            newcomer.go_on(len(newcomer.waiting))
            self._take_over(newcomer)

    def _take_over(self, newcomer: _Newcomer) -> None:
        self._box, self._present, self._newcomer = newcomer.box, self.parameters, None
        self._T_odom_own = _between(self._recent.pose, newcomer.T_own_sensor)


class Bank:
    """Several instances side by side, each with its own parameters and each on every scan.

    The mean of their motions is taken, each by its weight. Those that depart from the others by
    more than a lost track does are left out of it, and where two or more agree the rest are started
    anew on the last seconds of scans.

    Parameters
    ----------
    make
        Makes instances.
    sets
        Their parameters. The first has all the weight to begin with, and a vote more than its
        weight: it is the one to trust where they disagree.
    warm_up
        Which scans an instance sees when it is started anew.
    lost_track
        Metres a second by which motions may differ and agree.

    Attributes
    ----------
    restarts : int
        How often an instance was started anew.
    """

    def __init__(
        self,
        make: Make,
        sets: Sequence[ParameterSet],
        warm_up: WarmUp,
        lost_track: float = 3.0,
    ):
        self.sets = [dict(parameters) for parameters in sets]
        self.restarts = 0
        self._boxes = [make(parameters) for parameters in self.sets]
        self._T_own_sensor = np.tile(np.eye(4), (len(self.sets), 1, 1))
        self._weights = np.eye(len(self.sets))[0]
        self._lost_track = lost_track
        self._recent = _Recent(warm_up, self._boxes[0])

    def prepare(self, scan: Scan) -> Stamped:
        """See `Odometry.prepare`."""
        return Stamped.by(self._boxes[0], scan)

    def configure(self, parameters: ParameterSet) -> None:
        """Give all the weight to the instance that has these parameters.

        Raises
        ------
        OdometryError
            If none has.
        """
        if parameters not in self.sets:
            raise OdometryError(f"no instance of the bank has the parameters {parameters}")
        self._weights = np.eye(len(self.sets))[self.sets.index(parameters)]

    def weigh(self, weights: Sequence[float]) -> None:
        """Give each instance a weight, of shape (n_instances,)."""
        self._weights = np.array(weights, np.float64)

    def start(
        self, prepared: Stamped, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """See `Odometry.start`."""
        for box in self._boxes:
            box.start(prepared.prepared, T_odom_sensor, T_previous_current)
        self._T_own_sensor[:] = T_odom_sensor
        self._recent.begin(prepared, T_odom_sensor, T_previous_current)

    def register(self, prepared: Stamped) -> Registration:
        """See `Odometry.register`."""
        registrations = _register_all(self._boxes, prepared.prepared)
        T_own_before = self._T_own_sensor
        self._T_own_sensor = np.array([r.T_odom_sensor for r in registrations])
        T_previous_current = invert(T_own_before) @ self._T_own_sensor
        seconds = (prepared.stamp - self._recent.last.scan.stamp) * 1e-9
        agreeing = agreement(T_previous_current, self._weights, self._lost_track * seconds)
        if not agreeing.any():
            return Registration(np.full((4, 4), np.nan), registered=False)
        shares = share(self._weights, agreeing)[agreeing]
        T_moved = mean_motion(T_previous_current[agreeing], shares)
        T_odom_sensor = rectify(self._recent.pose @ T_moved)
        self._recent.add(prepared, T_odom_sensor)
        for i in np.flatnonzero(~agreeing):
            # One that stands alone may be the one that is not lost.
            if agreeing.sum() > 1 or not np.isfinite(T_previous_current[i]).all():
                self._T_own_sensor[i] = self._recent.warm_up(self._boxes[i])
                self.restarts += 1
        registered = any(
            r.registered for r, its in zip(registrations, agreeing, strict=True) if its
        )
        return Registration(T_odom_sensor, registered)


def _register_all(boxes: Sequence[Box], prepared: Any) -> list[Registration]:
    """Register a scan with every instance; those in processes of their own work side by side."""
    for box in boxes:
        if isinstance(box, Isolated):
            box.request(prepared)
    return [box.result() if isinstance(box, Isolated) else box.register(prepared) for box in boxes]


def agreement(
    T_previous_current: Poses,
    weights: NDArray[np.float64],
    bound: float | NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Which motions over a scan to believe: those near the one that most others are near to.

    Parameters
    ----------
    T_previous_current
        Of shape (..., n_instances, 4, 4); NaN where there is none.
    weights
        Of shape (..., n_instances). The first instance's counts `TRUST` more.
    bound
        Metres by which two motions may differ and agree, of shape (..., 1, 1).

    Returns
    -------
    ndarray of shape (..., n_instances)
        Nowhere true where there is no motion at all.
    """
    moved = T_previous_current[..., :3, 3]
    known = np.asarray(np.isfinite(T_previous_current).all(axis=(-2, -1)))
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(moved[..., :, None, :] - moved[..., None, :, :], axis=-1)
    near = np.asarray((apart <= bound) & known[..., None, :] & known[..., :, None])
    # Of those that have no weight, two that agree are heard more than one.
    votes = weights + 1e-9
    votes[..., 0] += TRUST
    heard = (near * votes[..., None, :]).sum(axis=-1)
    return np.asarray(
        np.take_along_axis(near, heard.argmax(axis=-1)[..., None, None], -2)[..., 0, :]
    )


def share(weights: NDArray[np.float64], agreeing: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Weights of those that agree; where they have none, each as much, of shape (..., n)."""
    shares = np.where(agreeing, weights, 0.0)
    return np.where(shares.any(axis=-1, keepdims=True), shares, agreeing.astype(np.float64))
