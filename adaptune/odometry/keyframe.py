"""Odometry that registers each scan to the last keyframe."""

from abc import abstractmethod
from collections.abc import Hashable
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
import small_gicp
from pydantic import Field

from adaptune._system.open3d import load
from adaptune.errors import import_extra
from adaptune.geometry import Poses, invert, rectify, scale, squared_ranges
from adaptune.odometry.base import MIN_POINTS, BaseSettings, Description, Odometry, Registration
from adaptune.recording.scan import Scan
from adaptune.space import Categorical, Float, Integer, ParameterSet, ParameterSpace

JITTER = 0.1
"""Two times between scans count as the same if they differ by no more than this share: a LiDAR
turns more steadily than its stamps say, and a missing scan doubles the time."""


DOWNSAMPLING = Categorical(choices=(0.15, 0.2, 0.25, 0.35, 0.5, 0.7, 1.0), baseline=0.5, unit="m")
"""Metres between points of a cloud. There are few values, so that sets share prepared clouds."""
ITERATIONS = Integer(low=5, high=60, baseline=20, log=True)  # of a registration, at most


class KeyframeSettings(BaseSettings):
    """Settings of keyframe odometries, in metres; parameters that are set are not tuned."""

    min_range: float = Field(1.0, ge=0, le=1e6)
    downsampling: float | None = Field(None, ge=1e-3, le=1e3)
    iterations: int | None = Field(None, ge=1, le=10_000)

    @property
    def kept(self) -> ParameterSet:
        """Parameters that are set, and not tuned."""
        return self.model_dump(include={"downsampling", "iterations"}, exclude_none=True)


class PreparedCloud(NamedTuple):
    """A downsampled cloud, whether it has enough points, its bytes, and its tree if it has one."""

    stamp: int
    cloud: Any
    usable: bool
    nbytes: int
    tree: Any = None


class KeyframeOdometry(Odometry):
    """Scan-to-keyframe odometry with a constant-velocity prediction.

    A scan becomes the new keyframe when it lies `keyframe_interval` metres or more from the old
    one. Where scans are missing, the prediction lasts until the next one. What `prepare` returns
    has a `stamp` in nanoseconds, and is `usable` or not. After Koide et al., IROS 2021.
    """

    settings_type = KeyframeSettings
    live = True
    clean = True
    warm_up = 0.0

    def __init__(
        self, parameters: ParameterSet | None = None, settings: BaseSettings | None = None
    ):
        super().__init__(parameters, settings)
        self.parameters |= self.settings.kept

    @classmethod
    def describe(cls, settings: Any) -> Description:
        described = super().describe(settings)
        kept = {} if settings is None else settings.kept
        tuned = {name: p for name, p in cls.space.parameters.items() if name not in kept}
        return described._replace(space=ParameterSpace(tuned))

    @property
    def preparation(self) -> Hashable:
        downsampling = self.parameters["downsampling"]
        return type(self).prepare, self.settings.min_range, downsampling

    def start(
        self, prepared: Any, T_odom_sensor: Poses, T_previous_current: Poses | None = None
    ) -> None:
        self._begin_keyframe(prepared, T_odom_sensor)
        self._T_previous_current = np.eye(4) if T_previous_current is None else T_previous_current
        # The given motion goes on for one scan, whatever time it took.
        self._stamp, self._duration = prepared.stamp, 0

    def _begin_keyframe(self, prepared: Any, T_odom_sensor: Poses) -> None:
        self._keyframe = prepared
        self._T_odom_keyframe = T_odom_sensor
        self._T_keyframe_sensor = np.eye(4)

    def register(self, prepared: Any) -> Registration:
        elapsed, self._stamp = prepared.stamp - self._stamp, prepared.stamp
        T_keyframe_guess = self._T_keyframe_sensor @ self._predict(elapsed)
        if not prepared.usable:
            self._T_keyframe_sensor = T_keyframe_guess
            return Registration(self._T_odom_keyframe @ T_keyframe_guess, registered=False)
        T_target_source, ok = T_keyframe_guess, False
        if self._keyframe.usable:
            T_target_source, ok = self.align(self._keyframe, prepared, T_keyframe_guess)
        if ok and np.isfinite(T_target_source).all():
            T_keyframe_sensor = rectify(T_target_source)
            self._T_previous_current = invert(self._T_keyframe_sensor) @ T_keyframe_sensor
            self._duration = elapsed
        else:
            T_keyframe_sensor, ok = T_keyframe_guess, False
        self._T_keyframe_sensor = T_keyframe_sensor
        T_odom_sensor = self._T_odom_keyframe @ T_keyframe_sensor
        # A scan that cannot be matched now cannot be later, from further away.
        interval = self.parameters["keyframe_interval"]
        if not ok or np.linalg.norm(T_keyframe_sensor[:3, 3]) >= interval:
            self._begin_keyframe(prepared, T_odom_sensor)
        return Registration(T_odom_sensor, ok)

    def _predict(self, elapsed: int) -> Poses:
        """The motion of so many nanoseconds, at the velocity of the last one."""
        if self._duration <= 0 or elapsed <= 0:
            return self._T_previous_current
        share = elapsed / self._duration
        return scale(self._T_previous_current, 1.0 if abs(share - 1.0) <= JITTER else share)

    @abstractmethod
    def align(self, target: Any, source: Any, T_target_guess: Poses) -> tuple[Poses, bool]:
        """Register two usable scans: ``T_target_source``, and whether that is reliable."""


