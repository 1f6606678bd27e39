"""Odometries as black boxes: scans and parameters in, poses out."""

from adaptune.errors import OdometryError
from adaptune.odometry.base import BaseSettings, InProcess, Odometry, Registration

__all__ = ["BaseSettings", "InProcess", "Odometry", "OdometryError", "Registration"]
