"""What every format of recordings offers, and which of its scans are used."""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

from adaptune.sequence.imu import Imu
from adaptune.sequence.part import Fractions
from adaptune.sequence.scan import Scan
from adaptune.trajectory import Trajectory

_log = logging.getLogger(__name__)


class Frame(NamedTuple):
    """A scan before it is decoded."""

    stamp: int  # nanoseconds, as recorded
    recorded: int  # nanoseconds on the clock of the recorder; the stamp where there is none
    load: Callable[[], Scan]  # decodes the scan


class Source(Protocol):
    """One format of recordings.

    Attributes
    ----------
    random_access : bool
        Whether frames hold nothing in memory before they are loaded.
    """

    random_access: ClassVar[bool]

    @property
    def name(self) -> str:
        """Its file, for messages."""

    @property
    def n_messages(self) -> int:
        """At least as many as there are scans."""

    @property
    def files(self) -> Sequence[Path]:
        """All files that its scans and its IMU are read from."""

    @property
    def pose_files(self) -> Sequence[Path]:
        """All other files that its own poses are read from."""

    def frames(self) -> Iterator[Frame]:
        """All scans in the order of their recording."""

    def about(self) -> dict[str, Any]:
        """Plain data to store with its decoded scans."""

    def span(self) -> tuple[int, int] | None:
        """First stamp, and about the last one; none where there is no scan."""

    def poses(self, name: str | None, child_frame: str | None) -> Trajectory | None:
        """Reference poses of the recording itself, or those of one topic."""

    def first_pose(self, name: str) -> int | None:
        """Stamp of the first pose on a topic."""

    def imu(self, name: str | None) -> Imu | None:
        """Measurements of its IMU, in the IMU's own units."""


@dataclass
class Repairs:
    """Counts of what was left out of a recording, by reason."""

    counts: dict[str, int] = field(default_factory=dict)

    def add(self, reason: str, n: int = 1) -> None:
        """Count what was left out."""
        if n:
            self.counts[reason] = self.counts.get(reason, 0) + n

    def report(self, name: str) -> None:
        """Log the counts, if there are any."""
        if self.counts:
            what = ", ".join(f"{n} {reason}" for reason, n in self.counts.items())
            _log.warning("%s: left out %s", name, what)


BACKWARD = "scans whose stamps do not come after the one before"
LEAP = "scans whose stamps leap ahead of the recording"


def in_order(frames: Iterable[Frame], repairs: Repairs) -> Iterator[Frame]:
    """Leave out the fewest frames so that stamps strictly increase.

    If a stamp does not come after the one before it, one of the two is wrong. The one that
    disagrees more with the recorder's clock is left out. A single stamp in the future thus costs
    one scan, not all that follow.
    """
    last: Frame | None = None
    doubtful: Frame | None = None
    for frame in frames:
        if doubtful is not None:
            if frame.stamp > doubtful.stamp:
                yield doubtful
                last = doubtful
            elif _leap(last, doubtful) > _leap(last, frame):
                repairs.add(LEAP)
            else:
                repairs.add(BACKWARD)
                continue
            doubtful = None
        if last is not None and frame.stamp <= last.stamp:
            repairs.add(BACKWARD)
        elif last is None or _leap(last, frame) > _DOUBT:
            # The next frame decides. Other frames pass at once: they are decoded while their bytes
            # are still in the processor's cache.
            doubtful = frame
        else:
            yield frame
            last = frame
    if doubtful is not None:
        yield doubtful


# Nanoseconds; a recorder is seldom later than this.
_DOUBT = 50_000_000


def _leap(last: Frame | None, frame: Frame) -> int:
    """By how much a stamp has moved against the recorder's clock."""
    usual = 0 if last is None else last.stamp - last.recorded
    return abs(frame.stamp - frame.recorded - usual)


@dataclass(frozen=True)
class Section:
    """A part of a sequence."""

    # Seconds since the first scan; those in [start, stop) belong to it.
    start: float = 0.0
    stop: float | None = None
    stride: int = 1  # use every stride-th scan

    def of(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames in it; their stamps strictly increase."""
        first, number = None, 0
        for frame in frames:
            first = frame.stamp if first is None else first
            seconds = (frame.stamp - first) * 1e-9
            if self.stop is not None and seconds >= self.stop:
                return
            if seconds >= self.start:
                if number % self.stride == 0:
                    yield frame
                number += 1

    def part(self, part: Fractions, seconds: float) -> "Section":
        """A part of it in a recording of so many seconds; the last part has the last scan."""
        begin, end = part
        whole = (seconds if self.stop is None else min(self.stop, seconds)) - self.start
        stop = self.stop if end == 1.0 else self.start + end * whole
        return replace(self, start=self.start + begin * whole, stop=stop)

    def count(self, n: int, seconds: float) -> int:
        """About how many of `n` scans are in it, in a recording of so many seconds."""
        stop = seconds if self.stop is None else min(self.stop, seconds)
        share = max(stop - self.start, 0.0) / seconds if seconds > 0.0 else 1.0
        return -(-round(n * share) // self.stride)

    def __str__(self) -> str:
        stop = "the end" if self.stop is None else f"{self.stop:g} s"
        return f"between start = {self.start:g} s and stop = {stop}"
