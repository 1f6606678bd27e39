"""Inspect a recording: what it holds, what is odd about it, and how to name it in a study."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text
from rosbags.highlevel import AnyReader

from adaptune import files, geometry
from adaptune.errors import AdaptuneError, MachineError
from adaptune.progress import Progress, unseen
from adaptune.recording import Scan, SequenceConfig, SequenceError
from adaptune.recording.bag import IMU_TYPES, POINTS_TYPES, BagSource, IndexReader
from adaptune.recording.clouds import FARTHEST, PATH, POSES, Pose, header_of, parse, usable
from adaptune.recording.config import BAG_SUFFIXES, REFERENCE_FILES, bag_paths
from adaptune.recording.recording import RecordedSequence
from adaptune.recording.scan import SOONEST, Reading, doubts
from adaptune.trajectory import Trajectory, is_kitti, read_kitti, read_trajectory

LEAST_POINTS = 20
"""Valid points that an odometry needs."""

# What each stage uses.
_INPUTS = {
    "offline": ("points", "reference"),
    "online": ("points",),
    "motion compensation": ("points", "imu"),
}


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong: what it means, and what to do about it."""

    text: str
    of: str = ""  # `points`, `reference` or `imu`, where one of them is affected
    lacks: str = ""  # what is missing because of it, where the stages cannot run


@dataclass(eq=False)
class Topic:
    """What was read of a topic, of the scans of a folder, or of a file of poses."""

    name: str
    type: str
    count: int  # messages in the recording
    stamped: bool = True
    n_read: int = 0
    # Nanoseconds of the messages that were read, on the recorder's clock if they have no stamps; a
    # list for every part of a sample.
    stamps: list[list[int]] = field(default_factory=list)
    undecoded: list[tuple[float, str]] = field(default_factory=list)  # seconds, and why

    @property
    def times(self) -> NDArray[np.int64]:
        """Nanoseconds of the stamps; of the recording, if messages have none."""
        return np.array([time for part in self.stamps for time in part], np.int64)

    @property
    def steps(self) -> NDArray[np.float64]:
        """Seconds from each message to the next one of its part, where it is later."""
        steps = [np.diff(np.array(part, np.int64)) * 1e-9 for part in self.stamps]
        joined = np.concatenate([np.empty(0), *steps])
        return joined[joined > 0]

    @property
    def rate(self) -> float | None:
        """Messages per second."""
        return float(1.0 / np.median(self.steps)) if len(self.steps) else None

    @property
    def gap(self) -> float | None:
        """Longest time between one message and the next, in seconds."""
        return float(self.steps.max()) if len(self.steps) else None


