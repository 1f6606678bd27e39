"""What a recording holds, what is odd about it, and how to name it in a study."""

import datetime
from collections.abc import Iterator
from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from adaptune import geometry, yaml
from adaptune.errors import AdaptuneError
from adaptune.files import replacing
from adaptune.sequence import Scan, SequenceConfig, SequenceError, cache, open_sequence
from adaptune.sequence.bag import IMU_TYPES, POINTS_TYPES, POSES, BagSource, bag_paths
from adaptune.sequence.pointcloud2 import RING_FIELDS
from adaptune.sequence.sequence import RecordedSequence
from adaptune.sequence.serialized import header_stamp
from adaptune.sequence.timing import TIME_FIELDS
from adaptune.trajectory import Trajectory

_KITTI_FOLDERS = ("velodyne", "velodyne_points")


@dataclass(frozen=True)
class Topic:
    """A topic, or the scans of a folder.

    Attributes
    ----------
    name, type : str
    count : int
        Messages.
    rate : float, optional
        Messages per second of their stamps; for topics without stamps, of their recording.
    first, last : int, optional
        Nanoseconds of the first and the last stamp.
    gap : float, optional
        Longest time between one message and the next, in seconds.
    oddities : tuple of str
        What is wrong with the stamps.
    """

    name: str
    type: str
    count: int
    rate: float | None = None
    first: int | None = None
    last: int | None = None
    gap: float | None = None
    oddities: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ScanSummary:
    """The first scan.

    Attributes
    ----------
    scan : Scan
    recorded : int
        Points in the message, those without a measurement included.
    ranges : tuple of float
        Least, median and greatest distance in metres.
    span : float, optional
        Seconds from the first point to the last.
    rings : int, optional
        How many rings there are.
    """

    scan: Scan
    recorded: int
    ranges: tuple[float, float, float] | None
    span: float | None
    rings: int | None


@dataclass(frozen=True, eq=False)
class Inspection:
    """What is known of a recording.

    Attributes
    ----------
    path : Path
    topics : tuple of Topic
    layout : tuple of (name, type, offset)
        Fields of a point, in the first cloud.
    scan : ScanSummary, optional
        None where no scan could be read.
    reference : Trajectory, optional
    problems : tuple of str
        What is odd or cannot be read.
    missing : dict
        What each stage still needs, by stage; nothing where it can run.
    entry : str
        YAML for the `sequences:` of a study.
    """

    path: Path
    topics: tuple[Topic, ...]
    layout: tuple[tuple[str, str, int], ...]
    scan: ScanSummary | None
    reference: Trajectory | None
    problems: tuple[str, ...]
    missing: dict[str, tuple[str, ...]]
    entry: str


def inspect(path: Path) -> Inspection:
    """Read through a recording and tell what it holds.

    Parameters
    ----------
    path
        A bag, a folder with bags, a KITTI sequence or drive, or a folder of scans.

    Raises
    ------
    SequenceError
        If it cannot be opened at all. What cannot be read after that is among the problems.
    """
    if not path.exists():
        raise SequenceError(f"{path}: there is no such file or folder")
    given: dict[str, Any] = {}
    topics: tuple[Topic, ...] = ()
    layout: tuple[tuple[str, str, int], ...] = ()
    problems: list[str] = []
    kind = _kind(path)
    given[kind] = str(path)
    if kind == "bag":
        source = _any_bag(path)
        topics, read = _topics(source)
        problems += read
        clouds = [t for t in topics if t.type in POINTS_TYPES and t.count]
        if clouds:
            # The densest of several: others are its own parts, or filtered.
            given["points"] = max(clouds, key=lambda t: (t.count, t.name)).name
        poses = [t for t in topics if t.type in POSES and t.count and "tf" not in t.type.lower()]
        if poses:
            given["reference"] = max(poses, key=lambda t: t.count).name
        if any(t.type in IMU_TYPES for t in topics):
            given["imu"] = {"topic": next(t.name for t in topics if t.type in IMU_TYPES)}
    scan, reference = None, None
    if kind != "bag" or "points" in given:
        scan, reference, layout, found, more = _first_scan(given)
        topics = topics or found
        problems += more
    for topic in topics:
        problems += [f"{topic.name}: {oddity}" for oddity in topic.oddities]
    if reference is not None:
        problems += _reference_problems(reference)
    missing = _missing(scan, reference)
    return Inspection(
        path,
        topics,
        layout,
        scan,
        reference,
        tuple(problems),
        missing,
        _entry(path, given, reference),
    )


def _kind(path: Path) -> str:
    """Key of a `sequences:` entry that opens it."""
    if not path.is_dir():
        return "bag"
    if any((path / name).is_dir() for name in _KITTI_FOLDERS):
        return "kitti"
    suffixes = {p.suffix for p in path.iterdir()}
    return "bag" if suffixes & {".bag", ".mcap", ".db3"} else "folder"


def _any_bag(path: Path) -> BagSource:
    """The bag, opened without asking for point clouds."""
    about = {"topics": {}, "points": "", "n_messages": 0, "duration": 0, "begins": {}}
    return BagSource(bag_paths([str(path)]), about=about)


