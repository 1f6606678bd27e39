"""The sensors of a simulated recording: their topics, and the mounting of the IMU."""

from pathlib import Path
from typing import Any

import numpy as np

from adaptune import geometry
from adaptune.geometry import Poses
from adaptune.sequence.config import SequenceConfig
from adaptune.sequence.imu import ImuNoise
from adaptune.simulation.course import Course

POINTS, POSES, IMU = "/velodyne_points", "/gt_poses", "/imu/data"
"""Topics, named as BotanicGarden names them."""

T_IMU_LIDAR: Poses = np.array(
    [
        [0.9996789, 0.0252866, 0.0015042, 0.058487],
        [-0.0252723, 0.9996494, -0.0078025, 0.008404],
        [-0.0017010, 0.0077630, 0.9999700, 0.168916],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Pose of the LiDAR in the IMU's frame, as on BotanicGarden's robot."""

NOISE = ImuNoise(5.2e-5, 5.9e-4, 2.0e-6, 3.0e-5)
"""Noise of an Xsens MTi-680G."""


def as_sequence(course: Course, path: Path) -> SequenceConfig:
    """Configuration of the sequence in the bag that was recorded of a course."""
    extrinsic = geometry.invert(T_IMU_LIDAR).tolist()
    imu: Any = {"topic": IMU, "extrinsic": extrinsic, "noise": NOISE._asdict()}
    imu = None if course.imu is None else imu
    return SequenceConfig(bag=str(path), points=POINTS, reference=POSES, imu=imu, part=course.part)
