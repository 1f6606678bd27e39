"""Trajectories that a user names: files, topics, topics of other bags, and arrays."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses, to_pose
from adaptune.recording.bag import UNOPENED, BagSource
from adaptune.recording.config import BAG_SUFFIXES, bag_paths
from adaptune.recording.recording import RecordedSequence
from adaptune.trajectory import Trajectory

Named = str | Path | Trajectory | tuple[Any, Any]
"""A file, a topic, a topic of another bag as ``run2.bag:/odom``, a chain of transforms as
``/tf:map.base_link``; or a trajectory; or stamps, of shape (n,), in integer nanoseconds or seconds,
and poses of shape (n, 4, 4)."""


class Convention(NamedTuple):
    """How the poses of trajectories are given."""

    T_body_sensor: Poses = to_pose(np.eye(4))  # the LiDAR's pose in their frame
    clock_offset: float = 0.0  # seconds to add to their stamps
    pose_time: Literal["stamp", "end"] = "stamp"  # the moment of a scan that they are of


def convention(extrinsic: Any, clock_offset: float, pose_time: Any) -> Convention:
    """What a user says of the poses; an AdaptuneError says what is wrong with it."""
    if isinstance(extrinsic, str):
        extrinsic = extrinsic.strip("[] ").replace(",", " ").split()
    if pose_time not in ("stamp", "end"):
        raise AdaptuneError(f"pose_time: give stamp or end, not {pose_time}")
    try:
        place = to_pose(np.eye(4) if extrinsic is None else extrinsic)
    except ValueError as error:
        raise AdaptuneError(f"extrinsic: {error}") from error
    return Convention(place, clock_offset, pose_time)


def parted(words: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Which words are recordings, and which trajectories; of neither kind, the first is one."""
    bags = [w for w in words if Path(w).suffix in BAG_SUFFIXES or Path(w).is_dir()] or words[:1]
    return [Path(w) for w in bags], [w for w in words if w not in bags]


def by_name(given: Sequence[Named]) -> dict[str, Named]:
    """Trajectories by what they are called: a file by its name, where no other one has it."""
    names = [_name(one, number) for number, one in enumerate(given, 1)]
    pairs = zip(names, given, strict=True)
    return {str(one) if names.count(name) > 1 else name: one for name, one in pairs}


def _name(given: Named, number: int) -> str:
    if not isinstance(given, str | Path):
        return f"trajectory {number}"
    return Path(given).name if Path(given).is_file() else str(given)


def read(name: str, given: Named, scans: RecordedSequence, by: Convention, span: int) -> Trajectory:
    """Read a trajectory as poses of the LiDAR, at the stamps of scans of `span` nanoseconds.

    An AdaptuneError says why it is none of this recording.
    """
    ends = by.pose_time == "end"
    if ends and not span:
        what = "its points have no times, which say when a scan ends; give --clock-offset"
        raise AdaptuneError(f"{scans.name}: {what} instead of --pose-time end")
    found, later = _poses(given, scans), round(1e9 * by.clock_offset) + span * ends
    T_world_sensor = found.T_world_sensor @ by.T_body_sensor
    found = Trajectory(found.stamps + later, T_world_sensor, found.max_gap)
    scans.check_time(found, by.clock_offset, name, "--clock-offset")
    return found


def _poses(given: Named, scans: RecordedSequence) -> Trajectory:
    if isinstance(given, Trajectory):
        return given
    if not isinstance(given, str | Path):
        try:
            stamps, T = np.asarray(given[0]), np.asarray(given[1], np.float64)
            stamps = np.round(1e9 * stamps) if stamps.dtype.kind == "f" else stamps
            return Trajectory(stamps.astype(np.int64), T)
        except (ValueError, IndexError, TypeError) as error:
            what = "give stamps of shape (n,), and poses of shape (n, 4, 4)"
            raise AdaptuneError(f"trajectory: {error}; {what}") from error
    if Path(given).is_file():
        return scans.from_file(Path(given))
    bag, _, topic = str(given).partition(":/")
    if Path(bag).suffix not in BAG_SUFFIXES and not Path(bag).exists():
        bag, topic = "", str(given)
    if not topic or not (bag or topic.startswith("/")):
        what = "there is no such file; topics begin with /, those of other bags as run2.bag:/odom"
        raise AdaptuneError(f"{given}: {what}")
    source: Any = BagSource(bag_paths([bag]), about=UNOPENED) if bag else scans.source
    if not isinstance(source, BagSource):
        raise AdaptuneError(f"{source.name}: has no topics; give a file of poses")
    if bag:
        with source.open() as reader:
            source.topics = {c.topic: c.msgtype for c in reader.connections}
    name, _, frames = str(topic).lstrip("/").partition(":")
    found = source.poses(f"/{name}", frames or None, strict=True)
    assert found is not None  # the topic is named
    return found
