"""Where scans stand still while the reference moves: a lift or a ferry carries the robot.

Both are right, and no odometry can see such a motion: nothing is judged there.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import Finding
from adaptune.geometry import Poses, invert, rotation_angle
from adaptune.live.hops import OFFLINE_REACHES, HopCloud, register
from adaptune.metrics import window_ends
from adaptune.recording.scan import Recording, Scan
from adaptune.trajectory import Trajectory

_NEAR, _FAR = 1.0, 2.5  # metres that the reference moves between two scans that are compared
_STANDS = 0.1  # by which share of them, and radians, scans that stand seem to move at most
_FEWEST, _SHORTEST = 2, 2_000_000_000  # comparisons in a row, and nanoseconds, from which it counts
_COMPARISON_PERIOD = 1_000_000_000  # nanoseconds to the next comparison where the scans move


class _Pair(NamedTuple):
    start: int  # nanoseconds
    end: int
    metres: float  # that the reference moves
    stands: bool  # whether the scans stand still
    agrees: bool  # whether they move as the reference does


class Carried:
    """Compares scans with their reference as they are read; of some metres, two are enough."""

    def __init__(self) -> None:
        self._pairs: list[_Pair] = []
        self._before: tuple[int, Poses, HopCloud] | None = None
        self._alone = False  # scans moved while the reference stood, as by another clock

    def see(self, scan: Scan, T_ref_sensor: Poses) -> None:
        """See the next scan, and its reference, of shape (4, 4)."""
        here = scan.stamp, T_ref_sensor, HopCloud(scan, np.eye(4), 0.0)
        before, pairs = self._before, self._pairs
        if before is None or np.isnan(T_ref_sensor).any():
            rests = (
                pairs and not pairs[-1].stands and scan.stamp < pairs[-1].end + _COMPARISON_PERIOD
            )
            self._before = None if rests or np.isnan(T_ref_sensor).any() else here
            return
        T = invert(before[1]) @ T_ref_sensor
        metres = float(np.linalg.norm(T[:3, 3]))
        if _NEAR <= metres <= _FAR:
            pairs.append(_Pair(before[0], scan.stamp, metres, *_compared(before[2], here[2], T)))
            self._before = here if pairs[-1].stands else None
        elif metres > _FAR or (metres < _STANDS and scan.stamp > before[0] + _COMPARISON_PERIOD):
            hop = register(before[2], here[2], [T]) if metres < _STANDS else None
            if hop is not None and np.linalg.norm(hop.T_start_end[:3, 3]) > 0.5 * _NEAR:
                self._alone = True
            self._before = here

    def findings(self, begin: int) -> list[Finding]:
        """The segments, whose poses do not count; seconds from `begin`, in nanoseconds, on."""
        pairs, found = self._pairs, []
        stand = np.array([False, *(pair.stands for pair in pairs), False])
        agree = sum(pair.agrees for pair in pairs)
        if self._alone or agree < max(_FEWEST, 0.5 * (~stand[1:-1]).sum()):
            return []  # the reference is wrong elsewhere, too, or the scans are in a map's frame
        for first, stop in np.flatnonzero(np.diff(stand)).reshape(-1, 2).tolist():
            start, end = pairs[first].start, pairs[stop - 1].end
            if stop - first < _FEWEST or end - start < _SHORTEST:
                continue
            metres = sum(pair.metres for pair in pairs[first:stop])
            what = f"the scans stand still while the reference moves by {metres:.1f} m and more"
            # It begins, and ends, during the pairs beside.
            beside = pairs[first - 1 : first], pairs[stop : stop + 1]
            start = max([begin, start - _SHORTEST, *(pair.start for pair in beside[0])])
            end = min([end + _SHORTEST, *(pair.end for pair in beside[1])])
            seconds = ((start - begin) * 1e-9, (end - begin) * 1e-9)
            mend = "a lift or a ferry may carry the robot: these poses are left out"
            found.append(Finding((), what, mend, seconds, of="reference"))
        return found


def _compared(start: HopCloud, end: HopCloud, T_start_end: Poses) -> tuple[bool, bool]:
    """Whether scans stand still, or move as their reference, from which they are registered."""
    way, metres = T_start_end[:3, 3], float(np.linalg.norm(T_start_end[:3, 3]))
    hop = register(start, end, [T_start_end], reaches=OFFLINE_REACHES)
    if hop is None or np.linalg.norm(hop.projection @ way) < (1.0 - _STANDS) * metres:
        return False, hop is not None
    moved = hop.T_start_end[:3, 3]
    near = [bool(np.linalg.norm(moved - other) < _STANDS * metres) for other in (0.0 * way, way)]
    return near[0] and bool(rotation_angle(hop.T_start_end) < _STANDS), near[1]


def left_out(
    stamps: NDArray[np.int64], findings: Iterable[Finding], begin: int
) -> NDArray[np.bool_]:
    """Which stamps lie in the segments that findings name, of shape (n,)."""
    seconds, lost = (stamps - begin) * 1e-9, np.zeros(len(stamps), bool)
    for start, end in (finding.seconds for finding in findings if finding.seconds is not None):
        lost |= (seconds >= start) & (seconds <= end)
    return lost


def without(reference: Trajectory, findings: Sequence[Finding], begin: int) -> Trajectory:
    """The reference, which is unknown in these segments."""
    if not (lost := left_out(reference.stamps, findings, begin)).any():
        return reference
    gaps = (f.seconds[1] - f.seconds[0] for f in findings if f.seconds is not None)
    known = reference.stamps[~lost], reference.T_world_sensor[~lost]
    return Trajectory(*known, min(reference.max_gap, *gaps))


def begin_of(scans: Recording, stamps: NDArray[np.int64]) -> int:
    """Nanoseconds at which a recording begins, of which these scans are read."""
    return int(stamps[0]) - round(1e9 * getattr(scans, "start", 0.0))


def may_be_carried(T_ref_sensor: Poses, T_odom_sensor: Poses) -> bool:
    """Whether an odometry stands still somewhere while the reference moves; (n, 4, 4) each."""
    return bool(stands(T_ref_sensor, T_odom_sensor).any())


def stands(T_ref_sensor: Poses, T_odom_sensor: Poses) -> NDArray[np.bool_]:
    """From which poses on an odometry stands still while the reference moves, of shape (n,)."""
    ends = window_ends(T_ref_sensor, 2.0 * _NEAR)
    starts, still = np.flatnonzero(ends >= 0), np.zeros(len(ends), bool)
    ways = (T[ends[starts], :3, 3] - T[starts, :3, 3] for T in (T_ref_sensor, T_odom_sensor))
    moved, others = (np.linalg.norm(way, axis=1) for way in ways)
    still[starts] = (moved > _NEAR) & (others < _STANDS * moved)
    return still
