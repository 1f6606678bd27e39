"""Odometries that run once on a whole recording."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from logging import getLogger
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from adaptune.files import temporary_folder
from adaptune.geometry import Poses, invert, steps
from adaptune.odometry.base import (
    BaseSettings,
    LastMotion,
    Motions,
    OdometryError,
    OdometryInstance,
    Registration,
    UnavailableError,
    Usage,
)
from adaptune.odometry.frame_check import check_frame
from adaptune.odometry.isolation import Limits
from adaptune.odometry.program_input import ProgramInput
from adaptune.ros.ros_link import LinkError
from adaptune.selection import Selection
from adaptune.sequence.config import Transform, to_pose
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet
from adaptune.trajectory import Trajectory, TrajectoryError

_log = getLogger(__name__)

_COVERAGE = 0.9
"""Least share of the scans, and of the way, for which there must be poses."""


class WholeSettings(BaseSettings):
    """What all odometries that run whole recordings may set.

    Attributes
    ----------
    extrinsic : Transform, optional
        The LiDAR's pose in the frame whose poses the program writes.
    """

    extrinsic: Transform | None = None


class WholeRun(OdometryInstance):
    """An odometry that runs once on a whole recording, and its trajectory.

    It cannot restart on the way: where `start` places it elsewhere, its motions go on from there.

    Parameters
    ----------
    parameters
        A value for every parameter.
    settings
        What is set once.
    limits
        What it may use: memory, and time for all scans together.
    read
        Gives the recording at the first start; None if scans are only prepared.
    """

    faults: Sequence[str] = ()
    _words = ""  # the last lines that the program wrote

    def __init__(
        self,
        parameters: ParameterSet,
        settings: Any,
        limits: Limits,
        read: Callable[[], ProgramInput] | None = None,
    ):
        self.parameters, self.settings = dict(parameters), settings
        self._limits, self._read_input = limits, read
        self._T_own_sensor: dict[int, Poses] | None = None
        self._T_odom_own = np.eye(4)
        self._usage = Usage(0.0, None)
        self._last_motion = LastMotion()

    @classmethod
    def instance(cls, *given: Any) -> Self:
        """Make an instance, as all programs of the user are made."""
        return cls(*given)

    @property
    def usage(self) -> Usage:
        """What the program has used, with all processes that it has started."""
        return self._usage

    @property
    def motions(self) -> Motions:
        return self._last_motion.motions

    @property
    @abstractmethod
    def called(self) -> str:
        """What messages call the program."""

    @abstractmethod
    def trajectory(self, given: ProgramInput, folder: Path) -> Trajectory:
        """Run the program, in an empty folder that is removed afterwards.

        Sets `_usage` and `_words`. A `TrajectoryError` or an `OdometryError` is a fault.
        """

    def prepare(self, scan: Scan) -> NDArray[np.int64]:
        return np.array(scan.stamp, np.int64)  # nothing else is needed

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        if self._T_own_sensor is None:
            if self._read_input is None:
                raise OdometryError("a program runs on a recording, not on single scans")
            given = self._read_input()
            poses = self._run(given)
            self._T_own_sensor = dict(zip(given.stamps.tolist(), poses, strict=True))
        self._T_odom_own = T_odom_sensor @ invert(self._own(prepared))
        self._last_motion.start(T_odom_sensor, T_previous_current)

    def submit(self, prepared: NDArray[np.int64]) -> None:
        self._submitted = prepared

    def collect(self) -> Registration:
        T_odom_sensor = self._T_odom_own @ self._own(self._submitted)
        self._last_motion.move(T_odom_sensor)
        return Registration(T_odom_sensor, bool(np.isfinite(T_odom_sensor).all()))

    def apply(self, selection: Selection) -> None:  # noqa: ARG002
        raise OdometryError(
            "a program that runs whole recordings cannot change its parameters: give it one set"
        )

    def close(self) -> None:
        pass  # the program has ended

    def _own(self, stamp: NDArray[np.int64]) -> Poses:
        assert self._T_own_sensor is not None
        return self._T_own_sensor.get(int(stamp), np.full((4, 4), np.nan))

    def _run(self, given: ProgramInput) -> Poses:
        """Poses at the scans' stamps, of shape (n, 4, 4), NaN where the program wrote none."""
        T_own_sensor, failure = np.full((len(given.stamps), 4, 4), np.nan), None
        with temporary_folder() as folder:
            try:
                trajectory = self.trajectory(given, folder)
                if self.settings.extrinsic is not None:
                    T = trajectory.T_world_sensor @ to_pose(self.settings.extrinsic)
                    trajectory = Trajectory(trajectory.stamps, T)
                T_own_sensor = poses_at(trajectory, given.stamps)
                failure = _lacking(T_own_sensor, given)
            except UnavailableError:
                raise
            except (TrajectoryError, OdometryError, LinkError) as error:
                failure = str(error)
        if failure is not None:
            self._fault(failure)
        try:
            check_frame(T_own_sensor, given.T_ref_sensor)
        except OdometryError as error:
            what = f"{self.called}, with {self.parameters}: {error}"
            raise OdometryError(self._quoting(what)) from error
        return T_own_sensor

    def _quoting(self, what: str) -> str:
        """What happened, and the last lines that the program wrote, if any."""
        return f"{what}: {self._words}" if self._words else what

    def _fault(self, what: str) -> None:
        what = self._quoting(what)
        self.faults = [*self.faults, what]
        _log.warning("%s with %s: %s", self.called, self.parameters, what)


def _lacking(T_own_sensor: Poses, given: ProgramInput) -> str | None:
    """What is said where too few scans have poses, or too little of the way."""
    known = np.isfinite(T_own_sensor[:, 0, 0])
    seconds = 1e-9 * (given.stamps - given.stamps[0])
    until = f"the last at {seconds[known][-1]:.1f} s of {seconds[-1]:.1f} s" if known.any() else ""
    if known.mean() < _COVERAGE:
        return f"it gave poses for {known.sum()} of {len(known)} scans, {until}"
    if given.T_ref_sensor is not None:
        metres = np.nan_to_num(np.linalg.norm(steps(given.T_ref_sensor)[:, :3, 3], axis=1))
        covered = metres[known[:-1] & known[1:]].sum()
        if covered < _COVERAGE * metres.sum():
            way = f"{covered:.0f} m of {metres.sum():.0f} m"
            return f"it gave poses for {way} of the way, {until}"
    return None


def poses_at(trajectory: Trajectory, stamps: NDArray[np.int64]) -> Poses:
    """Poses at the scans' stamps.

    Programs stamp a scan at its start or at its end: the scan before the first pose and the one
    after the last get the motion next to them.
    """
    spacing = np.diff(stamps)
    gap = max(1.0, 3e-9 * float(np.median(spacing))) if len(spacing) else 1.0
    T = trajectory.at(stamps, gap)
    known = np.flatnonzero(np.isfinite(T[:, 0, 0]))
    if len(known) > 1:
        first, last = known[[0, -1]]
        if first == 1 and np.isfinite(T[2]).all():
            T[0] = T[1] @ invert(T[2]) @ T[1]
        if last == len(T) - 2 and np.isfinite(T[-3]).all():
            T[-1] = T[-2] @ invert(T[-3]) @ T[-2]
    elif not len(known):
        begin, end = (1e-9 * trajectory.stamps[[0, -1]]).tolist()
        raise OdometryError(
            f"its poses are of {begin:.3f} s to {end:.3f} s, the scans of "
            f"{1e-9 * stamps[0]:.3f} s to {1e-9 * stamps[-1]:.3f} s"
        )
    return T
