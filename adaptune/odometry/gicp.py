"""Keyframe GICP and VGICP on small_gicp."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import small_gicp
from pydantic import Field

from adaptune.geometry import Poses
from adaptune.odometry.base import BaseSettings
from adaptune.odometry.keyframe import Alignment, KeyframeOdometry, crop
from adaptune.sequence.scan import Scan
from adaptune.space import Float, ParameterSpace

MIN_POINTS = 20
"""small_gicp crashes on an empty target, and with too few points returns the guess as converged."""


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


class _SmallGicp(KeyframeOdometry):
    """A keyframe odometry on small_gicp."""

    settings_type: ClassVar[type[BaseSettings]] = Settings

    def prepare(self, scan: Scan) -> Prepared:
        """See `Odometry.prepare`."""
        points = crop(scan, self.settings.min_range)
        if len(points) < MIN_POINTS:
            return Prepared(scan.stamp, small_gicp.PointCloud(points), None)
        cloud, tree = small_gicp.preprocess_points(
            points, downsampling_resolution=self.settings.downsampling, num_threads=1
        )
        return Prepared(scan.stamp, cloud, tree)

    def usable(self, prepared: Prepared) -> bool:
        """See `KeyframeOdometry.usable`."""
        return bool(prepared.cloud.size() >= MIN_POINTS)

    def _align(self, clouds: tuple[Any, ...], guess: Poses, distance: Any) -> Alignment:
        result = small_gicp.align(
            *clouds,
            init_T_target_source=guess,
            max_correspondence_distance=distance,
            max_iterations=self.settings.iterations,
            num_threads=1,
        )
        return Alignment(result.T_target_source, result.num_inliers >= MIN_POINTS)


class KeyframeGicp(_SmallGicp):
    """Scan-to-keyframe GICP (Segal et al., RSS 2009; Koide et al., small_gicp, JOSS 2024)."""

    space = ParameterSpace(
        {
            "max_correspondence_distance": Float(low=1.0, high=10.0, baseline=4.0, log=True),
            "keyframe_interval": Float(low=1.0, high=30.0, baseline=4.0, log=True),
        }
    )

    def align(self, target: Prepared, source: Prepared, T_target_guess: Poses) -> Alignment:
        """See `KeyframeOdometry.align`."""
        distance = self.parameters["max_correspondence_distance"]
        return self._align((target.cloud, source.cloud, target.tree), T_target_guess, distance)


class KeyframeVgicp(_SmallGicp):
    """Scan-to-keyframe voxelised GICP (Koide et al., ICRA 2021; small_gicp, JOSS 2024)."""

    space = ParameterSpace(
        {
            "resolution": Float(low=0.5, high=5.0, baseline=1.0, log=True),
            "keyframe_interval": Float(low=1.0, high=30.0, baseline=4.0, log=True),
        }
    )
    # The keyframe's cells, with the cloud and the resolution that they were made from.
    _cells: tuple[Prepared, Any, Any] | None = None

    def align(self, target: Prepared, source: Prepared, T_target_guess: Poses) -> Alignment:
        """See `KeyframeOdometry.align`."""
        # A point is matched to the cell that contains it, however far the cell's mean is.
        return self._align((self._voxel_map(target), source.cloud), T_target_guess, np.inf)

    def _voxel_map(self, target: Prepared) -> Any:
        resolution = self.parameters["resolution"]
        if self._cells is None or self._cells[0] is not target or self._cells[1] != resolution:
            cells = small_gicp.GaussianVoxelMap(resolution)
            cells.insert(target.cloud)
            self._cells = target, resolution, cells
        return self._cells[2]
