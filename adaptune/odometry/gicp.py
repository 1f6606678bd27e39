"""Keyframe GICP and VGICP on small_gicp."""

from abc import abstractmethod
from typing import Any

import numpy as np
import small_gicp

from adaptune.geometry import Poses
from adaptune.odometry.base import MIN_POINTS
from adaptune.odometry.keyframe import (
    DOWNSAMPLING,
    ITERATIONS,
    Alignment,
    KeyframeOdometry,
    PreparedCloud,
    crop,
)
from adaptune.sequence.scan import Scan
from adaptune.space import Float, ParameterSpace


class _SmallGicp(KeyframeOdometry):
    """A keyframe odometry on small_gicp."""

    def prepare(self, scan: Scan) -> PreparedCloud:
        points = crop(scan, self.settings.min_range)
        # small_gicp crashes on an empty target, and calls a guess from too few points converged.
        if len(points) < MIN_POINTS:
            return PreparedCloud(scan.stamp, None, usable=False, nbytes=0)
        cloud, tree = small_gicp.preprocess_points(
            points, downsampling_resolution=self.parameters["downsampling"], num_threads=1
        )
        # Measured. Points, normals and covariances alone are 24 doubles; then there is the tree.
        nbytes = 4096 + 300 * cloud.size()
        return PreparedCloud(scan.stamp, cloud, cloud.size() >= MIN_POINTS, nbytes, tree)

    @abstractmethod
    def _pair(self, target: PreparedCloud, source: PreparedCloud) -> tuple[tuple[Any, ...], Any]:
        """What small_gicp aligns, and the greatest distance of correspondences in metres."""

    def align(
        self, target: PreparedCloud, source: PreparedCloud, T_target_guess: Poses
    ) -> Alignment:
        clouds, distance = self._pair(target, source)
        result = small_gicp.align(
            *clouds,
            init_T_target_source=T_target_guess,
            max_correspondence_distance=distance,
            max_iterations=self.parameters["iterations"],
            num_threads=1,
        )
        return Alignment(result.T_target_source, result.num_inliers >= MIN_POINTS)


class KeyframeGicp(_SmallGicp):
    """Scan-to-keyframe GICP (Segal et al., RSS 2009; Koide et al., small_gicp, JOSS 2024)."""

    space = ParameterSpace.of(
        max_correspondence_distance=Float(low=1.0, high=10.0, baseline=4.0, log=True, unit="m"),
        keyframe_interval=Float(low=1.0, high=30.0, baseline=4.0, log=True, unit="m"),
        downsampling=DOWNSAMPLING,
        iterations=ITERATIONS,
    )

    def _pair(self, target: PreparedCloud, source: PreparedCloud) -> tuple[tuple[Any, ...], Any]:
        distance = self.parameters["max_correspondence_distance"]
        return (target.cloud, source.cloud, target.tree), distance


class KeyframeVgicp(_SmallGicp):
    """Scan-to-keyframe voxelised GICP (Koide et al., ICRA 2021; small_gicp, JOSS 2024)."""

    space = ParameterSpace.of(
        resolution=Float(low=0.5, high=5.0, baseline=1.0, log=True, unit="m"),
        keyframe_interval=Float(low=1.0, high=30.0, baseline=4.0, log=True, unit="m"),
        downsampling=DOWNSAMPLING,
        iterations=ITERATIONS,
    )
    # The keyframe's cells, with the cloud and the resolution that they were made from.
    _cells: tuple[PreparedCloud, Any, Any] | None = None

    def _pair(self, target: PreparedCloud, source: PreparedCloud) -> tuple[tuple[Any, ...], Any]:
        resolution = self.parameters["resolution"]
        if self._cells is None or self._cells[0] is not target or self._cells[1] != resolution:
            cells = small_gicp.GaussianVoxelMap(resolution)
            cells.insert(target.cloud)
            self._cells = target, resolution, cells
        # A point is matched to the cell that contains it, however far the cell's mean is.
        return (self._cells[2], source.cloud), np.inf
