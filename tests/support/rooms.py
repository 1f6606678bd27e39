"""Made-up places of a few thousand points that a hop can be registered in, and paths."""

import numpy as np

from adaptune.recording.scan import Scan
from adaptune.trajectory import Trajectory

REACH = 18.0


def street(length=60.0, seed=0):
    """Ground, two walls, and boxes along them, as points in the world."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform([-REACH, -6.0, -1.5], [length, 6.0, -1.5], (2500, 3))
    walls = rng.uniform([-REACH, -6.0, -1.5], [length, 6.0, 4.0], (4000, 3))
    walls[:, 1] = np.where(walls[:, 1] < 0.0, -6.0, 6.0)
    boxes = []
    for x in np.arange(-REACH, length, 4.0):
        front = np.array([x + rng.uniform(0.0, 2.0), rng.choice([-1.0, 1.0]) * rng.uniform(3, 5)])
        face = rng.uniform([0.0, -1.0, -1.5], [0.0, 1.0, 2.0], (150, 3))
        side = rng.uniform([0.0, -1.0, -1.5], [1.5, -1.0, 2.0], (150, 3))
        boxes.append(np.concatenate([face, side]) + np.append(front, 0.0))
    return np.concatenate([ground, walls, *boxes])


def tunnel(length=60.0, seed=0):
    """A pipe along x without any feature; another seed touches it at other points."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 2.0 * np.pi, 8000)
    along = rng.uniform(-REACH, length, 8000)
    return np.column_stack([along, 3.0 * np.cos(angle), 3.0 * np.sin(angle)])


def scan_at(world, x, stamp=0, seed=None):
    """The scan of a sensor that stands at x and looks along x."""
    points = world - np.array([x, 0.0, 0.0])
    seen = points[np.abs(points[:, 0]) < REACH]
    noise = np.random.default_rng(int(1000 * x) if seed is None else seed)
    return Scan(stamp, (seen + noise.normal(0.0, 0.01, seen.shape)).astype(np.float32))


def moved(x=0.0, y=0.0, z=0.0, yaw=0.0):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T


def along_x(x):
    """Poses at these metres along x."""
    T = np.tile(np.eye(4), (len(x), 1, 1))
    T[:, 0, 3] = x
    return T


def write_kitti(path, T):
    """Write poses as KITTI has them, 12 numbers a line."""
    np.savetxt(path, T[:, :3].reshape(-1, 12), fmt="%.9e")


def trajectory(T, first=0):
    return Trajectory(np.arange(first, first + len(T)) * 10**8, T)


def straight(n, step=1.0):
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 3] = step * np.arange(n)
    return T
