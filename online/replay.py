"""Replay a recording in lockstep, selecting parameters on the way."""

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable, MutableSequence, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.cores import resident_megabytes
from adaptune.errors import AdaptuneError
from adaptune.odometry.base import OdometryInstance, Usage
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.tracker import RegisteredScan
from adaptune.selection import Selection
from adaptune.sequence.scan import Scan
from adaptune.timed_selector import Schedule, Selects
from adaptune.trajectory import Trajectory
from online.safety import Choice, Driver

_SAMPLED = 10
"""Scans from one look at the memory to the next."""

_log = logging.getLogger(__name__)


@dataclass
class RealTimeRecord:
    """How a replay in real time kept up."""

    rate: float  # times as fast as it was recorded
    dropped: int = 0  # scans that the odometry did not get
    missed: int = 0  # selections that were not there at their deadline
    unseen: int = 0  # scans that the selector did not get
    late: MutableSequence[float] = field(
        default_factory=list
    )  # (n,): seconds from a scan's arrival to its pose
    waited: MutableSequence[float] = field(default_factory=list)  # seconds for each selection
    late_members: dict[int, int] = field(default_factory=dict)  # scans at which they were, by trial
    removed: tuple[int, ...] = ()  # trials of members that were always late


class Progressed(NamedTuple):
    """How far a replay is."""

    done: int  # scans, with those that were dropped
    step: RegisteredScan  # the newest
    choice: Choice | None  # the newest, applied or not
    real_time: RealTimeRecord | None = None  # in real time


Watch = Callable[[Progressed], None]
"""Called after every scan."""
Look = Callable[[str, int, Progressed], None]
"""Called after every scan with what is driven, and how many scans there are (0: nobody knows)."""


@dataclass(frozen=True, eq=False)
class Replay:
    """One way through a recording."""

    trajectory: Trajectory  # the odometry's
    restarted: NDArray[np.bool_]  # (n,): frames at which the health check restarted the odometry
    # (n,): false where the scan was too poor to register and the last motion went on.
    registered: NDArray[np.bool_]
    steps: Sequence[RegisteredScan]  # (n,)
    choices: list[Choice]  # those that were applied
    rejected: list[Choice]  # those that were not
    seconds: float  # the whole replay, reading included
    unhealthy: dict[str, int]  # how often the health check found what
    cpu_ms: float  # milliseconds of CPU time a scan, in all processes, without reading it
    memory: float  # most megabytes of all processes
    real_time: RealTimeRecord | None = None  # in real time


def replay(
    scans: Iterable[Scan],
    odometry: OdometryInstance,
    health: HealthCheck,
    selector: Selects | None = None,
    period: float = 1.0,
    watch: Watch = lambda _: None,
    what: str = "the replay",
    fixed: Selection | None = None,
) -> Replay:
    """Replay a recording, as fast as it goes and always the same way.

    Selections are made as `Schedule` says, from a scan and before it is registered.

    Parameters
    ----------
    scans
        In order of time.
    odometry
        A new instance; with a selector, one that applies selections.
    health
        The odometry is restarted where its motion is not healthy.
    selector
        Chooses the parameters; without one they stay.
    period
        Seconds between selections.
    watch
        Called after every scan.
    what
        What is replayed, for the log.
    fixed
        What an adaptive mode returns to where it fails, see `online.safety.Driver`.

    Raises
    ------
    AdaptuneError
        If there are no scans.
    OdometryError
        If the odometry cannot change its parameters, and there is no `fixed` to return to.
    """
    choices, steps = list[Choice](), list[RegisteredScan]()
    driver = Driver(odometry, health, fixed, what, choices.append)
    schedule, meter = Schedule(period * 1e9), Meter()
    for scan in scans:
        meter.begin()
        if selector is not None:
            selector.observe(scan.stamp, scan, odometry.motions)
            if schedule.due(scan.stamp):
                t = time.perf_counter()
                selection = selector.select()
                driver.take(scan.stamp, selection, time.perf_counter() - t)
                selector.measure()
        steps.append(driver.register(scan))
        meter.end()
        watch(Progressed(len(steps), steps[-1], choices[-1] if choices else None))
    return recorded(steps, choices, meter, odometry.usage)


class Meter:
    """Measures CPU time and memory, scan by scan."""

    def __init__(self) -> None:
        self._cpu = self._memory = 0.0
        self._n = 0
        self._started = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Since this was made."""
        return time.perf_counter() - self._started

    def begin(self) -> None:
        """A scan is there."""
        self._begin = time.process_time()

    def end(self) -> None:
        """It is done."""
        self._cpu += time.process_time() - self._begin
        if self._n % _SAMPLED == 0:
            self._memory = max(self._memory, resident_megabytes())
        self._n += 1

    def used(self, odometry: Usage) -> tuple[float, float]:
        """Milliseconds a scan, and megabytes, with what the odometry used in other processes."""
        ms = 1e3 * (self._cpu + odometry.elsewhere) / self._n
        return ms, self._memory + (odometry.memory or 0.0)


def recorded(
    steps: Sequence[RegisteredScan],
    choices: Sequence[Choice],
    meter: Meter,
    usage: Usage,
    real_time: RealTimeRecord | None = None,
) -> Replay:
    """A replay from what became of its scans, and of all selections."""
    if not steps:
        raise AdaptuneError("there is no scan to replay; check start, stop and views")
    stamps, poses, registered, unhealthy, _, _ = zip(*steps, strict=True)
    return Replay(
        Trajectory(np.array(stamps, np.int64), np.array(poses)),
        np.array([what is not None for what in unhealthy]),
        np.array(registered),
        steps,
        [choice for choice in choices if not choice.why_not],
        [choice for choice in choices if choice.why_not],
        meter.seconds,
        dict(Counter(what for what in unhealthy if what is not None)),
        *meter.used(usage),
        real_time,
    )
