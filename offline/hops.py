"""Hops along a training sequence: what a bank will measure there while it drives."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from adaptune.archive import Frames
from adaptune.live.along import hops_along
from adaptune.sequence.scan import Scan


def with_measured_hops(
    scans: Iterable[Scan], frames: Frames, advance: Callable[[int, int], None] = lambda *_: None
) -> Frames:
    """Register scans directly to those some metres before, see `hops_along`.

    Parameters
    ----------
    scans
        Of the sequence.
    frames
        Of the same scans; their reference takes the odometry's place.
    advance
        Called with how many scans are done, and how many there are.

    Returns
    -------
    Frames
        The same with the hops, and with the CPU time that they took.
    """
    n, reading = len(frames.stamps), 0.0

    def read() -> Iterator[Scan]:
        nonlocal reading
        begin = time.process_time()
        for scan in scans:
            reading += time.process_time() - begin
            yield scan
            begin = time.process_time()

    begin = time.process_time()
    with_poses = zip(read(), frames.T_ref_sensor, strict=True)
    hops = hops_along(with_poses, lambda done: advance(done, n))
    seconds = time.process_time() - begin - reading
    return replace(frames, hops=hops, evidence_ms=1e3 * seconds / n)
