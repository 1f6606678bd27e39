"""KISS-ICP, through its Python class."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from kiss_icp.mapping import get_voxel_hash_map
from kiss_icp.threshold import get_threshold_estimator
from numpy.typing import NDArray
from pydantic import Field

from adaptune.geometry import Poses, count_within
from adaptune.odometry.base import BaseSettings, Odometry, Registration
from adaptune.sequence.scan import Scan
from adaptune.space import Float, Integer, ParameterSet, ParameterSpace

MIN_POINTS = 20


class Settings(BaseSettings):
    """Settings of KISS-ICP, in metres."""

    min_range: float = Field(1.0, ge=0)
    max_range: float = Field(100.0, gt=0)
    deskew: bool = True


@dataclass(frozen=True, eq=False)
class Prepared:
    """Points, their times as shares of the turn, and whether enough are in range."""

    points: NDArray[np.float64]
    times: NDArray[np.float64]
    usable: bool

    @property
    def nbytes(self) -> int:
        """What the arrays hold."""
        return self.points.nbytes + self.times.nbytes


class Kiss(Odometry):
    """KISS-ICP (Vizzo et al., RA-L 2023).

    A change of parameters between scans rebuilds the parts that use them, and the new local map
    keeps the points of the old one. With `deskew`, poses belong to the scans' ends.
    """

    space = ParameterSpace(
        {
            "voxel_size": Float(low=0.1, high=3.0, baseline=1.0, log=True),
            "max_points_per_voxel": Integer(low=1, high=50, baseline=20, log=True),
            "initial_threshold": Float(low=0.2, high=5.0, baseline=2.0, log=True),
            "min_motion_th": Float(low=0.01, high=1.0, baseline=0.1, log=True),
        }
    )
    settings_type: ClassVar[type[BaseSettings]] = Settings
    live = True
    clean = True

    def __init__(
        self, parameters: ParameterSet | None = None, settings: BaseSettings | None = None
    ):
        super().__init__(parameters, settings)
        self._kiss = KissICP(self._config())

    def _config(self) -> Any:
        config = KISSConfig()
        config.data.min_range = self.settings.min_range
        config.data.max_range = self.settings.max_range
        config.data.deskew = self.settings.deskew
        config.registration.max_num_threads = 1
        config.mapping.voxel_size = self.parameters["voxel_size"]
        config.mapping.max_points_per_voxel = self.parameters["max_points_per_voxel"]
        config.adaptive_threshold.initial_threshold = self.parameters["initial_threshold"]
        config.adaptive_threshold.min_motion_th = self.parameters["min_motion_th"]
        return config

    def configure(self, parameters: ParameterSet) -> None:
        """See `Odometry.configure`.

        The adaptive threshold restarts at a new `initial_threshold`; with a new `min_motion_th`
        alone it goes on from its value.
        """
        before = dict(self.parameters)
        super().configure(parameters)
        changed = {name for name, value in self.parameters.items() if value != before[name]}
        kiss, config = self._kiss, self._config()
        kiss.config = config
        if changed & {"voxel_size", "max_points_per_voxel"}:
            points = kiss.local_map.point_cloud()
            kiss.local_map = get_voxel_hash_map(config)
            kiss.local_map.add_points(points)
        if changed & {"initial_threshold", "min_motion_th"}:
            begin = config.model_copy(deep=True)
            if "initial_threshold" not in changed:
                begin.adaptive_threshold.initial_threshold = kiss.adaptive_threshold.get_threshold()
            kiss.adaptive_threshold = get_threshold_estimator(begin)

    def prepare(self, scan: Scan) -> Prepared:
        """See `Odometry.prepare`."""
        points = scan.points.astype(np.float64)
        n_in_range = count_within(points, self.settings.min_range, self.settings.max_range)
        times = np.empty(0)
        if scan.times is not None and len(scan.times):
            # KISS-ICP wants the share of the turn.
            first, last = float(scan.times.min()), float(scan.times.max())
            if last > first:
                times = (scan.times.astype(np.float64) - first) / (last - first)
        return Prepared(points, times, n_in_range >= MIN_POINTS)

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        """See `Odometry.start`."""
        self._kiss = KissICP(self._config())
        self._kiss.last_delta = np.eye(4) if T_previous_current is None else T_previous_current
        # The first scan is registered to an empty map, which leaves it where it is predicted.
        self._kiss.last_pose = T_odom_sensor @ np.linalg.inv(self._kiss.last_delta)
        self.register(prepared)

    def register(self, prepared: Any) -> Registration:
        """See `Odometry.register`."""
        kiss = self._kiss
        if not prepared.usable:
            kiss.last_pose = kiss.last_pose @ kiss.last_delta
            return Registration(kiss.last_pose, registered=False)
        kiss.register_frame(prepared.points, prepared.times)
        return Registration(kiss.last_pose)
