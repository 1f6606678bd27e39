"""An odometry's own error, estimated without ground truth from chains of hops.

A hop is shorter than the sub-trajectories whose error is wanted, and an odometry's errors over a
few metres are much like the registration's. So hops that follow each other are chained, until they
reach over a sub-trajectory, where the odometry's errors are several times the chain's.
"""

from collections import deque
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert
from adaptune.live.hops import LENGTHS, METRES, Hop, windows

OWN_SECONDS = 60.0
"""A chain counts as long as it is no older, or its start is among the last metres."""
MIN_COVERED = 0.5
"""Least share of a chain that its hops cover; in between, the odometry's own motion is taken."""
MIN_REACH = 0.8  # a chain that reaches over this share of the length is long enough
GROWTH = -0.15
"""The error over some metres, as a share of them, grows with this power of the metres."""
LOG_DEVIATION = 0.3
"""Standard deviation of the logarithm of an estimate that rests on one chain; and of one that is
scaled to e times the metres of its chains."""
SCATTER = 0.6
"""Standard deviation of the logarithm of the error from one sub-trajectory to the next."""
HOP_ERROR = 0.05
"""Metres by which a hop itself may be wrong at most, and where no others tell."""
FEWEST_PAIRS = 4  # of hops that overlap by half, from which on they tell how wrong they are
HIDDEN = 0.0075  # metres of an odometry's error that a hop may have, too, and so hide
PREDICTED_WINDOWS = 2.0  # how many chains that do not overlap a prediction from training counts as
DEVIATION, COMMON = 0.64, 0.1
"""Standard deviation of the logarithm of one such chain's error, or of the prediction; and the part
of its variance that all have in common."""
LEAST = 0.01  # percent; no odometry is better
CONTRADICTED = 2.0
"""A prediction does not count where the error is surely more than so many times as large."""
SIMILAR = 0.1  # a prediction counts less and less in places that are less familiar than this


class OwnError(NamedTuple):
    """An odometry's own error, estimated without ground truth, in percent of the distance."""

    mean: float
    low: float  # 95 % interval
    high: float


class Link(NamedTuple):
    """A hop, and what the odometry believed of its ends."""

    start: float  # metres driven
    end: float
    seconds: float  # time of its end
    T_odom_start: Poses
    T_odom_end: Poses
    hop: Hop


class _Chain(NamedTuple):
    """The odometry's error over a chain of hops."""

    start: float  # metres driven
    end: float
    seconds: float
    error: float  # metres
    hops: int  # how many
    covered: float  # metres that they cover


