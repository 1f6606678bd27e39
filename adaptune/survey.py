"""Read what a bag holds: a sample of its messages, or all of them."""

from collections.abc import Callable
from collections.abc import Sequence as Items
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from adaptune import geometry
from adaptune.faults import FARTHEST, Fault
from adaptune.sequence import Scan, SequenceError
from adaptune.sequence.bag import IMU_TYPES, POINTS_TYPES, BagSource
from adaptune.sequence.bag_files import bag_paths
from adaptune.sequence.bag_index import IndexReader
from adaptune.sequence.pose_messages import PATH, POSES, TRANSFORMS, Pose, of_frame, usable
from adaptune.sequence.serialized import header_stamp
from adaptune.trajectory import Trajectory

Show = Callable[[str, int, int], None]
"""Called with what is done, how much of it is done, and how much there is."""

Take = Callable[[bytes], None]
"""Decodes a message."""

Span = tuple[int | None, int | None]
"""Nanoseconds on the recorder's clock from which, and up to which, to read."""

# A recording that takes no longer than this is read completely, and a sample takes about as long.
_SECONDS = 1.0
# Bytes read in a second, with BZ2 and without; seconds that a message takes to decode.
_SLOW, _FAST, _DECODE = 2.5e6, 2e8, 4e-5
# Parts of a sample, and the clouds in each; clouds where only the beginning can be read quickly.
_FEWEST, _MOST, _CLOUDS, _FIRST_CLOUDS = 5, 20, 2.5, 50


@dataclass
class Reading:
    """What was read of a topic; each list holds a list for every part of the sample."""

    name: str
    kind: str
    count: int  # messages in the recording
    stamped: bool
    stamps: list[list[int]] = field(default_factory=list)
    recorded: list[list[int]] = field(default_factory=list)
    undecoded: list[tuple[float, str]] = field(default_factory=list)  # seconds, and why

    @property
    def n_read(self) -> int:
        """Messages that were read."""
        return sum(map(len, self.recorded))


