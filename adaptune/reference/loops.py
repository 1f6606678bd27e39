"""Registrations where the path comes by again."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import Poses, invert, steps
from adaptune.live.hop import HopCloud, register
from adaptune.metrics import travelled
from adaptune.reference.graph import Edge
from adaptune.sequence.scan import Scan

LATER = 30.0
"""Metres driven until a place counts as one that the path comes by again."""
NEAR = 3.0
"""Metres from such a place, at most."""
EVERY = 5.0
"""Metres driven from one to the next."""
MOST = 100
"""Places. Their scans are in memory at the same time."""
_DEPARTURE = (0.3, 0.01)
"""A registration is rejected if it departs by more than so many metres, and by more than this share
of the way between the two scans: it may be of another place that looks alike."""


class Loop(NamedTuple):
    """Two scans at the same place, by their numbers."""

    start: int
    end: int


def loops(T_world_sensor: Poses, numbers: NDArray[np.intp]) -> list[Loop]:
    """Find where a path comes by again.

    Parameters
    ----------
    T_world_sensor
        The path, of shape (n, 4, 4).
    numbers
        The poses to choose from, of shape (m,), in order.
    """
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
            found.append(Loop(int(numbers[before[int(away.argmin())]]), int(numbers[j])))
            last = metres[j]
    return found[:: -(-len(found) // MOST)] if found else []


def closed(scans: Iterable[Scan], wanted: Sequence[Loop], T_world_sensor: Poses) -> list[Edge]:
    """Register the scans of loops, which takes another pass over the recording.

    Parameters
    ----------
    scans
        The recording.
    wanted
        The loops.
    T_world_sensor
        The path as it is known so far, of shape (n, 4, 4).
    """
    numbers, motions = {number for loop in wanted for number in loop}, steps(T_world_sensor)
    clouds: dict[int, HopCloud] = {}
    last: Scan | None = None
    for number, scan in enumerate(scans):
        if last is not None and number - 1 in numbers:
            seconds = (scan.stamp - last.stamp) * 1e-9
            cloud = clouds[number - 1] = HopCloud(last, motions[number - 1], seconds)
            _ = cloud.prepared  # the scan itself is not kept
        last = scan
    metres, edges = travelled(T_world_sensor), []
    for start, end in wanted:
        if start not in clouds or end not in clouds:
            continue  # the last scan, whose motion is not known
        T = invert(T_world_sensor[start]) @ T_world_sensor[end]
        hop = register(clouds[start], clouds[end], [T])
        most = max(_DEPARTURE[0], _DEPARTURE[1] * (metres[end] - metres[start]))
        if hop is not None and np.linalg.norm(hop.T_start_end[:3, 3] - T[:3, 3]) <= most:
            edges.append(Edge(start, end, hop, again=True))
    return edges
