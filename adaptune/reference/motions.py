"""Motions that scans alone show."""

from collections.abc import Iterable, Iterator
from itertools import islice

import numpy as np

from adaptune.geometry import Poses, invert, rotation_angle
from adaptune.live.hops import OFFLINE_CLOUD, OFFLINE_REACHES, Hop, HopCloud, Hops, register
from adaptune.recording.compensation import neighbour_motions
from adaptune.recording.scan import Scan

STRETCHES, SCANS = 4, 40
"""Stretches of a recording that are looked at, evenly spread, and the scans of each."""
METRES, EACH = 4.0, 4
"""A motion is measured over so many metres, or over half a stretch if that is less, and begins at
every fourth scan of it."""
NEAR = 0.6, 0.1, 0.5
"""Metres, radians and seconds between neighbours, below which scans in between are left out."""
STANDING = 0.5
"""Metres below which a motion is noise."""
ENOUGH = 10.0
"""Metres after which the rest of a stretch is not looked at."""
MOTIONS = 12
"""Motions after which no more are measured, an equal share of them in each stretch."""
_AGREE = 0.3
"""Metres by which two ways of registering the same scans may differ."""


def measured_motions(scans: Iterable[Scan], n_scans: int) -> Hops:
    """Register scans over some metres from standing still, here and there along a recording.

    Neighbours are registered one after the other, then scans some metres apart directly. What is
    returned owes nothing to any poses. There is nothing where both ways end apart, as where the
    view is narrow.
    """
    n_stretches = min(STRETCHES, max(n_scans // SCANS, 1))
    begins = np.linspace(0, max(n_scans - SCANS, 0), n_stretches).astype(int)
    scans, position = iter(scans), 0
    found: list[tuple[int, int, Hop]] = []
    for begin in begins.tolist():
        stretch = list(islice(scans, begin - position, begin - position + SCANS))
        position = begin + SCANS
        some = islice(_motions_over(stretch), -(-MOTIONS // n_stretches))
        found += [(begin + i, begin + k, hop) for i, k, hop in some]
    return Hops.of(found)


def _stride(stretch: list[Scan]) -> int:
    """Which scans are enough where the sensor moves slowly: every one, second or fourth."""
    *_, (_, T, seconds) = neighbour_motions(stretch[:2])
    T = np.full((4, 4), np.nan) if T is None else T
    apart = np.array([np.linalg.norm(T[:3, 3]), rotation_angle(T), seconds])
    return max(n for n in (1, 2, EACH) if n == 1 or (n * apart < NEAR).all())


def _motions_over(stretch: list[Scan]) -> Iterator[tuple[int, int, Hop]]:
    """Numbers of two scans of a stretch, and the registration of one to the other."""
    if len(stretch) < 2:
        return
    stride = _stride(stretch)
    stretch = stretch[::stride]
    T: list[Poses] = []
    clouds: list[HopCloud] = []
    start = 0
    for i, (scan, step, seconds) in enumerate(neighbour_motions(stretch)):
        if i and step is None:
            break
        T.append(np.eye(4) if step is None else T[-1] @ step)
        motion = np.eye(4) if step is None else step
        clouds.append(HopCloud(scan, motion, seconds if i else 0.0, OFFLINE_CLOUD))
        if i == 1 and step is not None:
            clouds[0].moved(step, seconds)
        while start < i:
            guess = invert(T[start]) @ T[i]
            metres = np.linalg.norm(guess[:3, 3])
            if metres < METRES and i - start < SCANS // 2 // stride:
                break
            ends = clouds[start], clouds[i]
            given = [guess] if metres >= STANDING else []
            if (hop := register(*ends, given, reaches=OFFLINE_REACHES)) is not None:
                apart = hop.projection @ (hop.T_start_end - guess)[:3, 3]
                if np.linalg.norm(apart) < _AGREE:
                    yield start * stride, i * stride, hop
            start += EACH // stride
        if np.linalg.norm(T[i][:3, 3]) > ENOUGH:
            break
