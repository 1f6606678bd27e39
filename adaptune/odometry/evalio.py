"""The odometries that evalio carries, compiled.

Points go over as raw bytes, not one Python object each; the conversion is evalio's own for
PointCloud2 messages, which it does not document: hence the pinned version.
"""

import contextlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from adaptune.geometry import Poses, invert, squared_ranges
from adaptune.odometry.base import Anchored, BaseSettings, Description, OdometryError
from adaptune.sequence import Imu, Scan
from adaptune.space import Float, Integer, ParameterSet, ParameterSpace, Value, nearest

MIN_POINTS = 20
GRAVITY = 9.80665

_BEHIND = 2
"""Scans that LIO-SAM waits for before it registers one."""

_SMOOTH = 3
"""Scans over which the velocity is taken that carries its poses on."""

FIELDS = ("x", "y", "z", "t", "row")
"""A point as evalio reads it, four bytes each: float32 metres, uint32 nanoseconds since the scan's
stamp, uint32 laser. The laser is left out where the pipeline does not ask for it."""


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
        Lasers; when left out, the least power of two that holds those of the first scan.
    columns : int, optional
        Firings in a turn; when left out, as many as the fullest laser of the first scan has
        points. With more columns than firings the image has holes, around which no features are
        found.
    """

    rows: int | None = Field(None, ge=2, le=256)
    columns: int | None = Field(None, ge=16, le=8192)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A scan in evalio's layout.

    Attributes
    ----------
    stamp : int
    cloud : ndarray of shape (n, 4) or (n, 5)
        float32, the last columns holding bytes of uint32, see `FIELDS`; of an image, row by row.
    shape : tuple of int
        Rows and columns.
    size : int
        Number of points in range.
    timed : bool
        Whether the points have times that differ.
    imu : Imu, optional
    """

    stamp: int
    cloud: NDArray[np.float32]
    shape: tuple[int, int]
    size: int
    timed: bool
    imu: Imu | None

    @property
    def nbytes(self) -> int:
        """Memory, in bytes."""
        return 256 + self.cloud.nbytes + (0 if self.imu is None else self.imu.nbytes)


@cache
def _evalio() -> Any:
    """The modules of evalio that are needed, and the description of `FIELDS`.

    Raises
    ------
    OdometryError
        If evalio is not installed.
    """
    try:
        from evalio import pipelines, types
        from evalio._cpp import helpers
    except ImportError as error:
        raise OdometryError(
            f"evalio cannot be imported ({error}); run `pip install 'adaptune[evalio]'`"
        ) from error
    kinds = (*(helpers.DataType.FLOAT32,) * 3, *(helpers.DataType.UINT32,) * 2)
    fields = [
        helpers.Field(name=name, datatype=kind, offset=4 * i)
        for i, (name, kind) in enumerate(zip(FIELDS, kinds, strict=True))
    ]
    return pipelines, types, helpers, fields


with contextlib.suppress(OdometryError):
    # Processes that are forked from one that has this module find it loaded.
    _evalio()


