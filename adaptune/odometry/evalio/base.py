"""What the adapters of evalio's pipelines share."""

import contextlib
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from adaptune.geometry import Poses, invert
from adaptune.odometry.base import (
    MIN_POINTS,
    BaseSettings,
    Description,
    OdometryError,
    RangeSettings,
)
from adaptune.odometry.evalio import point_layout
from adaptune.odometry.evalio.point_layout import EvalioScan, evalio_modules, to_evalio
from adaptune.odometry.own_frame import NO_IMU, OwnFrameOdometry
from adaptune.odometry.scan_time import END, MIDDLE, duration_of
from adaptune.sequence.imu import Imu
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet, Value, nearest

GRAVITY = 9.80665


NO_FIELD = "{} needs to know {}, and the scans do not say; record clouds with a {} field"


class EvalioSettings(RangeSettings):
    """Settings of all pipelines.

    Attributes
    ----------
    parameters : dict
        Values of any of the pipeline's parameters, where they are not tuned.
    """

    parameters: dict[str, Value] = Field(default_factory=dict)


class RangeImageSettings(EvalioSettings):
    """Settings of pipelines that see scans as images.

    Attributes
    ----------
    rows : int, optional
        Lasers; by default the smallest power of two that holds those of the first scan.
    columns : int, optional
        Firings in a turn; by default as many as the fullest laser of the first scan has points.
        With more columns than firings the image has holes, around which no features are found.
    """

    rows: int | None = Field(None, ge=2, le=256)
    columns: int | None = Field(None, ge=16, le=8192)


with contextlib.suppress(OdometryError):
    # Processes that are forked from one with this module find evalio loaded.
    evalio_modules()


class Pipeline(OwnFrameOdometry):
    """A pipeline of evalio (Potokar and Kaess).

    Pipelines read their parameters only when they begin, and begin at rest. Those that deskew do so
    to the scan's end; their poses are carried back to its stamp. Pipelines with an IMU give poses
    of the IMU, which become the LiDAR's here.

    Attributes
    ----------
    pipeline : str
        What evalio calls it; class attribute.
    deskews_to : float
        Share of a scan's duration, see `adaptune.odometry.scan_time`; class attribute.
    untuned : dict
        Values that must differ from the pipeline's own defaults: one thread, no scans dropped
        when late; class attribute.
    """

    settings_type = EvalioSettings
    live = False
    # Some end the process at unexpected scans, some share state between instances.
    clean = False
    pipeline: ClassVar[str]
    deskews_to: ClassVar[float] = END
    untuned: ClassVar[ParameterSet] = {}

    def __init__(
        self, parameters: ParameterSet | None = None, settings: BaseSettings | None = None
    ):
        super().__init__(parameters, settings)
        self._defaults = evalio_modules()[0].all_pipelines()[self.pipeline].default_params()
        kept = {name: self._typed(name, v) for name, v in self.settings.parameters.items()}
        given = {name: self._typed(name, v) for name, v in (parameters or {}).items()}
        self.parameters |= {name: v for name, v in kept.items() if name in self.space.names} | given
        self._given = kept | self.parameters

    @classmethod
    def describe(cls, settings: Any) -> Description:
        evalio_modules()  # raises if there is no evalio
        if settings is not None and settings.parameters:
            cls(settings=settings)  # raises if a parameter is unknown, or a value of another type
        return super().describe(settings)

    def _typed(self, name: str, value: Value) -> Value:
        """A value in the type that the pipeline needs: it takes no 1 for a float."""
        where = f"parameters.{name}: {self.pipeline}"
        if name not in self._defaults:
            help_ = nearest(name, self._defaults)
            raise OdometryError(f"{where} has no such parameter; {help_}")
        default = self._defaults[name]
        if isinstance(default, float) and type(value) is int:
            return float(value)
        if type(value) is not type(default):
            raise OdometryError(f"{where} takes a value like {default!r}, not {value!r}")
        return value

    def prepare(self, scan: Scan) -> EvalioScan:
        if self.needs_imu and scan.imu is None:
            raise OdometryError(NO_IMU.format(self.pipeline))
        cropped = point_layout.crop(scan, self.settings.min_range, self.settings.max_range)
        cloud, shape = self._layout(cropped)
        usable, duration = len(cropped) >= MIN_POINTS, duration_of(cropped)
        return EvalioScan(scan.stamp, cloud, shape, usable, duration, scan.imu)

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """Points as `FIELDS` has them, and their numbers of rows and columns."""
        return point_layout.cloud(scan, 4), (1, len(scan))

    def _begin(self, prepared: EvalioScan) -> None:
        pipelines, types, _ = evalio_modules()
        self._shape = prepared.shape
        parameters = self._defaults | self.untuned | self._given
        if "deskew" in self._defaults and "deskew" not in self.settings.parameters:
            parameters["deskew"] = self.settings.deskew and prepared.duration > 0
        # Pipelines divide by the length of the scan, and some end the process where it is 0.
        self._needs_times = bool(parameters.get("deskew"))
        if "deskew" in parameters:
            self._share = self.deskews_to if parameters["deskew"] else MIDDLE
        pipeline = pipelines.all_pipelines()[self.pipeline]()
        pipeline.set_params(parameters)
        ranges = {"min_range": self.settings.min_range, "max_range": self.settings.max_range}
        rows, columns = self._shape
        lidar = types.LidarParams(num_rows=rows, num_columns=columns, **ranges)
        pipeline.set_lidar_params(lidar)
        self._T_imu_sensor = np.eye(4)
        if prepared.imu is not None:
            self._T_imu_sensor = invert(prepared.imu.T_sensor_imu)
            pipeline.set_imu_params(_imu_parameters(prepared.imu))
        pipeline.set_imu_T_lidar(types.SE3.from_mat(self._T_imu_sensor))
        pipeline.initialize()
        self._pipeline = pipeline

    def _process(self, prepared: EvalioScan) -> Poses | None:
        if self.needs_imu and prepared.imu is not None:
            self._measure(prepared.imu)
        if not prepared.usable or (self._needs_times and not prepared.duration):
            return None
        return self._estimate(prepared)

    def _measure(self, imu: Imu) -> None:
        """Pass on what the IMU measured."""
        types = evalio_modules()[1]
        stamps = map(types.Stamp.from_nsec, imu.stamps.tolist())
        for measured in zip(stamps, imu.angular_velocity, imu.acceleration, strict=True):
            self._pipeline.add_imu(types.ImuMeasurement(*measured))

    def _estimate(self, prepared: EvalioScan) -> Poses | None:
        """Pass a scan on, and return the last pose that comes back."""
        self._pipeline.add_lidar(to_evalio(prepared))
        estimates = self._pipeline.saved_estimates()
        return estimates[-1][1].to_mat() @ self._T_imu_sensor if estimates else None


