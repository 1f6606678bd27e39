"""Intensities of a scan: the material of the surroundings rather than their shape."""

import numpy as np
from numpy.typing import NDArray

from adaptune.model.descriptor import DescriptorError
from adaptune.recording import Scan

RING = 3.0
"""Metres between rings."""
N_RINGS = 10
N_QUANTILES = 9


def intensity(scan: Scan) -> NDArray[np.float64]:
    """Deciles of all intensities, and mean and standard deviation in ten rings of 3 m: (29,).

    They are on the scale of the sensor: train and run with the same one.
    """
    if not len(scan):
        return np.zeros(N_QUANTILES + 2 * N_RINGS)
    if scan.intensities is None:
        help_ = "leave `intensity` out of `descriptor`"
        raise DescriptorError(f"the points of scan {scan.stamp} have no intensity: {help_}")
    deciles = np.arange(1, N_QUANTILES + 1) / (N_QUANTILES + 1)
    rings = (np.hypot(scan.points[:, 0], scan.points[:, 1]) / RING).astype(np.intp)
    inside = rings < N_RINGS
    rings, values = rings[inside], scan.intensities[inside].astype(np.float64)
    n = np.maximum(np.bincount(rings, minlength=N_RINGS), 1)
    mean = np.bincount(rings, values, N_RINGS) / n
    variance = np.bincount(rings, (values - mean[rings]) ** 2, N_RINGS) / n
    return np.concatenate([np.quantile(scan.intensities, deciles), mean, np.sqrt(variance)])
