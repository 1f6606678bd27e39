"""What is wrong with a recording: what it means, and what to do about it."""

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise, repeat
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import Finding
from adaptune.recording.content import Content, of_looks
from adaptune.recording.poses import in_angles, sound
from adaptune.recording.scan import Frame, in_order
from adaptune.recording.timing import SOONEST, doubts
from adaptune.trajectory import Trajectory


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
    recorded: list[int] = field(default_factory=list)  # of the same messages
    undecoded: list[tuple[float, str]] = field(default_factory=list)  # seconds, and why
    types: Counter[str] = field(default_factory=Counter)  # how many messages there are of each
    frames: set[str] = field(default_factory=set)  # of the messages that were read

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


_AT_REST = 0.01  # metres
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
    "points": "odometries lose track there; leave them out with `start` or `stop`",
    "reference": "scans in gaps beyond `max_gap` are not labelled",
}


def of_topic(topic: Topic, role: str, complete: bool, separate: bool) -> Iterator[Finding]:
    """What is wrong with the messages of a topic, used as `role`, and with their stamps."""
    where = (topic.name,)
    if role and len(topic.types) > 1:
        many = ", ".join(f"{n} {kind}" for kind, n in topic.types.items())
        mend = "" if topic.undecoded else "adaptune reads each as what it is"
        yield Finding(where, f"messages of {len(topic.types)} types ({many})", mend, of=role)
    if topic.undecoded:
        (seconds, why), n = topic.undecoded[0], len(topic.undecoded)
        mend, lacks = _UNDECODED[role]
        mend = "the stages refuse them" if role == "points" and "`" in why else mend
        many = f"all {n}" if n == topic.n_read else f"{n} of {topic.n_read}"
        what = f"{many} messages do not decode, the first at {seconds:.1f} s ({why})"
        yield Finding(where, what, mend, of=role, lacks=lacks)
    if role and topic.count and not topic.n_read and not complete:
        what = f"its {topic.count} messages are not in the sample"
        yield Finding(where, what, "`--deep` reads them", of=role)
    if topic.stamped and any(topic.stamps) and not separate:
        yield from _stamps(topic, role)
        if not complete and sum(map(len, topic.stamps)) < topic.count:
            yield from _count(topic, role)


def _stamps(topic: Topic, role: str) -> Iterator[Finding]:
    where, n = (topic.name,), len(topic.times)
    wrong = int(np.count_nonzero(np.diff(topic.times) <= 0))
    if role == "points" and wrong:
        left, stamps = Counter[str](), topic.times.tolist()
        unread: Any = repeat(None)
        deque(in_order(map(Frame, stamps, topic.recorded or stamps, unread), left), 0)
        wrong = left.total()
    if wrong:
        mend = "adaptune leaves such scans out" if role == "points" else ""
        lacks = "stamps that increase" if wrong == n - 1 and role in ("points", "reference") else ""
        what = f"{wrong} of {n} stamps do not come after the one before"
        yield Finding(where, what, mend, of=role, lacks=lacks)
    if len(topic.steps):
        gap, usual = topic.steps.max(), np.median(topic.steps)
        if gap > 3.5 * usual and gap > 0.2:
            lost = np.count_nonzero(topic.steps > 3.5 * usual)
            what = f"{lost} gaps, the longest of {gap:.2f} s"
            yield Finding(where, what, _GAPS.get(role, ""), of=role)


def _count(topic: Topic, role: str) -> Iterator[Finding]:
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
        yield Finding((topic.name,), what, "`--deep` looks for the gaps", of=role)


class Part(NamedTuple):
    """Messages, in the order of recording, between two leaps of their clock."""

    first: int  # number of its first message
    last: int  # of the one after its last message
    seconds: tuple[float, float]  # since the first one, as if the clock had not leapt
    twice: bool  # the clock was set back, and messages from before and after lie in between
    leap: float  # seconds by which the clock leaps at its beginning


_WINDOW = 6  # messages that tell a leap from a few wrong stamps
_LEAP, _PAUSE = 10 * 10**9, 600 * 10**9  # nanoseconds that no clock, and no drive, leaves out


def clock_parts(stamps: NDArray[np.int64], recorded: NDArray[np.int64]) -> list[Part]:
    """Cut messages where their clock leaps for good, by stamps and the recorder's clock: (n,).

    Where both clocks were set back, a segment of time comes twice, and messages as often again.
    """
    n, steps, passed = len(stamps), np.diff(stamps), np.diff(recorded)
    cuts = {0: False, n: False}  # whether what begins there comes twice
    away = (steps <= 0) | (steps > _PAUSE) | (steps - passed > _LEAP)
    for i in (np.flatnonzero(away) + 1).tolist():
        # As many on both sides, and even: two sensors may take turns.
        k = min(i, n - i, _WINDOW) // 2 * 2
        if k <= _WINDOW // 2:
            continue
        before, after = (np.median(stamps[j : j + k] - stamps[i]) for j in (i - k, i))
        if after < before or min(after - before, steps[i - 1]) > _LEAP:
            cuts[i] = False
    two = stamps[2:] - stamps[:-2]
    usual = float(np.median(two)) / 2.0 if len(two) else 0.0
    edges = np.flatnonzero(np.diff(np.r_[False, two < 1.5 * usual, False].astype(int)))
    for begin, end in edges.reshape(-1, 2).tolist():
        # A recorder that falls behind pauses before as many messages as these.
        if end - begin >= _WINDOW and begin > 0 and end + 2 < n:
            regular = (stamps[end + 2] - stamps[begin - 1]) / usual
            if end + 3 - begin - regular >= _WINDOW // 2:
                cuts |= {begin: True, end + 2: False}
    parts, shift, at = [], 0, sorted(cuts)
    for first, last in pairwise(at):
        leap = int(steps[first - 1]) if first else 0
        if first and not 0 <= leap <= _LEAP:
            goes_on = 0 < passed[first - 1] < _PAUSE
            shift += leap - int(passed[first - 1] if goes_on else usual)
        ends = [(int(stamps[i] - stamps[0]) - shift) * 1e-9 for i in (first, last - 1)]
        parts.append(Part(first, last, (ends[0], ends[1]), cuts[first], leap * 1e-9))
    return parts