def _imu_parameters(imu: Imu) -> Any:
    rate = 1e9 / float(np.median(np.diff(imu.stamps))) if len(imu) > 1 else 100.0
    return evalio_modules()[1].ImuParams(
        **dict(zip(("gyro", "accel", "gyro_bias", "accel_bias"), imu.noise, strict=True)),
        gravity=np.array([0.0, 0.0, -GRAVITY]),
        rate=rate,
    )


class RingedPipeline(Pipeline):
    """A pipeline that needs to know which laser measured each point."""

    settings_type = RangeImageSettings
    # What the settings leave open follows from the first scan.
    _rows = _columns = 0

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        if scan.rings is None:
            raise OdometryError(
                NO_FIELD.format(self.pipeline, "which laser measured each point", "`ring`")
            )
        points = point_layout.cloud(scan, 5)
        if len(scan) < MIN_POINTS:
            return points, (1, len(scan))
        counts = np.bincount(scan.rings)
        if not self._rows:
            sizes = (16, 32, 64, 128, 256, 65536)
            self._rows = self.settings.rows or next(n for n in sizes if n >= len(counts))
            self._columns = self.settings.columns or max(16, int(counts.max()))
        if len(counts) > self._rows:
            raise OdometryError(
                f"odometry.settings.rows: {self._rows} rows do not hold laser number "
                f"{len(counts) - 1}; set it to the sensor's number of lasers"
            )
        return points, (self._rows, self._columns)


class GridPipeline(RingedPipeline):
    """A pipeline that needs a complete image of rows x columns, and ends the process otherwise."""

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        points, shape = super()._layout(scan)
        return points if len(scan) < MIN_POINTS else point_layout.image(scan, points, *shape), shape

    def _estimate(self, prepared: EvalioScan) -> Poses | None:
        if prepared.shape != self._shape:
            before, now = ("{} x {}".format(*shape) for shape in (self._shape, prepared.shape))
            raise OdometryError(
                f"{self.pipeline} began with scans of {before} points and cannot go on with {now}"
            )
        return super()._estimate(prepared)