def _topics(source: BagSource) -> tuple[tuple[Topic, ...], list[str]]:
    """Every topic with its stamps, and what kept them from being read."""
    problems = []
    with source.open() as reader:
        kinds = {c.topic: c.msgtype for c in reader.connections}
        counts = dict.fromkeys(kinds, 0)
        stamps: dict[str, list[int]] = {topic: [] for topic in kinds}
        recorded: dict[str, list[int]] = {topic: [] for topic in kinds}
        definitions = reader.typestore.fielddefs
        stamped = {
            topic
            for topic, kind in kinds.items()
            if kind in definitions
            and definitions[kind][1]
            and definitions[kind][1][0][1][1] == "std_msgs/msg/Header"
        }
        try:
            for connection, when, data in source.read(reader):
                topic = connection.topic
                counts[topic] += 1
                recorded[topic].append(when)
                stamp = header_stamp(data, reader.is2) if topic in stamped else None
                if stamp is not None:
                    stamps[topic].append(stamp)
        except SequenceError as error:
            problems.append(str(error))
    topics = tuple(
        _topic(topic, kinds[topic], counts[topic], stamps[topic], recorded[topic])
        for topic in sorted(kinds)
    )
    return topics, problems


def _topic(
    name: str, kind: str, count: int, stamps: Items[int], recorded: Items[int] = ()
) -> Topic:
    times = np.array(stamps or recorded, np.int64)
    if not count or len(times) < 1:
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
    told = []
    steps = np.diff(stamps)
    if len(stamps) > 1 and stamps.max() == 0:
        return ("all stamps are zero",)
    for what, number in (
        ("stamps repeat the one before", np.count_nonzero(steps == 0)),
        ("stamps go back in time", np.count_nonzero(steps < 0)),
        # Recordings that count from zero begin with it.
        ("stamps are zero", np.count_nonzero(stamps[1:] == 0)),
    ):
        if number:
            told.append(f"{number} {what}")
    if gap is not None and rate is not None and gap * rate > 3.5 and gap > 0.2:
        lost = np.count_nonzero(steps * 1e-9 * rate > 3.5)
        told.append(f"{lost} gaps, the longest of {gap:.2f} s")
    if len(recorded) == len(stamps):
        late = (np.array(recorded, np.int64) - stamps) * 1e-9
        usual = float(np.median(late))
        if abs(usual) > 5.0:
            told.append(f"its clock is {abs(usual):.3f} s {_side(usual)} the recorder's")
        if leaps := np.count_nonzero(np.abs(late - usual) > 5.0):
            told.append(f"{leaps} stamps leap by more than 5 s against the recorder's clock")
    return tuple(told)


def _side(late: float) -> str:
    return "behind" if late > 0 else "ahead of"


def _first_scan(
    given: dict[str, Any],
) -> tuple[
    ScanSummary | None,
    Trajectory | None,
    tuple[tuple[str, str, int], ...],
    tuple[Topic, ...],
    list[str],
]:
    """First scan and reference through the very reader that the stages use."""
    problems = []
    scan, reference = None, None
    layout: tuple[tuple[str, str, int], ...] = ()
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
    count = 0
    try:
        if isinstance(source, BagSource):
            layout, count = _layout(source)
        else:
            stamps = [frame.stamp for frame in source.frames()]
            topics = (_topic(str(source.name), "scans", len(stamps), stamps),)
        scan = _summary(next(iter(sequence)), count)
    except AdaptuneError as error:
        problems.append(str(error))
    try:
        reference = sequence.reference()
    except AdaptuneError as error:
        problems.append(str(error))
    return scan, reference, layout, topics, problems


def _layout(source: BagSource) -> tuple[tuple[tuple[str, str, int], ...], int]:
    """Fields of a point of the first cloud, and how many points it holds."""
    message = next(source.messages(source.points), None)
    if message is None or not hasattr(message, "fields"):
        points = list(getattr(message, "points", ()))
        names = [name for point in points[:1] for name in vars(point) if name[:2] != "__"]
        return tuple((name, "", 0) for name in names), len(points)
    kinds = {1: "int8", 2: "uint8", 3: "int16", 4: "uint16", 5: "int32", 6: "uint32"}
    kinds |= {7: "float32", 8: "float64"}
    fields = tuple(
        (
            field.name,
            kinds.get(field.datatype, "?") + (f"[{field.count}]" if field.count > 1 else ""),
            int(field.offset),
        )
        for field in sorted(message.fields, key=lambda field: field.offset)
    )
    return fields, int(message.height) * int(message.width)


def _summary(scan: Scan, recorded: int) -> ScanSummary:
    ranges = np.linalg.norm(scan.points, axis=1)
    return ScanSummary(
        scan,
        max(recorded, len(scan)),
        (float(ranges.min()), float(np.median(ranges)), float(ranges.max())) if len(scan) else None,
        None if scan.times is None or not len(scan) else float(np.ptp(scan.times)),
        None if scan.rings is None else len(np.unique(scan.rings)),
    )


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
    entry = dict(given)
    text = yaml.dump({"sequences": {name or "recording": entry}})
    if reference is None and "reference" not in entry:
        text += "    # reference: its poses - a topic, or a TUM, KITTI or EuRoC file\n"
    if "points" in entry and "stamp" not in entry:
        text += "    # stamp: end - if headers mark scans' ends and times count from the start\n"
    return text


