"""What is wrong with a recording: what it means, and what to do about it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.trajectory import Trajectory

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
