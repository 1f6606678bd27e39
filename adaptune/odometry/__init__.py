"""Odometries as black boxes: scans and parameters in, poses out."""

from adaptune.odometry.base import (
    BaseSettings,
    Box,
    Description,
    Odometry,
    OdometryError,
    Registration,
    WarmUp,
)
from adaptune.odometry.command import Command
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.isolation import Isolated, Limits
from adaptune.odometry.process import Process
from adaptune.odometry.registry import BOXES, box_class, versions
from adaptune.odometry.switching import Bank, HandOver

__all__ = [
    "BOXES",
    "Bank",
    "BaseSettings",
    "Box",
    "Command",
    "Description",
    "HandOver",
    "HealthCheck",
    "Isolated",
    "Limits",
    "Odometry",
    "OdometryError",
    "Process",
    "Registration",
    "WarmUp",
    "box_class",
    "versions",
]
