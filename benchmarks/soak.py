"""Whether the memory of a drive of hours on a robot grows.

    python benchmarks/soak.py FOLDER [--hours 2]

It drives an untrained bank of four GICP as on a robot, on scans of a simulated street that go back
and forth at ten a second by a simulated clock, as fast as they are registered. FOLDER receives the
drive. It prints the memory of all processes every ten simulated minutes, and the slope over the
last three quarters in megabytes an hour (limit 5).
"""

import argparse
import itertools
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from threading import Semaphore, Thread
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from adaptune._system import yaml12
from adaptune._system.machine import resident_megabytes
from adaptune.recording.scan import Scan
from adaptune.runs.record import Run
from adaptune.simulation import Course
from adaptune.simulation.record import simulate
from offline.config import load_study
from online.robot import RobotDrive

RATE = 10.0
CLOUD = "sensor_msgs/msg/PointCloud2"
EVERY = 600.0
"""Simulated seconds between two lines."""
POINTS = 4000
STUDY = {
    "odometry": {"name": "gicp", "settings": {"downsampling": 0.5}},
    "courses": {"back_and_forth": {"scenes": ["street"], "length": 60, "seed": 3}},
    "training": ["back_and_forth"],
    "online": {"real_time": {"deadline": 5.0, "queue": 0}, "ros": {"points": "/points"}},
}


class Robot:
    """A link on which scans are published as fast as they are taken."""

    def __init__(self, scans: list[Scan], n: int):
        self.store = get_typestore(Stores.ROS1_NOETIC)
        text = "geometry_msgs/TransformStamped[] transforms\n"
        self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self.free, self.alive, self.is2 = Semaphore(2), True, False
        self._clouds = [self._cloud(scan) for scan in scans]
        self._n = n

    def subscribe(
        self, topic: str, kind: str, take: Callable[[Any], None], raw: bool = True
    ) -> None:
        """Begin to publish."""
        assert raw, topic
        write = partial(self.store.serialize_ros1, typename=kind)
        Thread(
            target=self._play, args=[lambda cloud: take(bytes(write(cloud)))], daemon=True
        ).start()

    def _play(self, take: Callable[[Any], None]) -> None:
        back_and_forth = [*self._clouds, *self._clouds[-2:0:-1]]
        for i, cloud in enumerate(itertools.islice(itertools.cycle(back_and_forth), self._n)):
            self.free.acquire()
            stamp = cloud.header.stamp
            stamp.sec, stamp.nanosec = divmod(round(i * 1e9 / RATE), 10**9)
            take(cloud)

    def advertise(self, topic: str, kind: str) -> Callable[[Any], None]:  # noqa: ARG002
        """Take messages, and drop them."""
        return lambda message: self.store.serialize_ros1(message, kind)

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> Mapping[str, Any]:  # noqa: ARG002
        """Hold what is given."""
        return values

    def topics(self) -> Mapping[str, str]:
        """The topic of the scans."""
        return {"/points": CLOUD}

    def close(self) -> None:
        """Do nothing."""

    def _cloud(self, scan: Scan) -> Any:
        types = self.store.types
        header = types["std_msgs/msg/Header"](
            0, types["builtin_interfaces/msg/Time"](0, 0), "lidar"
        )
        field = types["sensor_msgs/msg/PointField"]
        fields = [field(name, 4 * i, 7, 1) for i, name in enumerate("xyz")]
        n, raw = len(scan.points), scan.points.view(np.uint8).reshape(-1)
        return types[CLOUD](header, 1, n, fields, False, 12, 12 * n, raw, True)


def memory() -> float:
    """Megabytes of this process and of all that it has started."""
    return resident_megabytes() + sum(map(_resident, _children(os.getpid())))


def _children(process: int) -> Iterator[int]:
    for task in Path(f"/proc/{process}/task").iterdir():
        for child in (task / "children").read_text().split():
            yield int(child)
            yield from _children(int(child))


def _resident(process: int) -> float:
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


def thinned(scan: Scan) -> Scan:
    """Fewer points, so that two hours take minutes."""
    rng = np.random.default_rng(scan.stamp % 2**32)
    chosen = np.sort(rng.choice(len(scan.points), min(POINTS, len(scan.points)), replace=False))
    return Scan(scan.stamp, np.ascontiguousarray(scan.points[chosen]))


def main(folder: Path, hours: float) -> None:
    """Drive, and print what it took."""
    logging.disable(logging.WARNING)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "soak.yaml"
    path.write_text(yaml12.dump(STUDY))
    study = load_study(path, folder=folder / "run")
    course = Course(scenes=("street",), length=60.0, seed=3, rate=RATE)
    scans = [thinned(scan) for scan in simulate(course)]
    n = round(hours * 3600.0 * RATE)
    robot = Robot(scans, n)
    drive = RobotDrive(study, "untrained", None)
    seconds: list[float] = []
    megabytes: list[float] = []
    begin = time.perf_counter()

    def watch(at: Run) -> None:
        robot.free.release()
        if at.done % round(EVERY * RATE) == 0:
            seconds.append(at.done / RATE)
            megabytes.append(memory())
            took = time.perf_counter() - begin
            print(
                f"{seconds[-1] / 60.0:4.0f} min: {megabytes[-1]:6.1f} MB  ({took:.0f} s)",
                flush=True,
            )
        if at.done == n:
            drive.stop()

    drive.run(robot, watch)
    late = len(seconds) // 4
    slope = 3600.0 * np.polyfit(seconds[late:], megabytes[late:], 1)[0]
    print(f"{drive.done} scans; {slope:+.1f} MB an hour over the last three quarters (limit 5)")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--hours", type=float, default=2.0)
    given = parser.parse_args()
    main(given.folder, given.hours)