class Pipeline(Anchored):
    """A pipeline of evalio (Potokar and Kaess).

    Pipelines read their parameters only when they begin, and begin at rest. The pose is that of
    the moment to which the pipeline brings the scan, its start or its end. Those with an IMU give
    poses of the IMU, which become the LiDAR's here.

    Attributes
    ----------
    pipeline : str
        What evalio calls it; class attribute.
    untuned : dict
        What must differ from the pipeline's own defaults: one thread, no dropping of scans when
        late; class attribute.
    """

    settings_type: ClassVar[type[BaseSettings]] = Settings
    live = False
    # Some end the process at scans they did not expect, some keep what all instances share.
    clean = False
    pipeline: ClassVar[str]
    untuned: ClassVar[ParameterSet]

    def __init__(
        self, parameters: ParameterSet | None = None, settings: BaseSettings | None = None
    ):
        super().__init__(parameters, settings)
        self._defaults = _evalio()[0].all_pipelines()[self.pipeline].default_params()
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
            If the settings hold what is no parameter of the pipeline, or a value of another type.
        """
        if settings is not None and settings.parameters:
            cls(settings=settings)
        return super().describe(settings)

    def _typed(self, name: str, value: Value) -> Value:
        """A value in the type that the pipeline insists on: 1 is no float to it."""
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
        cropped = self._crop(scan)
        cloud, shape = self._layout(cropped)
        timed = cropped.times is not None and bool(np.ptp(cropped.times) if len(cropped) else 0)
        return Prepared(scan.stamp, cloud, shape, len(cropped), timed, scan.imu)

    def _crop(self, scan: Scan) -> Scan:
        squared = squared_ranges(scan.points)
        low, high = self.settings.min_range, self.settings.max_range
        kept = (squared >= low * low) & (squared <= high * high)
        return scan if kept.all() else scan.select(kept)

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """Points as `FIELDS` has them, and how many rows and columns they are."""
        return _cloud(scan, 4), (1, len(scan))

    def _usable(self, prepared: Prepared) -> bool:
        return prepared.size >= MIN_POINTS

    def _begin(self, prepared: Prepared) -> None:
        pipelines, types, *_ = _evalio()
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

    def _hand_over(self, prepared: Prepared) -> Poses | None:
        self._measure(prepared.imu)
        if not self._usable(prepared) or (self._needs_times and not prepared.timed):
            return None
        return self._estimate(prepared)

    def _measure(self, imu: Imu | None) -> None:
        """Hand over what the IMU measured."""
        if imu is None or not self.needs_imu:
            return
        types = _evalio()[1]
        for stamp, gyro, acceleration in zip(
            imu.stamps.tolist(), imu.angular_velocity, imu.acceleration, strict=True
        ):
            self._pipeline.add_imu(
                types.ImuMeasurement(types.Stamp.from_nsec(stamp), gyro, acceleration)
            )

    def _estimate(self, prepared: Prepared) -> Poses | None:
        """Hand a scan over, and take the last pose that comes back."""
        _, types, helpers, fields = _evalio()
        size, n_fields = prepared.cloud.shape
        layout = helpers.PointCloudMetadata(
            stamp=types.Stamp.from_nsec(prepared.stamp),
            width=size,
            height=1,
            point_step=4 * n_fields,
            row_step=4 * n_fields * size,
            is_bigendian=0,
            is_dense=1,
        )
        cloud = helpers.pc2_to_evalio(layout, fields[:n_fields], prepared.cloud.tobytes())
        self._pipeline.add_lidar(cloud)
        estimates = self._pipeline.saved_estimates()
        if not estimates:
            return None
        T_own_imu: Poses = estimates[-1][1].to_mat()
        return T_own_imu @ self._T_imu_sensor


def _cloud(scan: Scan, n_fields: int) -> NDArray[np.float32]:
    """Points with the first so many of `FIELDS`."""
    cloud = np.empty((len(scan), n_fields), np.float32)
    cloud[:, :3] = scan.points
    whole = cloud.view(np.uint32)
    whole[:, 3] = 0 if scan.times is None else nanoseconds(scan.times)
    if n_fields > 4:
        whole[:, 4] = 0 if scan.rings is None else scan.rings
    return cloud


def _imu_parameters(imu: Imu) -> Any:
    noise = imu.noise
    rate = 1e9 / float(np.median(np.diff(imu.stamps))) if len(imu) > 1 else 100.0
    return _evalio()[1].ImuParams(
        gyro=noise.gyroscope,
        accel=noise.accelerometer,
        gyro_bias=noise.gyroscope_walk,
        accel_bias=noise.accelerometer_walk,
        gravity=np.array([0.0, 0.0, -GRAVITY]),
        rate=rate,
    )


class _Ringed(Pipeline):
    """A pipeline that asks which laser measured each point."""

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
                f"not tell; record clouds with a `ring` field"
            )
        points = _cloud(scan, 5)
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


class _Grid(_Ringed):
    """A pipeline that wants a complete image of rows x columns, and ends the process otherwise."""

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        points, (rows, columns) = super()._layout(scan)
        if len(scan) < MIN_POINTS:
            return points, (rows, columns)
        # The seam lies behind the sensor.
        place = np.arctan2(scan.points[:, 1], scan.points[:, 0])
        place *= columns / (2 * np.pi)
        place += columns / 2
        # Firings that fall on the borders between columns would share every other one.
        place -= np.angle(np.exp(2j * np.pi * place[::16]).mean()) / (2 * np.pi)
        column = np.rint(place).astype(np.int64) % columns
        # Rays that did not come back lie at the origin, where every pipeline drops them.
        image = np.zeros((rows * columns, 5), np.float32)
        row = image.view(np.uint32)[:, 4]
        row[:] = np.repeat(np.arange(rows, dtype=np.uint32), columns)
        image[points.view(np.uint32)[:, 4] * np.int64(columns) + column] = points
        return image, (rows, columns)

    def _estimate(self, prepared: Prepared) -> Poses | None:
        if prepared.shape != self._shape:
            raise OdometryError(
                f"{self.pipeline} began with scans of {self._shape[0]} x {self._shape[1]} points "
                f"and cannot go on with {prepared.shape[0]} x {prepared.shape[1]}"
            )
        return super()._estimate(prepared)


def nanoseconds(times: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Seconds since a scan's stamp as whole nanoseconds; none lies before the stamp."""
    return (np.maximum(times, 0.0) * 1e9).astype(np.uint32)


