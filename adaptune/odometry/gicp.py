"""Keyframe GICP on small_gicp."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import small_gicp
from pydantic import Field

from adaptune.geometry import Poses, squared_ranges
from adaptune.odometry.base import BaseSettings
from adaptune.odometry.keyframe import Alignment, KeyframeOdometry
from adaptune.sequence import Scan
from adaptune.space import Float, ParameterSpace

MIN_POINTS = 20
"""small_gicp crashes on an empty target, and calls a guess kept for want of points converged."""


class Settings(BaseSettings):
    """Settings of keyframe GICP and VGICP, in metres."""

    downsampling: float = Field(0.5, gt=0)
    min_range: float = Field(1.0, ge=0)
    iterations: int = Field(20, ge=1)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A downsampled cloud with its covariances and its search tree."""

    stamp: int
    cloud: Any
    tree: Any

    @property
    def nbytes(self) -> int:
        """Points, normals, covariances (4 + 4 + 16 doubles) and the tree."""
        return 4096 + 230 * int(self.cloud.size())


class KeyframeGicp(KeyframeOdometry):
    """Scan-to-keyframe GICP (Segal et al., RSS 2009; Koide et al., small_gicp, JOSS 2024)."""

    space = ParameterSpace(
        {
            "max_correspondence_distance": Float(low=1.0, high=10.0, baseline=4.0, log=True),
            "keyframe_interval": Float(low=1.0, high=30.0, baseline=4.0, log=True),
        }
    )
    settings_type: ClassVar[type[BaseSettings]] = Settings

    def prepare(self, scan: Scan) -> Prepared:
        """See `Odometry.prepare`."""
        return prepare(scan, self.settings)

    def usable(self, prepared: Prepared) -> bool:
        """See `KeyframeOdometry.usable`."""
        return bool(prepared.cloud.size() >= MIN_POINTS)

    def align(self, target: Prepared, source: Prepared, T_target_guess: Poses) -> Alignment:
        """See `KeyframeOdometry.align`."""
        result = small_gicp.align(
            target.cloud,
            source.cloud,
            target.tree,
            init_T_target_source=T_target_guess,
            max_correspondence_distance=self.parameters["max_correspondence_distance"],
            max_iterations=self.settings.iterations,
            num_threads=1,
        )
        return Alignment(result.T_target_source, result.num_inliers >= MIN_POINTS)


def prepare(scan: Scan, settings: Settings) -> Prepared:
    """Crop and downsample a scan, and estimate its covariances."""
    points = crop(scan, settings.min_range)
    if len(points) < MIN_POINTS:
        return Prepared(scan.stamp, small_gicp.PointCloud(points), None)
    cloud, tree = small_gicp.preprocess_points(
        points, downsampling_resolution=settings.downsampling, num_threads=1
    )
    return Prepared(scan.stamp, cloud, tree)


def crop(scan: Scan, min_range: float) -> Any:
    """Points no nearer than `min_range` metres, as float64 of shape (n, 3)."""
    points = scan.points.astype(np.float64)
    kept = squared_ranges(points) >= min_range**2
    # Numbers are picked in a quarter of the time that a mask takes.
    return points if kept.all() else points.take(np.flatnonzero(kept), axis=0)
