"""Inspect a recording: what it holds, what is odd about it, and how to name it in a study."""

import datetime
from collections.abc import Iterator, Sequence
from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from adaptune import files
from adaptune.errors import AdaptuneError
from adaptune.progress import Progress, unseen
from adaptune.recording import Scan, SequenceConfig, SequenceError, cache
from adaptune.recording import survey as faults
from adaptune.recording.clouds import DATATYPES, RING_FIELDS
from adaptune.recording.config import BAG_SUFFIXES, REFERENCE_FILES
from adaptune.recording.recording import RecordedSequence, open_sequence
from adaptune.recording.scan import TIME_FIELDS
from adaptune.recording.survey import Fault, Parts, Reading, Survey, n_valid, survey
from adaptune.trajectory import Trajectory, is_kitti, read_kitti, read_trajectory

Layout = tuple[tuple[str, str, int], ...]
"""Name, type and offset of the fields of a point."""

_KITTI_FOLDERS = ("velodyne", "velodyne_points")
# Scan files that are read, unless all are to be.
_FILES = 40


@dataclass(frozen=True)
class Topic:
    """A topic, the scans of a folder, or the poses of a file."""

    name: str
    type: str
    count: int  # messages
    # Messages per second of their stamps; for topics without stamps, of their recording.
    rate: float | None = None
    # Nanoseconds of the first and the last stamp that was read.
    first: int | None = None
    last: int | None = None
    gap: float | None = None  # longest time between one message and the next, in seconds


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
    complete: bool  # whether it was read to its end or damage, and not only a sample of it
    n_read: tuple[int, int]  # messages that were read, and clouds among them
    layout: Layout  # of the first cloud
    scan: ScanSummary | None  # none where no scan could be read
    reference: Trajectory | None  # as far as it was read
    faults: tuple[Fault, ...]
    # What each stage still needs, by stage; empty if it can run.
    missing: dict[str, tuple[str, ...]]
    entry: str  # YAML for a study

    @property
    def n_messages(self) -> int:
        """How many messages, scans or poses there are."""
        return sum(topic.count for topic in self.topics)

    @property
    def name(self) -> str:
        """Name of the sequence that is proposed; empty if there is none, as for a file of poses."""
        document: Any = files.Document(self.entry).data or {}
        return next(iter(document.get("sequences", {})), "")

    def config(self) -> SequenceConfig:
        """The sequence that is proposed."""
        document: Any = files.Document(self.entry).data
        return SequenceConfig(**document["sequences"][self.name])

    def doubts(self, stage: str) -> bool:
        """Whether a fault concerns a stage that can run."""
        return any(fault.of in _INPUTS[stage] for fault in self.faults)


# What each stage uses.
_INPUTS = {
    "offline": ("points", "reference"),
    "online": ("points",),
    "comparison with the reference": ("points", "reference"),
    "motion compensation": ("points", "imu"),
}


def inspect(path: Path, deep: bool = False, show: Progress = unseen) -> Inspection:
    """Read a recording and report what it holds: a sample of it if it is long and not `deep`.

    It is a bag, a folder with bags, a KITTI sequence or drive, a folder of scans, or a file of
    poses. An AdaptuneError says that it cannot be opened at all. What fails later is among the
    faults.
    """
    if not path.exists():
        raise SequenceError(f"{path}: there is no such file or folder")
    # The study that names it may lie in any folder.
    path = path.resolve()
    if path.suffix in REFERENCE_FILES and path.is_file():
        return _inspect_poses(path)
    kind = _kind(path)
    if kind == "bag":
        return _inspect_bag(path, survey(path, deep, show))
    return _inspect_scans(path, kind, deep, show)


def _kind(path: Path) -> str:
    """Key of the `sequences:` entry that opens it."""
    if not path.is_dir():
        return "bag"
    if any((path / name).is_dir() for name in _KITTI_FOLDERS):
        return "kitti"
    # Files of a ROS 2 folder may be compressed, and then have other suffixes.
    bags = {p.suffix for p in path.iterdir()} & {*BAG_SUFFIXES}
    return "bag" if bags or (path / "metadata.yaml").exists() else "folder"