class OwnErrors:
    """Chains of the last hops, or of a whole recording, for the mean error over `length` metres."""

    def __init__(self, length: float, whole: bool = False, seconds: float = OWN_SECONDS):
        self._length, self._whole, self._seconds = length, whole, seconds
        self._links: deque[Link] = deque()
        self._chains: deque[_Chain] = deque()

    def add(self, link: Link) -> None:
        """Add the newest hop."""
        self._links.append(link)
        while link.end - self._links[0].end > self._length + LENGTHS[0] / MIN_COVERED:
            self._links.popleft()
        self._chains.append(_chain(self._links, self._length))
        if self._whole:
            return
        until, behind = link.seconds - self._seconds, link.end - max(METRES, self._length)
        while self._chains[0].seconds < until and self._chains[0].start < behind:
            self._chains.popleft()

    def interrupt(self) -> None:
        """Let no later chain begin at a hop so far: in between, the poses are unknown."""
        self._links.clear()

    @property
    def complete(self) -> bool:
        """Whether the newest chain reaches over a sub-trajectory."""
        newest = self._chains[-1] if self._chains else None
        return newest is not None and newest.end - newest.start >= MIN_REACH * self._length

    @property
    def begin(self) -> float:
        """Metres driven where the oldest chain begins that counts."""
        return min(chain.start for chain in self._chains)

    def estimate(self) -> OwnError | None:
        """The mean error over the last chains; None without any."""
        if not self._chains:
            return None
        (start, end, error, hops, covered), times = self._long_chains()
        reach = end - start
        mean = times**GROWTH * float((100.0 * error / reach).mean())
        n = windows(start, end)
        # What no hop covers may be another sort of place.
        missed = max(0.0, 1.0 - n * float(covered.mean()) / float(end.max() - start.min()))
        of_one = LOG_DEVIATION**2 + SCATTER**2 * missed
        deviation = np.sqrt(of_one / n + (LOG_DEVIATION * np.log(times)) ** 2)
        factor = float(np.exp(1.96 * deviation))
        # Some of it, or all, may be what the hops are wrong by.
        of_a_metre = times**GROWTH * float((100.0 * np.sqrt(hops) / reach).mean())
        low = float(np.sqrt(max(0.0, mean**2 - (self._hop_error() * of_a_metre) ** 2))) / factor
        return OwnError(mean, low, float(np.hypot(mean * factor, HIDDEN * of_a_metre)))

    def estimate_with(self, predicted: float, share: float) -> OwnError | None:
        """The mean error by the last chains, and by what training predicts, in percent.

        Chains have outliers, so that their geometric mean is the better estimate. `share`, from 0
        to 1, says how far the prediction counts. None without any chain.
        """
        if not self._chains:
            return None
        (start, end, error, *_), times = self._long_chains()
        measured = np.log(np.maximum(LEAST, times**GROWTH * 100.0 * error / (end - start))).mean()
        n, prior = windows(start, end), PREDICTED_WINDOWS * share
        mean = float(np.exp((n * measured + prior * np.log(max(LEAST, predicted))) / (n + prior)))
        variance = DEVIATION**2 * (1.0 / (n + prior) + COMMON)
        factor = float(np.exp(1.96 * np.sqrt(variance + (LOG_DEVIATION * np.log(times)) ** 2)))
        return OwnError(mean, mean / factor, mean * factor)

    def _hop_error(self) -> float:
        """Metres by which hops are wrong: where two overlap, the odometry errs about alike."""
        apart = [
            _wrong(link) - _wrong(before)
            for before, link in pairwise(self._links)
            if before.end - link.start > 0.5 * max(before.end - before.start, link.end - link.start)
        ]
        if self._whole or len(apart) < FEWEST_PAIRS:
            return HOP_ERROR
        return float(
            np.clip(np.sqrt(0.5 * (np.array(apart) ** 2).sum() / len(apart)), HIDDEN, HOP_ERROR)
        )

    def _long_chains(self) -> tuple[NDArray[np.float64], float]:
        """Starts, ends, errors, hops and covers of long chains, and the length in theirs."""
        start, end, _, *others = np.array(self._chains).T
        reach = end - start
        # Of a whole recording, the last chain may be a short one.
        usual = float(reach.max() if self._whole else reach[-1])
        long = reach >= MIN_REACH * min(self._length, usual)
        times = max(1.0, self._length / float(reach[long].mean()))
        return np.stack([start, end, *others])[:, long], times


def _chain(links: deque[Link], length: float) -> _Chain:
    """Chain hops from the newest back until they reach over a length, or none is near enough."""
    first = newest = links[-1]
    covered, n = newest.end - newest.start, 1
    T = _completed(newest)
    for link in reversed(links):
        if newest.end - first.start >= MIN_REACH * length:
            break
        if link.end > first.start:
            continue
        metres = covered + link.end - link.start
        if metres < MIN_COVERED * (newest.end - link.start):
            break
        T = _completed(link) @ (invert(link.T_odom_end) @ first.T_odom_start) @ T
        first, covered, n = link, metres, n + 1
    T_odom = invert(first.T_odom_start) @ newest.T_odom_end
    error = float(np.linalg.norm(T_odom[:3, 3] - T[:3, 3]))
    # Between the hops it errs, too, and not in the same direction.
    error *= float(np.sqrt((newest.end - first.start) / covered))
    return _Chain(first.start, newest.end, newest.seconds, error, n, covered)


def _wrong(link: Link) -> NDArray[np.float64]:
    """What the odometry's motion differs by from the hop's, in metres, of shape (3,)."""
    T_odom = invert(link.T_odom_start) @ link.T_odom_end
    return np.asarray(T_odom[:3, 3] - _completed(link)[:3, 3])


def _completed(link: Link) -> Poses:
    """The hop's motion; in directions that it cannot tell, the odometry's."""
    T_odom = invert(link.T_odom_start) @ link.T_odom_end
    T: NDArray[np.float64] = link.hop.T_start_end.copy()
    unknown = np.eye(3) - link.hop.projection
    T[:3, 3] = link.hop.projection @ T[:3, 3] + unknown @ T_odom[:3, 3]
    return T
