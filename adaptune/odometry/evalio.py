"""The pipelines of evalio.

Points go over as raw bytes, not one Python object each. The conversion is evalio's own for
PointCloud2 messages, which is not documented: hence the pinned version.
"""

import contextlib
from collections import deque
from functools import cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation

from adaptune.errors import OdometryError, import_extra, nearest
from adaptune.geometry import Poses, invert, squared_ranges
from adaptune.odometry.base import MIN_POINTS, BaseSettings, Description, ToolSettings
from adaptune.odometry.own_frame import END, MIDDLE, NO_IMU, OwnFrameOdometry, duration_of
from adaptune.odometry.template import Template
from adaptune.recording.scan import Imu, Scan
from adaptune.space import Float, Integer, ParameterSet, ParameterSpace, Value

GRAVITY = 9.80665
NO_FIELD = "{} needs to know {}, and the scans do not say; record clouds with a {} field"


class EvalioSettings(ToolSettings):
    """Settings of all pipelines."""

    in_file: ClassVar[tuple[str, ...]] = ("parameters",)

    # Values of any of the pipeline's parameters, where they are not tuned.
    parameters: dict[str, Value] = Field(default_factory=dict)


class RangeImageSettings(EvalioSettings):
    """Settings of pipelines that see scans as images."""

    # Lasers; by default the smallest power of two that holds those of the first scan.
    rows: int | None = Field(None, ge=2, le=256)
    # Firings in a turn; by default as many as the fullest laser of the first scan has points. With
    # more columns than firings the image has holes, around which no features are found.
    columns: int | None = Field(None, ge=16, le=8192)


_FIELDS = ("x", "y", "z", "t", "row")
"""A point as evalio reads it, four bytes each: float32 metres, uint32 nanoseconds since the scan's
stamp, uint32 laser. The laser is left out where the pipeline does not ask for it."""


class EvalioScan(NamedTuple):
    """A scan in evalio's layout; the last columns of its cloud hold bytes of uint32."""

    stamp: int
    cloud: NDArray[np.float32]  # of shape (n, 4) or (n, 5), see `_FIELDS`; an image row by row
    shape: tuple[int, int]  # rows and columns
    usable: bool  # whether enough points are in range
    duration: int  # nanoseconds from the stamp to the last point; 0 if the times do not differ
    imu: Imu | None


def _modules() -> tuple[Any, ...]:
    return import_extra("evalio", "evalio.pipelines", "evalio.types", "evalio._cpp.helpers")


@cache
def _fields() -> Any:
    """The description of `_FIELDS`."""
    helpers = _modules()[2]
    kinds = [helpers.DataType.FLOAT32] * 3 + [helpers.DataType.UINT32] * 2
    fields = zip(_FIELDS, kinds, range(0, 20, 4), strict=True)
    return [helpers.Field(name=name, datatype=kind, offset=at) for name, kind, at in fields]


with contextlib.suppress(OdometryError):
    _modules()  # processes that are forked from one with this module find it loaded


