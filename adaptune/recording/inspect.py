"""Inspect a recording: what it holds, what is odd about it, and how to name it in a study."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from adaptune._system import files, yaml12
from adaptune._system.progress import Progress, unseen
from adaptune.errors import AdaptuneError, Finding, MachineError
from adaptune.recording import Scan, SequenceConfig, SequenceError
from adaptune.recording.bag import (
    IMU_TYPES,
    UNOPENED,
    BagSource,
    IndexReader,
    Window,
    storages,
)
from adaptune.recording.clouds import CLOUDS, decode_cloud, header_of, parse
from adaptune.recording.config import BAG_SUFFIXES, REFERENCE_FILES, bag_paths
from adaptune.recording.content import Content
from adaptune.recording.findings import (
    Topic,
    of_clouds,
    of_overlap,
    of_reference,
    of_times,
    of_topic,
)
from adaptune.recording.fleet import LONGEST_GAP
from adaptune.recording.folder import kitti, scan_folder
from adaptune.recording.pose_messages import PATH, POSES, Pose, untimed, usable
from adaptune.trajectory import Trajectory, is_kitti, read_kitti, read_trajectory

INPUTS = {  # of each stage
    "offline": ("points", "reference"),
    "online": ("points",),
    "motion compensation": ("points", "imu"),
}


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
    content: Content = field(default_factory=Content)  # of each cloud that was read
    reference: Trajectory | None = None  # as far as it was read
    findings: list[Finding] = field(default_factory=list)
    stamped_by: str = ""  # what gives the times of scans in files

    def keep(self, scan: Scan) -> None:
        """Look at a scan that was read."""
        self.content.see(scan)
        self.scan = self.scan or scan

    @property
    def n_messages(self) -> int:
        """How many messages, scans or poses there are."""
        return sum(topic.count for topic in self.topics.values())

    @property
    def n_read(self) -> tuple[int, int]:
        """How many of them were read, and clouds among them that could be decoded."""
        return sum(topic.n_read for topic in self.topics.values()), len(self.content.looks)

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
        """What each stage still needs; empty if it can run."""
        if not self.name:
            return {}
        lacks = {
            role: [f.lacks for f in self.findings if f.of == role and f.lacks]
            for role in ("points", "reference", "imu")
        }
        if self.scan is None and not any(finding.of == "points" for finding in self.findings):
            lacks["points"].append("point clouds that can be read")
        if self.scan is not None and self.scan.times is None:
            lacks["imu"].append("a time for each point")
        return {
            stage: tuple(dict.fromkeys(what for role in inputs for what in lacks[role]))
            for stage, inputs in INPUTS.items()
        }

    @property
    def entry(self) -> str:
        """YAML for a study."""
        if not self.name:
            return yaml12.dump(self.given)
        return yaml12.dump({"sequences": {self.name: self.given}}, self.hints)

    @property
    def hints(self) -> dict[yaml12.YamlPath, str]:
        """Comments for a study: what else its entry may say."""
        hints = []
        if "bag" in self.given and "reference" not in self.used:
            hints.append("reference: a topic, or a TUM, KITTI or EuRoC file; estimated if left out")
        if "bag" in self.given and "compensate" in self.given:
            hints.append("without `compensate` for an odometry that undoes the motion itself")
        if "bag" in self.given and self.scan is not None and self.scan.times is not None:
            hints.append("stamp: end - if headers mark scans' ends and times count from the start")
        return {("sequences", self.name): "\n".join(hints)}


def inspect(path: Path, deep: bool = False, show: Progress = unseen) -> Inspection:
    """Read a recording and report what it holds: a sample of it if it is long and not `deep`.

    It is a bag, a folder with bags, a KITTI sequence, a folder of scans, or a file of poses. An
    AdaptuneError says that it cannot be opened; what fails later is among its findings.
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
    there = files.entries(path)
    if {p.suffix for p in there} & {*BAG_SUFFIXES} or path / "metadata.yaml" in there:
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
    found.findings += of_reference(reference, complete=True, timed=timed)
    return found


_SCAN_FILES = 40  # scan files that are read, unless all are to be


def _inspect_scans(path: Path, kind: str, deep: bool, show: Progress) -> Inspection:
    source = kitti(path) if kind == "kitti" else scan_folder(path)
    frames = list(source.frames())
    number = len(frames) if deep else min(_SCAN_FILES, len(frames))
    topic = Topic(str(path), "scans", len(frames), n_read=number)
    topic.stamps = [[frame.stamp for frame in frames]]
    found = Inspection(path, {kind: str(path)}, {topic.name: topic}, {"points": topic.name})
    found.complete = number == len(frames)
    found.stamped_by, found.findings = source.stamped_by, [*source.findings]
    for done, i in enumerate(np.linspace(0, len(frames) - 1, number).astype(int), start=1):
        try:
            found.keep(frames[i].load())
        except AdaptuneError as error:
            topic.undecoded.append(((frames[i].stamp - frames[0].stamp) * 1e-9, str(error)))
        show("reading", done, number)
    try:
        found.reference = source.poses(None, None)
    except AdaptuneError as error:
        found.findings.append(
            Finding((), str(error), of="reference", lacks="a reference trajectory")
        )
    _find(found, separate=False, slack=0.0)
    return found