class KissIcp(Pipeline):
    """KISS-ICP (Vizzo et al., RA-L 2023), compiled."""

    pipeline = "kiss"
    untuned: ClassVar[ParameterSet] = {"max_num_threads": 1}
    space = ParameterSpace(
        {
            "voxel_size": Float(low=0.1, high=3.0, baseline=1.0, log=True),
            "max_points_per_voxel": Integer(low=1, high=50, baseline=20, log=True),
            "initial_threshold": Float(low=0.2, high=5.0, baseline=2.0, log=True),
            "min_motion_th": Float(low=0.01, high=1.0, baseline=0.1, log=True),
        }
    )


class CtIcp(Pipeline):
    """CT-ICP (Dellenbach et al., ICRA 2022).

    It finds the motion during a scan, and its pose is that of the scan's start: of scans whose
    points have no times it would be that of the scan before.
    """

    pipeline = "ct"
    untuned: ClassVar[ParameterSet] = {"ls_num_threads": 1}
    space = ParameterSpace(
        {
            "voxel_size": Float(low=0.1, high=2.0, baseline=0.5, log=True),
            "sample_voxel_size": Float(low=0.3, high=4.0, baseline=1.5, log=True),
            "size_voxel_map": Float(low=0.3, high=3.0, baseline=1.0, log=True),
            "max_dist_to_plane_ct_icp": Float(low=0.1, high=2.0, baseline=0.5, log=True),
            "beta_location_consistency": Float(low=1e-5, high=0.1, baseline=1e-3, log=True),
            "beta_constant_velocity": Float(low=1e-5, high=0.1, baseline=1e-3, log=True),
        }
    )

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        if scan.times is None:
            raise OdometryError(
                "ct_icp needs to know when each point was measured, and the scans do not tell; "
                "record clouds with a time field"
            )
        return super()._layout(scan)