@dataclass(eq=False)
class Inspection:
    """Content of a recording."""

    path: Path
    given: dict[str, Any]  # the keys of a sequence that name it; for a file of poses, its key
    topics: dict[str, Topic]
    # Names of the topics that adaptune would use as `points`, `reference` and `imu`.
    used: dict[str, str] = field(default_factory=dict)
    complete: bool = True  # whether it was read to its end or damage, and not only a sample of it
    scan: Scan | None = None  # the first one; none where no scan could be read
    fields: tuple[str, ...] = ()  # names of those of a point, in a PointCloud2
    valid: list[int] = field(default_factory=list)  # valid points of each cloud that was read
    readings: list[Reading] = field(default_factory=list)  # of each of them
    reference: Trajectory | None = None  # as far as it was read
    faults: list[Fault] = field(default_factory=list)

    @property
    def n_messages(self) -> int:
        """How many messages, scans or poses there are."""
        return sum(topic.count for topic in self.topics.values())

    @property
    def n_read(self) -> tuple[int, int]:
        """How many of them were read, and clouds among them that could be decoded."""
        return sum(topic.n_read for topic in self.topics.values()), len(self.valid)

    @property
    def name(self) -> str:
        """Name of the sequence that is proposed; empty for a file of poses."""
        if "reference" in self.given and len(self.given) == 1:
            return ""
        return files.plain_name(self.path)

    def config(self) -> SequenceConfig:
        """The sequence that is proposed."""
        return SequenceConfig(**self.given)

    @property
    def missing(self) -> dict[str, tuple[str, ...]]:
        """What each stage still needs; empty if it can run.

        Where there is no reference, one is estimated.
        """
        if not self.name:
            return {}
        lacks = {
            of: [fault.lacks for fault in self.faults if fault.of == of and fault.lacks]
            for of in ("points", "reference", "imu")
        }
        if self.scan is None and not any(fault.of == "points" for fault in self.faults):
            lacks["points"].append("point clouds that can be read")
        if self.scan is not None and self.scan.times is None:
            lacks["imu"].append("a time for each point")
        return {
            stage: tuple(dict.fromkeys(what for of in inputs for what in lacks[of]))
            for stage, inputs in _INPUTS.items()
        }

    @property
    def entry(self) -> str:
        """YAML for a study."""
        if not self.name:
            return files.dump(self.given)
        text = files.dump({"sequences": {self.name: self.given}})
        if "bag" not in self.given:
            return text
        hint = "    # reference: a topic, or a TUM, KITTI or EuRoC file; estimated if left out\n"
        text += hint if "reference" not in self.used else ""
        if "compensate" in self.given:
            text += "    # without `compensate` for an odometry that undoes the motion itself\n"
        hint = "    # stamp: end - if headers mark scans' ends and times count from the start\n"
        return text + (hint if self.scan is not None and self.scan.times is not None else "")


def inspect(path: Path, deep: bool = False, show: Progress = unseen) -> Inspection:
    """Read a recording and report what it holds: a sample of it if it is long and not `deep`.

    It is a bag, a folder with bags, a KITTI sequence, a folder of scans, or a file of
    poses. An AdaptuneError says that it cannot be opened at all. What fails later is among the
    faults.
    """
    if not path.exists():
        raise SequenceError(f"{path}: there is no such file or folder")
    # The study that names it may lie in any folder.
    path = path.resolve()
    if path.suffix in REFERENCE_FILES and path.is_file():
        return _inspect_poses(path)
    if not path.is_dir():
        return _inspect_bags(path, deep, show)
    if (path / "velodyne").is_dir():
        return _inspect_scans(path, "kitti", deep, show)
    # Files of a ROS 2 folder may be compressed, and then have other suffixes.
    if {p.suffix for p in path.iterdir()} & {*BAG_SUFFIXES} or (path / "metadata.yaml").exists():
        return _inspect_bags(path, deep, show)
    return _inspect_scans(path, "folder", deep, show)


def _inspect_poses(path: Path) -> Inspection:
    topic = Topic(path.name, "poses with stamps", 0)
    if timed := not is_kitti(path):
        reference = read_trajectory(path)
        topic.stamps = [reference.stamps.tolist()]
    else:
        poses = read_kitti(path)
        reference = Trajectory(np.arange(len(poses)), poses)
        topic.type = "poses, one for each scan"
    topic.count = topic.n_read = len(reference)
    found = Inspection(path, {"reference": str(path)}, {topic.name: topic}, reference=reference)
    found.faults += _reference_faults(reference, complete=True, timed=timed)
    return found


# Scan files that are read, unless all are to be.
_FILES = 40


def _inspect_scans(path: Path, kind: str, deep: bool, show: Progress) -> Inspection:
    source = RecordedSequence(SequenceConfig(**{kind: str(path)}, cache=False)).source
    frames = list(source.frames())
    number = len(frames) if deep else min(_FILES, len(frames))
    topic = Topic(str(path), "scans", len(frames), n_read=number)
    topic.stamps = [[frame.stamp for frame in frames]]
    found = Inspection(path, {kind: str(path)}, {topic.name: topic}, {"points": topic.name})
    found.complete = number == len(frames)
    for done, i in enumerate(np.linspace(0, len(frames) - 1, number).astype(int), start=1):
        try:
            _keep_scan(found, frames[i].load())
        except AdaptuneError as error:
            topic.undecoded.append(((frames[i].stamp - frames[0].stamp) * 1e-9, str(error)))
        show("reading", done, number)
    try:
        found.reference = source.poses(None, None)
    except AdaptuneError as error:
        found.faults.append(Fault(str(error), "reference", "a reference trajectory"))
    _find_faults(found, apart=False, slack=0.0)
    return found


