"""Read what a bag holds: a sample of its messages, or all of them."""

from collections.abc import Callable, Iterator, Sequence
from collections.abc import Sequence as Items
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection

from adaptune import geometry
from adaptune.progress import Progress
from adaptune.recording import Scan, SequenceError
from adaptune.recording.bag import IMU_TYPES, POINTS_TYPES, BagSource, IndexReader
from adaptune.recording.clouds import PATH, POSES, Pose, header_stamp, usable
from adaptune.recording.config import bag_paths
from adaptune.trajectory import Trajectory

# What is wrong with a recording: what it means, and what to do about it.


Parts = Sequence[Sequence[int]]
"""Nanoseconds of messages; those of a part follow each other."""

LEAST_POINTS, FARTHEST = 20, 1000.0
"""Valid points that an odometry needs, and metres beyond which a point is not valid."""

_FASTEST = 100.0  # metres per second
_STILL = 0.01  # metres
_SUB_TRAJECTORY = 25.0  # metres, where a study sets no other


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong."""

    text: str
    of: str = ""  # `points`, `reference` or `imu`, where one of them is affected
    lacks: str = ""  # what is missing because of it, where the stages cannot run


_LEFT_OUT = {
    "points": ": adaptune leaves such scans out",
    "reference": ": of poses with one stamp the first counts, the others are sorted",
    "imu": ": of measurements with one stamp the first counts, the others are sorted",
}


def of_stamps(name: str, of: str, stamps: Parts, recorded: Parts) -> Iterator[Fault]:
    """Faults of a topic's stamps; `recorded` is empty where there is no recorder's clock."""
    times = np.array([stamp for part in stamps for stamp in part], np.int64)
    n = len(times)
    if n > 1 and len(np.unique(times)) == 1:
        what = "are zero" if times[0] == 0 else "are the same"
        lacks = {"points": "scans with stamps", "reference": "poses with stamps"}.get(of, "")
        help_ = ": the driver or the converter lost them, record or convert again" if lacks else ""
        yield Fault(f"{name}: all {n} stamps {what}{help_}", of, lacks)
        return
    steps = np.diff(times)
    counts = {
        "repeat the one before": np.count_nonzero(steps == 0),
        "go back in time": np.count_nonzero(steps < 0),
        # Recordings that count from zero begin with it.
        "are zero": np.count_nonzero(times[1:] == 0),
    }
    for what, count in counts.items():
        if count:
            yield Fault(f"{name}: {count} of {n} stamps {what}{_LEFT_OUT.get(of, '')}", of)
    yield from _gaps(name, of, stamps)
    if n == sum(map(len, recorded)):
        yield from _clocks(name, of, times, np.array([t for part in recorded for t in part]))


def _gaps(name: str, of: str, stamps: Parts) -> Iterator[Fault]:
    steps = inner_steps(stamps)
    positive = steps[steps > 0]
    if not len(positive):
        return
    gap, usual = positive.max(), np.median(positive)
    if gap > 3.5 * usual and gap > 0.2:
        lost = np.count_nonzero(steps > 3.5 * usual)
        help_ = {
            "points": ": odometries lose track there; leave them out with `start`, `stop` or `cut`",
            "reference": ": scans in gaps beyond `max_gap` (1 s) are not labelled",
        }.get(of, "")
        yield Fault(f"{name}: {lost} gaps, the longest of {gap:.2f} s{help_}", of)


def _clocks(
    name: str, of: str, stamps: NDArray[np.int64], recorded: NDArray[np.int64]
) -> Iterator[Fault]:
    late = (recorded - stamps) * 1e-9
    usual = float(np.median(late))
    if abs(usual) > 5.0:
        side = "behind" if usual > 0 else "ahead of"
        help_ = "" if not of else ": harmless if the clocks of scans, poses and IMU agree"
        yield Fault(f"{name}: its clock is {abs(usual):.3f} s {side} the recorder's{help_}", of)
    if leaps := np.count_nonzero(np.abs(late - usual) > 5.0):
        what = f"{leaps} stamps leap by more than 5 s against the recorder's clock"
        yield Fault(f"{name}: {what}{_LEFT_OUT['points'] if of == 'points' else ''}", of)


def inner_steps(stamps: Parts) -> NDArray[np.float64]:
    """Seconds from each message to the next one of its part."""
    steps = [np.diff(np.array(part, np.int64)) * 1e-9 for part in stamps if len(part) > 1]
    return np.concatenate([np.empty(0), *steps])


def of_count(name: str, of: str, stamps: Parts, count: int) -> Iterator[Fault]:
    """Messages that are missing outside the sample, by their number in the whole recording."""
    steps = inner_steps(stamps)
    steps = steps[steps > 0]
    usual = np.median(steps) if len(steps) else np.inf
    # Only what comes regularly has a number to expect.
    if len(steps) < 5 or np.mean(np.abs(steps - usual) < 0.2 * usual) < 0.9:
        return
    times = [stamp for part in stamps for stamp in part]
    expected = 1 + round((max(times) - min(times)) * 1e-9 / float(usual))
    if count < 0.9 * expected:
        what = f"about {expected - count:,} of {expected:,} messages are missing"
        yield Fault(f"{name}: {what}: gaps that the sample does not show, `--deep` finds them", of)


def of_clouds(name: str, count: int, valid: Sequence[int]) -> Iterator[Fault]:
    """Faults of a topic with so many clouds; those that were read have `valid` points each."""
    if count == 1:
        yield Fault(f"{name}: holds a single cloud: no motion", "points", "more than one cloud")
    n, few = len(valid), sum(1 for points in valid if points < LEAST_POINTS)
    if not few:
        return
    rule = f"fewer than {LEAST_POINTS} valid points (finite, not zero, within {FARTHEST:g} m)"
    if few == n:
        help_ = "an odometry cannot use them: look at the driver, or choose another topic"
        yield Fault(f"{name}: all {n} clouds hold {rule}; {help_}", "points", "clouds with points")
    else:
        help_ = "odometries lose track there; leave them out with `start`, `stop` or `cut`"
        yield Fault(f"{name}: {few} of {n} clouds hold {rule}; {help_}", "points")


def of_reference(reference: Trajectory, complete: bool, timed: bool = True) -> Iterator[Fault]:
    """Faults of the poses themselves; with `timed` false, the stamps only number them."""
    of, lacks = "reference", "a reference that moves"
    if len(reference) < 2:
        if complete:
            help_ = "no motion follows from it; name another topic, or a file of poses"
            yield Fault(f"the reference holds a single pose: {help_}", of, lacks)
        return
    positions = reference.T_world_sensor[:, :3, 3]
    steps = np.linalg.norm(geometry.steps(reference.T_world_sensor)[:, :3, 3], axis=1)
    if np.linalg.norm(positions - positions[0], axis=1).max() < _STILL:
        what = f"the reference stands still: all {len(reference)} poses are within 1 cm"
        help_ = "errors are per metre; drive, or name another topic or a file of poses"
        yield Fault(f"{what}; {help_}", of, lacks)
        return
    if still := np.count_nonzero(steps == 0):
        what = f"the reference repeats the pose before it {still} times"
        help_ = "harmless while the robot stood, wrong if the poses came less often than the scans"
        yield Fault(f"{what}: {help_}", of)
    seconds = np.diff(reference.stamps) * 1e-9 if timed else np.full(len(steps), 0.1)
    if jumps := np.count_nonzero(steps > _FASTEST * np.maximum(seconds, 1e-3)):
        help_ = "errors there are not the odometry's; leave them out with `start`, `stop` or `cut`"
        yield Fault(f"the reference jumps {jumps} times: {help_}", of)
    if complete and steps.sum() < _SUB_TRAJECTORY:
        what = f"the reference is {steps.sum():.1f} m long"
        help_ = f"set `sub_trajectory` to less than that (it is {_SUB_TRAJECTORY:g} m if left out)"
        yield Fault(f"{what}: {help_}", of)
    if complete and timed and (gaps := np.count_nonzero(seconds > reference.max_gap)):
        what = f"the reference has {gaps} gaps beyond {reference.max_gap:g} s"
        yield Fault(f"{what}, the longest of {seconds.max():.2f} s: their scans get no label", of)


def of_overlap(reference: Trajectory, scans: tuple[int, int], slack: float) -> Iterator[Fault]:
    """Scans outside the reference; both may go on for `slack` seconds beyond what was read."""
    begin, end = int(reference.stamps[0]), int(reference.stamps[-1])
    times = [f"{stamp * 1e-9:.3f}" for stamp in (begin, end, *scans)]
    spans = f"covers {times[0]} to {times[1]} s, the scans cover {times[2]} to {times[3]} s"
    if (max(begin, scans[0]) - min(end, scans[1])) * 1e-9 > slack:
        help_ = "set `clock_offset` to the seconds to add to the reference's stamps"
        more = "if it is of the same drive; `adaptune offline` proposes them"
        lacks = "a reference of the same time"
        yield Fault(f"the reference {spans}: {help_}, {more}", "reference", lacks)
        return
    seconds = (scans[1] - scans[0]) * 1e-9
    outside = [(begin - scans[0]) * 1e-9, (scans[1] - end) * 1e-9]
    lost = sum(s for s in outside if s > slack + 1.0)
    if lost > 0.05 * seconds:
        yield Fault(f"the reference {spans}: the scans outside get no label", "reference")


Take = Callable[[bytes], None]
"""Decodes a message."""

Span = tuple[int | None, int | None]
"""Nanoseconds on the recorder's clock from which, and up to which, to read."""

