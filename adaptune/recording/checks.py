"""What some scans of a recording show about its times: whether they can be."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from adaptune.recording.scan import AUTO, LEAVE_OUT, Reading, Timing, unit_of

FIRST_SCANS = 10
"""Scans at the beginning of a recording that show how it is timed."""
SOONEST = 1_000_000
"""Nanoseconds from one scan to the next one; no LiDAR is faster."""
_POSSIBLE = "possible times of the points"


class Doubt(NamedTuple):
    """What is odd; which input then lacks what: points without it cannot be used."""

    text: str
    of: str = "points"
    lacks: str = ""


def doubts(readings: Sequence[Reading], period: float, timing: Timing = AUTO) -> Iterator[Doubt]:
    """What is odd about scans that come every `period` seconds, and were read with `timing`."""
    timed = [reading for reading in readings if reading.last == reading.last]
    if len(timed) >= 5 and period * 1e9 >= SOONEST:
        first, last = np.array([reading[1:3] for reading in timed]).T
        late, span = float(np.median(first)), float(np.median(last - first))
        if not (last > first).any():
            help_ = "no motion compensation is possible; `time_unit: none` leaves the times out"
            what = "all points of a scan have the same time"
            yield Doubt(f"{what}: {help_}", "imu", "a time for each point")
        elif span > 1.5 * period or span < min(0.05 * period, 0.002):
            what = f"the times of the points span {span:.3g} s, scans come every {period:.3g} s"
            help_, known = _mended(span, float(last.max()), timed[0].unit, period)
            sure = timing.unit is None and (known or span > 5.0 * period)
            text = f"{what}; {help_}, or name their unit if they are right"
            yield Doubt(text, lacks=_POSSIBLE if sure else "")
        if late > 1.5 * period:
            what = f"the times of the points begin {late:.3g} s after their scan's stamp"
            help_ = "write `stamp: first_point` to count them from the first point of each scan"
            yield Doubt(f"{what}; {help_}", lacks=_POSSIBLE if timing.stamp == "auto" else "")
    late_by = [reading.stamp - reading.clock for reading in timed if reading.clock is not None]
    if len(late_by) >= 5:
        steps = np.diff(late_by)
        if (shake := float(np.quantile(np.abs(steps), 0.8)) * 1e-6) > 5.0:
            what = f"the stamps shake by {shake:.0f} ms against the sensor's clock"
            yield Doubt(f"{what}; write `stamp: sensor_clock`, and `clock_offset` if needed")


def _mended(span: float, last: float, unit: float, period: float) -> tuple[str, bool]:
    """What to write so that points span a scan, and whether anything helps."""
    if unit == 1.0 and span > 0.9 and last < 1.001:
        help_ = f"write `time_unit: turn` and `period: {period:.3g}`"
        return f"they look like shares of a turn: {help_}", True
    right = unit_of(span / unit, 0.2 * period, 1.5 * period) if unit else None
    return LEAVE_OUT if right is None else f"write `time_unit: {right}`", right is not None