def _keep_scan(found: Inspection, scan: Scan) -> None:
    with np.errstate(over="ignore"):
        found.valid.append(geometry.count_within(scan.points, 0.0, FARTHEST))
    found.readings.append(scan.reading)
    found.scan = found.scan or scan


# Reading bags: a sample of their messages, or all of them.


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


def _inspect_bags(path: Path, deep: bool, show: Progress) -> Inspection:
    about = {"topics": {}, "points": "", "n_messages": 0, "duration": 0, "begins": {}}
    source = BagSource(bag_paths([str(path)]), about=about)
    with source.open(by_index=True) as reader:
        topics = _topics(reader)
        used = _used(topics)
        given: dict[str, Any] = {"bag": str(path), **used}
        if "imu" in used:
            given["imu"] = {"topic": used["imu"]}
        found = Inspection(path, given, topics, used)
        source.topics = {topic.name: topic.type for topic in topics.values()}
        source.points = used.get("points", "")
        apart = _apart(reader, source.paths)
        found.faults += apart
        survey = _Survey(source, reader, found)
        survey.read(0 if deep else survey.n_parts(), show)
        found.reference = survey.trajectory()
    _find_faults(found, bool(apart), survey.slack)
    return found


def _topics(reader: AnyReader) -> dict[str, Topic]:
    first = {kind: fields[:1] for kind, (_, fields) in reader.typestore.fielddefs.items()}
    topics: dict[str, Topic] = {}
    for c in sorted(reader.connections, key=lambda c: c.topic):
        stamped = [f[1][1] for f in first.get(c.msgtype, ())] == ["std_msgs/msg/Header"]
        topics.setdefault(c.topic, Topic(c.topic, c.msgtype, 0, stamped)).count += c.msgcount
    return topics


def _used(topics: dict[str, Topic]) -> dict[str, str]:
    """Which topics adaptune would use: of several, the densest; others are parts of it."""
    poses = [kind for kind in POSES if "tf" not in kind]
    used = {}
    for of, kinds in (("points", POINTS_TYPES), ("reference", poses), ("imu", IMU_TYPES)):
        if fit := [t for t in topics.values() if t.type in kinds and t.count]:
            used[of] = max(fit, key=lambda t: (t.count, t.name)).name
    return used


def _apart(reader: AnyReader, paths: tuple[Path, ...]) -> list[Fault]:
    """Whether bags do not follow each other: the two with the longest time between them."""
    readers: Any = reader.readers
    spans = [(r.start_time, r.end_time, p.name) for r, p in zip(readers, paths, strict=True)]
    spans = sorted(span for span in spans if span[0] < span[1])
    ends = np.maximum.accumulate([end for _, end, _ in spans])
    gaps = [(start - end) * 1e-9 for (start, *_), end in zip(spans[1:], ends, strict=False)]
    if not gaps or max(gaps) <= _APART:
        return []
    longest = int(np.argmax(gaps))
    days = f" ({gaps[longest] / 86400.0:,.0f} days)" if gaps[longest] > 2.0 * 86400.0 else ""
    text = (
        f"the bags do not follow each other: {gaps[longest]:,.0f} s{days} lie between "
        f"{spans[longest][2]} and {spans[longest + 1][2]}; inspect each recording by itself, and "
        f"name each as a sequence of its own"
    )
    return [Fault(text, "points", "bags that follow each other")]


