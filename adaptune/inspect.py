"""Inspect a recording: what it holds, what is odd about it, and how to name it in a study."""

from collections.abc import Iterator
from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry, yaml
from adaptune.errors import AdaptuneError
from adaptune.sequence import Scan, SequenceConfig, SequenceError
from adaptune.sequence.bag import IMU_TYPES, POINTS_TYPES, BagSource
from adaptune.sequence.bag_files import bag_paths
from adaptune.sequence.opening import open_sequence
from adaptune.sequence.pointcloud2 import DATATYPES
from adaptune.sequence.pose_messages import POSES
from adaptune.sequence.recorded import RecordedSequence
from adaptune.sequence.serialized import header_stamp
from adaptune.trajectory import Trajectory

Layout = tuple[tuple[str, str, int], ...]
"""Name, type and offset of the fields of a point."""

_KITTI_FOLDERS = ("velodyne", "velodyne_points")


@dataclass(frozen=True)
class Topic:
    """A topic, or the scans of a folder."""

    name: str
    type: str
    count: int  # messages
    # Messages per second of their stamps; for topics without stamps, of their recording.
    rate: float | None = None
    # Nanoseconds of the first and the last stamp.
    first: int | None = None
    last: int | None = None
    gap: float | None = None  # longest time between one message and the next, in seconds
    oddities: tuple[str, ...] = ()  # what is wrong with the stamps


@dataclass(frozen=True, eq=False)
class ScanSummary:
    """The first scan."""

    scan: Scan
    recorded: int  # points in the message, those without a measurement included
    ranges: tuple[float, float, float] | None  # least, median and greatest distance in metres
    span: float | None  # seconds from the first point to the last
    rings: int | None  # how many rings there are


@dataclass(frozen=True, eq=False)
class Inspection:
    """Content of a recording."""

    path: Path
    topics: tuple[Topic, ...]
    layout: Layout  # of the first cloud
    scan: ScanSummary | None  # none where no scan could be read
    reference: Trajectory | None
    problems: tuple[str, ...]  # what is odd or unreadable
    # What each stage still needs, by stage; empty if it can run.
    missing: dict[str, tuple[str, ...]]
    entry: str  # YAML for the `sequences:` of a study


def inspect(path: Path) -> Inspection:
    """Read a whole recording and report what it holds.

    It is a bag, a folder with bags, a KITTI sequence or drive, or a folder of scans. A
    SequenceError says that it cannot be opened at all. Later failures are among the problems.
    """
    if not path.exists():
        raise SequenceError(f"{path}: there is no such file or folder")
    topics: tuple[Topic, ...] = ()
    layout: Layout = ()
    problems: list[str] = []
    kind = _kind(path)
    given: dict[str, Any] = {kind: str(path)}
    if kind == "bag":
        source = _any_bag(path)
        topics, read = _topics(source)
        problems += read
        clouds = [t for t in topics if t.type in POINTS_TYPES and t.count]
        if clouds:
            # The densest of several: the others are parts of it, or filtered.
            given["points"] = max(clouds, key=lambda t: (t.count, t.name)).name
        poses = [t for t in topics if t.type in POSES and t.count and "tf" not in t.type.lower()]
        if poses:
            given["reference"] = max(poses, key=lambda t: t.count).name
        if imus := [t.name for t in topics if t.type in IMU_TYPES]:
            given["imu"] = {"topic": imus[0]}
    scan, reference = None, None
    if kind != "bag" or "points" in given:
        scan, reference, layout, found, more = _first_scan(given)
        topics = topics or found
        problems += more
    for topic in topics:
        problems += [f"{topic.name}: {oddity}" for oddity in topic.oddities]
    if reference is not None:
        problems += _reference_problems(reference)
    missing, entry = _missing(scan, reference), _entry(path, given, reference)
    return Inspection(path, topics, layout, scan, reference, tuple(problems), missing, entry)


