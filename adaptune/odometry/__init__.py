"""Odometries as black boxes: scans and parameters in, poses out."""

from adaptune.odometry.base import BaseSettings as BaseSettings
from adaptune.odometry.base import Description as Description
from adaptune.odometry.base import Motions as Motions
from adaptune.odometry.base import Odometry as Odometry
from adaptune.odometry.base import OdometryError as OdometryError
from adaptune.odometry.base import OdometryInstance as OdometryInstance
from adaptune.odometry.base import Registration as Registration
from adaptune.odometry.base import Usage as Usage
from adaptune.odometry.base import WarmUp as WarmUp