class _Survey:
    """Reads the messages of open bags, or a sample of them, into an inspection."""

    def __init__(self, source: BagSource, reader: AnyReader, found: Inspection):
        self._source, self._reader, self._found = source, reader, found
        self._begin = reader.start_time
        self._length = reader.end_time - reader.start_time
        # Number of clouds; where there are none, of messages.
        points = found.topics.get(source.points)
        self._usual = found.n_messages if points is None else points.count
        self._of = {name: of for of, name in found.used.items()}
        if points is not None:
            self._load = source.loader(reader)
        self._poses: list[Pose] = []
        self._path = b""
        self.slack = 0.0  # seconds between two parts of the sample

    def n_parts(self) -> int:
        """Parts of a sample; 0 if the recording is to be read completely.

        It is if it is short, or a part cannot be read without what is before it: in mcap files
        without chunks.
        """
        storages = [getattr(r, "storage", None) for r in self._reader.readers]
        opened = [file for s in storages for file in getattr(s, "storages", [s])]
        if not all(getattr(file, "chunks", True) for file in opened):
            return 0
        size = sum(path.stat().st_size for path in self._source.files)
        try:
            readers = self._reader.readers
            slow = any(isinstance(r, IndexReader) and r.is_slow() for r in readers)
        except Exception:  # damage, which reading reports
            slow = False
        speed = _SLOW if slow else _FAST
        seconds = size / speed + self._found.n_messages * _DECODE
        if seconds <= SECONDS or self._length <= 0:
            return 0
        # Whole chunks are unpacked for each part.
        cost = size * min(_EACH / max(self._usual, 1), 1.0) + min(size, 5e5)
        return int(np.clip(SECONDS * speed / cost, _FEWEST, _MOST))

    def _spans(self, number: int, count: int) -> list[Span]:
        """Parts of the recording in which a topic of so many messages has some each."""
        if not number or number * _EACH >= count:
            return [(None, None)]
        width = _EACH / count
        starts = self._begin + np.linspace(0.0, (1.0 - width) * self._length, number).astype(int)
        return [(start, start + round(width * self._length) + 1) for start in starts.tolist()]

    def read(self, number: int, show: Progress) -> None:
        """Read so many parts, or everything if it is 0."""
        found, done = self._found, 0
        spans = self._spans(number, self._usual)
        found.complete = spans == [(None, None)]
        if not found.complete:
            self.slack = self._length * 1e-9 / (len(spans) - 1)
        # What comes more rarely than the clouds has parts of its own.
        rare = [t for t in self._of if found.topics[t].count < self._usual and not found.complete]
        jobs: list[tuple[str | None, Span]] = [(None, span) for span in spans]
        jobs += [(t, span) for t in rare for span in self._spans(number, found.topics[t].count)]
        for name, span in jobs:
            chosen = [name] if name else [t for t in found.topics if t not in rare]
            for topic in chosen:
                found.topics[topic].stamps.append([])
            try:
                for connection, when, data in self._source.read(self._reader, name, span):
                    if connection.topic in chosen:
                        self._take(found.topics[connection.topic], when, data)
                    done += 1
                    if done % 100 == 0:
                        show("reading", done, found.n_messages)
            except SequenceError as error:
                fault = Fault(str(error), "points", "a recording that can be read to its end")
                if fault not in found.faults:
                    found.faults.append(fault)
        show("reading", found.n_messages, found.n_messages)

    def _take(self, topic: Topic, when: int, data: bytes) -> None:
        """Keep when a message was made and recorded, and decode it where it is used."""
        topic.n_read += 1
        stamp = header_of(data, self._reader.is2)[0] if topic.stamped else when
        if stamp is not None:
            topic.stamps[-1].append(stamp)
        if topic.type == PATH and topic.name in self._of:
            self._path = data  # each path repeats the one before: the last one will do
        else:
            self._decode(topic, when, data)

    def _decode(self, topic: Topic, when: int, data: bytes) -> None:
        try:
            match self._of.get(topic.name):
                case "points":
                    first = self._found.scan is None
                    _keep_scan(self._found, self._load(data, "message"))
                    if first and topic.type == POINTS_TYPES[0]:
                        fields = parse(data, self._reader.is2).fields
                        self._found.fields = tuple(name for name, *_ in fields)
                case "reference":
                    self._poses += POSES[topic.type](self._reader.deserialize(data, topic.type))
                case "imu":
                    message: Any = self._reader.deserialize(data, topic.type)
                    w, a = message.angular_velocity, message.linear_acceleration
                    np.asarray_chkfinite([w.x, w.y, w.z, a.x, a.y, a.z])
        except MachineError:
            raise
        except Exception as error:  # deserializers raise whatever damaged data leads them to
            why = str(error) or type(error).__name__
            topic.undecoded.append(((when - self._begin) * 1e-9, why))

    def trajectory(self) -> Trajectory | None:
        """The reference, as far as it was read; its faults are kept."""
        found = self._found
        if self._path:
            topic = found.topics[found.used["reference"]]
            self._decode(topic, self._reader.end_time, self._path)
        if not self._poses:
            return None
        trajectory, unusable = usable(self._poses)
        if unusable:
            what = f"{unusable} of {len(self._poses)} poses are not finite or have no rotation"
            lacks = "a reference trajectory" if trajectory is None else ""
            text = f"{found.used['reference']}: {what}: adaptune leaves them out"
            found.faults.append(Fault(text, "reference", lacks))
        return trajectory