def _inspect_bag(path: Path, found: Survey) -> Inspection:
    given: dict[str, Any] = {"bag": str(path)}
    used = {"points": found.points, "reference": found.reference, "imu": found.imu}
    given |= {key: name for key, name in used.items() if name is not None}
    if found.imu is not None:
        given["imu"] = {"topic": found.imu}
    reference, problems = found.trajectory(), found.faults
    for topic in found.topics.values():
        of = next((key for key, name in used.items() if name == topic.name), "")
        problems += _topic_faults(topic, of, found.complete, found.apart)
    if found.points is not None:
        problems += faults.of_clouds(found.points, found.topics[found.points].count, found.valid)
    layout: Layout = ()
    summary = None
    if found.first is not None:
        layout, count = _layout(found.first[1])
        summary = _summary(found.first[0], count)
    if reference is not None and found.reference is not None:
        alone = found.topics[found.reference].count == 1
        problems += faults.of_reference(reference, found.complete or alone)
        if (scans := _scan_span(found)) is not None and (found.complete or len(reference) > 1):
            problems += faults.of_overlap(reference, scans, found.slack)
    readings = found.topics.values()
    return Inspection(
        path,
        topics=tuple(_topic(reading) for reading in readings),
        complete=found.complete,
        n_read=(sum(reading.n_read for reading in readings), len(found.valid)),
        layout=layout,
        scan=summary,
        reference=reference,
        faults=tuple(problems),
        missing=_missing(summary, problems),
        entry=_entry(path, given, found),
    )


def _inspect_scans(path: Path, kind: str, deep: bool, show: Progress) -> Inspection:
    given = {kind: str(path)}
    sequence = open_sequence(SequenceConfig(**given, cache=False))
    assert isinstance(sequence, RecordedSequence)
    frames = list(sequence.source.frames())
    number = len(frames) if deep else min(_FILES, len(frames))
    chosen = [frames[i] for i in np.linspace(0, len(frames) - 1, number).astype(int)]
    reading = Reading(str(path), "scans", len(frames), stamped=True)
    reading.stamps = [[frame.stamp for frame in frames]]
    reading.recorded = [[frame.stamp for frame in chosen]]
    valid, summary, reference = [], None, None
    for done, frame in enumerate(chosen, start=1):
        try:
            scan = frame.load()
        except AdaptuneError as error:
            reading.undecoded.append(((frame.stamp - frames[0].stamp) * 1e-9, str(error)))
            continue
        valid.append(n_valid(scan))
        summary = summary or _summary(scan, 0)
        show("reading", done, number)
    problems = [
        *_topic_faults(reading, "points", complete=True),
        *faults.of_clouds(str(path), len(frames), valid),
    ]
    try:
        reference = sequence.source.poses(None, None)
    except AdaptuneError as error:
        problems.append(Fault(str(error), "reference", "a reference trajectory"))
    if reference is not None:
        problems += faults.of_reference(reference, complete=True)
        problems += faults.of_overlap(reference, (frames[0].stamp, frames[-1].stamp), 0.0)
    return Inspection(
        path,
        topics=(_topic(reading),),
        complete=number == len(frames),
        n_read=(number, number),
        layout=(),
        scan=summary,
        reference=reference,
        faults=tuple(problems),
        missing=_missing(summary, problems),
        entry=_entry(path, given),
    )


def _inspect_poses(path: Path) -> Inspection:
    timed = not is_kitti(path)
    if timed:
        reference, kind = read_trajectory(path), "poses with stamps"
    else:
        poses, kind = read_kitti(path), "poses, one for each scan"
        reference = Trajectory(np.arange(len(poses)), poses)
    stamps = reference.stamps.tolist() if timed else []
    reading = Reading(path.name, kind, len(reference), timed, [stamps], [[0] * len(reference)])
    topic = _topic(reading) if timed else Topic(path.name, kind, len(reference))
    return Inspection(
        path,
        topics=(topic,),
        complete=True,
        n_read=(len(reference), 0),
        layout=(),
        scan=None,
        reference=reference,
        faults=tuple(faults.of_reference(reference, complete=True, timed=timed)),
        missing={},
        entry=files.dump({"reference": str(path)}),
    )


