"""What an odometry did along a recording: the record of a run."""

import itertools
import math
import os
import platform
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping, MutableSequence, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from adaptune._system.machine import resident_megabytes
from adaptune.errors import AdaptuneError
from adaptune.odometry.base import OdometryInstance, Usage
from adaptune.odometry.faults import MAX_SHARE_WITHOUT_POSE
from adaptune.odometry.tracker import RegisteredScan
from adaptune.space import Selection
from adaptune.trajectory import Trajectory

_SAMPLED = 10
"""Scans from one look at the memory to the next."""


class Choice(NamedTuple):
    """A selection that was made."""

    stamp: int  # nanoseconds, of the scan that it was made from and first applied to
    selection: Selection
    seconds: float  # to describe the scan and choose; in real time, until it counts
    why_not: str = ""  # it was not applied; empty if it was
    fallen_back: str = ""  # why it is the fixed set; empty if it was chosen


class RunSummary(BaseModel, frozen=True):
    """A run in figures: the content of ``replay.json``."""

    scans: int
    restarts: int  # how often the health check restarted the odometry
    unhealthy: dict[str, int]  # how often the health check found what
    poor_scans: int  # scans that were too poor to register
    selections: int
    lost_seconds: float = 0.0  # how long the bank was lost
    cpu_ms: float | None = None  # milliseconds of CPU time a scan, without reading it
    memory_mb: float | None = None  # most megabytes of all processes
    real_time: dict[str, float] | None = None  # how it kept up
    first_pose: float = 0.0  # seconds from the first scan; what was before is left out
    lacking: int = 0  # scans without a pose
    fault: str = ""  # the last one of the odometry
    machine: str | None = None  # on which it was driven
    inputs: dict[str, Any] = Field({}, exclude=True)  # see `adaptune._system.manifest`


NO_RUN = RunSummary(scans=0, restarts=0, unhealthy={}, poor_scans=0, selections=0)
"""Where nothing was driven."""


