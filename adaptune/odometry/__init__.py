"""Odometries as black boxes: scans and parameters in, poses out."""

from adaptune.errors import OdometryError
from adaptune.odometry.base import (
    BaseSettings,
    Description,
    InProcess,
    Motions,
    Odometry,
    OdometryInstance,
    Registration,
    Usage,
)

__all__ = [
    "BaseSettings",
    "Description",
    "InProcess",
    "Motions",
    "Odometry",
    "OdometryError",
    "OdometryInstance",
    "Registration",
    "Usage",
]
