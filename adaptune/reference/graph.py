"""The pose graph: motions on which several odometries agree, and registrations over metres.

Solved by GTSAM (Dellaert and Kaess, *Factor Graphs for Robot Perception*, 2017).
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system.forking import processes
from adaptune.bank.bank import Bank
from adaptune.geometry import Poses, invert, rectify, rotation_angle, steps
from adaptune.live.hops import NEW_GUESS, OFFLINE_CLOUD, OFFLINE_REACHES, Hop, HopCloud, register
from adaptune.metrics import travelled
from adaptune.odometry.base import InProcess
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.tracker import RESTART_WARM_UP, Tracker
from adaptune.recording.scan import Scan, read_ahead
from adaptune.space import ParameterSet, Selection

POOL: tuple[tuple[str, Mapping[str, float]], ...] = (
    ("gicp", {"max_correspondence_distance": 2.2, "keyframe_interval": 1.3}),
    ("gicp", {"max_correspondence_distance": 1.3, "keyframe_interval": 3.1}),
    ("gicp", {"max_correspondence_distance": 4.5, "keyframe_interval": 5.3}),
    ("vgicp", {"resolution": 0.9, "keyframe_interval": 1.7}),
    ("vgicp", {"resolution": 1.8, "keyframe_interval": 3.7}),
)
"""Odometries and their parameters. No study's trials are among them: the reference that judges an
odometry is not made with it."""
HALVES = ((0, 1, 2), (3, 4))  # members of either half, which have no algorithm in common
_DOWNSAMPLING = 0.45  # metres between points of their clouds


class Consensus:
    """Runs the pool scan after scan.

    A bank of even weights: members that agree move it by their mean, others are warmed up on the
    last scans at its pose.
    """

    n_members = len(POOL)

    def __init__(self) -> None:
        def make(parameters: Mapping[str, Any]) -> InProcess:
            kind, given = POOL[int(parameters["number"])]
            cls: Any = odometry_class(kind)
            made = InProcess(cls(dict(given), cls.settings_type(downsampling=_DOWNSAMPLING)))
            made.warm_up = RESTART_WARM_UP  # on open ground, that is better than none
            return made

        sets: dict[int, ParameterSet] = {n: {"number": n} for n in range(len(POOL))}
        self._bank = Bank(make, sets)
        even = dict.fromkeys(sets, 1.0)
        self._bank.apply(Selection(trial=0, parameters={}, weights=even))
        self._tracker = Tracker(self._bank, HealthCheck())

    def register(self, scan: Scan) -> tuple[Poses, Poses]:
        """Register the next scan.

        Returns the consensus's pose, of shape (4, 4), and the motions of the members, of shape
        (n_members, 4, 4), NaN where one has none.
        """
        found = self._tracker.register(scan)
        members = self._bank.motions.members
        T_previous_current = np.array([members[i] for i in range(len(POOL))])
        return found.T_odom_sensor, T_previous_current


LENGTHS = (2.0, 5.0, 10.0)
"""Metres over which scans are registered directly. Over 25 m, too little overlaps in caves."""
INTERVAL = 0.25
"""Seconds from one scan that is registered to the next: three scans of a usual LiDAR."""
SPACING = (0.2, 2.0)
"""Metres from one to the next: at least, so that a robot that stands costs nothing; and the way
after which it comes sooner."""
DEPARTURE = (0.2, 0.08)
"""A registration is rejected if it departs from the guess by more than so many metres, and by more
than this share of the way."""
MIN_INLIERS_OFFLINE = 0.3
"""Least share of points near a point of the other scan. Many registrations check each other, so it
may be lower than while driving."""


class Guess(NamedTuple):
    """A registration of two scans that began at the motion of the consensus, or of a member."""

    start: int  # numbers of the scans
    end: int
    member: int  # whose motion it began at; -1 for the consensus
    hop: Hop | None  # None if too few points lie on each other, or it departs too far


@dataclass(frozen=True, eq=False)
class Pass:
    """What one pass over a recording finds."""

    stamps: NDArray[np.int64]  # (n,): of the scans, in nanoseconds
    T_odom_sensor: Poses  # (n, 4, 4): of the consensus
    T_previous_current: Poses  # (n, n_members, 4, 4): of the members; NaN where one has none
    guesses: Sequence[Guess]  # all registrations, by end, start, and member


class _Anchor(NamedTuple):
    number: int
    stamp: int
    metres: float  # driven until there
    cloud: HopCloud
    T_odom_sensor: Poses  # (1 + n_members, 4, 4): of the consensus, then of its members


_SCANS_AHEAD = 8
"""Scans by which the consensus may be ahead of what is registered directly, and behind those that
are read: most bags are packed."""


def pass_over(scans: Iterable[Scan], advance: Callable[[int], None] = lambda _: None) -> Pass:
    """Run the consensus along a recording, and register scans directly to those before them.

    Only the scans of the last metres and seconds are kept. `advance` gets how many are done. Scans
    are registered directly in a process beside this one: that takes as long as the consensus.
    """
    consensus = Consensus()
    stamps: list[int] = []
    poses: list[Poses] = []
    motions: list[Poses] = []
    waiting: deque[Future[None]] = deque()
    with processes(1, [__name__]) as beside:
        for scan in read_ahead(scans, _SCANS_AHEAD):
            T_odom_sensor, T_previous_current = consensus.register(scan)
            waiting.append(beside.submit(_add, scan, T_odom_sensor, T_previous_current))
            stamps.append(scan.stamp)
            poses.append(T_odom_sensor)
            motions.append(T_previous_current)
            if len(waiting) > _SCANS_AHEAD:
                waiting.popleft().result()
            advance(len(stamps))
        for one in waiting:
            one.result()
        guesses = beside.submit(_guesses).result()
    return Pass(
        np.array(stamps, np.int64),
        np.array(poses).reshape(-1, 4, 4),
        np.array(motions).reshape(-1, Consensus.n_members, 4, 4),
        guesses,
    )


@cache
def _registering() -> "_Registering":
    """Of the process that registers, which ends with the pass."""
    return _Registering()


def _add(scan: Scan, T_odom_sensor: Poses, T_previous_current: Poses) -> None:
    _registering().add(scan, T_odom_sensor, T_previous_current)


def _guesses() -> list[Guess]:
    _registering().end()
    return _registering().guesses


class _Registering:
    """Registers every few scans to those some metres before."""

    def __init__(self) -> None:
        self.guesses: list[Guess] = []
        self._anchors: deque[_Anchor] = deque()
        self._tracks = np.eye(4)[None]  # (1 + n_members, 4, 4): of the consensus, then of members
        self._newest: tuple[int, Scan] | None = None
        self._T_last, self._seconds = np.eye(4), 0.0  # the last motion, and how long it took
        self._n_to_first = 0  # registrations to the first scan

    def add(self, scan: Scan, T_odom_sensor: Poses, T_previous_current: Poses) -> None:
        """Take the next scan, with the pose of the consensus and the motions of its members."""
        if self._newest is None:
            self._tracks = np.tile(T_odom_sensor, (1 + len(T_previous_current), 1, 1))
            self._newest = 0, scan
            return
        number, before = self._newest
        T = invert(self._tracks[0]) @ T_odom_sensor
        seconds = (scan.stamp - before.stamp) * 1e-9
        # How the sensor moved during a scan is known once the next one is registered.
        self._register(number, before, T, seconds)
        known = np.asarray(np.isfinite(T_previous_current).all(axis=(1, 2)))
        members = np.where(known[:, None, None], T_previous_current, T)
        self._tracks[1:] = rectify(self._tracks[1:] @ members)
        self._tracks[0] = T_odom_sensor
        self._newest = number + 1, scan
        self._T_last, self._seconds = T, seconds

    def end(self) -> None:
        """Register the last scan, however near it is to the last one that was registered."""
        if self._newest is not None and self._newest[0]:
            self._register(*self._newest, self._T_last, self._seconds, last=True)

    def _register(
        self, number: int, scan: Scan, T_current_next: Poses, seconds: float, last: bool = False
    ) -> None:
        """Register a scan if it is far enough from the one that was registered before, or last."""
        metres = 0.0
        if self._anchors:
            before = self._anchors[-1]
            # The straight way: a robot that stands does not drive by jitter.
            way = float(np.linalg.norm((invert(before.T_odom_sensor[0]) @ self._tracks[0])[:3, 3]))
            least, most = SPACING
            elapsed = (scan.stamp - before.stamp) * 1e-9
            soon = way < least or (elapsed < INTERVAL and way < most)
            if soon and not last:
                return
            metres = before.metres + way
        cloud = HopCloud(scan, T_current_next, seconds, OFFLINE_CLOUD)
        end = _Anchor(number, scan.stamp, metres, cloud, self._tracks.copy())
        for start in self._starts(metres):
            self.guesses += self._tries(start, end)
        self._anchors.append(end)
        while len(self._anchors) > 1 and metres - self._anchors[1].metres >= LENGTHS[-1]:
            self._anchors.popleft()

    def _starts(self, metres: float) -> Iterator[_Anchor]:
        """The scans to which one is registered, each once."""
        starts = []
        for length in LENGTHS:
            starts += [a for a in self._anchors if metres - a.metres >= length][-1:]
            # The robot may stand at first: without these, nothing spans its first motions.
            if self._n_to_first < len(LENGTHS) and metres >= LENGTHS[self._n_to_first]:
                starts.append(self._anchors[0])
                self._n_to_first += 1
        yield from {start.number: start for start in starts}.values()

    def _tries(self, start: _Anchor, end: _Anchor) -> Iterator[Guess]:
        """Register two scans; where the consensus does not lead there, as its members moved."""
        T_start_end = invert(start.T_odom_sensor) @ end.T_odom_sensor
        hop = _registered(start, end, T_start_end[0])
        yield Guess(start.number, end.number, -1, hop)
        tried = [T_start_end[0]]
        for member, T in enumerate(T_start_end[1:]):
            if hop is None and all(_metres_apart(T, other) > NEW_GUESS for other in tried):
                tried.append(T)
                yield Guess(start.number, end.number, member, _registered(start, end, T))


def _registered(start: _Anchor, end: _Anchor, T_start_end: Poses) -> Hop | None:
    hop = register(start.cloud, end.cloud, [T_start_end], MIN_INLIERS_OFFLINE, OFFLINE_REACHES)
    if hop is None:
        return None
    metres, share = DEPARTURE
    most = metres + share * (end.metres - start.metres)
    return hop if _metres_apart(hop.T_start_end, T_start_end) <= most else None


def _metres_apart(T: Poses, other: Poses) -> float:
    return float(np.linalg.norm(T[:3, 3] - other[:3, 3]))


_OF_A_STEP = (0.005, 0.002)
"""Metres and radians by which the motion from scan to scan is wrong, about, if it is small."""
_NOISE_SHARE = (0.05, 0.02)  # what each metre adds to the metres, and each radian to the radians
_OF_A_HOP = (0.02, 0.003)
"""Metres and radians by which a registration over `_LONG` metres is wrong, about."""
_LONG = LENGTHS[-1]
_SHORTER = (1.0, 0.5)
"""Exponents. Registrations over shorter ways are not more wrong, but many follow each other, and
what they get wrong alike adds up: on open ground, the rings of the laser on the ground pull each
towards no motion. So they count as more wrong: in metres as the way is shorter, in radians as its
square root."""
_UNKNOWN = 10.0  # metres by which a registration is wrong along a direction that it does not tell
_SOLVER_ITERATIONS = 50


class Edge(NamedTuple):
    """A registration of two scans, by their numbers; `again` if the path came by again."""

    start: int
    end: int
    hop: Hop
    again: bool = False


def optimised(
    T_odom_sensor: Poses, edges: Sequence[Edge], T_first_guess: Poses | None = None
) -> Poses:
    """The poses on which the motions of `T_odom_sensor` and registrations agree best.

    All have robust weights: a wrong one hardly counts. The search begins at `T_first_guess`, by
    default at `T_odom_sensor`. All poses are of shape (n, 4, 4).
    """
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, T in enumerate(T_odom_sensor if T_first_guess is None else T_first_guess):
        values.insert(i, gtsam.Pose3(T))
    motions = steps(T_odom_sensor)
    metres = _OF_A_STEP[0] + _NOISE_SHARE[0] * np.linalg.norm(motions[:, :3, 3], axis=1)
    radians = _OF_A_STEP[1] + _NOISE_SHARE[1] * rotation_angle(motions)
    for i, T in enumerate(motions):
        noise = _sigmas(metres[i], radians[i])
        graph.add(gtsam.BetweenFactorPose3(i, i + 1, gtsam.Pose3(T), _robust(noise)))
    for edge in edges:
        motion = gtsam.Pose3(edge.hop.T_start_end)
        noise = _robust(_noise(edge), bounded=not edge.again)
        graph.add(gtsam.BetweenFactorPose3(edge.start, edge.end, motion, noise))
    first = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), first))
    options = gtsam.LevenbergMarquardtParams()
    options.setMaxIterations(_SOLVER_ITERATIONS)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, options).optimize()
    T = np.array([found.atPose3(i).matrix() for i in range(len(T_odom_sensor))])
    return np.asarray(rectify(invert(T[0]) @ T))


def _sigmas(metres: float, radians: float) -> Any:
    import gtsam

    return gtsam.noiseModel.Diagonal.Sigmas(np.repeat([radians, metres], 3))


def _noise(edge: Edge) -> Any:
    """Noise of a registration: rotation, then translation in the frame of its end."""
    import gtsam

    hop = edge.hop
    way = float(np.linalg.norm(hop.T_start_end[:3, 3]))
    shorter = 1.0 if edge.again else _LONG / np.clip(way, LENGTHS[0], _LONG)
    metres, radians = (sigma * shorter**by for sigma, by in zip(_OF_A_HOP, _SHORTER, strict=True))
    known = np.eye(3) - hop.projection
    if np.abs(known).max() < 1e-6:
        return _sigmas(metres, radians)
    R = hop.T_start_end[:3, :3]
    covariance = np.diag(np.repeat([radians**2, metres**2], 3))
    covariance[3:, 3:] += _UNKNOWN**2 * R.T @ known @ R
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def _robust(noise: Any, bounded: bool = True) -> Any:
    """Noise with Cauchy's weights, by which one that is far off hardly counts, or with Huber's.

    Short registrations share what they get wrong, and are many: what holds together over long ways
    would count as far off.
    """
    import gtsam

    estimators = gtsam.noiseModel.mEstimator
    kernel = estimators.Cauchy(1.0) if bounded else estimators.Huber(1.345)
    return gtsam.noiseModel.Robust.Create(kernel, noise)


LATER = 30.0  # metres driven until a place counts as one that the path comes by again
NEAR = 3.0  # metres from such a place, at most
EVERY = 5.0  # metres driven from one to the next
MOST = 100  # places; their scans are in memory at the same time
_DEPARTURE = (0.3, 0.01)
"""A registration is rejected if it departs by more than so many metres, and by more than this share
of the way between the two scans: it may be of another place that looks alike."""

Loop = tuple[int, int]
"""Two scans at the same place, by their numbers."""


def loops(T_world_sensor: Poses, numbers: NDArray[np.intp]) -> list[Loop]:
    """Find where a path of shape (n, 4, 4) comes by again, among the poses of these numbers."""
    from scipy.spatial import cKDTree

    if not len(numbers):
        return []
    places, metres = T_world_sensor[numbers, :3, 3], travelled(T_world_sensor)[numbers]
    found: list[Loop] = []
    last, tree = -np.inf, cKDTree(places)
    for j in range(len(numbers)):
        if metres[j] - last < EVERY:
            continue
        if before := [
            i for i in tree.query_ball_point(places[j], NEAR) if metres[j] - metres[i] > LATER
        ]:
            away = np.linalg.norm(places[before] - places[j], axis=1)
            found.append((int(numbers[before[int(away.argmin())]]), int(numbers[j])))
            last = metres[j]
    return found[:: -(-len(found) // MOST)] if found else []


def closed(scans: Iterable[Scan], wanted: Sequence[Loop], T_world_sensor: Poses) -> list[Edge]:
    """Register the scans of loops in another pass; the path as known so far is (n, 4, 4)."""
    numbers, motions = {number for loop in wanted for number in loop}, steps(T_world_sensor)
    clouds: dict[int, HopCloud] = {}
    last: Scan | None = None
    for number, scan in enumerate(scans):
        if last is not None and number - 1 in numbers:
            seconds = (scan.stamp - last.stamp) * 1e-9
            cloud = clouds[number - 1] = HopCloud(last, motions[number - 1], seconds, OFFLINE_CLOUD)
            _ = cloud.prepared  # the scan itself is not kept
        last = scan
    metres, edges = travelled(T_world_sensor), []
    for start, end in wanted:
        if start not in clouds or end not in clouds:
            continue  # the last scan, whose motion is not known
        T = invert(T_world_sensor[start]) @ T_world_sensor[end]
        hop = register(clouds[start], clouds[end], [T], reaches=OFFLINE_REACHES)
        most = max(_DEPARTURE[0], _DEPARTURE[1] * (metres[end] - metres[start]))
        if hop is not None and np.linalg.norm(hop.T_start_end[:3, 3] - T[:3, 3]) <= most:
            edges.append(Edge(start, end, hop, again=True))
    return edges