def _find(found: Inspection, separate: bool, slack: float) -> None:
    """Add what is wrong with what was read, see `of_topic` and `of_overlap`."""
    roles = {name: key for key, name in found.used.items()}
    for topic in found.topics.values():
        found.findings += of_topic(topic, roles.get(topic.name, ""), found.complete, separate)
    scans = found.topics.get(found.used.get("points", ""))
    if scans is not None:
        found.findings += [*of_clouds(scans, found.content), *of_times(scans, found.content)]
    if (reference := found.reference) is None:
        return
    poses = found.topics.get(found.used.get("reference", ""))
    complete = poses is None or found.complete or poses.count == 1
    begin = int(scans.times.min()) if scans is not None and any(scans.stamps) else None
    found.findings += of_reference(reference, complete, begin=begin)
    if scans is not None and any(scans.stamps) and (found.complete or len(reference) > 1):
        found.findings += of_overlap(reference, scans.times, slack)
        in_map = poses is not None and scans.frames == poses.frames
        found.findings += found.content.of_place(reference, in_map, (scans.name,))


# A recording that takes no longer than this is read completely, and a sample takes about as long.
SECONDS = 1.0
# Bytes read in a second, with BZ2 and without; seconds that a message takes to decode.
_SLOW, _FAST, _DECODE = 2.5e6, 2e8, 4e-5
_FEWEST, _MOST, _EACH = 5, 20, 2.5  # parts of a sample, and messages of a topic in each


def _inspect_bags(path: Path, deep: bool, show: Progress) -> Inspection:
    source = BagSource(bag_paths([str(path)]), about=UNOPENED)
    with source.open(by_index=True) as reader:
        topics = _topics(reader)
        used = _used(topics)
        given: dict[str, Any] = {"bag": str(path), **used}
        if "imu" in used:
            given["imu"] = {"topic": used["imu"]}
        found = Inspection(path, given, topics, used)
        source.topics = {topic.name: topic.type for topic in topics.values()}
        source.points = used.get("points", "")
        source.look_at_clock(reader)
        found.findings += source.findings
        separate = _separate(reader, source.paths)
        found.findings += separate
        survey = _Survey(source, reader, found)
        survey.read(0 if deep else survey.n_parts(), show)
        found.reference = survey.trajectory()
    _find(found, bool(separate), survey.slack)
    return found


def _topics(reader: AnyReader) -> dict[str, Topic]:
    first = {kind: fields[:1] for kind, (_, fields) in reader.typestore.fielddefs.items()}
    topics: dict[str, Topic] = {}
    for c in sorted(reader.connections, key=lambda c: (c.topic, -c.msgcount)):
        stamped = [f[1][1] for f in first.get(c.msgtype, ())] == ["std_msgs/msg/Header"]
        topic = topics.setdefault(c.topic, Topic(c.topic, c.msgtype, 0, stamped))
        topic.count += c.msgcount
        topic.types[c.msgtype] += c.msgcount
    return topics


def _used(topics: dict[str, Topic]) -> dict[str, str]:
    """Which topics adaptune would use: of several, the densest; others are parts of it."""
    poses = [kind for kind in POSES if "tf" not in kind]
    used = {}
    for role, kinds in (("points", tuple(CLOUDS)), ("reference", poses), ("imu", IMU_TYPES)):
        if fit := [t for t in topics.values() if t.type in kinds and t.count]:
            used[role] = max(fit, key=lambda t: (t.count, t.name)).name
    return used


def _separate(reader: AnyReader, paths: tuple[Path, ...]) -> list[Finding]:
    """Whether bags do not follow each other: the two with the longest time between them."""
    readers: Any = reader.readers
    spans = [(r.start_time, r.end_time, p.name) for r, p in zip(readers, paths, strict=True)]
    spans = sorted(span for span in spans if span[0] < span[1])
    ends = np.maximum.accumulate([end for _, end, _ in spans])
    gaps = [(start - end) * 1e-9 for (start, *_), end in zip(spans[1:], ends, strict=False)]
    if not gaps or max(gaps) <= LONGEST_GAP:
        return []
    longest = int(np.argmax(gaps))
    days = f" ({gaps[longest] / 86400.0:,.0f} days)" if gaps[longest] > 2.0 * 86400.0 else ""
    what = (
        f"the bags do not follow each other: {gaps[longest]:,.0f} s{days} lie between "
        f"{spans[longest][2]} and {spans[longest + 1][2]}"
    )
    mend = "inspect each recording by itself, and name each as a sequence of its own"
    return [Finding((), what, mend, of="points", lacks="bags that follow each other")]


