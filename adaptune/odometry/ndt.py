"""Keyframe NDT on Open3D."""

from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import Field

from adaptune import open3d
from adaptune.geometry import Poses
from adaptune.odometry.base import BaseSettings
from adaptune.odometry.keyframe import Alignment, KeyframeOdometry, crop
from adaptune.sequence.scan import Scan
from adaptune.space import Float, ParameterSpace

MIN_POINTS = 20


class Settings(BaseSettings):
    """Settings of keyframe NDT, in metres."""

    downsampling: float = Field(0.5, gt=0)
    min_range: float = Field(1.0, ge=0)
    iterations: int = Field(30, ge=1)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A downsampled cloud."""

    stamp: int
    cloud: Any
    size: int

    @property
    def nbytes(self) -> int:
        """Three doubles a point."""
        return 4096 + 24 * self.size


class KeyframeNdt(KeyframeOdometry):
    """Scan-to-keyframe NDT (Magnusson, *The Three-Dimensional Normal-Distributions Transform*)."""

    space = ParameterSpace(
        {
            "resolution": Float(low=1.0, high=10.0, baseline=4.0, log=True),
            # The paper's range begins at 0, where a logarithm has no place.
            "keyframe_interval": Float(low=0.1, high=10.0, baseline=4.0, log=True),
        }
    )
    settings_type: ClassVar[type[BaseSettings]] = Settings

    def prepare(self, scan: Scan) -> Prepared:
        """See `Odometry.prepare`."""
        o3d = open3d.load()
        points = o3d.utility.Vector3dVector(crop(scan, self.settings.min_range))
        cloud = o3d.geometry.PointCloud(points).voxel_down_sample(self.settings.downsampling)
        return Prepared(scan.stamp, cloud, len(cloud.points))

    def usable(self, prepared: Prepared) -> bool:
        """See `KeyframeOdometry.usable`."""
        return prepared.size >= MIN_POINTS

    def align(self, target: Prepared, source: Prepared, T_target_guess: Poses) -> Alignment:
        """See `KeyframeOdometry.align`."""
        registration = open3d.load().pipelines.registration
        option = registration.NormalDistributionsTransformOption(
            voxel_size=self.parameters["resolution"], max_iteration=self.settings.iterations
        )
        try:
            result = registration.registration_ndt(
                source.cloud, target.cloud, option, T_target_guess
            )
        except RuntimeError:
            # No cell of the target holds enough points.
            return Alignment(T_target_guess, ok=False)
        return Alignment(result.transformation, len(result.correspondence_set) >= MIN_POINTS)
