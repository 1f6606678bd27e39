"""KISS-ICP, through its Python class."""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from kiss_icp.mapping import get_voxel_hash_map
from kiss_icp.registration import get_registration
from kiss_icp.threshold import get_threshold_estimator
from numpy.typing import NDArray
from pydantic import ValidationError

from adaptune._system import yaml12
from adaptune._system.strict import in_one_line
from adaptune.errors import OdometryError
from adaptune.geometry import Poses, count_within
from adaptune.odometry.base import (
    MIN_POINTS,
    BaseSettings,
    Description,
    Odometry,
    OwnFile,
    Registration,
    ToolSettings,
)
from adaptune.odometry.own_frame import END, MIDDLE, AtStamp, duration_of
from adaptune.recording.scan import Scan
from adaptune.space import Float, Integer, ParameterSet, ParameterSpace

_SECTION = {
    name: section
    for section, field in KISSConfig.model_fields.items()
    for name in getattr(field.annotation, "model_fields", ())
}
"""By value, the section of KISS-ICP's configuration that holds it."""
_KNOWN = {f"{section}.{name}" for name, section in _SECTION.items()} | {
    "out_dir",
    "data.preprocess",  # of older versions
    *("covariance.position_covariance", "covariance.orientation_covariance"),  # of its node
}


class KissScan(NamedTuple):
    """Points, their times as shares of the turn, and whether enough are in range."""

    stamp: int
    duration: int  # nanoseconds, see `duration_of`
    points: NDArray[np.float64]
    times: NDArray[np.float64]
    usable: bool


class Kiss(Odometry):
    """KISS-ICP (Vizzo et al., RA-L 2023).

    A change of parameters between scans rebuilds the parts that use them, and the new local map
    keeps the points of the old one. With `deskew`, its poses belong to the scans' ends; they are
    carried back to the stamps.
    """

    space = ParameterSpace.of(
        voxel_size=Float(low=0.1, high=3.0, baseline=1.0, log=True, unit="m"),
        max_points_per_voxel=Integer(low=1, high=50, baseline=20, log=True),
        initial_threshold=Float(low=0.2, high=5.0, baseline=2.0, log=True, unit="m"),
        min_motion_th=Float(low=0.01, high=1.0, baseline=0.1, log=True, unit="m"),
        max_num_iterations=Integer(low=5, high=500, baseline=500, log=True),
    )
    settings_type = ToolSettings
    live = True
    clean = True

    @cached_property
    def _kiss(self) -> Any:
        return KissICP(self._config())

    def __init__(
        self, parameters: ParameterSet | None = None, settings: BaseSettings | None = None
    ):
        super().__init__(parameters, settings)
        # What adaptune sets; or all that the user's file gives, also in the layouts of ROS.
        template = self.settings.template
        self._untuned = self.settings.model_dump(include={*ToolSettings.in_file})
        if template is not None:
            self._untuned = template.held(_SECTION)
            self.settings = self.settings.model_copy(update=dict(self._config().data))

    @classmethod
    def describe(cls, settings: Any) -> Description:
        if settings is not None and (template := settings.template) is not None:
            template.check_known(_KNOWN, "KISS-ICP")
        return super().describe(settings)

    def _config(self) -> Any:
        values = self._untuned | self.parameters | {"max_num_threads": 1}
        sections: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            sections.setdefault(_SECTION[name], {})[name] = value
        try:
            config = KISSConfig(**sections)
        except ValidationError as error:
            raise OdometryError(f"{self.settings.config}: {in_one_line(error)}") from error
        if config.mapping.voxel_size is None:  # as KISS-ICP's own tool does
            config.mapping.voxel_size = config.data.max_range / 100.0
        return config

    @classmethod
    def own_file(cls, parameters: ParameterSet, settings: Any) -> OwnFile:
        use = "kiss_icp_pipeline --config FILE DATA"
        if (users := super().own_file(parameters, settings)) is not None:
            sections = {name.partition(".")[0] for name in settings.template.names}
            return users._replace(use=use) if sections <= {*KISSConfig.model_fields} else users
        # Where results go stays open: KISS-ICP has an environment variable for it.
        data = cls(parameters, settings)._config().model_dump(exclude={"out_dir"})
        return OwnFile(".yaml", yaml12.dump(data), use)

    def configure(self, parameters: ParameterSet) -> None:
        # The adaptive threshold restarts at a new `initial_threshold`; with a new `min_motion_th`
        # alone it goes on from its value.
        before = dict(self.parameters)
        super().configure(parameters)
        changed = {name for name, value in self.parameters.items() if value != before[name]}
        kiss, config = self._kiss, self._config()
        kiss.config = config
        if "max_num_iterations" in changed:
            kiss.registration = get_registration(config)
        if changed & {"voxel_size", "max_points_per_voxel"}:
            points = kiss.local_map.point_cloud()
            kiss.local_map = get_voxel_hash_map(config)
            kiss.local_map.add_points(points)
        if changed & {"initial_threshold", "min_motion_th"}:
            begin = config.model_copy(deep=True)
            if "initial_threshold" not in changed:
                begin.adaptive_threshold.initial_threshold = kiss.adaptive_threshold.get_threshold()
            kiss.adaptive_threshold = get_threshold_estimator(begin)

    def prepare(self, scan: Scan) -> KissScan:
        points = scan.points.astype(np.float64)
        n_in_range = count_within(points, self.settings.min_range, self.settings.max_range)
        times = np.empty(0)
        if scan.times is not None and len(scan.times):
            # KISS-ICP wants the share of the turn.
            first, last = float(scan.times.min()), float(scan.times.max())
            if last > first:
                times = (scan.times.astype(np.float64) - first) / (last - first)
        usable = n_in_range >= MIN_POINTS
        return KissScan(scan.stamp, duration_of(scan), points, times, usable)

    def start(
        self, prepared: KissScan, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self._kiss = kiss = KissICP(self._config())
        kiss.last_delta = np.eye(4) if T_previous_current is None else T_previous_current
        self._at_stamp = AtStamp(END if self.settings.deskew else MIDDLE)
        self._T_odom_sensor = T_odom_sensor
        taken = prepared.stamp, prepared.duration
        T_odom_then = self._at_stamp.begin(*taken, T_odom_sensor, T_previous_current)
        # The first scan is registered to an empty map, which leaves it where it is predicted.
        kiss.last_pose = T_odom_then @ np.linalg.inv(kiss.last_delta)
        self._advance(prepared)

    def register(self, prepared: KissScan) -> Registration:
        kiss = self._kiss
        if not self._advance(prepared):
            self._T_odom_sensor = self._T_odom_sensor @ kiss.last_delta
            return Registration(self._T_odom_sensor, registered=False)
        taken = prepared.stamp, prepared.duration
        self._T_odom_sensor = self._at_stamp(*taken, kiss.last_pose)
        return Registration(self._T_odom_sensor)

    def _advance(self, prepared: KissScan) -> bool:
        """Go on to the next pose; False if the scan has too few points to be registered."""
        kiss = self._kiss
        if not prepared.usable:
            kiss.last_pose = kiss.last_pose @ kiss.last_delta
            return False
        kiss.register_frame(prepared.points, prepared.times)
        return True
