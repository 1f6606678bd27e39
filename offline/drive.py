"""A drive: one parameter set along one stretch of a recording, as a robot drives it."""

from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import MachineError, UnavailableError, in_a_line
from adaptune.geometry import Poses
from adaptune.odometry.base import Usage
from adaptune.odometry.factory import Factory
from adaptune.odometry.tracker import Tracker
from adaptune.progress import Progress, unseen, watched
from adaptune.recording.scan import Recording, SequenceError
from adaptune.space import ParameterSet
from adaptune.study.sequences import StudySequences
from offline.config import OfflineStudyConfig
from offline.shared_scans import SharedScan, SharedScans
from offline.stretches import Stretch


@dataclass(eq=False)
class Drive:
    """What one parameter set did along one stretch; it is lost where it was not driven.

    It begins at the reference's pose, as a robot does, with the health check, and without the
    reference from then on.
    """

    T_odom_sensor: Poses  # (n, 4, 4)
    restarted: NDArray[np.bool_]  # (n,): by the health check
    registered: NDArray[np.bool_]  # (n,)
    tried: NDArray[np.bool_]  # (n,): scans that the odometry was given
    without_pose: NDArray[np.bool_]  # (n,)
    seconds: NDArray[np.float64]  # (n,): NaN where it begins
    unhealthy: Counter[str] = field(default_factory=Counter)
    faults: tuple[str, ...] = ()  # of the odometry
    exception: str = ""  # after which the drive has no pose
    usage: Usage = Usage(0.0, None)  # noqa: RUF009 (a tuple)
    prepare_ms: float = 0.0  # mean CPU time that it took to prepare a scan
    too_slow: bool = False

    @classmethod
    def lost(cls, stretch: Stretch) -> Self:
        """A drive before it begins."""
        n = len(stretch.stamps)
        T_odom_sensor = np.tile(stretch.T_odom_start, (n, 1, 1))
        restarted, registered, tried = np.zeros((3, n), bool)
        return cls(
            T_odom_sensor, restarted, registered, tried, np.ones(n, bool), np.full(n, np.nan)
        )


class _Driver:
    """Drives one parameter set along one stretch.

    An exception of the odometry is a fault, after which the drive has no pose. A set that takes
    more than `most` seconds of CPU time is stopped.
    """

    def __init__(self, begin: Callable[[], Tracker], stretch: Stretch, most: float):
        self.drive = Drive.lost(stretch)
        self._begin, self._stretch, self._most = begin, stretch, most
        self._stamps = stretch.stamps.tolist()
        self._tracker: Tracker | None = None

    def step(self, i: int, scan: SharedScan) -> None:
        """Register scan `i`."""
        drive = self.drive
        try:
            if not drive.exception and not drive.too_slow:
                self._register(i, scan)
        except (UnavailableError, SequenceError, MachineError, MemoryError):
            raise  # of the machine or the recording, whatever the parameters
        except Exception as error:
            drive.exception = in_a_line(error)
        if not (drive.tried[i] and np.isfinite(drive.T_odom_sensor[i, 0, 0])):
            drive.without_pose[i] = True
            drive.T_odom_sensor[i] = drive.T_odom_sensor[i - 1] if i else self._stretch.T_odom_start

    def close(self, scans: SharedScans) -> None:
        """End the odometry's processes, and note what they used."""
        if self._tracker is None:
            return
        drive, odometry = self.drive, self._tracker.odometry
        odometry.close()
        drive.faults, drive.usage = tuple(odometry.faults), odometry.usage
        drive.prepare_ms = scans.milliseconds(self._stretch, odometry)
        if drive.usage.seconds is not None:
            drive.seconds[~np.isnan(drive.seconds)] = drive.usage.seconds

    def _register(self, i: int, scan: SharedScan) -> None:
        if self._tracker is None:
            self._tracker = self._begin()
        drive, odometry = self.drive, self._tracker.odometry
        found = self._tracker.register_prepared(self._stamps[i], scan(odometry))
        drive.T_odom_sensor[i], drive.tried[i] = found.T_odom_sensor, True
        lost = not np.isfinite(found.T_odom_sensor).all()
        drive.without_pose[i] = lost or found.unhealthy == "no_pose"
        drive.registered[i] = found.registered and not drive.without_pose[i]
        drive.restarted[i] = found.unhealthy is not None
        if found.unhealthy not in (None, "no_pose"):
            drive.unhealthy[found.unhealthy] += 1
        if i:
            drive.seconds[i] = found.register_seconds
        drive.too_slow = odometry.usage.cpu > self._most


class TrialSetup(NamedTuple):
    """What a process needs to describe recordings, and to drive along them."""

    config: OfflineStudyConfig
    odometry: Factory
    sequences: StudySequences


def drive_sets(
    setup: TrialSetup,
    shared: SharedScans,
    scans: Recording,
    stretch: Stretch,
    sets: Iterable[ParameterSet],
    most: float = np.inf,
    bare: bool = False,
    progress: Progress = unseen,
) -> list[list[Drive]]:
    """Drive with several parameter sets on one pass along a stretch; each for every repeat.

    Sets that take more than `most` seconds of CPU time are stopped. What is driven `bare`, once and
    without the health check, shows how a set does elsewhere.
    """
    (config, odometry, _), n = setup, len(stretch.stamps)

    def begin(parameters: ParameterSet) -> Tracker:
        return Tracker(
            odometry(parameters, stretch.sequence),
            config.health,
            T_odom_start=stretch.T_odom_start,
            T_before_start=stretch.T_before_start,
            bare=bare,
        )

    def n_repeats(parameters: ParameterSet) -> int:
        of_baseline, repeats = config.offline.baseline_runs, config.offline.repeats
        if bare:
            return 1
        if of_baseline is None or parameters not in odometry.space.baselines:
            return repeats
        return max(repeats, of_baseline)

    drivers = [
        [_Driver(partial(begin, one), stretch, most) for _ in range(n_repeats(one))] for one in sets
    ]
    with ExitStack() as ended:
        each = [driver for of_set in drivers for driver in of_set]
        for driver in each:
            ended.callback(driver.close, shared)
        for i, scan in enumerate(watched(shared.along(stretch, scans), n, "running", progress)):
            for driver in each:
                driver.step(i, scan)
    return [[driver.drive for driver in of_set] for of_set in drivers]