@dataclass
class Survey:
    """What was read of a bag."""

    topics: dict[str, Reading]
    points: str | None  # the topics that adaptune would use
    reference: str | None
    imu: str | None
    parts: tuple[Span, ...] = ((None, None),)
    first: tuple[Scan, Any] | None = None  # the first scan, and its message
    valid: list[int] = field(default_factory=list)  # points of each cloud that are valid
    poses: list[Pose] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Whether all messages were read."""
        return self.parts == ((None, None),)

    @property
    def slack(self) -> float:
        """Seconds between two parts of the sample; infinite if it is only the beginning."""
        starts = [start for start, _ in self.parts if start is not None]
        longest = max(np.diff(starts), default=np.inf)
        return 0.0 if self.complete else float(longest) * 1e-9

    def trajectory(self) -> Trajectory | None:
        """The reference, as far as it was read; its faults are kept."""
        if self.reference is None or not self.poses:
            return None
        try:
            if self.topics[self.reference].kind in TRANSFORMS:
                of_frame(self.reference, self.poses, None)
            found, unusable = usable(self.poses)
        except SequenceError as error:
            self.faults.append(Fault(str(error), "reference", "a reference trajectory"))
            return None
        if unusable:
            what = f"{unusable} of {len(self.poses)} poses are not finite or have no rotation"
            help_ = "adaptune leaves them out"
            self.faults.append(Fault(f"{self.reference}: {what}; {help_}", "reference"))
        return found


def survey(path: Path, deep: bool, show: Show) -> Survey:
    """Read the bags of a path: all messages if there are few or if it is to be `deep`."""
    source = _source(bag_paths([str(path)]))
    with source.open(by_index=True) as reader:
        found = _empty(reader)
        found.parts = () if deep else _parts(reader, source.paths, found)
        found.parts = found.parts or ((None, None),)
        _read(_source(source.paths, found), reader, found, show)
    return found


def _source(paths: Items[Path], found: Survey | None = None) -> BagSource:
    """The bags, without opening them; the topics are those found."""
    about: dict[str, Any] = {"n_messages": 0, "duration": 0, "begins": {}}
    topics = {} if found is None else {name: t.kind for name, t in found.topics.items()}
    points = None if found is None else found.points
    return BagSource(paths, about=about | {"topics": topics, "points": points or ""})


def _empty(reader: AnyReader) -> Survey:
    """The topics, and which of them adaptune would use."""
    first = {kind: fields[:1] for kind, (_, fields) in reader.typestore.fielddefs.items()}
    topics: dict[str, Reading] = {}
    for c in sorted(reader.connections, key=lambda c: c.topic):
        stamped = [f[1][1] for f in first.get(c.msgtype, ())] == ["std_msgs/msg/Header"]
        topic = topics.setdefault(c.topic, Reading(c.topic, c.msgtype, 0, stamped))
        topic.count += c.msgcount

    def most(kinds: Items[str]) -> str | None:
        # The densest of several clouds: the others are parts of it, or filtered.
        fit = [t for t in topics.values() if t.kind in kinds and t.count]
        return max(fit, key=lambda t: (t.count, t.name)).name if fit else None

    poses = [kind for kind in POSES if "tf" not in kind]
    return Survey(topics, most(POINTS_TYPES), most(poses), most(IMU_TYPES))


def _parts(reader: AnyReader, paths: Items[Path], found: Survey) -> tuple[Span, ...]:
    """Parts of a recording that is too long to be read completely; none if it is not."""
    size = sum(p.stat().st_size for path in paths for p in [path, *path.glob("*")] if p.is_file())
    try:
        slow = any(isinstance(r, IndexReader) and r.is_slow() for r in reader.readers)
    except Exception:  # damage, which reading reports
        slow = False
    speed, total = _SLOW if slow else _FAST, sum(t.count for t in found.topics.values())
    begin, length = reader.start_time, reader.end_time - reader.start_time
    if size / speed + total * _DECODE <= _SECONDS or length <= 0:
        return ()
    cloud = min(1 / max(found.topics[found.points].count if found.points else total, 1), 0.005)
    if not _indexed(reader):
        return ((begin, begin + round(_FIRST_CLOUDS * cloud * length)),)
    width = _CLOUDS * cloud
    # Whole chunks are unpacked for each part.
    number = int(np.clip(_SECONDS * speed / (size * width + min(size, 5e5)), _FEWEST, _MOST))
    starts = begin + np.linspace(0.0, (1.0 - width) * length, number).astype(np.int64)
    return tuple((start, start + round(width * length) + 1) for start in starts.tolist())


def _indexed(reader: AnyReader) -> bool:
    """Whether a part can be read without what is before it: not in mcap files without chunks."""
    storages = [getattr(r, "storage", None) for r in reader.readers]
    files = [file for s in storages for file in getattr(s, "storages", [s])]
    return all(getattr(file, "chunks", True) for file in files)


def _read(source: BagSource, reader: AnyReader, found: Survey, show: Show) -> None:
    """Read the parts."""
    takers = _takers(source, reader, found)
    total, done, begin = sum(t.count for t in found.topics.values()), 0, reader.start_time
    last_path: tuple[float, bytes] | None = None
    for start, stop in found.parts:
        for topic in found.topics.values():
            topic.stamps.append([])
            topic.recorded.append([])
        try:
            span: Span = (start, stop) if _indexed(reader) else (None, None)
            for connection, when, data in source.read(reader, None, span):
                if stop is not None and when >= stop:
                    break
                topic, seconds = found.topics[connection.topic], (when - begin) * 1e-9
                topic.recorded[-1].append(when)
                stamp = header_stamp(data, reader.is2) if topic.stamped else None
                if stamp is not None:
                    topic.stamps[-1].append(stamp)
                if topic.kind == PATH and topic.name == found.reference:
                    last_path = seconds, data
                elif topic.name in takers:
                    _try(takers[topic.name], data, topic, seconds)
                done += 1
                if done % 100 == 0:
                    show("reading", done, total)
        except SequenceError as error:
            lacks = "a recording that can be read to its end"
            if str(error) not in [fault.text for fault in found.faults]:
                found.faults.append(Fault(str(error), "points", lacks))
    if last_path is not None and found.reference is not None:
        seconds, data = last_path
        _try(takers[found.reference], data, found.topics[found.reference], seconds)
    show("reading", total, total)


def _try(take: Take, data: bytes, topic: Reading, seconds: float) -> None:
    try:
        take(data)
    except Exception as error:  # deserializers raise whatever damaged data leads them to
        topic.undecoded.append((seconds, str(error) or type(error).__name__))


def _takers(source: BagSource, reader: AnyReader, found: Survey) -> dict[str, Take]:
    """What decodes the messages of the topics that adaptune would use."""
    takers: dict[str, Take] = {}
    if found.points is not None:
        kind = found.topics[found.points].kind
        try:
            source.check(None, None)
            load = source.loader(reader)
        except SequenceError as error:
            found.faults.append(Fault(str(error), "points", "point clouds that can be read"))
        else:
            takers[found.points] = lambda data: _take_cloud(data, load, reader, kind, found)
    if found.reference is not None:
        pose = found.topics[found.reference].kind
        takers[found.reference] = lambda data: found.poses.extend(
            POSES[pose](reader.deserialize(data, pose))
        )
    if found.imu is not None:
        takers[found.imu] = lambda data: _take_measurement(reader.deserialize(data, IMU_TYPES[0]))
    return takers


def _take_cloud(
    data: bytes, load: Callable[[bytes, str], Scan], reader: AnyReader, kind: str, found: Survey
) -> None:
    scan = load(data, "a message")
    found.valid.append(n_valid(scan))
    if found.first is None:
        found.first = scan, reader.deserialize(data, kind)


def _take_measurement(message: Any) -> None:
    w, a = message.angular_velocity, message.linear_acceleration
    if not np.isfinite([w.x, w.y, w.z, a.x, a.y, a.z]).all():
        raise SequenceError("a measurement is not finite")


def n_valid(scan: Scan) -> int:
    """Points that an odometry can use."""
    with np.errstate(over="ignore"):
        return geometry.count_within(scan.points, 0.0, FARTHEST)