class Pipeline(OwnFrameOdometry):
    """A pipeline of evalio (Potokar and Kaess).

    Pipelines read their parameters only when they begin, and begin at rest. Those that deskew do so
    to the scan's end; their poses are carried back to its stamp. Pipelines with an IMU give poses
    of the IMU, which become the LiDAR's here.
    """

    settings_type = EvalioSettings
    # Some end the process at unexpected scans, some share state between instances.
    clean = False
    pipeline: ClassVar[str]  # what evalio calls it
    deskews_to: ClassVar[float] = END  # share of a scan's duration
    # Values that differ from the pipeline's defaults: one thread, no scans dropped when late.
    untuned: ClassVar[ParameterSet] = {}

    def __init__(
        self, parameters: ParameterSet | None = None, settings: BaseSettings | None = None
    ):
        super().__init__(parameters, settings)
        self._defaults = _modules()[0].all_pipelines()[self.pipeline].default_params()
        of_user, template = self.settings.parameters, self.settings.template
        if template is not None:
            # adaptune drives on one thread, whatever the file says.
            names = [name for name in self._defaults if name not in self.untuned]
            under = self._under(template)
            of_user = template.held(names, under)
            template.check_known(self._defaults, self.pipeline, under)
        kept = {name: self._typed(name, v) for name, v in of_user.items()}
        given = {name: self._typed(name, v) for name, v in (parameters or {}).items()}
        self.parameters |= {name: v for name, v in kept.items() if name in self.space.names} | given
        self._given = kept | self.parameters

    @classmethod
    def describe(cls, settings: Any) -> Description:
        _modules()  # raises if there is no evalio
        return super().describe(settings)

    @classmethod
    def _under(cls, template: Template) -> str:
        # evalio lists its pipelines; ROS has the values alone.
        names = [name for name in template.names if name.endswith(".pipeline")]
        own = [name for name in names if template.value(name) == cls.pipeline]
        if names and len(own) != 1:
            there = ", ".join(str(template.value(name)) for name in names)
            raise OdometryError(
                f"{template.path}: is to hold one pipeline {cls.pipeline!r}; there is {there}"
            )
        return own[0].removesuffix("pipeline") if own else ""

    def _values(self, deskew: bool) -> ParameterSet:
        """All parameters of the pipeline; `deskew` counts unless the settings name it, too."""
        values: ParameterSet = self._defaults | self.untuned | self._given
        if "deskew" in self._defaults and "deskew" not in self._given:
            values["deskew"] = deskew
        return values

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
        squared = squared_ranges(scan.points)
        low, high = self.settings.min_range, self.settings.max_range
        in_range = (squared >= low * low) & (squared <= high * high)
        cropped = scan if in_range.all() else scan.select(in_range)
        cloud, shape = self._layout(cropped)
        usable, duration = len(cropped) >= MIN_POINTS, duration_of(cropped)
        return EvalioScan(scan.stamp, cloud, shape, usable, duration, scan.imu)

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """Points as `_FIELDS` has them, and their numbers of rows and columns."""
        return _cloud(scan, 4), (1, len(scan))

    def _begin(self, prepared: EvalioScan) -> None:
        pipelines, types, _ = _modules()
        parameters = self._values(self.settings.deskew and prepared.duration > 0)
        # Pipelines divide by the length of the scan, and some end the process where it is 0.
        self._needs_times = bool(parameters.get("deskew"))
        if "deskew" in parameters:
            self._share = self.deskews_to if parameters["deskew"] else MIDDLE
        pipeline = pipelines.all_pipelines()[self.pipeline]()
        pipeline.set_params(parameters)
        ranges = {"min_range": self.settings.min_range, "max_range": self.settings.max_range}
        rows, columns = prepared.shape
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
        types = _modules()[1]
        stamps = map(types.Stamp.from_nsec, imu.stamps.tolist())
        for measured in zip(stamps, imu.angular_velocity, imu.acceleration, strict=True):
            self._pipeline.add_imu(types.ImuMeasurement(*measured))

    def _estimate(self, prepared: EvalioScan) -> Poses | None:
        """Pass a scan on, and return the last pose that comes back."""
        self._pipeline.add_lidar(_to_evalio(prepared))
        estimates = self._pipeline.saved_estimates()
        return estimates[-1][1].to_mat() @ self._T_imu_sensor if estimates else None


def _to_evalio(prepared: EvalioScan) -> Any:
    """A prepared scan as evalio's own measurement."""
    _, types, helpers = _modules()
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
    return helpers.pc2_to_evalio(layout, _fields()[:n_fields], prepared.cloud.tobytes())


def _cloud(scan: Scan, n_fields: int) -> NDArray[np.float32]:
    """Points with the first so many of `_FIELDS`."""
    points = np.empty((len(scan), n_fields), np.float32)
    points[:, :3] = scan.points
    whole = points.view(np.uint32)
    # None lies before the stamp.
    whole[:, 3] = 0 if scan.times is None else np.maximum(scan.times, 0.0) * 1e9
    if n_fields > 4:
        whole[:, 4] = 0 if scan.rings is None else scan.rings
    return points