# A recording that takes no longer than this is read completely, and a sample takes about as long.
SECONDS = 1.0
# Bytes read in a second, with BZ2 and without; seconds that a message takes to decode.
_SLOW, _FAST, _DECODE = 2.5e6, 2e8, 4e-5
# Parts of a sample, and messages of a topic in each.
_FEWEST, _MOST, _EACH = 5, 20, 2.5
# Seconds. Bags of one drive are not further apart.
_APART = 60.0


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
    complete: bool = True  # whether all messages were read
    apart: bool = False  # whether it is of bags that do not follow each other
    slack: float = 0.0  # seconds between two parts of the sample
    first: tuple[Scan, Any] | None = None  # the first scan, and its message
    valid: list[int] = field(default_factory=list)  # points of each cloud that are valid
    poses: list[Pose] = field(default_factory=list)
    path: bytes = b""  # the last message, where each repeats all poses before
    faults: list[Fault] = field(default_factory=list)

    def trajectory(self) -> Trajectory | None:
        """The reference, as far as it was read; its faults are kept."""
        if self.reference is None or not self.poses:
            return None
        found, unusable = usable(self.poses)
        if unusable:
            what = f"{unusable} of {len(self.poses)} poses are not finite or have no rotation"
            lacks = "a reference trajectory" if found is None else ""
            text = f"{self.reference}: {what}: adaptune leaves them out"
            self.faults.append(Fault(text, "reference", lacks))
        return found


