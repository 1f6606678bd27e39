"""Trajectories that a user names: files, topics, topics of other bags, and arrays."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.errors import AdaptuneError
from adaptune.geometry import Poses
from adaptune.recording.bag import UNOPENED, BagSource
from adaptune.recording.config import BAG_SUFFIXES, bag_paths
from adaptune.recording.poses import in_angles
from adaptune.recording.recording import RecordedSequence
from adaptune.trajectory import Trajectory

PoseTime = Literal["stamp", "end"]
"""The moment of a scan that a pose with its stamp is of."""
Named = str | Path | Trajectory | NDArray[np.float64] | tuple[Any, Any]
"""A file, a topic, a topic of another bag as in ``run2.bag:/odom``, a chain of transforms as in
``/tf:map.base_link``; a trajectory; rows as those of TUM, of shape (n, 8); or stamps (integer
nanoseconds, or seconds) of shape (n,) and poses of shape (n, 4, 4)."""


class Convention(NamedTuple):
    """How the poses of trajectories are read."""

    T_body_sensor: Poses | None = None  # the LiDAR's pose in their frame
    clock_offset: float = 0.0  # seconds to add to their stamps
    pose_time: PoseTime = "stamp"


def parted(words: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Which words are recordings, and which trajectories; the first is a recording."""
    found: tuple[list[Path], list[str]] = [], []
    for i, word in enumerate(words):
        path = Path(word)
        if i == 0 or path.suffix in BAG_SUFFIXES or path.is_dir():
            found[0].append(path)
        else:
            found[1].append(word)
    return found


def name_of(given: Named, number: int) -> str:
    """What a trajectory is called."""
    if not isinstance(given, str | Path):
        return f"trajectory {number}"
    return Path(given).name if Path(given).is_file() else str(given)


def read(given: Named, scans: RecordedSequence, by: Convention, span: float) -> Trajectory:
    """Read a trajectory as poses of the LiDAR, at the stamps of scans that take `span` seconds.

    A SequenceError, or a TrajectoryError, says why it is none of this recording.
    """
    found = _poses(given, scans)
    if len(found) > 1 and (angles := in_angles(found)) is not None:
        raise AdaptuneError(f"{name_of(given, 1)}: {angles}")
    offset = by.clock_offset + (span if by.pose_time == "end" else 0.0)
    T = found.T_world_sensor
    T = T if by.T_body_sensor is None else T @ by.T_body_sensor
    found = Trajectory(found.stamps + round(1e9 * offset), T, found.max_gap)
    scans.check_time(found, name_of(given, 1))
    return found


def _poses(given: Named, scans: RecordedSequence) -> Trajectory:
    if isinstance(given, Trajectory):
        return given
    if not isinstance(given, str | Path):
        return _of_arrays(given)
    if Path(given).is_file():
        return scans.from_file(Path(given))
    bag, colon, topic = str(given).partition(":/")
    if colon:
        source: Any = BagSource(bag_paths([bag]), about=UNOPENED)
        with source.open() as reader:
            source.topics = {c.topic: c.msgtype for c in reader.connections}
    else:
        source, topic = scans.source, str(given).removeprefix("/")
    if not str(given).startswith("/") and not colon:
        raise AdaptuneError(
            f"{given}: there is no such file; topics begin with /, and stand behind other bags as "
            f"in run2.bag:/odom"
        )
    if not isinstance(source, BagSource):
        raise AdaptuneError(f"{source.name}: has no topics; give a file of poses")
    name, _, frames = f"/{topic}".partition(":")
    found = source.poses(name, frames or None, strict=True)
    assert found is not None  # the topic is named
    return found


def _of_arrays(given: Any) -> Trajectory:
    """A trajectory of rows as TUM's, or of stamps and poses."""
    what = "give rows of `timestamp x y z qx qy qz qw`, or stamps and poses of shape (n, 4, 4)"
    try:
        if isinstance(given, tuple):
            stamps, T = np.asarray(given[0]), np.asarray(given[1], np.float64)
        else:
            rows = np.asarray(given, np.float64)
            stamps, T = rows[:, 0], geometry.from_quaternions(rows[:, 1:4], rows[:, 4:])
        if stamps.dtype.kind == "f":
            stamps = np.round(1e9 * stamps)
        order, T = stamps.astype(np.int64), T.reshape(-1, 4, 4)
        if not len(order) or not np.isfinite(T).all():
            raise ValueError("holds no poses" if not len(order) else "a pose is not finite")  # noqa: TRY301
        return Trajectory(order, T)
    except (ValueError, IndexError, TypeError) as error:
        raise AdaptuneError(f"trajectory: {error}; {what}") from error
