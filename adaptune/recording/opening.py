"""Open the sequences that a study describes."""

import math
from collections.abc import Callable
from collections.abc import Sequence as Items
from pathlib import Path
from typing import Any, NamedTuple

from adaptune.recording import cache, views
from adaptune.recording.config import (
    ESTIMATED,
    NO_REFERENCE,
    REFERENCE_FILES,
    ImuConfig,
    SequenceConfig,
    bag_paths,
    files_of,
    to_pose,
)
from adaptune.recording.folder import kitti, scan_folder
from adaptune.recording.recording import (
    ImuSettings,
    RecordedSequence,
    ReferenceSettings,
    Section,
    Source,
)
from adaptune.recording.scan import ImuNoise, Recording, SequenceError, Timing
from adaptune.recording.views import Reversible
from adaptune.trajectory import Trajectory

PRIOR_GAP = 3.0
"""Seconds. The default of `max_gap` for a prior: a GPS may give a position a second, and miss
one."""

# Livox IMUs measure acceleration in multiples of this.
_STANDARD_GRAVITY = 9.80665

_VIEWS: dict[str, Callable[[Reversible, Any], Reversible]] = {
    "cut": views.cut,
    "drop": lambda of, v: views.drop(of, v.share, (v.start, v.stop), v.seed),
    "speed": lambda of, v: views.speed(of, v.factor, (v.start, v.stop)),
    "reverse": lambda of, _: views.Reversed(of),
    "rings": views.thin_rings,
    "noise": lambda of, v: views.add_noise(of, v.sigma, v.seed),
    "transform": lambda of, v: views.transform(of, to_pose(v)),
}


def open_sequence(config: SequenceConfig) -> Recording:
    """Open what a study describes; scans are not read before they are asked for.

    A SequenceError says why it cannot be opened as described.
    """
    sequence: Reversible = _recorded(config)
    if config.compensate == "constant_velocity":
        sequence = views.WithoutMotion(sequence)
    elif config.compensate == "gyro":
        sequence = views.without_rotation(sequence)
    for view in config.views:
        sequence = _VIEWS[view.name](sequence, getattr(view, view.name))
    return sequence


def check_sequence(config: SequenceConfig) -> None:
    """Find what would fail while it is read, without reading its scans.

    A SequenceError says that it cannot be opened as described, ends before its `start`, or that its
    reference is of another time.
    """
    _recorded(config).check()
    if config.position_prior is None:
        return
    if not wants_estimate(config):
        raise SequenceError(
            f"position_prior: joins an estimated reference, and the recording has poses of its "
            f"own; write `reference: {ESTIMATED}`, or leave `position_prior` out"
        )
    _recorded(of_prior(config)).check()


def wants_estimate(config: SequenceConfig) -> bool:
    """Whether the reference of a sequence is to be estimated; a SequenceError if it cannot tell."""
    if config.reference is not None or config.bag is not None:
        return config.reference in (None, ESTIMATED)
    source, _ = _source(config)
    if config.evalio is not None:
        return source.poses(None, None) is None
    return not source.pose_files


def open_unseen(config: SequenceConfig) -> RecordedSequence:
    """The scans of a sequence as they were recorded, without views and without compensation."""
    return _recorded(config)


def position_prior(config: SequenceConfig) -> Trajectory | None:
    """Poses of the LiDAR that are right over long distances only, if the sequence names any."""
    return None if config.position_prior is None else _recorded(of_prior(config)).reference()


def prior_files(config: SequenceConfig) -> Items[Path]:
    """The files of these poses, where they are not in the recording."""
    return () if config.position_prior is None else sequence_files(of_prior(config)).reference


def of_prior(config: SequenceConfig) -> SequenceConfig:
    """The sequence with the poses of its prior as its reference."""
    gap = config.max_gap if "max_gap" in config.model_fields_set else PRIOR_GAP
    of = {"reference": config.position_prior, "position_prior": None, "max_gap": gap}
    return config.model_copy(update=of)


