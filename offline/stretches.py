"""The stretches of a recording that are driven."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Frames
from adaptune.geometry import Poses, invert, scale
from adaptune.metrics import travelled, window_ends


class Stretch(NamedTuple):
    """A stretch of a recording, as it is driven."""

    sequence: str
    first: int  # number of its first scan
    stamps: NDArray[np.int64]  # (n,): nanoseconds of its scans
    T_odom_start: Poses  # (4, 4): where a drive begins
    # (4, 4): the motion that leads there. A robot drives already where a recording is entered, and
    # is started at its begin.
    T_before_start: Poses | None

    @property
    def key(self) -> tuple[str, int, int]:
        """Identifies it among all of a study."""
        return self.sequence, self.first, len(self.stamps)


RECENT = 0.5
"""Seconds of the reference whose mean motion leads to the begin of a stretch: one step is noisy."""


def stretches_along(name: str, frames: Frames) -> list[Stretch]:
    """The stretches of a sequence that are driven."""
    T_ref_sensor, stamps = frames.T_ref_sensor, frames.stamps
    found = []
    for first, _, end in frames.stretches.tolist():
        before = int(np.searchsorted(stamps, stamps[first] - round(RECENT * 1e9)))
        known = not np.isnan(T_ref_sensor[first, 0, 0])
        T_odom_start = T_ref_sensor[first] if first and known else np.eye(4)
        T_before_start = None
        if before < first and known and np.isfinite(T_ref_sensor[before]).all():
            moved = invert(T_ref_sensor[before]) @ T_ref_sensor[first]
            share = (stamps[first] - stamps[first - 1]) / (stamps[first] - stamps[before])
            T_before_start = scale(moved, float(share))
        found.append(Stretch(name, first, stamps[first:end], T_odom_start, T_before_start))
    return found


STRETCH, OVERHANG = 2.0, 1.0
"""Sub-trajectories that begin along a stretch, and that it is longer than that."""
WARM_UP = 20.0, 6.0
"""Metres and seconds that do not count where a stretch begins within a recording, without a map."""
MOST_DRIVEN = 0.7
"""Share of a recording above which all of it is driven."""


def stretches_of(
    T_ref_sensor: Poses, stamps: NDArray[np.int64], length: float, n: int | None
) -> NDArray[np.intp]:
    """Choose `n` stretches, evenly spaced along the reference's path; None for all of it.

    Returns shape (k, 3), see `Frames.stretches`.
    """
    metres, seconds = travelled(T_ref_sensor), (stamps - stamps[0]) * 1e-9
    whole = np.array([[0, 0, len(stamps)]], np.intp)
    size = (STRETCH + OVERHANG) * length
    if n is None or n * size > metres[-1]:
        return whole

    def last(of: NDArray[np.float64], until: NDArray[np.float64]) -> NDArray[np.intp]:
        return np.maximum(np.searchsorted(of, until, side="right") - 1, 0)

    # Where the robot stands, the last scan before it moves.
    begins = last(metres, np.linspace(0.0, metres[-1] - 1.01 * size, n))
    ends = last(metres, metres[begins] + size) + 2
    warm = np.minimum(
        last(metres, np.maximum(metres[begins] - WARM_UP[0], 0.0)),
        last(seconds, seconds[begins] - WARM_UP[1]),
    )
    firsts = np.maximum(warm, last(metres, np.maximum(metres[begins] - size / 3.0, 0.0)))
    found = np.stack([firsts, begins, np.minimum(ends, len(stamps))], axis=1)
    if (firsts[1:] < ends[:-1]).any() or (ends - firsts).sum() > MOST_DRIVEN * len(stamps):
        return whole
    known = window_ends(T_ref_sensor, length) >= 0
    return found[[bool(known[begin:end].any()) for _, begin, end in found]]