def survey(path: Path, deep: bool, show: Progress) -> Survey:
    """Read the bags of a path: all messages if there are few or if it is to be `deep`."""
    source = _source(bag_paths([str(path)]))
    with source.open(by_index=True) as reader:
        found = _empty(reader)
        found.faults += _apart(reader, source.paths)
        found.apart = bool(found.faults)
        number = 0 if deep else _number(reader, source.paths, found)
        _read(_source(source.paths, found), reader, found, number, show)
    return found


def _source(paths: Items[Path], found: Survey | None = None) -> BagSource:
    """The bags, without opening them; the topics are those found."""
    about: dict[str, Any] = {"n_messages": 0, "duration": 0, "begins": {}}
    topics = {} if found is None else {name: t.kind for name, t in found.topics.items()}
    points = None if found is None else found.points
    return BagSource(paths, about=about | {"topics": topics, "points": points or ""})


def _apart(reader: AnyReader, paths: Items[Path]) -> list[Fault]:
    """Whether bags do not follow each other: the two with the longest time between them."""
    if len(paths) < 2:
        return []
    readers: Items[Any] = reader.readers
    spans = [(r.start_time, r.end_time, p.name) for r, p in zip(readers, paths, strict=True)]
    spans = sorted(span for span in spans if span[0] < span[1])
    gaps, end, before = [], 0, ""
    for start, stop, name in spans:
        if before:
            gaps.append(((start - end) * 1e-9, before, name))
        if stop > end:
            end, before = stop, name
    seconds, before, name = max(gaps, default=(0.0, "", ""))
    if seconds <= _APART:
        return []
    days = f" ({seconds / 86400.0:,.0f} days)" if seconds > 2.0 * 86400.0 else ""
    text = (
        f"the bags do not follow each other: {seconds:,.0f} s{days} lie between {before} and "
        f"{name}; inspect each recording by itself, and name each as a sequence of its own"
    )
    return [Fault(text, "points", "bags that follow each other")]


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