def crop(scan: Scan, min_range: float) -> Any:
    """Points no nearer than `min_range` metres, as float64 of shape (n, 3)."""
    points = scan.points.astype(np.float64)
    kept = squared_ranges(points) >= min_range**2
    # Numbers are picked in a quarter of the time that a mask takes.
    return points if kept.all() else points.take(np.flatnonzero(kept), axis=0)


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
    ) -> tuple[Poses, bool]:
        clouds, distance = self._pair(target, source)
        result = small_gicp.align(
            *clouds,
            init_T_target_source=T_target_guess,
            max_correspondence_distance=distance,
            max_iterations=self.parameters["iterations"],
            num_threads=1,
        )
        return result.T_target_source, result.num_inliers >= MIN_POINTS


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


class KeyframeNdt(KeyframeOdometry):
    """Scan-to-keyframe NDT (Magnusson, *The Three-Dimensional Normal-Distributions Transform*)."""

    space = ParameterSpace.of(
        resolution=Float(low=1.0, high=10.0, baseline=4.0, log=True, unit="m"),
        # The paper's range begins at 0, where a logarithm has no place.
        keyframe_interval=Float(low=0.1, high=10.0, baseline=4.0, log=True, unit="m"),
        downsampling=DOWNSAMPLING,
        iterations=ITERATIONS.model_copy(update={"baseline": 30}),
    )

    @classmethod
    def describe(cls, settings: Any) -> Description:
        if find_spec("open3d") is None:  # it takes a second to import
            import_extra("open3d", "open3d")
        return super().describe(settings)

    def prepare(self, scan: Scan) -> PreparedCloud:
        o3d = load()
        points = o3d.utility.Vector3dVector(crop(scan, self.settings.min_range))
        cloud = o3d.geometry.PointCloud(points).voxel_down_sample(self.parameters["downsampling"])
        size = len(cloud.points)
        return PreparedCloud(scan.stamp, cloud, size >= MIN_POINTS, nbytes=4096 + 24 * size)

    def align(
        self, target: PreparedCloud, source: PreparedCloud, T_target_guess: Poses
    ) -> tuple[Poses, bool]:
        registration = load().pipelines.registration
        option = registration.NormalDistributionsTransformOption(
            voxel_size=self.parameters["resolution"], max_iteration=self.parameters["iterations"]
        )
        try:
            result = registration.registration_ndt(
                source.cloud, target.cloud, option, T_target_guess
            )
        except RuntimeError:
            # No cell of the target holds enough points.
            return T_target_guess, False
        return result.transformation, len(result.correspondence_set) >= MIN_POINTS