def render_inspection(inspection: Inspection) -> RenderableType:
    """The inspection for a terminal."""
    parts: list[RenderableType] = [
        Text(str(inspection.path), style="bold"),
        _topic_table(inspection),
    ]
    if inspection.layout:
        parts.append(Text(f"point: {_layout_text(inspection.layout)}"))
    if inspection.scan is not None:
        parts.append(Text(f"first scan: {_scan_text(inspection.scan)}"))
    if inspection.reference is not None:
        parts.append(Text(f"reference: {_reference_text(inspection.reference)}"))
    parts += [Text(f"! {problem}", style="yellow") for problem in inspection.problems]
    for stage, lacking in inspection.missing.items():
        state = f"lacks {' and '.join(lacking)}" if lacking else "has all it needs"
        parts.append(Text(f"{stage}: {state}", style="red" if lacking else "green"))
    parts.append(Text("\n" + inspection.entry))
    return Group(*parts)


def inspection_text(inspection: Inspection, width: int = 100) -> str:
    """The inspection as plain text."""
    console = Console(width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(render_inspection(inspection))
    return capture.get()


def _topic_table(inspection: Inspection) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("topic", "type", "count", "rate", "seconds", "max gap"):
        numeric = column not in ("topic", "type")
        table.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for topic in inspection.topics:
        seconds = None
        if topic.first is not None and topic.last is not None:
            seconds = (topic.last - topic.first) * 1e-9
        table.add_row(
            topic.name,
            topic.type.replace("/msg/", "/"),
            str(topic.count),
            "" if topic.rate is None else f"{topic.rate:.2f} Hz",
            "" if seconds is None else f"{seconds:.2f}",
            "" if topic.gap is None else f"{topic.gap:.3f} s",
        )
    return table


def _layout_text(layout: Items[tuple[str, str, int]]) -> str:
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


def _reference_text(reference: Trajectory) -> str:
    length = np.linalg.norm(np.diff(reference.T_world_sensor[:, :3, 3], axis=0), axis=1).sum()
    seconds = (reference.stamps[-1] - reference.stamps[0]) * 1e-9
    return f"{len(reference):,} poses, {length:.1f} m in {seconds:.1f} s"


def write_inspection_png(inspection: Inspection, path: Path) -> None:
    """Draw the first scan from above and from the side.

    Raises
    ------
    SequenceError
        If no scan could be read.
    """
    if inspection.scan is None:
        raise SequenceError(f"{inspection.path}: no scan can be drawn, none could be read")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    points = inspection.scan.scan.points
    # Few far points would shrink all others to a dot.
    reach = float(np.percentile(np.abs(points[:, :2]), 98)) if len(points) else 1.0
    low, high = np.percentile(points[:, 2], (2, 98)) if len(points) else (0.0, 1.0)
    figure = Figure(figsize=(9, 12), layout="constrained")
    FigureCanvasAgg(figure)
    above, side = figure.subplots(2, 1, height_ratios=(3, 1))
    for axes, (i, j), names in ((above, (0, 1), "xy"), (side, (0, 2), "xz")):
        order = np.argsort(points[:, 2])
        dots = axes.scatter(
            points[order, i],
            points[order, j],
            c=points[order, 2],
            s=0.4,
            cmap="viridis",
            vmin=low,
            vmax=high,
        )
        axes.set_xlim(-reach, reach)
        axes.set_aspect("equal")
        axes.set_xlabel(f"{names[0]} (m)")
        axes.set_ylabel(f"{names[1]} (m)")
    above.set_ylim(-reach, reach)
    above.plot(0, 0, "r+", markersize=10)
    figure.colorbar(dots, ax=above, label="z (m)", shrink=0.6, extend="both")
    figure.suptitle(f"{inspection.path.name}: {_scan_text(inspection.scan)}", fontsize=9)
    with replacing(path) as beside:
        figure.savefig(beside, format="png", dpi=110)


def render_cache() -> RenderableType:
    """The decoded sequences on disk, for a terminal."""
    entries = cache.list_cache()
    table = Table(box=None, pad_edge=False)
    for column in ("sequence", "scans", "size", "last used"):
        table.add_column(column, justify="left" if column == "sequence" else "right")
    for entry in entries:
        used = datetime.datetime.fromtimestamp(entry.used).strftime("%Y-%m-%d %H:%M")
        table.add_row(entry.name, str(entry.n_scans), f"{entry.size / 1e6:,.1f} MB", used)
    total = sum(entry.size for entry in entries) / 1e9
    return Group(
        table, Text(f"{cache.folder()}: {total:.2f} GB of at most {cache.cap() / 1e9:g} GB")
    )
