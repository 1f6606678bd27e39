"""Hops along a recording whose poses are known, at least in part."""

from collections.abc import Callable, Iterable

import numpy as np

from adaptune.geometry import Poses, invert
from adaptune.live.hop import Hop, Hops
from adaptune.live.live_evidence import LiveEvidence
from adaptune.odometry.base import Motions
from adaptune.sequence.scan import Scan

PERIOD = 1_000_000_000
"""Nanoseconds from one registration to the next."""


def hops_along(
    scans: Iterable[tuple[Scan, Poses]], advance: Callable[[int], None] = lambda _: None
) -> Hops:
    """Register scans directly to those some metres before, once a second.

    The known poses take the odometry's place: they give each registration its first guess. Where
    they are unknown, nothing is measured.

    Parameters
    ----------
    scans
        Scans with their poses, each of shape (4, 4), NaN where it is unknown.
    advance
        Called after every scan with how many are done.
    """
    live = LiveEvidence()
    found: list[tuple[int, int, Hop]] = []
    frame_of: dict[int, int] = {}
    due, last, step = 0, np.full((4, 4), np.nan), np.eye(4)
    for i, (scan, T) in enumerate(scans):
        before, step = step, invert(last) @ T if i else np.eye(4)
        if not np.isfinite(step).all():
            live.reset()
        # The motion over the scan before, as an odometry knows it.
        known = before if np.isfinite(before).all() else np.eye(4)
        live.observe(scan.stamp, scan, Motions(known, {}))
        frame_of[scan.stamp] = i
        due = due if i else scan.stamp
        if scan.stamp >= due:
            due += (int(scan.stamp - due) // PERIOD + 1) * PERIOD
            if (one := live.measure()) is not None:
                found.append((frame_of[one.start], frame_of[one.end], one.hop))
        last = T
        advance(i + 1)
    return Hops.of(found)