def _kind(path: Path) -> str:
    """Key of the `sequences:` entry that opens it."""
    if not path.is_dir():
        return "bag"
    if any((path / name).is_dir() for name in _KITTI_FOLDERS):
        return "kitti"
    suffixes = {p.suffix for p in path.iterdir()}
    return "bag" if suffixes & {".bag", ".mcap", ".db3"} else "folder"


def _any_bag(path: Path) -> BagSource:
    """Open the bag without looking for point clouds."""
    about = {"topics": {}, "points": "", "n_messages": 0, "duration": 0, "begins": {}}
    return BagSource(bag_paths([str(path)]), about=about)


def _topics(source: BagSource) -> tuple[tuple[Topic, ...], list[str]]:
    """Every topic with its stamps, and the problems of reading them."""
    problems = []
    with source.open() as reader:
        kinds = {c.topic: c.msgtype for c in reader.connections}
        stamps: dict[str, list[int]] = {topic: [] for topic in kinds}
        recorded: dict[str, list[int]] = {topic: [] for topic in kinds}
        first = {kind: fields[:1] for kind, (_, fields) in reader.typestore.fielddefs.items()}
        stamped = {
            topic
            for topic, kind in kinds.items()
            if [field[1][1] for field in first.get(kind, ())] == ["std_msgs/msg/Header"]
        }
        try:
            for connection, when, data in source.read(reader):
                topic = connection.topic
                recorded[topic].append(when)
                stamp = header_stamp(data, reader.is2) if topic in stamped else None
                if stamp is not None:
                    stamps[topic].append(stamp)
        except SequenceError as error:
            problems.append(str(error))
    topics = tuple(
        _topic(name, kinds[name], stamps[name], recorded[name]) for name in sorted(kinds)
    )
    return topics, problems


def _topic(name: str, kind: str, stamps: Items[int], recorded: Items[int] = ()) -> Topic:
    """Topic of messages with these stamps, recorded at these times if they are of a bag."""
    times, count = np.array(stamps or recorded, np.int64), len(recorded or stamps)
    if not count:
        return Topic(name, kind, count)
    steps = np.diff(times) * 1e-9
    positive = steps[steps > 0]
    rate = float(1.0 / np.median(positive)) if len(positive) else None
    gap = float(positive.max()) if len(positive) else None
    oddities = _oddities(times, recorded, gap, rate) if stamps else ()
    return Topic(name, kind, count, rate, int(times.min()), int(times.max()), gap, oddities)


def _oddities(
    stamps: NDArray[np.int64], recorded: Items[int], gap: float | None, rate: float | None
) -> tuple[str, ...]:
    if len(stamps) > 1 and stamps.max() == 0:
        return ("all stamps are zero",)
    steps = np.diff(stamps)
    counts = {
        "stamps repeat the one before": np.count_nonzero(steps == 0),
        "stamps go back in time": np.count_nonzero(steps < 0),
        # Recordings that count from zero begin with it.
        "stamps are zero": np.count_nonzero(stamps[1:] == 0),
    }
    found = [f"{number} {what}" for what, number in counts.items() if number]
    if gap is not None and rate is not None and gap * rate > 3.5 and gap > 0.2:
        lost = np.count_nonzero(steps * 1e-9 * rate > 3.5)
        found.append(f"{lost} gaps, the longest of {gap:.2f} s")
    if len(recorded) == len(stamps):
        late = (np.array(recorded, np.int64) - stamps) * 1e-9
        usual = float(np.median(late))
        if abs(usual) > 5.0:
            side = "behind" if usual > 0 else "ahead of"
            found.append(f"its clock is {abs(usual):.3f} s {side} the recorder's")
        if leaps := np.count_nonzero(np.abs(late - usual) > 5.0):
            found.append(f"{leaps} stamps leap by more than 5 s against the recorder's clock")
    return tuple(found)


