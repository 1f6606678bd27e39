"""Odometries as black boxes: scans and parameters in, poses out."""

from adaptune.odometry.base import (
    BaseSettings,
    Description,
    Motions,
    Odometry,
    OdometryError,
    OdometryInstance,
    Registration,
    Usage,
    WarmUp,
)

__all__ = [
    "BaseSettings",
    "Description",
    "Motions",
    "Odometry",
    "OdometryError",
    "OdometryInstance",
    "Registration",
    "Usage",
    "WarmUp",
]