class _Survey:
    """Reads the messages of open bags, or a sample of them, into an inspection."""

    def __init__(self, source: BagSource, reader: AnyReader, found: Inspection):
        self._source, self._reader, self._found = source, reader, found
        begin, end = source.window
        self._begin = reader.start_time if begin is None else begin
        self._length = (reader.end_time if end is None else end) - self._begin
        # Number of clouds; where there are none, of messages.
        points = found.topics.get(source.points)
        self._usual = found.n_messages if points is None else points.count
        self._roles = {name: role for role, name in found.used.items()}
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
        is2 = self._reader.is2
        if is2 and not all(getattr(file, "chunks", True) for file in storages(self._reader)):
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

    def _spans(self, number: int, count: int) -> list[Window]:
        """Parts of the recording in which a topic of so many messages has some each."""
        if not number or number * _EACH >= count:
            return [self._source.window]
        width = _EACH / count
        starts = self._begin + np.linspace(0.0, (1.0 - width) * self._length, number).astype(int)
        return [(start, start + round(width * self._length) + 1) for start in starts.tolist()]

    def read(self, number: int, show: Progress) -> None:
        """Read so many parts, or everything if it is 0."""
        found, done = self._found, 0
        spans = self._spans(number, self._usual)
        found.complete = spans == [self._source.window]
        rare: list[str] = []
        if not found.complete:
            self.slack = self._length * 1e-9 / (len(spans) - 1)
            # What comes more rarely than the clouds has parts of its own.
            rare = [t for t in self._roles if found.topics[t].count < self._usual]
        jobs: list[tuple[str | None, Window]] = [(None, span) for span in spans]
        jobs += [(t, span) for t in rare for span in self._spans(number, found.topics[t].count)]
        for name, span in jobs:
            chosen = [name] if name else [t for t in found.topics if t not in rare]
            for topic in chosen:
                found.topics[topic].stamps.append([])
            try:
                for connection, when, data in self._source.read(self._reader, name, span):
                    if connection.topic in chosen:
                        self._take(found.topics[connection.topic], connection.msgtype, when, data)
                    done += 1
                    if done % 100 == 0:
                        show("reading", done, found.n_messages)
            except SequenceError as error:
                lacks = "a recording that can be read to its end"
                damage = Finding((), str(error), of="points", lacks=lacks)
                if damage not in found.findings:
                    found.findings.append(damage)
        show("reading", found.n_messages, found.n_messages)

    def _take(self, topic: Topic, kind: str, when: int, data: bytes) -> None:
        """Keep when a message was made and recorded, and decode it where it is used."""
        topic.n_read += 1
        stamp, frame = header_of(data, self._reader.is2) if topic.stamped else (when, "")
        if stamp is not None:
            topic.stamps[-1].append(stamp)
            topic.recorded.append(when)
            topic.frames.add(frame)
        if kind == PATH and topic.name in self._roles:
            self._path = data  # each path repeats the one before: the last one will do
        else:
            self._decode(topic, kind, when, data)

    def _decode(self, topic: Topic, kind: str, when: int, data: bytes) -> None:
        try:
            match self._roles.get(topic.name):
                case "points":
                    first = self._found.scan is None
                    self._found.keep(self._load(kind, data, "message"))
                    if first and CLOUDS[kind] is decode_cloud:
                        fields = parse(data, self._reader.is2).fields
                        self._found.fields = tuple(name for name, *_ in fields)
                case "reference":
                    self._poses += POSES[kind](self._reader.deserialize(data, kind))
                case "imu":
                    message: Any = self._reader.deserialize(data, kind)
                    w, a = message.angular_velocity, message.linear_acceleration
                    np.asarray_chkfinite([w.x, w.y, w.z, a.x, a.y, a.z])
        except MachineError:
            raise
        except Exception as error:  # deserializers raise whatever damaged data leads them to
            why = str(error) or type(error).__name__
            topic.undecoded.append(((when - self._begin) * 1e-9, why))

    def trajectory(self) -> Trajectory | None:
        """The reference, as far as it was read; what is wrong with it is kept."""
        found = self._found
        if self._path:
            topic = found.topics[found.used["reference"]]
            self._decode(topic, PATH, self._reader.end_time, self._path)
        if not self._poses:
            return None
        where = (found.used["reference"],)
        if what := untimed(self._poses):
            mend, lacks = "name another topic, or a file of poses", "poses with stamps"
            found.findings.append(Finding(where, what, mend, of="reference", lacks=lacks))
            return None
        trajectory, left_out = usable(self._poses)
        mend, lacks = "adaptune leaves them out", "a reference trajectory" * (trajectory is None)
        found.findings += [Finding(where, w, mend, of="reference", lacks=lacks) for w in left_out]
        return trajectory
