"""Keyframe VGICP on small_gicp."""

from typing import Any, ClassVar

import numpy as np
import small_gicp

from adaptune.geometry import Poses
from adaptune.odometry.base import BaseSettings
from adaptune.odometry.gicp import MIN_POINTS, Prepared, Settings, prepare
from adaptune.odometry.keyframe import Alignment, KeyframeOdometry
from adaptune.sequence import Scan
from adaptune.space import Float, ParameterSpace


class KeyframeVgicp(KeyframeOdometry):
    """Scan-to-keyframe voxelised GICP (Koide et al., ICRA 2021; small_gicp, JOSS 2024)."""

    space = ParameterSpace(
        {
            "resolution": Float(low=0.5, high=5.0, baseline=1.0, log=True),
            "keyframe_interval": Float(low=1.0, high=30.0, baseline=4.0, log=True),
        }
    )
    settings_type: ClassVar[type[BaseSettings]] = Settings
    # The keyframe's cells, with the cloud and the resolution that they were made from.
    _cells: tuple[Prepared, Any, Any] | None = None

    def prepare(self, scan: Scan) -> Prepared:
        """See `Odometry.prepare`."""
        return prepare(scan, self.settings)

    def usable(self, prepared: Prepared) -> bool:
        """See `KeyframeOdometry.usable`."""
        return bool(prepared.cloud.size() >= MIN_POINTS)

    def align(self, target: Prepared, source: Prepared, T_target_guess: Poses) -> Alignment:
        """See `KeyframeOdometry.align`."""
        result = small_gicp.align(
            self._voxel_map(target),
            source.cloud,
            init_T_target_source=T_target_guess,
            # A point is matched to the cell it lies in, however far that cell's mean may be.
            max_correspondence_distance=np.inf,
            max_iterations=self.settings.iterations,
            num_threads=1,
        )
        return Alignment(result.T_target_source, result.num_inliers >= MIN_POINTS)

    def _voxel_map(self, target: Prepared) -> Any:
        resolution = self.parameters["resolution"]
        if self._cells is None or self._cells[0] is not target or self._cells[1] != resolution:
            cells = small_gicp.GaussianVoxelMap(resolution)
            cells.insert(target.cloud)
            self._cells = target, resolution, cells
        return self._cells[2]
