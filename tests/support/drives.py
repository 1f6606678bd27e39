"""Bags of a sensor driving through a world of points, small enough to register in no time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rec
from numpy.typing import NDArray

FIRST_STAMP = 1_700_000_000_123_456_789
STUDY_FILE = "small.yaml"
STUDY = """\
odometry:
  name: "fake_odometry:Fake"
  settings: {downsampling: 0.5, min_range: 0.5}
  parameters:
    max_correspondence_distance: {low: 0.1, high: 5.0, baseline: 2.0, log: true}
    keyframe_interval: {low: 0.5, high: 15.0, baseline: 1.0, log: true}
sequences:
  one: {bag: one.bag, points: /points, reference: /truth}
  two: {bag: two.bag, points: /points, reference: /truth}
  three: {bag: three.bag, points: /points, reference: /truth}
training: [one, two]
test: [three]
sub_trajectory: 3.0
offline: {trials: 10, initial: 4, batch: 4, seed: 3, workers: 2}
"""


def world(seed: int = 0, length: float = 40.0, n: int = 6000) -> NDArray[np.float64]:
    """Points on a floor, two rough walls and some poles, along x."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-10.0, length + 10.0, n)
    floor = np.stack([x, rng.uniform(-4.0, 4.0, n), rng.normal(-1.0, 0.01, n)], axis=1)
    bumps = 0.5 * np.sin(1.7 * x + seed) + 0.3 * np.sin(0.61 * x)
    side = rng.choice([-1.0, 1.0], n)
    walls = np.stack([x, side * (4.0 + bumps), rng.uniform(-1.0, 3.0, n)], axis=1)
    at = rng.uniform(-10.0, length + 10.0, 25)[rng.integers(0, 25, n // 3)]
    poles = np.stack(
        [at + rng.normal(0, 0.05, len(at)), 3.0 * np.sin(37.0 * at), rng.uniform(-1, 3, len(at))],
        axis=1,
    )
    return np.concatenate([floor, walls, poles])


def scans(
    seed: int = 0, n_scans: int = 60, step: float = 0.3
) -> list[tuple[int, NDArray[np.float32], NDArray[np.float64]]]:
    """Stamp, points and pose of every scan of a straight drive along x at 10 Hz."""
    rng = np.random.default_rng((seed, 1))
    points = world(seed, n_scans * step)
    made = []
    for i in range(n_scans):
        T_world_sensor = np.eye(4)
        T_world_sensor[0, 3] = step * i
        near = points[np.abs(points[:, 0] - step * i) < 12.0] - T_world_sensor[:3, 3]
        some = near[rng.random(len(near)) < 0.7] + rng.normal(0.0, 0.01, (1, 3))
        made.append((FIRST_STAMP + i * 100_000_000, some.astype(np.float32), T_world_sensor))
    return made


def cloud(stamp: int, points: NDArray[np.float32], names: str = "xyz") -> Any:
    """A sensor_msgs/PointCloud2 of points of shape (n, 3)."""
    kind = [(name, "<f4") for name in names]
    return rec.cloud(np.ascontiguousarray(points, "<f4").view(kind)[:, 0], stamp, rec.ROS1)


def write_bag(
    path: Path,
    drive: list[tuple[int, NDArray[np.float32], NDArray[np.float64]]],
    first: Sequence[tuple[str, int, Any]] = (),
) -> Path:
    """Write a drive without rotations to a ROS 1 bag with /points and /truth."""
    path.parent.mkdir(parents=True, exist_ok=True)
    messages = [*first]
    for stamp, xyz, T in drive:
        position, still = T[:3, 3].tolist(), (0.0, 0.0, 0.0, 1.0)
        messages.append(("/points", stamp, cloud(stamp, xyz)))
        messages.append(("/truth", stamp, rec.pose(stamp, position, still, rec.ROS1)))
    rec.write_bag(path, messages)
    return path


def study_with(odometry: str, bags: Path) -> str:
    """The same study of another odometry, given as YAML, for a file elsewhere than its bags."""
    return odometry + STUDY[STUDY.index("sequences:") :].replace("bag: ", f"bag: {bags}/")


def write_study(folder: Path) -> Path:
    """Write a study of three short drives, with its bags, and return its file."""
    for seed, name in enumerate(("one", "two", "three")):
        write_bag(folder / f"{name}.bag", scans(seed, 40))
    (folder / STUDY_FILE).write_text(STUDY)
    return folder / STUDY_FILE