@dataclass(eq=False, repr=False)
class Run:
    """What an odometry did at each scan so far, and what was selected on the way.

    It is of a trial, of a replay, or of a drive on a robot.
    """

    rate: float | None = None  # times as fast as it was recorded; None if in lockstep
    tell: Callable[[Choice], None] | None = None  # called with every choice
    steps: MutableSequence[RegisteredScan] = field(default_factory=list)  # (n,)
    choices: MutableSequence[Choice] = field(default_factory=list)  # those that were applied
    rejected: MutableSequence[Choice] = field(default_factory=list)  # those that were not
    newest: Choice | None = None  # applied or not
    cpu_ms: float = math.nan  # milliseconds of CPU time a scan, in all processes, without reading
    memory: float = 0.0  # most megabytes of all processes
    lacking: int = 0  # scans without a pose
    first_pose: float = 0.0  # seconds from the first scan to the odometry's first pose
    faults: tuple[str, ...] = ()  # of the odometry, as it says them
    # In training:
    exception: str = ""  # after which it has no pose
    too_slow: bool = False  # and stopped therefore
    usage: Usage = Usage(0.0, None)  # noqa: RUF009 (a tuple)
    prepare_ms: float = 0.0  # mean CPU time that it took to prepare a scan
    # In real time:
    dropped: int = 0  # scans that the odometry did not get
    missed: int = 0  # selections that were not there at their deadline
    unseen: int = 0  # scans that the selector did not get
    # (n,): seconds from a scan's arrival to its pose
    late: MutableSequence[float] = field(default_factory=list)
    waited: MutableSequence[float] = field(default_factory=list)  # seconds for each selection
    late_members: int = 0  # scans at which members of a bank were late, over all members
    removed: int = 0  # members that were always late

    def __post_init__(self) -> None:
        self._cpu, self._n = 0.0, len(self.steps)

    def __repr__(self) -> str:
        what = f"{self.done} scans, {len(self.choices)} selections, {self.restarted.sum()} restarts"
        return f"<Run: {what}>"

    @property
    def done(self) -> int:
        """Scans so far, with those that were dropped."""
        return self._n + self.dropped

    @property
    def trajectory(self) -> Trajectory:
        """The odometry's."""
        stamps = np.array([step.stamp for step in self.steps], np.int64)
        return Trajectory(stamps, np.array([step.T_odom_sensor for step in self.steps]))

    @property
    def restarted(self) -> NDArray[np.bool_]:
        """Frames at which the health check restarted the odometry, of shape (n,)."""
        return np.array([step.unhealthy is not None for step in self.steps], bool)

    @property
    def registered(self) -> NDArray[np.bool_]:
        """Frames that were not too poor to register, of shape (n,)."""
        return np.array([step.registered for step in self.steps], bool)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Frames for which the odometry gave no pose, of shape (n,)."""
        finite = (bool(np.isfinite(step.T_odom_sensor).all()) for step in self.steps)
        every = zip(self.steps, finite, strict=True)
        return np.array([not known or step.unhealthy == "no_pose" for step, known in every], bool)

    @property
    def unhealthy(self) -> dict[str, int]:
        """How often the health check found what."""
        return dict(Counter(s.unhealthy for s in self.steps if s.unhealthy is not None))

    def note(self, choice: Choice) -> None:
        """Note a selection."""
        self.newest = choice
        (self.rejected if choice.why_not else self.choices).append(choice)
        if self.tell is not None:
            self.tell(choice)

    def begin(self) -> None:
        """A scan is there: its CPU time counts from now on."""
        self._begun = time.process_time()

    def end(self, step: RegisteredScan) -> None:
        """Note where the odometry is, by the scan that has begun."""
        self._cpu += time.process_time() - self._begun
        if self._n % _SAMPLED == 0:
            self.memory = max(self.memory, resident_megabytes())
        self._n += 1
        self.steps.append(step)

    def finish(self, odometry: OdometryInstance, other_cpu: float = 0.0) -> Self:
        """Sum up, with what the odometry used and its faults, and what else took CPU seconds.

        An AdaptuneError says that there was no scan.
        """
        if not self._n:
            raise AdaptuneError("there is no scan to replay; check start and stop")
        # Scans before the first pose are unknown, unless they are so many that it has failed.
        waiting = sum(1 for _ in takewhile(lambda step: not step.begun, self.steps))
        if 0 < waiting < MAX_SHARE_WITHOUT_POSE * self._n:
            stamps = self.steps[waiting].stamp, self.steps[0].stamp
            self.first_pose = 1e-9 * (stamps[0] - stamps[1])
            del self.steps[:waiting], self.late[:waiting]
        usage, self.faults = odometry.usage, tuple(odometry.faults)
        self.cpu_ms = 1e3 * (self._cpu + usage.other_cpu + other_cpu) / self._n
        self.memory += usage.memory or 0.0
        self.lacking = max(usage.lacking, self.unhealthy.get("no_pose", 0))
        return self

    @cached_property
    def summary(self) -> RunSummary:
        """It in figures, once it has finished."""
        return RunSummary(
            scans=len(self.steps),
            restarts=int(self.restarted.sum()),
            unhealthy=self.unhealthy,
            poor_scans=int((~self.registered).sum()),
            selections=len(self.choices),
            lost_seconds=round(self._lost_seconds, 3),
            cpu_ms=round(self.cpu_ms, 3),
            memory_mb=round(self.memory, 1),
            real_time=self._kept_up,
            first_pose=round(self.first_pose, 3),
            lacking=self.lacking,
            fault=self.faults[-1] if self.faults else "",
            machine=machine(),
        )

    @property
    def _kept_up(self) -> dict[str, float] | None:
        """Counts, and medians and 99th percentiles in milliseconds, of a replay in real time."""
        if self.rate is None:
            return None
        counts: dict[str, float] = {
            "rate": self.rate,
            "dropped_scans": self.dropped,
            "missed_selections": self.missed,
            "unseen_scans": self.unseen,
            "late_members_scans": self.late_members,
            "removed_members": self.removed,
        }
        latencies = [choice.seconds for choice in self.choices]
        named = {"pose": self.late, "selection": latencies, "waited": self.waited}
        for name, seconds in named.items():
            for q in (50, 99):
                value = 1e3 * float(np.percentile(seconds, q)) if seconds else 0.0
                counts[f"{name}_ms_p{q}"] = round(value, 3)
        return counts

    @property
    def _lost_seconds(self) -> float:
        """Seconds from selections at which the bank was lost to the next ones."""
        ends = itertools.pairwise([*self.choice_stamps.tolist(), self.steps[-1].stamp])
        pairs = zip(self.choices, ends, strict=True)
        lost = sum(end - begin for choice, (begin, end) in pairs if choice.selection.lost)
        return 1e-9 * float(lost)

    @property
    def choice_stamps(self) -> NDArray[np.int64]:
        """When selections were made, in nanoseconds, of shape (m,)."""
        return np.array([choice.stamp for choice in self.choices], np.int64)

    @property
    def values(self) -> dict[str, list[Any]]:
        """For every parameter its values, of shape (m,); in a bank those of the heaviest member.

        Where the set of another odometry has none, NaN, or no text.
        """
        sets = [choice.selection.parameters for choice in self.choices]
        known = {name: value for one in sets for name, value in one.items()}
        none = {name: "" if isinstance(value, str) else math.nan for name, value in known.items()}
        return {name: [one.get(name, none[name]) for one in sets] for name in known}

    @property
    def weights(self) -> dict[int, list[float]]:
        """In a bank, by trial, of shape (m,); empty without one."""
        every = [choice.selection.weights or {} for choice in self.choices]
        return {trial: [of[trial] for of in every] for trial in every[0]}

    @property
    def estimated(self) -> NDArray[np.float64]:
        """The odometry's own error as measured while driving, in percent, of shape (m, 3).

        It is followed by the ends of its interval; NaN where it is unknown.
        """
        made = [choice.selection for choice in self.choices]
        return np.array([(s.estimated_error, s.estimated_low, s.estimated_high) for s in made])


def switched(choices: Mapping[str, Sequence[Any]]) -> NDArray[np.bool_]:
    """Which of m selections changed a parameter, of shape (m,), from their values by name."""
    # As texts, because NaN does not equal itself.
    rows = list(map(repr, zip(*choices.values(), strict=True)))
    return np.array([False, *(a != b for a, b in itertools.pairwise(rows))])


@cache
def machine() -> str:
    """The kind of this machine: costs that were measured on others cannot be compared."""
    name = None
    with suppress(OSError):
        listed = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        name = re.search(r"model name\s*: (.*)", listed)
    return f"{name[1] if name else platform.machine()}, {os.cpu_count()} cores"
