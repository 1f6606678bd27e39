"""What all drives on a recording share: its scans, described, its segments, and its hops."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system.progress import Progress, unseen, watched
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses, invert, scale
from adaptune.live.evidence import hops_along
from adaptune.metrics import KITTI_LENGTHS, travelled, window_ends
from adaptune.model.descriptor import Describer, DescriptorError, lowest_elevation
from adaptune.odometry.base import MIN_POINTS
from adaptune.recording.scan import Scan
from adaptune.runs.archive import Frames
from adaptune.study.sequences import StudySequences
from adaptune.trajectory import Trajectory
from offline.config import OfflineStudyConfig


class Segment(NamedTuple):
    """A segment of a recording, as it is driven."""

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
"""Seconds of the reference whose mean motion leads to the begin of a segment: one step is noisy."""


def segments_along(name: str, frames: Frames) -> list[Segment]:
    """The segments of a sequence that are driven."""
    T_ref_sensor, stamps = frames.T_ref_sensor, frames.stamps
    found = []
    for first, _, end in frames.segments.tolist():
        before = int(np.searchsorted(stamps, stamps[first] - round(RECENT * 1e9)))
        known = not np.isnan(T_ref_sensor[first, 0, 0])
        T_odom_start = T_ref_sensor[first] if first and known else np.eye(4)
        T_before_start = None
        if before < first and known and np.isfinite(T_ref_sensor[before]).all():
            moved = invert(T_ref_sensor[before]) @ T_ref_sensor[first]
            share = (stamps[first] - stamps[first - 1]) / (stamps[first] - stamps[before])
            T_before_start = scale(moved, float(share))
        found.append(Segment(name, first, stamps[first:end], T_odom_start, T_before_start))
    return found


SEGMENT, OVERHANG = 2.0, 1.0
"""Sub-trajectories that begin along a segment, and that it is longer than that."""
WARM_UP = 20.0, 6.0
"""Metres and seconds that do not count where a segment begins within a recording, without a map."""
MOST_DRIVEN = 0.7
"""Share of a recording above which all of it is driven."""


def segments_of(
    T_ref_sensor: Poses, stamps: NDArray[np.int64], length: float, n: int | None
) -> NDArray[np.intp]:
    """Choose `n` segments, evenly spaced along the reference's path; None for all of it.

    Returns shape (k, 3), see `Frames.segments`.
    """
    metres, seconds = travelled(T_ref_sensor), (stamps - stamps[0]) * 1e-9
    whole = np.array([[0, 0, len(stamps)]], np.intp)
    size = (SEGMENT + OVERHANG) * length
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


def describe(
    config: OfflineStudyConfig, sequences: StudySequences, name: str, progress: Progress = unseen
) -> Frames:
    """Read a whole sequence, and describe its scans.

    There is an AdaptuneError if it cannot be read, or no error can be measured on it.
    """
    key, scans = sequences.key(name), sequences.open(name)
    reference = scans.reference()
    if reference is None:
        raise AdaptuneError(f"{key}: training needs a reference trajectory")
    stamps, descriptors, elevations, enough = [], [], [], False
    try:
        describer = Describer(config.descriptor)
        for scan in watched(scans, scans.n_messages, "reading", progress):
            enough = enough or len(scan) >= MIN_POINTS
            stamps.append(scan.stamp)
            descriptors.append(describer(scan))
            elevations.append(lowest_elevation(scan))
    except DescriptorError as error:
        raise AdaptuneError(f"sequences.{name}: {error}") from error
    if not enough:
        raise AdaptuneError(
            f"sequences.{name}: none of its {len(stamps)} scans has {MIN_POINTS} points; check "
            f"`points` and what the sensor recorded"
        )
    at = np.array(stamps, np.int64)
    T_ref_sensor = reference_poses(key, reference, at, config)
    described, elevation = np.array(descriptors), np.array(elevations, np.float32)
    segments = segments_of(T_ref_sensor, at, config.sub_trajectory, config.segments)
    return Frames(at, T_ref_sensor, described, describer.blocks, elevation, segments=segments)


def reference_poses(
    key: str, reference: Trajectory, stamps: NDArray[np.int64], config: OfflineStudyConfig
) -> Poses:
    """Reference poses at the scans' stamps, of shape (n, 4, 4), NaN where they are not known.

    There is an AdaptuneError if no error can be measured on the sequence.
    """
    T_ref_sensor = reference.at(stamps)
    whole = (window_ends(T_ref_sensor, config.sub_trajectory) >= 0).any()
    if not whole and reference.sparse:
        raise AdaptuneError(f"{key}: {reference.sparse}")
    if np.isnan(T_ref_sensor).all():
        raise AdaptuneError(
            f"{key}: the reference does not overlap the scans in time; check that both "
            f"are of the same recording and clock"
        )
    if not whole:
        metres = travelled(T_ref_sensor[~np.isnan(T_ref_sensor[:, 0, 0])])[-1]
        raise AdaptuneError(
            f"{key}: its path of {metres:.1f} m holds no sub-trajectory of "
            f"{config.sub_trajectory:g} m; make sub_trajectory shorter or the sequence longer"
        )
    shortest = min(KITTI_LENGTHS)
    if "kitti" in config.offline.objective and not (window_ends(T_ref_sensor, shortest) >= 0).any():
        raise AdaptuneError(
            f"{key}: its path holds no sub-trajectory of {shortest:g} m, the shortest "
            f"of KITTI's error; judge by another metric (offline.objective)"
        )
    return T_ref_sensor


def with_measured_hops(
    scans: Iterable[Scan], frames: Frames, progress: Progress = unseen
) -> Frames:
    """The frames with the hops along them, see `hops_along`, and what evidence takes there."""
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
    of = "registering hops of"
    hops = hops_along(with_poses, lambda done: progress(of, done, n), checks=True)
    seconds = time.process_time() - begin - reading
    return replace(frames, hops=hops, evidence_ms=1e3 * seconds / n)
