"""Show an inspected recording, and the cache, on a terminal; draw a recording's first scan."""

import datetime
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from adaptune.files import replacing
from adaptune.inspect import Inspection, ScanSummary
from adaptune.sequence import SequenceError, cache
from adaptune.sequence.pointcloud2 import RING_FIELDS
from adaptune.sequence.timing import TIME_FIELDS
from adaptune.trajectory import Trajectory


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


def draw_inspection(inspection: Inspection, path: Path) -> None:
    """Draw the first scan from above and from the side, as SVG if the path says so, else as PNG.

    A SequenceError says that there is none.
    """
    if inspection.scan is None:
        raise SequenceError(f"{inspection.path}: no scan can be drawn, none could be read")
    from matplotlib.figure import Figure

    points = inspection.scan.scan.points
    # Few far points would shrink all others to a dot.
    reach = float(np.percentile(np.abs(points[:, :2]), 98)) if len(points) else 1.0
    low, high = np.percentile(points[:, 2], (1, 99)) if len(points) else (0.0, 1.0)
    figure = Figure(figsize=(9, 12), layout="constrained")
    above, side = figure.subplots(2, 1, height_ratios=(3, 1), sharex=True)
    for axes, j, title in ((above, 1, "from above"), (side, 2, "from the side, z not to scale")):
        order = np.argsort(points[:, 2])
        x, y, z = points[order, 0], points[order, j], points[order, 2]
        # As a picture inside an SVG: it would have tens of thousands of shapes.
        dots = axes.scatter(x, y, c=z, s=0.5, vmin=low, vmax=high, rasterized=True)
        axes.plot(0, 0, "r+", markersize=12, mew=2, label="LiDAR")
        axes.set(title=title, xlabel="x [m]", ylabel=f"{'xyz'[j]} [m]", xlim=(-reach, reach))
        axes.grid(alpha=0.3)
    above.set(ylim=(-reach, reach), aspect="equal")
    above.legend(loc="upper right")
    margin = 0.1 * (high - low) + 0.5
    side.set_ylim(low - margin, high + margin)
    figure.colorbar(dots, ax=above, label="height z [m]", shrink=0.6, extend="both")
    text = f"{_scan_text(inspection.scan)}; drawn within {reach:.0f} m"
    heading = [*textwrap.wrap(f"{inspection.path.name}, first scan", 90), *_balanced(text, 90)]
    figure.suptitle("\n".join(heading), fontsize=10)
    kind = "svg" if path.suffix.lower() == ".svg" else "png"
    with replacing(path) as temporary:
        figure.savefig(temporary, format=kind, dpi=110)


def _balanced(text: str, most: int) -> list[str]:
    """Lines of about the same length that end with commas, as few as `most` characters allow."""
    for stop in ",;":
        text = text.replace(f"{stop} ", f"{stop}\n")
    # Only between phrases may a line end.
    text = text.replace(" ", "\N{NO-BREAK SPACE}").replace("\n", " ")
    n = len(textwrap.wrap(text, most))
    widths = range(len(text) // n, most + 1)
    lines = next(fit for w in widths if len(fit := textwrap.wrap(text, w)) <= n)
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines]


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