# What is wrong with a recording: what it means, and what to do about it.


_FASTEST = 100.0  # metres per second
_STILL = 0.01  # metres
_MISSED = 0.01  # of the messages of a topic: fewer are not told

_UNDECODED = {
    "points": (
        "the stages stop there: set `stop` before it or `start` after it, or repair the bag",
        "point clouds that decode",
    ),
    "reference": (
        "it cannot be the reference: repair the bag, or name another topic or a file of poses",
        "a reference that decodes",
    ),
    "imu": ("leave `imu` out, or repair the bag", ""),
}
_GAPS = {
    "points": ": odometries lose track there; leave them out with `start`, `stop` or `cut`",
    "reference": ": scans in gaps beyond `max_gap` (1 s) are not labelled",
}


def _find_faults(found: Inspection, apart: bool, slack: float) -> None:
    """Add the faults of what was read.

    Between bags that are `apart` nothing is missing. Scans and reference may both go on for `slack`
    seconds beyond what was read.
    """
    of = {name: key for key, name in found.used.items()}
    for topic in found.topics.values():
        found.faults += _topic_faults(topic, of.get(topic.name, ""), found.complete, apart)
    scans = found.topics.get(found.used.get("points", ""))
    if scans is not None:
        found.faults += [*_cloud_faults(scans, found.valid), *_time_faults(found, scans)]
    if (reference := found.reference) is None:
        return
    poses = found.topics.get(found.used.get("reference", ""))
    complete = poses is None or found.complete or poses.count == 1
    found.faults += _reference_faults(reference, complete)
    if scans is not None and any(scans.stamps) and (found.complete or len(reference) > 1):
        found.faults += _overlap_faults(reference, scans.times, slack)


def _topic_faults(topic: Topic, of: str, complete: bool, apart: bool) -> Iterator[Fault]:
    if topic.undecoded:
        (seconds, why), n = topic.undecoded[0], len(topic.undecoded)
        help_, lacks = _UNDECODED[of]
        help_ = "the stages refuse them" if of == "points" and "`" in why else help_
        many = f"all {n}" if n == topic.n_read else f"{n} of {topic.n_read}"
        what = f"{many} messages do not decode, the first at {seconds:.1f} s ({why})"
        yield Fault(f"{topic.name}: {what}; {help_}", of, lacks)
    if of and topic.count and not topic.n_read and not complete:
        what = "are not in the sample, `--deep` reads them"
        yield Fault(f"{topic.name}: its {topic.count} messages {what}", of)
    if topic.stamped and any(topic.stamps) and not apart:
        yield from _stamp_faults(topic, of)
        if not complete and sum(map(len, topic.stamps)) < topic.count:
            yield from _count_faults(topic, of)