def _topic(reading: Reading) -> Topic:
    parts: Parts = reading.stamps if any(reading.stamps) else reading.recorded
    times = [time for part in parts for time in part]
    if not times:
        return Topic(reading.name, reading.kind, reading.count)
    steps = faults.inner_steps(parts)
    positive = steps[steps > 0]
    rate = float(1.0 / np.median(positive)) if len(positive) else None
    gap = float(positive.max()) if len(positive) else None
    return Topic(reading.name, reading.kind, reading.count, rate, min(times), max(times), gap)


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


def _topic_faults(topic: Reading, of: str, complete: bool, apart: bool = False) -> Iterator[Fault]:
    if topic.undecoded:
        (seconds, why), n = topic.undecoded[0], len(topic.undecoded)
        help_, lacks = _UNDECODED[of]
        many = f"all {n}" if n == topic.n_read else f"{n} of {topic.n_read}"
        what = f"{many} messages do not decode, the first at {seconds:.1f} s ({why})"
        yield Fault(f"{topic.name}: {what}; {help_}", of, lacks)
    if of and topic.count and not topic.n_read:
        if complete:
            what, lacks = "are listed but cannot be found: repair the bag", _UNDECODED[of][1]
        else:
            what, lacks = "are not in the sample, `--deep` reads them", ""
        yield Fault(f"{topic.name}: its {topic.count} messages {what}", of, lacks)
    # Between bags that do not follow each other nothing is missing.
    if any(topic.stamps) and not apart:
        yield from faults.of_stamps(topic.name, of, topic.stamps, topic.recorded)
        if not complete:
            yield from faults.of_count(topic.name, of, topic.stamps, topic.count)


def _scan_span(found: Survey) -> tuple[int, int] | None:
    """First and last stamp of the scans that were read, without those that leap."""
    topic = found.topics.get(found.points or "")
    if topic is None or not any(topic.stamps):
        return None
    stamps, recorded = (
        np.array([t for part in parts for t in part], np.int64)
        for parts in (topic.stamps, topic.recorded)
    )
    if len(stamps) == len(recorded):
        late = recorded - stamps
        stamps = stamps[np.abs(late - np.median(late)) < 5e9]
    return (int(stamps.min()), int(stamps.max())) if len(np.unique(stamps)) > 1 else None


def _layout(message: Any) -> tuple[Layout, int]:
    """Fields of a point of a cloud, and how many points it holds."""
    if not hasattr(message, "fields"):
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


def _missing(scan: ScanSummary | None, problems: Items[Fault]) -> dict[str, tuple[str, ...]]:
    """What each stage needs and does not find; where there is no reference, one is estimated."""
    lacks = {
        of: tuple({f.lacks: None for f in problems if f.of == of and f.lacks})
        for of in ("points", "reference")
    }
    clouds, truth = lacks["points"], lacks["reference"]
    if scan is None and not any(f.of == "points" for f in problems):
        clouds = ("point clouds that can be read",)
    timeless = scan is not None and scan.scan.times is None
    times = ("a time for each point",) if timeless else ()
    return {
        "offline": (*clouds, *truth),
        "online": clouds,
        "comparison with the reference": (*clouds, *truth),
        "motion compensation": (*clouds, *times),
    }


def _entry(path: Path, given: dict[str, Any], found: Survey | None = None) -> str:
    name = "".join(c if c.isalnum() or c in "_.-" else "_" for c in path.stem).lstrip(".-")
    text = files.dump({"sequences": {name or "recording": given}})
    if found is None:
        return text
    if found.reference is None:
        text += "    # reference: a topic, or a TUM, KITTI or EuRoC file; estimated if left out\n"
    if found.first is not None and found.first[0].times is not None:
        text += "    # stamp: end - if headers mark scans' ends and times count from the start\n"
    return text