class SequenceFiles(NamedTuple):
    """The files that a sequence is read from."""

    recording: Items[Path]
    reference: Items[Path]  # those of the poses, where they are not in the recording


def sequence_files(config: SequenceConfig) -> SequenceFiles:
    """The files that a sequence is read from; a SequenceError if it cannot be opened."""
    reference = config.reference or ""
    own = [Path(reference)] if reference.endswith(REFERENCE_FILES) else None
    if reference in (ESTIMATED, NO_REFERENCE):
        own = []
    if config.bag is not None:
        bags = bag_paths((config.bag,) if isinstance(config.bag, str) else config.bag)
        return SequenceFiles(files_of(bags), own or ())
    source, _ = _source(config)
    return SequenceFiles(source.files, source.pose_files if own is None else own)


def interval_of(config: SequenceConfig) -> tuple[float, float]:
    """From which stamp to before which one a sequence uses its recording, in nanoseconds.

    Raises
    ------
    SequenceError
        If it cannot be opened.
    """
    recorded = _recorded(config)
    section, (first, _) = recorded.section, recorded.source.span() or (0, 0)
    stop = math.inf if section.stop is None else first + 1e9 * section.stop
    return first + 1e9 * section.start, stop


def _recorded(config: SequenceConfig) -> RecordedSequence:
    from adaptune.recording.bag import IMU_TYPES, BagSource  # rosbags takes long to import

    given = config.reference not in (ESTIMATED, NO_REFERENCE)
    reference: str | Path | None = config.reference if given else None
    if isinstance(reference, str) and reference.endswith(REFERENCE_FILES):
        reference = Path(reference)
        if not reference.is_file():
            raise SequenceError(f"{reference}: there is no such file")
    source, key = _source(config)
    if isinstance(source, BagSource):
        topic = reference if isinstance(reference, str) else None
        source.check(topic, None if config.imu is None else config.imu.topic)
        if config.imu is not None and config.bag is not None:
            source.topic(config.imu.topic, IMU_TYPES, "an IMU's measurements")
    T = None if config.extrinsic is None else to_pose(config.extrinsic)
    settings = ReferenceSettings(
        reference, config.child_frame, T, config.clock_offset, config.max_gap, given
    )
    section = _section(config)
    if config.part is not None and (span := source.span()) is not None:
        section = section.part(config.part, (span[1] - span[0]) * 1e-9)
    return RecordedSequence(source, section, settings, imu_settings(config.imu), key)


def _source(config: SequenceConfig) -> tuple[Source, str | None]:
    """What reads the recording, and under which key its decoded scans are kept."""
    from adaptune.recording.bag import BagSource  # rosbags takes long to import

    timing = Timing(config.stamp, config.time_unit, config.period)
    if config.kitti is not None:
        return kitti(Path(config.kitti), config.elevation), None
    if config.folder is not None:
        return scan_folder(Path(config.folder), timing), None
    if config.evalio is not None:
        # evalio is an optional package.
        from adaptune.recording.evalio import evalio_source

        return evalio_source(config.evalio), None
    bags = (config.bag,) if isinstance(config.bag, str) else config.bag or ()
    paths = bag_paths(bags)
    if not config.cache or not cache.cap():
        return BagSource(paths, config.points, timing), None
    try:
        part = () if config.part is None else (config.part,)
        key = cache.key(paths, (config.points, timing, _section(config), *part))
    except OSError as error:
        raise SequenceError(f"{paths[0]}: cannot be read ({error})") from error
    entry = cache.find(key)
    about = None if entry is None else entry.about
    return BagSource(paths, config.points, timing, about), key


def _section(config: SequenceConfig) -> Section:
    return Section(config.start, config.stop, config.stride)


def imu_settings(config: ImuConfig | None) -> ImuSettings | None:
    """How to read an IMU that a sequence names."""
    if config is None:
        return None
    T = None if config.extrinsic is None else to_pose(config.extrinsic)
    scale = _STANDARD_GRAVITY if config.unit == "g" else 1.0
    return ImuSettings(config.topic, T, scale, ImuNoise(**config.noise.model_dump()))
