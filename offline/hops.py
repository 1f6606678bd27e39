"""Hops along a training sequence: what a bank will measure there while it drives."""

from collections.abc import Callable, Iterable

import numpy as np

from adaptune.archive import Frames
from adaptune.geometry import steps
from adaptune.live.hop import Hops
from adaptune.live.live_evidence import LiveEvidence
from adaptune.odometry.base import Motions
from adaptune.sequence.scan import Scan

PERIOD = 1_000_000_000
"""Nanoseconds from one registration to the next."""


def measured_hops(
    scans: Iterable[Scan], frames: Frames, advance: Callable[[int, int], None] = lambda *_: None
) -> Hops:
    """Register scans directly to those some metres before, once a second.

    The reference takes the odometry's place: it gives each registration its first guess. Where it
    is unknown, nothing is measured.

    Parameters
    ----------
    scans
        Of the sequence.
    frames
        Of the same scans.
    advance
        Called with how many scans are done, and how many there are.
    """
    live, found, due = LiveEvidence(), [], frames.stamps[0]
    frame_of = {stamp: i for i, stamp in enumerate(frames.stamps.tolist())}
    T_previous_current = np.concatenate([np.eye(4)[None], steps(frames.T_ref_sensor)])
    known = np.isfinite(T_previous_current).all(axis=(1, 2))
    for i, scan in enumerate(scans):
        if not known[i]:
            live.reset()
        # The motion over the scan before, as an odometry knows it.
        before = T_previous_current[i - 1] if i and known[i - 1] else np.eye(4)
        live.observe(scan.stamp, scan, Motions(before, {}))
        if scan.stamp >= due:
            due += (int(scan.stamp - due) // PERIOD + 1) * PERIOD
            if (one := live.measure()) is not None:
                found.append((frame_of[one.start], frame_of[one.end], one.hop))
        advance(i + 1, len(frames.stamps))
    return Hops.of(found)
