"""Show an inspected recording on a terminal."""

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from adaptune.metrics import travelled
from adaptune.recording import Scan
from adaptune.recording.inspect import INPUTS, Inspection
from adaptune.trajectory import Trajectory


def render_inspection(inspection: Inspection, accuracy: str = "") -> RenderableType:
    """The inspection for a terminal, and how wrong its reference is, or how to find out."""
    parts: list[RenderableType] = [Text(str(inspection.path), style="bold")]
    parts.append(_topic_table(inspection))
    if inspection.fields:
        parts.append(Text(f"point: {', '.join(inspection.fields)}"))
    if inspection.scan is not None:
        parts.append(Text(f"first scan: {_scan_text(inspection.scan)}"))
    if inspection.stamped_by:
        parts.append(Text(f"times of the scans: {inspection.stamped_by}"))
    if inspection.reference is not None:
        text = _reference_text(inspection.reference, inspection.complete)
        parts.append(Text(f"reference: {text}"))
        if accuracy and inspection.name and not inspection.missing["offline"]:
            parts.append(Text(f"reference: {accuracy}"))
    elif inspection.scan is not None and not any(f.of == "reference" for f in inspection.findings):
        parts.append(Text("reference: none; adaptune estimates one from the scans"))
    parts.append(Text(_read_text(inspection)))
    parts += [Text(f"! {f}", "red" if f.lacks else "yellow") for f in inspection.findings]
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
    if any(finding.of in INPUTS[stage] for finding in inspection.findings):
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
    length = travelled(reference.T_world_sensor)[-1]
    seconds = reference.seconds[-1]
    words = "poses, " if complete else "poses in the sample, at least "
    # Poses without stamps are numbered by nanoseconds.
    lasted = f" in {seconds:.1f} s" if seconds > 1e-3 else ""
    return f"{len(reference):,} {words}{length:.1f} m{lasted}"