class GenzIcp(Pipeline):
    """GenZ-ICP (Lee et al., RA-L 2025)."""

    pipeline = "genz"
    untuned: ClassVar[ParameterSet] = {}
    space = ParameterSpace(
        {
            "voxel_size": Float(low=0.1, high=3.0, baseline=0.3, log=True),
            "desired_num_voxelized_points": Integer(low=500, high=10000, baseline=2000, log=True),
            "max_points_per_voxel": Integer(low=1, high=20, baseline=1),
            "planarity_threshold": Float(low=0.02, high=1.0, baseline=0.2, log=True),
            "initial_threshold": Float(low=0.2, high=5.0, baseline=2.0, log=True),
            "min_motion_th": Float(low=0.01, high=1.0, baseline=0.1, log=True),
        }
    )


class MadIcp(Pipeline):
    """MAD-ICP (Ferrari et al., RA-L 2024)."""

    pipeline = "mad"
    untuned: ClassVar[ParameterSet] = {"num_threads": 1, "realtime": False}
    space = ParameterSpace(
        {
            "b_max": Float(low=0.05, high=1.0, baseline=0.2, log=True),
            "b_min": Float(low=0.02, high=0.5, baseline=0.1, log=True),
            "b_ratio": Float(low=0.005, high=0.1, baseline=0.02, log=True),
            "p_th": Float(low=0.3, high=1.0, baseline=0.8),
            "rho_ker": Float(low=0.02, high=0.5, baseline=0.1, log=True),
            "num_keyframes": Integer(low=1, high=32, baseline=8, log=True),
        }
    )


class Loam(_Grid):
    """LOAM (Zhang and Singh, RSS 2014), in the version of D. McGann."""

    pipeline = "loam"
    untuned: ClassVar[ParameterSet] = {}
    space = ParameterSpace(
        {
            "edge_feat_threshold": Float(low=10.0, high=1000.0, baseline=100.0, log=True),
            "planar_feat_threshold": Float(low=0.1, high=10.0, baseline=1.0, log=True),
            "max_edge_neighbor_dist": Float(low=0.5, high=10.0, baseline=2.0, log=True),
            "max_plane_neighbor_dist": Float(low=0.5, high=10.0, baseline=4.0, log=True),
            "max_planar_feats_per_sector": Integer(low=5, high=200, baseline=50, log=True),
            "num_local_map_scans": Integer(low=1, high=20, baseline=3, log=True),
        }
    )


class Form(_Grid):
    """FORM (Potokar et al.): features, fixed-lag smoothing and sparse key scans."""

    pipeline = "form"
    untuned: ClassVar[ParameterSet] = {"num_threads": 1}
    space = ParameterSpace(
        {
            "max_dist_matching": Float(low=0.2, high=3.0, baseline=0.8, log=True),
            "min_dist_map": Float(low=0.02, high=1.0, baseline=0.1, log=True),
            "planar_threshold": Float(low=0.1, high=10.0, baseline=1.0, log=True),
            "radius": Float(low=0.3, high=3.0, baseline=1.0, log=True),
            "keyscan_match_ratio": Float(low=0.02, high=0.5, baseline=0.1, log=True),
            "max_num_keyscans": Integer(low=5, high=200, baseline=50, log=True),
        }
    )