def _number(reader: AnyReader, paths: Items[Path], found: Survey) -> int:
    """Parts of a sample; 0 if the recording is short enough to be read completely."""
    size = sum(p.stat().st_size for path in paths for p in [path, *path.glob("*")] if p.is_file())
    try:
        slow = any(isinstance(r, IndexReader) and r.is_slow() for r in reader.readers)
    except Exception:  # damage, which reading reports
        slow = False
    speed, total = _SLOW if slow else _FAST, sum(t.count for t in found.topics.values())
    length = reader.end_time - reader.start_time
    if size / speed + total * _DECODE <= SECONDS or length <= 0:
        return 0
    # Whole chunks are unpacked for each part.
    cost = size * min(_EACH / max(_usual(found), 1), 1.0) + min(size, 5e5)
    return int(np.clip(SECONDS * speed / cost, _FEWEST, _MOST))


def _usual(found: Survey) -> int:
    """Number of clouds; where there are none, of messages."""
    total = sum(topic.count for topic in found.topics.values())
    return total if found.points is None else found.topics[found.points].count


def _spans(reader: AnyReader, number: int, count: int) -> list[Span]:
    """Parts of the recording in which a topic of so many messages has some each."""
    begin, length = reader.start_time, reader.end_time - reader.start_time
    if not number or number * _EACH >= count:
        return [(None, None)]
    if not _indexed(reader):
        return [(begin, begin + round(length * number * _EACH / count))]
    width = _EACH / count
    starts = begin + np.linspace(0.0, (1.0 - width) * length, number).astype(np.int64)
    return [(start, start + round(width * length) + 1) for start in starts.tolist()]


def _indexed(reader: AnyReader) -> bool:
    """Whether a part can be read without what is before it: not in mcap files without chunks."""
    storages = [getattr(r, "storage", None) for r in reader.readers]
    files = [file for s in storages for file in getattr(s, "storages", [s])]
    return all(getattr(file, "chunks", True) for file in files)