def _stamp_faults(topic: Topic, of: str) -> Iterator[Fault]:
    name, n = topic.name, len(topic.times)
    if wrong := np.count_nonzero(np.diff(topic.times) <= 0):
        help_ = ": adaptune leaves such scans out" if of == "points" else ""
        lacks = "stamps that increase" if wrong == n - 1 and of in ("points", "reference") else ""
        yield Fault(
            f"{name}: {wrong} of {n} stamps do not come after the one before{help_}", of, lacks
        )
    if len(topic.steps):
        gap, usual = topic.steps.max(), np.median(topic.steps)
        if gap > 3.5 * usual and gap > 0.2:
            lost = np.count_nonzero(topic.steps > 3.5 * usual)
            what = f"{lost} gaps, the longest of {gap:.2f} s{_GAPS.get(of, '')}"
            yield Fault(f"{name}: {what}", of)


def _count_faults(topic: Topic, of: str) -> Iterator[Fault]:
    """Messages that are missing between the parts of a sample, by their number in the whole."""
    usual = np.median(topic.steps) if len(topic.steps) else np.inf
    steps = topic.steps[np.abs(topic.steps - usual) < 0.2 * usual]
    # Only what comes regularly has a number to expect.
    if len(topic.steps) < 5 or len(steps) < 0.9 * len(topic.steps):
        return
    expected = 1 + round(int(np.ptp(topic.times)) * 1e-9 / float(steps.mean()))
    doubt = max(_MISSED, 3.0 * float(steps.std() / steps.mean()) / len(steps) ** 0.5)
    if topic.count < (1.0 - doubt) * expected:
        what = f"about {expected - topic.count:,} of {expected:,} messages are missing"
        yield Fault(f"{topic.name}: {what}: `--deep` looks for the gaps", of)


def _cloud_faults(topic: Topic, valid: list[int]) -> Iterator[Fault]:
    """Faults of clouds; those that were read have `valid` points each."""
    name = topic.name
    if topic.count == 1:
        yield Fault(f"{name}: holds a single cloud: no motion", "points", "more than one cloud")
    n, few = len(valid), sum(points < LEAST_POINTS for points in valid)
    rule = f"fewer than {LEAST_POINTS} valid points (finite, not zero, within {FARTHEST:g} m)"
    if few and few == n:
        help_ = "an odometry cannot use them: look at the driver, or choose another topic"
        yield Fault(f"{name}: all {n} clouds hold {rule}; {help_}", "points", "clouds with points")
    elif few:
        yield Fault(f"{name}: {few} of {n} clouds hold {rule}{_GAPS['points']}", "points")


def _time_faults(found: Inspection, topic: Topic) -> Iterator[Fault]:
    """Faults of the times of the points."""
    steps = topic.steps[topic.steps * 1e9 >= SOONEST]
    for doubt in doubts(found.readings, float(np.median(steps)) if len(steps) else 0.0):
        yield Fault(f"{topic.name}: {doubt.text}", doubt.of, doubt.lacks)


def _reference_faults(reference: Trajectory, complete: bool, timed: bool = True) -> Iterator[Fault]:
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
    seconds = np.diff(reference.stamps) * 1e-9 if timed else np.full(len(steps), 0.1)
    if jumps := np.count_nonzero(steps > _FASTEST * np.maximum(seconds, 1e-3)):
        help_ = "errors there are not the odometry's; leave them out with `start`, `stop` or `cut`"
        yield Fault(f"the reference jumps {jumps} times: {help_}", of)
    if complete and timed and (gaps := np.count_nonzero(seconds > reference.max_gap)):
        what = f"the reference has {gaps} gaps beyond {reference.max_gap:g} s"
        what += f", the longest of {seconds.max():.2f} s: their scans get no label"
        yield Fault(reference.sparse or what, of)


def _overlap_faults(
    reference: Trajectory, stamps: NDArray[np.int64], slack: float
) -> Iterator[Fault]:
    """Scans outside the reference; both may go on for `slack` seconds beyond what was read."""
    begin, end = int(reference.stamps[0]), int(reference.stamps[-1])
    scans = int(stamps.min()), int(stamps.max())
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


# Show an inspected recording on a terminal.