class LioSam(_Ringed):
    """LIO-SAM (Shan et al., IROS 2020), in the version of E. Potokar, without loop closure.

    It is always two scans behind. Its pose is carried on to the present scan with the gyroscope's
    rotation and the mean velocity of the last scans.
    """

    pipeline = "liosam"
    needs_imu = True
    untuned: ClassVar[ParameterSet] = {"numberOfCores": 1, "mappingProcessInterval": 0.0}
    space = ParameterSpace(
        {
            "edgeThreshold": Float(low=0.1, high=10.0, baseline=1.0, log=True),
            "surfThreshold": Float(low=0.01, high=1.0, baseline=0.1, log=True),
            "odometrySurfLeafSize": Float(low=0.1, high=1.5, baseline=0.4, log=True),
            "mappingCornerLeafSize": Float(low=0.05, high=1.0, baseline=0.2, log=True),
            "mappingSurfLeafSize": Float(low=0.1, high=1.5, baseline=0.4, log=True),
            "surroundingkeyframeAddingDistThreshold": Float(
                low=0.2, high=5.0, baseline=1.0, log=True
            ),
            "surroundingKeyframeSearchRadius": Float(low=10.0, high=100.0, baseline=50.0, log=True),
        }
    )

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        points, shape = super()._layout(scan)
        if len(scan) and scan.times is not None:
            # It takes the last point's time for the scan's end.
            points = np.concatenate([points, points[[int(scan.times.argmax())]]])
        return points, shape

    def _begin(self, prepared: Prepared) -> None:
        self._scans: deque[Prepared] = deque(maxlen=_BEHIND + 1)
        self._own: deque[tuple[int, Poses]] = deque(maxlen=_SMOOTH + 1)
        super()._begin(prepared)

    def _estimate(self, prepared: Prepared) -> Poses | None:
        T_own_then = super()._estimate(prepared)
        self._scans.append(prepared)
        if T_own_then is None or len(self._scans) <= _BEHIND:
            return None
        then = self._scans[0].stamp
        if not self._own:
            self._own.append((then, T_own_then))
            return T_own_then @ self._T_previous_current @ self._T_previous_current
        if np.array_equal(self._own[-1][1], T_own_then):
            # It waits for measurements.
            return None
        self._own.append((then, T_own_then))
        before, T_own_before = self._own[0]
        velocity = (T_own_then[:3, 3] - T_own_before[:3, 3]) / (then - before)
        T_own_sensor = T_own_then.copy()
        T_own_sensor[:3, 3] += velocity * (prepared.stamp - then)
        T_own_sensor[:3, :3] @= _turned([s.imu for s in self._scans if s.imu], then, prepared.stamp)
        return T_own_sensor


def _turned(measured: Sequence[Imu], start: int, stop: int) -> NDArray[np.float64]:
    """Rotation of the LiDAR from one stamp to another, by the gyroscope's mean rate."""
    stamps = np.concatenate([imu.stamps for imu in measured])
    rates = np.concatenate([imu.angular_velocity for imu in measured])
    rates = rates[(stamps > start) & (stamps <= stop)]
    if not len(rates):
        return np.eye(3)
    turn = measured[0].T_sensor_imu[:3, :3] @ rates.mean(axis=0) * (stop - start) * 1e-9
    R: NDArray[np.float64] = Rotation.from_rotvec(turn).as_matrix()
    return R


class Dlio(Pipeline):
    """DLIO (Chen et al., ICRA 2023).

    It learns which way is down from its first measurements, and takes biases to be small. What it
    would adapt by rules of its own (`adaptive_params`) is tuned here. Its pose is that of a scan's
    end.
    """

    pipeline = "dlio"
    needs_imu = True
    untuned: ClassVar[ParameterSet] = {
        "adaptive_params": False,
        # By default it wants to stand still for 3 s, and gives no pose before.
        "imu_calib_time": 0.05,
        "calibrate_gyro": False,
        "calibrate_accel": False,
    }
    space = ParameterSpace(
        {
            "vf_res": Float(low=0.1, high=1.0, baseline=0.25, log=True),
            "gicp_max_corr_dist": Float(low=0.2, high=3.0, baseline=0.5, log=True),
            "gicp_k_correspondences": Integer(low=8, high=32, baseline=16, log=True),
            "keyframe_thresh_dist": Float(low=0.3, high=10.0, baseline=1.0, log=True),
            "submap_knn": Integer(low=2, high=30, baseline=10, log=True),
            "geo_Kp": Float(low=1.0, high=10.0, baseline=4.5, log=True),
            "geo_Kv": Float(low=2.0, high=25.0, baseline=11.25, log=True),
            "geo_Kq": Float(low=1.0, high=10.0, baseline=4.0, log=True),
        }
    )