def _first_scan(
    given: dict[str, Any],
) -> tuple[ScanSummary | None, Trajectory | None, Layout, tuple[Topic, ...], list[str]]:
    """First scan and reference, read as the stages read them."""
    problems = []
    scan, reference, count = None, None, 0
    layout: Layout = ()
    topics: tuple[Topic, ...] = ()
    options = {key: value for key, value in given.items() if key != "imu"}
    try:
        sequence = open_sequence(SequenceConfig(**options, cache=False))
    except SequenceError as error:
        if "bag" not in given:
            raise
        return None, None, (), (), [str(error)]
    assert isinstance(sequence, RecordedSequence)
    source = sequence.source
    try:
        if isinstance(source, BagSource):
            layout, count = _layout(source)
        else:
            stamps = [frame.stamp for frame in source.frames()]
            topics = (_topic(str(source.name), "scans", stamps),)
        scan = _summary(next(iter(sequence)), count)
    except AdaptuneError as error:
        problems.append(str(error))
    try:
        reference = sequence.reference()
    except AdaptuneError as error:
        problems.append(str(error))
    return scan, reference, layout, topics, problems


def _layout(source: BagSource) -> tuple[Layout, int]:
    """Fields of a point of the first cloud, and how many points it holds."""
    message = next(source.messages(source.points), None)
    if message is None or not hasattr(message, "fields"):
        points = list(getattr(message, "points", ()))
        names = [name for point in points[:1] for name in vars(point) if name[:2] != "__"]
        return tuple((name, "", 0) for name in names), len(points)
    layout = []
    for field in sorted(message.fields, key=lambda field: field.offset):
        kind = np.dtype(DATATYPES[field.datatype]).name if field.datatype in DATATYPES else "?"
        kind += f"[{field.count}]" if field.count > 1 else ""
        layout.append((field.name, kind, int(field.offset)))
    return tuple(layout), int(message.height) * int(message.width)


def _summary(scan: Scan, recorded: int) -> ScanSummary:
    ranges, span = None, None
    if len(scan):
        away = np.linalg.norm(scan.points, axis=1)
        ranges = (float(away.min()), float(np.median(away)), float(away.max()))
        span = None if scan.times is None else float(np.ptp(scan.times))
    rings = None if scan.rings is None else len(np.unique(scan.rings))
    return ScanSummary(scan, max(recorded, len(scan)), ranges, span, rings)


def _reference_problems(reference: Trajectory) -> Iterator[str]:
    if len(reference) < 2:
        yield "the reference holds a single pose"
        return
    steps = np.linalg.norm(geometry.steps(reference.T_world_sensor)[:, :3, 3], axis=1)
    seconds = np.diff(reference.stamps) * 1e-9
    if still := np.count_nonzero(steps == 0):
        yield f"the reference repeats the pose before it {still} times"
    if jumps := np.count_nonzero(steps > 100.0 * np.maximum(seconds, 1e-3)):
        yield f"the reference jumps {jumps} times"
    if gaps := np.count_nonzero(seconds > reference.max_gap):
        yield (
            f"the reference has {gaps} gaps beyond {reference.max_gap:g} s, the longest of "
            f"{seconds.max():.2f} s: scans in them are not labelled"
        )


def _missing(scan: ScanSummary | None, reference: Trajectory | None) -> dict[str, tuple[str, ...]]:
    """What each stage needs and does not find."""
    clouds = () if scan is not None else ("point clouds that can be read",)
    truth = () if reference is not None else ("a reference trajectory",)
    timeless = scan is not None and scan.scan.times is None
    times = ("a time for each point",) if timeless else ()
    return {
        "offline": (*clouds, *truth),
        "online": clouds,
        "comparison with the reference": (*clouds, *truth),
        "motion compensation": (*clouds, *times),
    }


def _entry(path: Path, given: dict[str, Any], reference: Trajectory | None) -> str:
    name = "".join(c if c.isalnum() or c in "_.-" else "_" for c in path.stem).lstrip(".-")
    text = yaml.dump({"sequences": {name or "recording": given}})
    if reference is None and "reference" not in given:
        text += "    # reference: its poses - a topic, or a TUM, KITTI or EuRoC file\n"
    if "points" in given:
        text += "    # stamp: end - if headers mark scans' ends and times count from the start\n"
    return text
