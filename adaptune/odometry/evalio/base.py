"""What the adapters of evalio's pipelines share."""

import contextlib
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from adaptune.geometry import Poses, invert
from adaptune.odometry.base import BaseSettings, Description, OdometryError
from adaptune.odometry.evalio.point_layout import (
    MIN_POINTS,
    Prepared,
    cloud,
    crop,
    evalio_modules,
    image,
    to_evalio,
)
from adaptune.odometry.own_frame import OwnFrameOdometry
from adaptune.sequence.imu import Imu
from adaptune.sequence.scan import Scan
from adaptune.space import ParameterSet, Value, nearest

GRAVITY = 9.80665


class Settings(BaseSettings):
    """Settings of all pipelines.

    Attributes
    ----------
    min_range, max_range : float
        Metres.
    deskew : bool
        Take the motion out of scans whose points have times, where the pipeline can.
    parameters : dict
        Values of any of the pipeline's parameters, where they are not tuned.
    """

    min_range: float = Field(1.0, ge=0)
    max_range: float = Field(100.0, gt=0)
    deskew: bool = True
    parameters: dict[str, Value] = Field(default_factory=dict)


class GridSettings(Settings):
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

    Pipelines read their parameters only when they begin, and begin at rest. The pose belongs to
    the start or the end of the scan, whichever the pipeline deskews to. Pipelines with an IMU give
    poses of the IMU, which become the LiDAR's here.

    Attributes
    ----------
    pipeline : str
        What evalio calls it; class attribute.
    untuned : dict
        Values that must differ from the pipeline's own defaults: one thread, no scans dropped
        when late; class attribute.
    """

    settings_type: ClassVar[type[BaseSettings]] = Settings
    live = False
    # Some end the process at unexpected scans, some share state between instances.
    clean = False
    pipeline: ClassVar[str]
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
        """See `Odometry.describe`.

        Raises
        ------
        OdometryError
            If the settings hold an unknown parameter, or a value of another type.
        """
        if settings is not None and settings.parameters:
            cls(settings=settings)
        return super().describe(settings)

    def _typed(self, name: str, value: Value) -> Value:
        """A value in the type that the pipeline needs: it takes no 1 for a float."""
        if name not in self._defaults:
            raise OdometryError(
                f"parameters.{name}: {self.pipeline} has no such parameter; "
                f"{nearest(name, self._defaults)}"
            )
        default = self._defaults[name]
        if isinstance(default, float) and type(value) is int:
            return float(value)
        if type(value) is not type(default):
            raise OdometryError(
                f"parameters.{name}: {self.pipeline} takes a value like {default!r}, not {value!r}"
            )
        return value

    def prepare(self, scan: Scan) -> Prepared:
        """See `Odometry.prepare`."""
        if self.needs_imu and scan.imu is None:
            raise OdometryError(
                f"{self.pipeline} needs an IMU, and the scans do not bring along what one measured"
            )
        cropped = crop(scan, self.settings.min_range, self.settings.max_range)
        cloud, shape = self._layout(cropped)
        timed = cropped.times is not None and bool(np.ptp(cropped.times) if len(cropped) else 0)
        return Prepared(scan.stamp, cloud, shape, len(cropped), timed, scan.imu)

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """Points as `FIELDS` has them, and their numbers of rows and columns."""
        return cloud(scan, 4), (1, len(scan))

    def _usable(self, prepared: Prepared) -> bool:
        return prepared.size >= MIN_POINTS

    def _begin(self, prepared: Prepared) -> None:
        pipelines, types, _ = evalio_modules()
        self._shape = prepared.shape
        parameters = self._defaults | self.untuned | self._given
        if "deskew" in self._defaults and "deskew" not in self.settings.parameters:
            parameters["deskew"] = self.settings.deskew and prepared.timed
        # Pipelines divide by the length of the scan, and some end the process where it is 0.
        self._needs_times = bool(parameters.get("deskew"))
        pipeline = pipelines.all_pipelines()[self.pipeline]()
        pipeline.set_params(parameters)
        pipeline.set_lidar_params(
            types.LidarParams(
                num_rows=self._shape[0],
                num_columns=self._shape[1],
                min_range=self.settings.min_range,
                max_range=self.settings.max_range,
            )
        )
        self._T_imu_sensor = np.eye(4)
        if prepared.imu is not None:
            self._T_imu_sensor = invert(prepared.imu.T_sensor_imu)
            pipeline.set_imu_params(_imu_parameters(prepared.imu))
        pipeline.set_imu_T_lidar(types.SE3.from_mat(self._T_imu_sensor))
        pipeline.initialize()
        self._pipeline = pipeline

    def _process(self, prepared: Prepared) -> Poses | None:
        self._measure(prepared.imu)
        if not self._usable(prepared) or (self._needs_times and not prepared.timed):
            return None
        return self._estimate(prepared)

    def _measure(self, imu: Imu | None) -> None:
        """Pass on what the IMU measured."""
        if imu is None or not self.needs_imu:
            return
        types = evalio_modules()[1]
        for stamp, gyro, acceleration in zip(
            imu.stamps.tolist(), imu.angular_velocity, imu.acceleration, strict=True
        ):
            self._pipeline.add_imu(
                types.ImuMeasurement(types.Stamp.from_nsec(stamp), gyro, acceleration)
            )

    def _estimate(self, prepared: Prepared) -> Poses | None:
        """Pass a scan on, and return the last pose that comes back."""
        self._pipeline.add_lidar(to_evalio(prepared))
        estimates = self._pipeline.saved_estimates()
        if not estimates:
            return None
        T_own_imu: Poses = estimates[-1][1].to_mat()
        return T_own_imu @ self._T_imu_sensor


def _imu_parameters(imu: Imu) -> Any:
    noise = imu.noise
    rate = 1e9 / float(np.median(np.diff(imu.stamps))) if len(imu) > 1 else 100.0
    return evalio_modules()[1].ImuParams(
        gyro=noise.gyroscope,
        accel=noise.accelerometer,
        gyro_bias=noise.gyroscope_walk,
        accel_bias=noise.accelerometer_walk,
        gravity=np.array([0.0, 0.0, -GRAVITY]),
        rate=rate,
    )


class RingedPipeline(Pipeline):
    """A pipeline that needs to know which laser measured each point."""

    settings_type: ClassVar[type[BaseSettings]] = GridSettings

    def __init__(
        self, parameters: ParameterSet | None = None, settings: BaseSettings | None = None
    ):
        super().__init__(parameters, settings)
        self._rows, self._columns = self.settings.rows, self.settings.columns

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        if scan.rings is None:
            raise OdometryError(
                f"{self.pipeline} needs to know which laser measured each point, and the scans do "
                f"not say; record clouds with a `ring` field"
            )
        points = cloud(scan, 5)
        if len(scan) < MIN_POINTS:
            return points, (1, len(scan))
        counts = np.bincount(scan.rings)
        self._rows = self._rows or next(
            n for n in (16, 32, 64, 128, 256, 65536) if n >= len(counts)
        )
        self._columns = self._columns or max(16, int(counts.max()))
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
        return points if len(scan) < MIN_POINTS else image(scan, points, *shape), shape

    def _estimate(self, prepared: Prepared) -> Poses | None:
        if prepared.shape != self._shape:
            raise OdometryError(
                f"{self.pipeline} began with scans of {self._shape[0]} x {self._shape[1]} points "
                f"and cannot go on with {prepared.shape[0]} x {prepared.shape[1]}"
            )
        return super()._estimate(prepared)