def _read(source: BagSource, reader: AnyReader, found: Survey, number: int, show: Progress) -> None:
    """Read so many parts, or everything if it is 0."""
    takers, usual = _takers(source, reader, found), _usual(found)
    total, done = sum(t.count for t in found.topics.values()), 0
    spans = _spans(reader, number, usual)
    found.complete = spans == [(None, None)]
    if not found.complete:
        length = (reader.end_time - reader.start_time) * 1e-9
        found.slack = length / (len(spans) - 1) if len(spans) > 1 else np.inf
    # What comes more rarely than the clouds has parts of its own.
    rare = [t for t in takers if found.topics[t].count < usual and not found.complete]
    jobs: list[tuple[str | None, Span]] = [(None, span) for span in spans]
    jobs += [(t, span) for t in rare for span in _spans(reader, number, found.topics[t].count)]
    for name, span in jobs:
        names = [name] if name else [t for t in found.topics if t not in rare]
        chosen = {t: found.topics[t] for t in names}
        for topic in chosen.values():
            topic.stamps.append([])
            topic.recorded.append([])
        try:
            for connection, when, data in _messages(source, reader, name, span):
                if (read := chosen.get(connection.topic)) is not None:
                    _take(takers.get(read.name), read, when, data, reader)
                done += 1
                if done % 100 == 0:
                    show("reading", done, total)
        except SequenceError as error:
            lacks = "a recording that can be read to its end"
            if str(error) not in [fault.text for fault in found.faults]:
                found.faults.append(Fault(str(error), "points", lacks))
    if found.path and found.reference is not None:
        take = partial(_take_poses, PATH, reader, found)
        _try(take, found.topics[found.reference], reader.end_time, found.path, reader)
    show("reading", total, total)


def _messages(
    source: BagSource, reader: AnyReader, topic: str | None, span: Span
) -> Iterator[tuple[Connection, int, bytes]]:
    asked: Span = span if _indexed(reader) else (None, None)
    for connection, when, data in source.read(reader, topic, asked):
        if span[1] is not None and when >= span[1]:
            return
        yield connection, when, data


def _take(take: Take | None, topic: Reading, when: int, data: bytes, reader: AnyReader) -> None:
    """Keep when a message was made and recorded, and decode it where it is used."""
    topic.recorded[-1].append(when)
    stamp = header_stamp(data, reader.is2) if topic.stamped else None
    if stamp is not None:
        topic.stamps[-1].append(stamp)
    if take is not None:
        _try(take, topic, when, data, reader)


def _try(take: Take, topic: Reading, when: int, data: bytes, reader: AnyReader) -> None:
    try:
        take(data)
    except Exception as error:  # deserializers raise whatever damaged data leads them to
        seconds = (when - reader.start_time) * 1e-9
        topic.undecoded.append((seconds, str(error) or type(error).__name__))


def _takers(source: BagSource, reader: AnyReader, found: Survey) -> dict[str, Take]:
    """What decodes the messages of the topics that adaptune would use."""
    takers: dict[str, Take] = {}
    if found.points is not None:
        try:
            source.check(None, None)
            takers[found.points] = partial(_take_cloud, source.loader(reader), reader, found)
        except SequenceError as error:
            found.faults.append(Fault(str(error), "points", "point clouds that can be read"))
    if found.reference is not None:
        kind = found.topics[found.reference].kind
        poses = partial(_take_poses, kind, reader, found)
        # Each path repeats the one before: the last one will do.
        takers[found.reference] = partial(setattr, found, "path") if kind == PATH else poses
    if found.imu is not None:
        takers[found.imu] = partial(_take_measurement, reader)
    return takers


def _take_cloud(
    load: Callable[[bytes, str], Scan], reader: AnyReader, found: Survey, data: bytes
) -> None:
    scan = load(data, "message")
    found.valid.append(n_valid(scan))
    if found.first is None and found.points is not None:
        found.first = scan, reader.deserialize(data, found.topics[found.points].kind)


def _take_poses(kind: str, reader: AnyReader, found: Survey, data: bytes) -> None:
    found.poses += POSES[kind](reader.deserialize(data, kind))


def _take_measurement(reader: AnyReader, data: bytes) -> None:
    message: Any = reader.deserialize(data, IMU_TYPES[0])
    w, a = message.angular_velocity, message.linear_acceleration
    if not np.isfinite([w.x, w.y, w.z, a.x, a.y, a.z]).all():
        raise SequenceError("a measurement is not finite")


def n_valid(scan: Scan) -> int:
    """Points that an odometry can use."""
    with np.errstate(over="ignore"):
        return geometry.count_within(scan.points, 0.0, FARTHEST)