def _image(scan: Scan, points: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """All `_FIELDS` of a scan as a complete image, row by row."""
    # The seam lies behind the sensor.
    place = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    place *= columns / (2 * np.pi)
    place += columns / 2
    # Firings that fall on the borders between columns would share every other one.
    place -= np.angle(np.exp(2j * np.pi * place[::16]).mean()) / (2 * np.pi)
    column = np.rint(place).astype(np.int64) % columns
    # Rays that did not come back lie at the origin, where every pipeline drops them.
    pixels = np.zeros((rows * columns, 5), np.float32)
    row = pixels.view(np.uint32)[:, 4]
    row[:] = np.repeat(np.arange(rows, dtype=np.uint32), columns)
    pixels[points.view(np.uint32)[:, 4] * np.int64(columns) + column] = points
    return pixels


def _imu_parameters(imu: Imu) -> Any:
    rate = 1e9 / float(np.median(np.diff(imu.stamps))) if len(imu) > 1 else 100.0
    return _modules()[1].ImuParams(
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
        points = _cloud(scan, 5)
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
        return points if len(scan) < MIN_POINTS else _image(scan, points, *shape), shape


class KissIcp(Pipeline):
    """KISS-ICP (Vizzo et al., RA-L 2023), compiled."""

    pipeline = "kiss"
    untuned: ClassVar[ParameterSet] = {"max_num_threads": 1}
    space = ParameterSpace.of(
        voxel_size=Float(low=0.1, high=3.0, baseline=1.0, log=True, unit="m"),
        max_points_per_voxel=Integer(low=1, high=50, baseline=20, log=True),
        initial_threshold=Float(low=0.2, high=5.0, baseline=2.0, log=True, unit="m"),
        min_motion_th=Float(low=0.01, high=1.0, baseline=0.1, log=True, unit="m"),
        max_num_iterations=Integer(low=5, high=500, baseline=500, log=True),
    )


class CtIcp(Pipeline):
    """CT-ICP (Dellenbach et al., ICRA 2022).

    It finds the motion during a scan, and its pose belongs to the scan's start. If points had no
    times, it would belong to the scan before.
    """

    pipeline = "ct"
    untuned: ClassVar[ParameterSet] = {"ls_num_threads": 1}
    space = ParameterSpace.of(
        voxel_size=Float(low=0.1, high=2.0, baseline=0.5, log=True, unit="m"),
        sample_voxel_size=Float(low=0.3, high=4.0, baseline=1.5, log=True, unit="m"),
        size_voxel_map=Float(low=0.3, high=3.0, baseline=1.0, log=True, unit="m"),
        max_dist_to_plane_ct_icp=Float(low=0.1, high=2.0, baseline=0.5, log=True, unit="m"),
        beta_location_consistency=Float(low=1e-5, high=0.1, baseline=1e-3, log=True),
        beta_constant_velocity=Float(low=1e-5, high=0.1, baseline=1e-3, log=True),
        num_iters_icp=Integer(low=3, high=30, baseline=30, log=True),
    )

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        if scan.times is None:
            raise OdometryError(NO_FIELD.format("ct_icp", "when each point was measured", "time"))
        return super()._layout(scan)


class GenzIcp(Pipeline):
    """GenZ-ICP (Lee et al., RA-L 2025)."""

    pipeline = "genz"
    space = ParameterSpace.of(
        voxel_size=Float(low=0.1, high=3.0, baseline=0.3, log=True, unit="m"),
        desired_num_voxelized_points=Integer(low=500, high=10000, baseline=2000, log=True),
        max_points_per_voxel=Integer(low=1, high=20, baseline=1),
        planarity_threshold=Float(low=0.02, high=1.0, baseline=0.2, log=True),
        initial_threshold=Float(low=0.2, high=5.0, baseline=2.0, log=True, unit="m"),
        min_motion_th=Float(low=0.01, high=1.0, baseline=0.1, log=True, unit="m"),
        max_num_iterations=Integer(low=5, high=100, baseline=100, log=True),
    )


class MadIcp(Pipeline):
    """MAD-ICP (Ferrari et al., RA-L 2024)."""

    pipeline = "mad"
    untuned: ClassVar[ParameterSet] = {"num_threads": 1, "realtime": False}
    space = ParameterSpace.of(
        b_max=Float(low=0.05, high=1.0, baseline=0.2, log=True, unit="m"),
        b_min=Float(low=0.02, high=0.5, baseline=0.1, log=True, unit="m"),
        b_ratio=Float(low=0.005, high=0.1, baseline=0.02, log=True),
        p_th=Float(low=0.3, high=1.0, baseline=0.8),
        rho_ker=Float(low=0.02, high=0.5, baseline=0.1, log=True, unit="m"),
        num_keyframes=Integer(low=1, high=32, baseline=8, log=True),
    )


class Loam(GridPipeline):
    """LOAM (Zhang and Singh, RSS 2014), in the version of D. McGann."""

    pipeline = "loam"
    space = ParameterSpace.of(
        edge_feat_threshold=Float(low=10.0, high=1000.0, baseline=100.0, log=True),
        planar_feat_threshold=Float(low=0.1, high=10.0, baseline=1.0, log=True),
        max_edge_neighbor_dist=Float(low=0.5, high=10.0, baseline=2.0, log=True, unit="m"),
        max_plane_neighbor_dist=Float(low=0.5, high=10.0, baseline=4.0, log=True, unit="m"),
        max_planar_feats_per_sector=Integer(low=5, high=200, baseline=50, log=True),
        num_local_map_scans=Integer(low=1, high=20, baseline=3, log=True),
        max_icf_iterations=Integer(low=3, high=20, baseline=20, log=True),
    )


class Form(GridPipeline):
    """FORM (Potokar et al.): features, fixed-lag smoothing, key scans. It does not deskew."""

    pipeline = "form"
    _share = MIDDLE
    untuned: ClassVar[ParameterSet] = {"num_threads": 1}
    space = ParameterSpace.of(
        max_dist_matching=Float(low=0.2, high=3.0, baseline=0.8, log=True, unit="m"),
        min_dist_map=Float(low=0.02, high=1.0, baseline=0.1, log=True, unit="m"),
        planar_threshold=Float(low=0.1, high=10.0, baseline=1.0, log=True),
        radius=Float(low=0.3, high=3.0, baseline=1.0, log=True, unit="m"),
        keyscan_match_ratio=Float(low=0.02, high=0.5, baseline=0.1, log=True),
        max_num_keyscans=Integer(low=5, high=200, baseline=50, log=True),
        max_num_rematches=Integer(low=3, high=30, baseline=30, log=True),
    )


_BEHIND = 2  # scans that LIO-SAM waits for before it registers one

_SMOOTH = 3  # scans over which the mean velocity is taken that carries its poses on


class LioSam(RingedPipeline):
    """LIO-SAM (Shan et al., IROS 2020), in the version of E. Potokar, without loop closure.

    It is always two scans behind. The gyroscope's rotation and the mean velocity of the last scans
    carry its pose on to the present scan.
    """

    pipeline = "liosam"
    needs_imu = True
    untuned: ClassVar[ParameterSet] = {"numberOfCores": 1, "mappingProcessInterval": 0.0}
    space = ParameterSpace.of(
        edgeThreshold=Float(low=0.1, high=10.0, baseline=1.0, log=True),
        surfThreshold=Float(low=0.01, high=1.0, baseline=0.1, log=True),
        odometrySurfLeafSize=Float(low=0.1, high=1.5, baseline=0.4, log=True, unit="m"),
        mappingCornerLeafSize=Float(low=0.05, high=1.0, baseline=0.2, log=True, unit="m"),
        mappingSurfLeafSize=Float(low=0.1, high=1.5, baseline=0.4, log=True, unit="m"),
        surroundingkeyframeAddingDistThreshold=Float(
            low=0.2, high=5.0, baseline=1.0, log=True, unit="m"
        ),
        surroundingKeyframeSearchRadius=Float(
            low=10.0, high=100.0, baseline=50.0, log=True, unit="m"
        ),
    )

    def _layout(self, scan: Scan) -> tuple[NDArray[np.float32], tuple[int, int]]:
        points, shape = super()._layout(scan)
        if len(scan) and scan.times is not None:
            # It takes the last point's time for the scan's end.
            points = np.concatenate([points, points[[int(scan.times.argmax())]]])
        return points, shape

    def _begin(self, prepared: EvalioScan) -> None:
        self._scans: deque[EvalioScan] = deque(maxlen=_BEHIND + 1)
        self._own: deque[tuple[int, Poses]] = deque(maxlen=_SMOOTH + 1)
        super()._begin(prepared)

    def _estimate(self, prepared: EvalioScan) -> Poses | None:
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


def _turned(measured: list[Imu], start: int, stop: int) -> NDArray[np.float64]:
    """Rotation of the LiDAR from one stamp to another, by the gyroscope's mean rate."""
    stamps = np.concatenate([imu.stamps for imu in measured])
    rates = np.concatenate([imu.angular_velocity for imu in measured])
    rates = rates[(stamps > start) & (stamps <= stop)]
    if not len(rates):
        return np.eye(3)
    turn = measured[0].T_sensor_imu[:3, :3] @ rates.mean(axis=0) * (stop - start) * 1e-9
    return np.asarray(Rotation.from_rotvec(turn).as_matrix())


class Dlio(Pipeline):
    """DLIO (Chen et al., ICRA 2023).

    It learns which way is down from its first measurements, and assumes small biases. Its own
    rules of adaptation (`adaptive_params`) are off: adaptune tunes those parameters. It deskews to
    the median time of a scan's points.
    """

    pipeline = "dlio"
    deskews_to = MIDDLE
    needs_imu = True
    untuned: ClassVar[ParameterSet] = {
        "adaptive_params": False,
        # By default it needs to stand still for 3 s, and gives no pose before.
        "imu_calib_time": 0.05,
        "calibrate_gyro": False,
        "calibrate_accel": False,
    }
    space = ParameterSpace.of(
        vf_res=Float(low=0.1, high=1.0, baseline=0.25, log=True, unit="m"),
        gicp_max_corr_dist=Float(low=0.2, high=3.0, baseline=0.5, log=True, unit="m"),
        gicp_max_iter=Integer(low=3, high=32, baseline=32, log=True),
        gicp_k_correspondences=Integer(low=8, high=32, baseline=16, log=True),
        keyframe_thresh_dist=Float(low=0.3, high=10.0, baseline=1.0, log=True, unit="m"),
        submap_knn=Integer(low=2, high=30, baseline=10, log=True),
        geo_Kp=Float(low=1.0, high=10.0, baseline=4.5, log=True),
        geo_Kv=Float(low=2.0, high=25.0, baseline=11.25, log=True),
        geo_Kq=Float(low=1.0, high=10.0, baseline=4.0, log=True),
    )
