"""What all drives on a recording share: its scans, described, and the hops along them."""

import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Frames
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.live.evidence import hops_along
from adaptune.metrics import KITTI_LENGTHS, travelled, window_ends
from adaptune.model.descriptor import (
    Describer,
    DescriptorError,
    fill_in,
    lowest_elevation,
    speed_and_turn_rate,
)
from adaptune.odometry.base import MIN_POINTS
from adaptune.progress import Progress, unseen, watched
from adaptune.recording.scan import Scan
from adaptune.study.sequences import StudySequences
from adaptune.trajectory import Trajectory
from offline.config import OfflineStudyConfig
from offline.stretches import stretches_of


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
    described = np.array(descriptors)
    # When a scan is described online, the pose of the scan before is known.
    motion = speed_and_turn_rate(at, T_ref_sensor)
    fill_in(described[1:], describer.blocks, motion[:-1])
    elevation = np.array(elevations, np.float32)
    stretches = stretches_of(T_ref_sensor, at, config.sub_trajectory, config.stretches)
    return Frames(at, T_ref_sensor, described, describer.blocks, elevation, stretches=stretches)


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
    """The frames with the hops along them, see `hops_along`, and with the CPU time they took."""
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
    hops = hops_along(with_poses, lambda done: progress("registering hops of", done, n))
    seconds = time.process_time() - begin - reading
    return replace(frames, hops=hops, evidence_ms=1e3 * seconds / n)