def of_clock(name: str, parts: Sequence[Part], used: Part) -> Finding:
    """What is said of clocks that leap, and of the part that is used."""
    twice = [part for part in parts if part.twice]
    leaps = [f"by {p.leap:+,.1f} s at {p.seconds[0]:.1f} s" for p in parts[1:] if not p.twice]
    leaps = leaps[:3] + ["..."] * (len(leaps) > 3)
    what = f"the clock of the stamps leaps {', '.join(leaps)}"
    if twice:
        what = "the clock was set back: the stamps of {:.2f} to {:.2f} s come twice, and scans and "
        what = (what + "reference go to and fro there").format(*twice[0].seconds)
    n, part = parts[-1].last, "{:.1f} to {:.1f} s".format(*used.seconds)
    what += f"; {n - used.last + used.first} of {n} scans are left out"
    mend = f"adaptune uses the longest part, {part}; `start` and `stop` choose another"
    return Finding((name,), what, mend, of="points")


def of_clouds(topic: Topic, content: Content) -> Iterator[Finding]:
    """What is wrong with the clouds that were read."""
    where, role = (topic.name,), "points"
    if topic.count == 1:
        what = "holds a single cloud: no motion"
        yield Finding(where, what, of=role, lacks="more than one cloud")
    if len(topic.frames) > 1:
        what = f"holds clouds of {', '.join(sorted(map(repr, topic.frames)))}"
        mend = "name one of these frames as `frame`"
        yield Finding(where, what, mend, of=role, lacks="clouds of one frame")
    else:
        yield from of_looks(content.looks, where)


def of_times(topic: Topic, content: Content) -> Iterator[Finding]:
    """What is wrong with the times of the points."""
    steps = topic.steps[topic.steps * 1e9 >= SOONEST]
    period = float(np.median(steps)) if len(steps) else 0.0
    readings = [look.reading for look in content.looks]
    return (doubt.below((topic.name,)) for doubt in doubts(readings, period))


def of_reference(
    reference: Trajectory, complete: bool, timed: bool = True, begin: int | None = None
) -> Iterator[Finding]:
    """What is wrong with poses, numbered only if not `timed`; seconds count from `begin`."""
    role, lacks = "reference", "a reference that moves"
    if len(reference) < 2:
        if complete:
            mend = "no motion follows from it; name another topic, or a file of poses"
            yield Finding((), "the reference holds a single pose", mend, of=role, lacks=lacks)
        return
    if (angles := in_angles(reference)) is not None:
        yield angles
        return
    positions = reference.T_world_sensor[:, :3, 3]
    if np.linalg.norm(positions - positions[0], axis=1).max() < _AT_REST:
        what = f"the reference stands still: all {len(reference)} poses are within 1 cm"
        mend = "errors are per metre; drive, or name another topic or a file of poses"
        yield Finding((), what, mend, of=role, lacks=lacks)
        return
    seconds = np.diff(reference.stamps) * 1e-9
    if timed and complete:  # between the parts of a sample, all may happen
        yield from sound(reference, begin)[1]
    elif not timed:  # ten a second, as most LiDARs measure
        numbered = Trajectory(reference.stamps * 10**8, reference.T_world_sensor)
        yield from (finding._replace(seconds=None) for finding in sound(numbered)[1])
    if complete and timed and (gaps := np.count_nonzero(seconds > reference.max_gap)):
        what = f"the reference has {gaps} gaps beyond {reference.max_gap:g} s"
        what += f", the longest of {seconds.max():.2f} s: their scans get no label"
        yield Finding((), reference.sparse or what, of=role)


def of_overlap(reference: Trajectory, stamps: NDArray[np.int64], slack: float) -> Iterator[Finding]:
    """Scans outside the reference; both may go on for `slack` seconds beyond what was read."""
    role = "reference"
    begin, end = int(reference.stamps[0]), int(reference.stamps[-1])
    scans = int(stamps.min()), int(stamps.max())
    times = [f"{stamp * 1e-9:.3f}" for stamp in (begin, end, *scans)]
    spans = f"covers {times[0]} to {times[1]} s, the scans cover {times[2]} to {times[3]} s"
    if (max(begin, scans[0]) - min(end, scans[1])) * 1e-9 > slack:
        mend = (
            "set `clock_offset` to the seconds to add to the reference's stamps, if it is of the "
            "same drive; `adaptune offline` proposes them"
        )
        lacks = "a reference of the same time"
        yield Finding((), f"the reference {spans}", mend, of=role, lacks=lacks)
        return
    seconds = (scans[1] - scans[0]) * 1e-9
    outside = [(begin - scans[0]) * 1e-9, (scans[1] - end) * 1e-9]
    lost = sum(s for s in outside if s > slack + 1.0)
    if lost > 0.05 * seconds:
        yield Finding((), f"the reference {spans}: the scans outside get no label", of=role)
