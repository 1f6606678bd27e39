"""Hops along a training sequence: what a bank will measure there while it drives."""

from collections.abc import Callable, Iterable

from adaptune.archive import Frames
from adaptune.live.along import hops_along
from adaptune.live.hop import Hops
from adaptune.sequence.scan import Scan


def measured_hops(
    scans: Iterable[Scan], frames: Frames, advance: Callable[[int, int], None] = lambda *_: None
) -> Hops:
    """Register scans directly to those some metres before, see `hops_along`.

    Parameters
    ----------
    scans
        Of the sequence.
    frames
        Of the same scans; their reference takes the odometry's place.
    advance
        Called with how many scans are done, and how many there are.
    """
    n = len(frames.stamps)
    with_poses = zip(scans, frames.T_ref_sensor, strict=True)
    return hops_along(with_poses, lambda done: advance(done, n))