def render_inspection(inspection: Inspection, accuracy: str = "") -> RenderableType:
    """The inspection for a terminal, and how wrong its reference is, or how to find out."""
    parts: list[RenderableType] = [Text(str(inspection.path), style="bold")]
    parts.append(_topic_table(inspection))
    if inspection.fields:
        parts.append(Text(f"point: {', '.join(inspection.fields)}"))
    if inspection.scan is not None:
        parts.append(Text(f"first scan: {_scan_text(inspection.scan)}"))
    if inspection.reference is not None:
        text = _reference_text(inspection.reference, inspection.complete)
        parts.append(Text(f"reference: {text}"))
        if accuracy and inspection.name and not inspection.missing["offline"]:
            parts.append(Text(f"reference: {accuracy}"))
    elif inspection.scan is not None and not any(f.of == "reference" for f in inspection.faults):
        parts.append(Text("reference: none; adaptune estimates one from the scans"))
    parts.append(Text(_read_text(inspection)))
    parts += [Text(f"! {f.text}", "red" if f.lacks else "yellow") for f in inspection.faults]
    parts += [_stage_text(inspection, stage) for stage in inspection.missing]
    # Broken lines would not be YAML.
    parts.append(Text("\n" + inspection.entry, no_wrap=True, overflow="ignore"))
    return Group(*parts)


def _read_text(inspection: Inspection) -> str:
    (read, clouds), total = inspection.n_read, inspection.n_messages
    if inspection.complete:
        return f"read: {'all' if read >= total else f'{read:,} of'} {total:,} messages"
    among = f" ({clouds:,} clouds)" if 0 < clouds < read else ""
    what = "rates, gaps and problems are estimates; `--deep` reads all"
    return f"read: a sample of {read:,} of {total:,} messages{among}: {what}"


def _stage_text(inspection: Inspection, stage: str) -> Text:
    if lacking := inspection.missing[stage]:
        return Text(f"{stage}: lacks {' and '.join(lacking)}", style="red")
    if any(fault.of in _INPUTS[stage] for fault in inspection.faults):
        return Text(f"{stage}: can run, but see the lines with ! above", style="yellow")
    limit = "" if inspection.complete else ", as far as the sample shows"
    return Text(f"{stage}: has all it needs{limit}", style="green")


def _topic_table(inspection: Inspection) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("topic", "type", "count", "rate", "seconds", "max gap"):
        numeric = column not in ("topic", "type")
        table.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for topic in inspection.topics.values():
        seconds = np.ptp(topic.times) * 1e-9 if len(topic.times) else None
        figures = ((topic.rate, "{:.2f} Hz"), (seconds, "{:.2f}"), (topic.gap, "{:.3f} s"))
        table.add_row(
            topic.name,
            topic.type.replace("/msg/", "/"),
            str(topic.count),
            *("" if value is None else text.format(value) for value, text in figures),
        )
    return table


def _scan_text(scan: Scan) -> str:
    words = [f"{len(scan):,} points"]
    times, rings, light = scan.times, scan.rings, scan.intensities
    if len(scan):
        away = np.linalg.norm(scan.points, axis=1)
        middle = f"half of them within {np.median(away):.2f} m"
        words.append(f"{away.min():.2f} to {away.max():.2f} m away, {middle}")
        words.append("no times" if times is None else f"times spanning {np.ptp(times):.4f} s")
        words.append("no rings" if rings is None else f"{len(np.unique(rings))} rings")
        span = "" if light is None else f"from {light.min():g} to {light.max():g}"
        words.append(f"intensities {span}" if span else "no intensities")
    return ", ".join(words)


def _reference_text(reference: Trajectory, complete: bool) -> str:
    length = np.linalg.norm(np.diff(reference.T_world_sensor[:, :3, 3], axis=0), axis=1).sum()
    seconds = (reference.stamps[-1] - reference.stamps[0]) * 1e-9
    words = "poses, " if complete else "poses in the sample, at least "
    # Poses without stamps are numbered by nanoseconds.
    lasted = f" in {seconds:.1f} s" if seconds > 1e-3 else ""
    return f"{len(reference):,} {words}{length:.1f} m{lasted}"