# Show an inspected recording, and the cache, on a terminal.


def render_inspection(inspection: Inspection, accuracy: str = "") -> RenderableType:
    """The inspection for a terminal.

    Parameters
    ----------
    inspection
        What was found.
    accuracy
        How wrong its reference is, or how to find out.
    """
    parts: list[RenderableType] = [Text(str(inspection.path), style="bold")]
    parts.append(_topic_table(inspection))
    if inspection.layout:
        parts.append(Text(f"point: {_layout_text(inspection.layout)}"))
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
    if inspection.doubts(stage):
        return Text(f"{stage}: can run, but see the lines with ! above", style="yellow")
    limit = "" if inspection.complete else ", as far as the sample shows"
    return Text(f"{stage}: has all it needs{limit}", style="green")


def _topic_table(inspection: Inspection) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("topic", "type", "count", "rate", "seconds", "max gap"):
        numeric = column not in ("topic", "type")
        table.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for topic in inspection.topics:
        seconds = ""
        if topic.first is not None and topic.last is not None:
            seconds = f"{(topic.last - topic.first) * 1e-9:.2f}"
        table.add_row(
            topic.name,
            topic.type.replace("/msg/", "/"),
            str(topic.count),
            "" if topic.rate is None else f"{topic.rate:.2f} Hz",
            seconds,
            "" if topic.gap is None else f"{topic.gap:.3f} s",
        )
    return table


def _layout_text(layout: Sequence[tuple[str, str, int]]) -> str:
    words = []
    for name, kind, offset in layout:
        role = " (time)" if name in TIME_FIELDS else " (ring)" if name in RING_FIELDS else ""
        words.append(f"{name}{role} {kind}@{offset}" if kind else f"{name}{role}")
    return ", ".join(words)


def _scan_text(scan: ScanSummary) -> str:
    words = [f"{len(scan.scan):,} points"]
    if scan.recorded > len(scan.scan):
        words[0] += f" of {scan.recorded:,}"
    if scan.ranges is not None:
        near, middle, far = scan.ranges
        words.append(f"{near:.2f} to {far:.2f} m away, half of them within {middle:.2f} m")
    words.append("no times" if scan.span is None else f"times spanning {scan.span:.4f} s")
    words.append("no rings" if scan.rings is None else f"{scan.rings} rings")
    light = scan.scan.intensities
    if light is None or not len(light):
        words.append("no intensities")
    else:
        words.append(f"intensities from {light.min():g} to {light.max():g}")
    return ", ".join(words)


def _reference_text(reference: Trajectory, complete: bool) -> str:
    length = np.linalg.norm(np.diff(reference.T_world_sensor[:, :3, 3], axis=0), axis=1).sum()
    seconds = (reference.stamps[-1] - reference.stamps[0]) * 1e-9
    words = "poses, " if complete else "poses in the sample, at least "
    # Poses without stamps are numbered by nanoseconds.
    lasted = f" in {seconds:.1f} s" if seconds > 1e-3 else ""
    return f"{len(reference):,} {words}{length:.1f} m{lasted}"


def render_cache() -> RenderableType:
    """The decoded sequences on disk, for a terminal."""
    entries = cache.list_cache()
    table = Table(box=None, pad_edge=False)
    for column in ("sequence", "scans", "size", "last used"):
        table.add_column(column, justify="left" if column == "sequence" else "right")
    for entry in entries:
        used = datetime.datetime.fromtimestamp(entry.used).strftime("%Y-%m-%d %H:%M")
        table.add_row(entry.name, str(entry.n_scans), f"{entry.size / 1e6:,.1f} MB", used)
    total, most = sum(entry.size for entry in entries) / 1e9, cache.cap() / 1e9
    return Group(table, Text(f"{cache.folder()}: {total:.2f} GB of at most {most:g} GB"))
