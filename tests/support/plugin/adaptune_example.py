"""What another package can add to adaptune: an odometry and a descriptor by short names."""

from typing import Any

import numpy as np
import small_gicp
from numpy.typing import NDArray

from adaptune.odometry import Odometry, Registration
from adaptune.recording import Scan
from adaptune.space import Float, ParameterSpace


class ScanToScan(Odometry):
    """Registers every scan to the one before."""

    space = ParameterSpace({"voxel": Float(low=0.1, high=2.0, baseline=0.5, log=True, unit="m")})
    live = True

    def prepare(self, scan: Scan) -> Any:
        return scan.points

    def start(self, prepared: Any, T_odom_sensor: Any, T_previous_current: Any = None) -> None:  # noqa: ARG002
        self.last, self.T_odom_sensor = prepared, T_odom_sensor

    def register(self, prepared: Any) -> Registration:
        voxel = self.parameters["voxel"]
        found = small_gicp.align(self.last, prepared, downsampling_resolution=voxel)
        self.last = prepared
        self.T_odom_sensor = self.T_odom_sensor @ found.T_target_source
        return Registration(self.T_odom_sensor, found.converged)


def range_deciles(scan: Scan) -> NDArray[np.float64]:
    """Deciles of the points' ranges, of shape (9,)."""
    ranges = np.linalg.norm(scan.points, axis=1)
    return np.quantile(ranges, np.linspace(0.1, 0.9, 9)) if len(ranges) else np.zeros(9)
