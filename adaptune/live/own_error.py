"""An odometry's own error, estimated without ground truth from chains of hops.

A hop is shorter than the sub-trajectories whose error is wanted, and an odometry's errors over a
few metres are much like the registration's. So hops that follow each other are chained, until they
reach over a sub-trajectory. There the odometry's errors, above all those of its rotation, are
several times the chain's.
"""

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert
from adaptune.live.hop import LENGTHS, Hop
from adaptune.live.squares import METRES, SECONDS, windows

COVERED = 0.5
"""Least share of a chain that its hops cover; in between, the odometry's own motion is taken."""
NEARLY = 0.8
"""A chain that reaches over this share of the length is long enough."""
GROWTH = -0.15
"""The error over some metres, as a share of them, grows with this power of the metres."""
UNSURE = 0.3
"""Standard deviation of the logarithm of an estimate that rests on one chain; and of one that is
scaled to e times the metres of its chains."""
HOP_ERROR = 0.05
"""Metres by which a hop itself is wrong where registrations are worst, as among plants."""


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


class OwnErrors:
    """Chains of the last hops.

    Parameters
    ----------
    length
        Metres of the sub-trajectories whose mean error is estimated.
    whole
        Whether to keep the chains of a whole recording, not only the last ones.
    """

    def __init__(self, length: float, whole: bool = False):
        self._length, self._whole = length, whole
        self._links: deque[Link] = deque()
        self._chains: deque[_Chain] = deque()

    def add(self, link: Link) -> None:
        """Add the newest hop."""
        self._links.append(link)
        while link.end - self._links[0].end > self._length + LENGTHS[0] / COVERED:
            self._links.popleft()
        self._chains.append(_chain(self._links, self._length))
        if self._whole:
            return
        until, behind = link.seconds - SECONDS, link.end - max(METRES, self._length)
        while self._chains[0].seconds < until and self._chains[0].start < behind:
            self._chains.popleft()

    def interrupt(self) -> None:
        """Let no later chain begin at a hop so far: in between, the poses are unknown."""
        self._links.clear()

    def clear(self) -> None:
        """Forget the hops so far."""
        self._links.clear()
        self._chains.clear()

    @property
    def begin(self) -> float:
        """Metres driven where the oldest chain begins that counts."""
        return min(chain.start for chain in self._chains)

    def estimate(self) -> OwnError | None:
        """The mean error over the last chains; None without any."""
        if not self._chains:
            return None
        start, end, _, error, hops = np.array(self._chains).T
        reach = end - start
        # Of a whole recording, the last chain may be a short one.
        usual = float(reach.max() if self._whole else reach[-1])
        long = reach >= NEARLY * min(self._length, usual)
        start, end, reach, error, hops = (of[long] for of in (start, end, reach, error, hops))
        times = max(1.0, self._length / float(reach.mean()))
        mean = times**GROWTH * float((100.0 * error / reach).mean())
        deviation = UNSURE * np.sqrt(1.0 / windows(start, end) + np.log(times) ** 2)
        factor = float(np.exp(1.96 * deviation))
        # Some of it, or all, may be what the hops are wrong by.
        of_hops = times**GROWTH * float((100.0 * HOP_ERROR * np.sqrt(hops) / reach).mean())
        low = float(np.sqrt(max(0.0, mean**2 - of_hops**2))) / factor
        return OwnError(mean, low, mean * factor)


def _chain(links: deque[Link], length: float) -> _Chain:
    """Chain hops from the newest back until they reach over a length, or none is near enough."""
    first = newest = links[-1]
    covered, n = newest.end - newest.start, 1
    T = _completed(newest)
    for link in reversed(links):
        if newest.end - first.start >= NEARLY * length:
            break
        if link.end > first.start:
            continue
        metres = covered + link.end - link.start
        if metres < COVERED * (newest.end - link.start):
            break
        T = _completed(link) @ (invert(link.T_odom_end) @ first.T_odom_start) @ T
        first, covered, n = link, metres, n + 1
    T_odom = invert(first.T_odom_start) @ newest.T_odom_end
    error = float(np.linalg.norm(T_odom[:3, 3] - T[:3, 3]))
    # Between the hops it errs, too, and not in the same direction.
    error *= float(np.sqrt((newest.end - first.start) / covered))
    return _Chain(first.start, newest.end, newest.seconds, error, n)


def _completed(link: Link) -> Poses:
    """The hop's motion; in directions that it cannot tell, the odometry's."""
    T_odom = invert(link.T_odom_start) @ link.T_odom_end
    T: NDArray[np.float64] = link.hop.T_start_end.copy()
    unknown = np.eye(3) - link.hop.projection
    T[:3, 3] = link.hop.projection @ T[:3, 3] + unknown @ T_odom[:3, 3]
    return T
