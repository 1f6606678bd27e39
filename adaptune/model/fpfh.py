"""Fast point feature histograms of a scan, by Open3D.

After Rusu, Blodow and Beetz, *Fast point feature histograms (FPFH) for 3D registration*, ICRA 2009.
"""

import numpy as np
from numpy.typing import NDArray

from adaptune import files
from adaptune.recording import Scan

CELL_SIZE = 0.5
"""Metres between points that are kept; normals and histograms look 2 and 4 times as far."""
MIN_POINTS = 10
N_BINS = 33


def fpfh(scan: Scan) -> NDArray[np.float64]:
    """Mean and standard deviation of the histograms of a thinned scan's points, of shape (66,).

    Zeros where there are too few points.
    """
    o3d = files.load()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scan.points.astype(np.float64)))
    cloud = cloud.voxel_down_sample(CELL_SIZE)
    if len(cloud.points) < MIN_POINTS:
        return np.zeros(2 * N_BINS)
    near = o3d.geometry.KDTreeSearchParamHybrid(2.0 * CELL_SIZE, 30)
    cloud.estimate_normals(near)
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    far = o3d.geometry.KDTreeSearchParamHybrid(4.0 * CELL_SIZE, 100)
    histograms = o3d.pipelines.registration.compute_fpfh_feature(cloud, far).data
    return np.concatenate([histograms.mean(axis=1), histograms.std(axis=1)])
