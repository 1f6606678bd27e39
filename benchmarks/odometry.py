"""The time that adapters add to their odometries.

    python benchmarks/odometry.py adapters RECORDING.bag [METRES]

The recording is that of a simulated course, as `adaptune simulate` writes it, or another one with
the same topics. *adapters* runs every installed odometry with its default parameters. It prints the
time for a scan, the part of it that is not spent in the odometry's own code, and the time that a
process of its own adds. Limit: 5 % of the odometry's time, or 0.3 ms where that is more.
The RTE is over 25 m, or the given METRES.
All times are CPU time on one core, medians, so that other work on the machine counts less.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import small_gicp

from adaptune._system import machine, open3d
from adaptune.geometry import Poses
from adaptune.metrics import sub_trajectory_rte
from adaptune.odometry.base import InProcess, OdometryInstance
from adaptune.odometry.registry import ODOMETRIES, odometry_class
from adaptune.odometry.remote import Isolated, Limits
from adaptune.recording import Scan, SequenceError
from adaptune.recording.recording import open_sequence
from adaptune.simulation import Course
from adaptune.simulation.course import as_sequence

LENGTH = 25.0
SOME = 30
"""Scans for which another process is measured."""


class Clock:
    """Adds up the time that the wrapped functions take."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def wrap(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, timed."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            begin = time.process_time()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds += time.process_time() - begin

        return timed


class Timed:
    """An object whose methods are timed."""

    def __init__(self, wrapped: Any, clock: Clock):
        self.__dict__.update(wrapped=wrapped, clock=clock)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.wrapped, name)
        return self.clock.wrap(value) if callable(value) else value

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.wrapped, name, value)


def read(path: Path) -> tuple[list[Scan], Poses]:
    """Scans, and the reference at their stamps."""
    course = Course(scenes=("garden",), imu=200)
    sequence: Any
    try:
        sequence = open_sequence(as_sequence(course, path), with_imu=True)
    except SequenceError:
        sequence = open_sequence(as_sequence(course.model_copy(update={"imu": None}), path))
    scans = list(sequence)
    reference = sequence.reference()
    if reference is None:
        sys.exit(f"{path}: has no /gt_poses")
    return scans, reference.at(np.array([scan.stamp for scan in scans]))


def run(odometry: OdometryInstance, scans: list[Scan]) -> tuple[Poses, float]:
    """Poses, and the median CPU time for a scan in milliseconds."""
    odometry.start(odometry.prepare(scans[0]), np.eye(4))
    poses, at = [np.eye(4)], []
    for scan in scans[1:]:
        poses.append(odometry.register(odometry.prepare(scan)).T_odom_sensor)
        # Another process reports its CPU time with each pose, not before the first.
        at.append(computed(odometry))
    return np.array(poses), 1e3 * float(np.median(np.diff(at)))


def computed(odometry: OdometryInstance) -> float:
    """Seconds of CPU time, here and in the other process if there is one."""
    return time.process_time() + (odometry.usage.cpu if odometry.usage.memory else 0.0)


def own_time(name: str, scans: list[Scan]) -> tuple[Poses, float, float]:
    """Poses, milliseconds a scan, and those of them not in the odometry's own code; medians."""
    clock = Clock()
    odometry: Any = odometry_class(name)()
    odometry.start(odometry.prepare(scans[0]), np.eye(4))
    originals = small_gicp.align, small_gicp.preprocess_points
    registration = open3d.load().pipelines.registration
    ndt = registration.registration_ndt
    cloud = open3d.load().geometry.PointCloud
    downsample = cloud.voxel_down_sample
    small_gicp.align, small_gicp.preprocess_points = map(clock.wrap, originals)
    registration.registration_ndt = clock.wrap(ndt)
    cloud.voxel_down_sample = clock.wrap(downsample)
    for attribute in ("_kiss", "_pipeline", "_lio"):
        if hasattr(odometry, attribute):
            setattr(odometry, attribute, Timed(getattr(odometry, attribute), clock))
    poses, whole, own = [np.eye(4)], [], []
    for scan in scans[1:]:
        at, begin = clock.seconds, time.process_time()
        poses.append(odometry.register(odometry.prepare(scan)).T_odom_sensor)
        whole.append(time.process_time() - begin)
        own.append(clock.seconds - at)
    small_gicp.align, small_gicp.preprocess_points = originals
    registration.registration_ndt = ndt
    cloud.voxel_down_sample = downsample
    added = np.subtract(whole, own)
    return np.array(poses), 1e3 * float(np.median(whole)), 1e3 * float(np.median(added))


def adapters(path: Path, length: float) -> None:
    """Print a row for every odometry."""
    scans, T_ref = read(path)
    print("odometry          RTE %   ms   adapter ms    +process ms   changes by")
    for name in ODOMETRIES:
        cls = odometry_class(name)
        try:
            poses, whole, added = own_time(name, scans)
        except Exception as error:
            print(f"{name:16} {error}", flush=True)
            continue
        isolated = ""
        if not cls.clean:
            some = scans[:SOME]
            here = run(InProcess(cls()), some)[1]
            there = run(Isolated(name, {}, cls.settings_type(), Limits()), some)[1]
            isolated = f"{there - here:.2f}"
        rte = np.nanmean(sub_trajectory_rte(T_ref, poses, length))
        print(
            f"{name:16} {rte:6.3f} {whole:6.1f} {added:6.2f} ({added / (whole - added):4.0%})"
            f"  {isolated:>8}       {'itself' if cls.live else 'bank'}",
            flush=True,
        )


if __name__ == "__main__":
    machine.pin(1)
    if len(sys.argv) in (3, 4) and sys.argv[1] == "adapters":
        adapters(Path(sys.argv[2]), float(sys.argv[3]) if len(sys.argv) == 4 else LENGTH)
    else:
        sys.exit(__doc__)
