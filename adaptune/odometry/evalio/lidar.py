"""The pipelines of evalio that need a LiDAR only."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from adaptune.odometry.base import OdometryError
from adaptune.odometry.evalio.base import NO_FIELD, GridPipeline, Pipeline
from adaptune.odometry.scan_time import MIDDLE
from adaptune.sequence.scan import Scan
from adaptune.space import Float, Integer, ParameterSet, ParameterSpace


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
    """FORM (Potokar et al.): features, fixed-lag smoothing and sparse key scans.

    It takes scans as they are.
    """

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
