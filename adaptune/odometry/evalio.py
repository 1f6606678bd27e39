"""The odometries that evalio carries, compiled.

Points go over as raw bytes, not one Python object each; the conversion is evalio's own for
PointCloud2 messages, which it does not document: hence the pinned version.
"""

import contextlib
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from adaptune.geometry import Poses, invert, rectify
from adaptune.odometry.base import BaseSettings, Odometry, OdometryError, Registration
from adaptune.sequence import Scan
from adaptune.space import Float, Integer, ParameterSet, ParameterSpace, Value, nearest

MIN_POINTS = 20

POINT: Any = np.dtype(
    {
        "names": ["x", "y", "z", "t", "row", "col"],
        "formats": ["<f4", "<f4", "<f4", "<u4", "<u2", "<u2"],
    }
)
"""A point as evalio reads it: metres, nanoseconds since the scan's stamp, laser and firing."""


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
    """Settings of pipelines that want scans as complete images.

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
    cloud : ndarray of `POINT`, of shape (rows, columns)
        One row, where the pipeline does not want an image.
    size : int
        Number of points in range.
    timed : bool
        Whether the points have times that differ.
    """

    stamp: int
    cloud: NDArray[Any]
    size: int
    timed: bool

    @property
    def nbytes(self) -> int:
        """Memory, in bytes."""
        return 256 + self.cloud.nbytes


@cache
def _evalio() -> Any:
    """The modules of evalio that are needed, and the description of `POINT`.

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
    kinds = {
        "f": helpers.DataType.FLOAT32,
        "I": helpers.DataType.UINT32,
        "H": helpers.DataType.UINT16,
    }
    fields = [
        helpers.Field(name=name, datatype=kinds[POINT[name].char], offset=POINT.fields[name][1])
        for name in POINT.names
    ]
    return pipelines, types, helpers, fields


with contextlib.suppress(OdometryError):
    # Processes that are forked from one that has this module find it loaded.
    _evalio()


class Pipeline(Odometry):
    """A pipeline of evalio (Potokar and Kaess).

    Pipelines read their parameters only when they begin, and begin at rest. The pose is that of
    the moment to which the pipeline brings the scan, its start or its end.

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
        cloud, size = self._layout(self._crop(scan))
        times = cloud["t"]
        return Prepared(scan.stamp, cloud, size, bool(size) and int(times.max()) > int(times.min()))

    def _crop(self, scan: Scan) -> Scan:
        squared = np.einsum("ij,ij->i", scan.points, scan.points)
        low, high = self.settings.min_range, self.settings.max_range
        return scan.select((squared >= low * low) & (squared <= high * high))

    def _layout(self, scan: Scan) -> tuple[NDArray[Any], int]:
        """Points as `POINT`, and how many they are."""
        cloud = np.zeros((1, len(scan)), POINT)
        for axis, values in zip("xyz", scan.points.T, strict=True):
            cloud[axis] = values
        if scan.times is not None:
            cloud["t"] = nanoseconds(scan.times)
        if scan.rings is not None:
            cloud["row"] = scan.rings
        return cloud, len(scan)

    def start(
        self,
        prepared: Prepared,
        T_odom_sensor: Poses,
        T_previous_current: Poses | None = None,
    ) -> None:
        """See `Odometry.start`."""
        self._T_odom_sensor = T_odom_sensor
        self._T_previous_current = np.eye(4) if T_previous_current is None else T_previous_current
        self._pipeline: Any = None
        if prepared.size >= MIN_POINTS:
            self._begin(prepared)

    def _begin(self, prepared: Prepared) -> None:
        """Make a new pipeline, whose own frame is that of its first estimate."""
        pipelines, types, *_ = _evalio()
        self._shape = prepared.cloud.shape
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
        pipeline.set_imu_T_lidar(types.SE3.identity())
        pipeline.initialize()
        self._pipeline = pipeline
        self._T_odom_own: Poses | None = None
        self._add(prepared)

    def register(self, prepared: Prepared) -> Registration:
        """See `Odometry.register`."""
        T_odom_previous = self._T_odom_sensor
        self._T_odom_sensor = T_odom_previous @ self._T_previous_current
        if prepared.size < MIN_POINTS:
            return Registration(self._T_odom_sensor, registered=False)
        if self._pipeline is None:
            self._begin(prepared)
        elif (self._needs_times and not prepared.timed) or not self._add(prepared):
            return Registration(self._T_odom_sensor, registered=False)
        self._T_previous_current = rectify(invert(T_odom_previous) @ self._T_odom_sensor)
        return Registration(self._T_odom_sensor)

    def _add(self, prepared: Prepared) -> bool:
        """Hand a scan over, and tell whether a pose came back."""
        _, types, helpers, fields = _evalio()
        size, itemsize = prepared.cloud.size, POINT.itemsize
        layout = helpers.PointCloudMetadata(
            stamp=types.Stamp.from_nsec(prepared.stamp),
            width=size,
            height=1,
            point_step=itemsize,
            row_step=size * itemsize,
            is_bigendian=0,
            is_dense=1,
        )
        self._pipeline.add_lidar(helpers.pc2_to_evalio(layout, fields, prepared.cloud.tobytes()))
        estimates = self._pipeline.saved_estimates()
        if not estimates:
            return False
        T_own_sensor = estimates[-1][1].to_mat()
        if self._T_odom_own is None:
            self._T_odom_own = self._T_odom_sensor @ invert(T_own_sensor)
        self._T_odom_sensor = self._T_odom_own @ T_own_sensor
        return True


class _Grid(Pipeline):
    """A pipeline that wants a complete image of rows x columns, and ends the process otherwise."""

    settings_type: ClassVar[type[BaseSettings]] = GridSettings

    def __init__(
        self, parameters: ParameterSet | None = None, settings: BaseSettings | None = None
    ):
        super().__init__(parameters, settings)
        self._rows, self._columns = self.settings.rows, self.settings.columns

    def _layout(self, scan: Scan) -> tuple[NDArray[Any], int]:
        if scan.rings is None:
            raise OdometryError(
                f"{self.pipeline} needs to know which laser measured each point, and the scans do "
                f"not tell; record clouds with a `ring` field"
            )
        points, size = super()._layout(scan)
        if size < MIN_POINTS:
            return points, size
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
        # The seam lies behind the sensor.
        turn = np.arctan2(scan.points[:, 1], scan.points[:, 0]) / (2 * np.pi) + 0.5
        place = turn * self._columns
        # Firings that fall on the borders between columns would share every other one.
        place -= np.angle(np.exp(2j * np.pi * place[::16]).mean()) / (2 * np.pi)
        points["col"] = np.rint(place).astype(np.int64) % self._columns
        # Rays that did not come back lie at the origin, where every pipeline drops them.
        image = np.zeros((self._rows, self._columns), POINT)
        image["row"], image["col"] = np.arange(self._rows)[:, None], np.arange(self._columns)
        image[points["row"], points["col"]] = points
        return image, size

    def _add(self, prepared: Prepared) -> bool:
        if prepared.cloud.shape != self._shape:
            raise OdometryError(
                f"{self.pipeline} began with scans of {self._shape[0]} x {self._shape[1]} points "
                f"and cannot go on with {prepared.cloud.shape[0]} x {prepared.cloud.shape[1]}"
            )
        return super()._add(prepared)


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

    def _layout(self, scan: Scan) -> tuple[NDArray[Any], int]:
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
