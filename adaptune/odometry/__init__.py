"""Odometries as black boxes: scans and parameters in, poses out."""

from adaptune.odometry.base import BaseSettings, Odometry, OdometryError, Registration
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.registry import BOXES, box_class

__all__ = [
    "BOXES",
    "BaseSettings",
    "HealthCheck",
    "Odometry",
    "OdometryError",
    "Registration",
    "box_class",
]
