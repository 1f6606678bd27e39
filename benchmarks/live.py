"""What live evidence costs: the share of one core that its registrations take.

    python benchmarks/live.py

ADAPTUNE_TEST_DATA names the folder of the recordings. Keyframe GICP with its defaults drives along
`town.bag` (an HDL-64E, every fifth point, a car) and along a simulated cave and street (an HDL-32E,
a robot). Once a second, `LiveEvidence` measures. The script prints the CPU time of preparing and
registering as a share of the recording's time. Limit: 10 % for `town.bag`.
"""

import os
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from adaptune._system import machine
from adaptune.live.evidence import LiveEvidence
from adaptune.odometry.base import InProcess
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.tracker import Tracker
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import open_sequence
from adaptune.recording.scan import Scan
from adaptune.simulation import Course
from adaptune.simulation.record import simulate

SECONDS = 30


def measure(name: str, scans: Iterable[Scan]) -> None:
    """Drive, and print what the measurements take."""
    odometry = InProcess(KeyframeGicp())
    tracker, live = Tracker(odometry, HealthCheck()), LiveEvidence()
    first, last, cpu, hops = None, 0, [], 0
    for scan in scans:
        first = scan.stamp if first is None else first
        live.observe(scan.stamp, scan, odometry.motions)
        if scan.stamp - first >= len(cpu) * 1_000_000_000:
            begin = time.thread_time()
            hops += live.measure() is not None
            cpu.append(time.thread_time() - begin)
        tracker.register(scan)
        last = scan.stamp
        if last - first > SECONDS * 1_000_000_000:
            break
    assert first is not None
    share = sum(cpu) / ((last - first) * 1e-9)
    print(
        f"{name:14} {share:6.1%} of a core, {hops} hops in {len(cpu)} s; a measurement takes "
        f"{1e3 * np.median(cpu):.0f} ms in the median, {1e3 * max(cpu):.0f} ms at most",
        flush=True,
    )


def main() -> None:
    """Measure on recorded and on simulated scans."""
    machine.pin(1)
    bag = Path(os.environ["ADAPTUNE_TEST_DATA"]) / "town.bag"
    measure("town.bag", open_sequence(SequenceConfig(bag=str(bag), points="/velodyne_points")))
    for scene in ("cave", "street"):
        measure(scene, simulate(Course(scenes=(scene,), length=60.0, seed=1)))


if __name__ == "__main__":
    main()
