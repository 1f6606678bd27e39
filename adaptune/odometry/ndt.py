"""Keyframe NDT on Open3D."""

from adaptune import open3d
from adaptune.geometry import Poses
from adaptune.odometry import keyframe
from adaptune.odometry.base import MIN_POINTS
from adaptune.odometry.keyframe import Alignment, KeyframeOdometry, PreparedCloud
from adaptune.sequence.scan import Scan
from adaptune.space import Float, ParameterSpace


class KeyframeNdt(KeyframeOdometry):
    """Scan-to-keyframe NDT (Magnusson, *The Three-Dimensional Normal-Distributions Transform*)."""

    space = ParameterSpace.of(
        resolution=Float(low=1.0, high=10.0, baseline=4.0, log=True, unit="m"),
        # The paper's range begins at 0, where a logarithm has no place.
        keyframe_interval=Float(low=0.1, high=10.0, baseline=4.0, log=True, unit="m"),
        downsampling=keyframe.DOWNSAMPLING,
        iterations=keyframe.ITERATIONS.model_copy(update={"baseline": 30}),
    )

    def prepare(self, scan: Scan) -> PreparedCloud:
        o3d = open3d.load()
        points = o3d.utility.Vector3dVector(keyframe.crop(scan, self.settings.min_range))
        cloud = o3d.geometry.PointCloud(points).voxel_down_sample(self.parameters["downsampling"])
        size = len(cloud.points)
        return PreparedCloud(scan.stamp, cloud, size >= MIN_POINTS, nbytes=4096 + 24 * size)

    def align(
        self, target: PreparedCloud, source: PreparedCloud, T_target_guess: Poses
    ) -> Alignment:
        registration = open3d.load().pipelines.registration
        option = registration.NormalDistributionsTransformOption(
            voxel_size=self.parameters["resolution"], max_iteration=self.parameters["iterations"]
        )
        try:
            result = registration.registration_ndt(
                source.cloud, target.cloud, option, T_target_guess
            )
        except RuntimeError:
            # No cell of the target holds enough points.
            return Alignment(T_target_guess, ok=False)
        return Alignment(result.transformation, len(result.correspondence_set) >= MIN_POINTS)
