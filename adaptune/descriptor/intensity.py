"""Intensities of a scan: the material of the surroundings rather than their shape."""

import numpy as np
from numpy.typing import NDArray

from adaptune.descriptor.base import DescriptorError
from adaptune.sequence import Scan

RING = 3.0
"""Metres between rings."""
N_RINGS = 10
N_QUANTILES = 9


def intensity(scan: Scan) -> NDArray[np.float64]:
    """Deciles of all intensities, and their mean and standard deviation in each ring.

    They are on the scale of the sensor: train and run with the same one.

    Returns
    -------
    ndarray of shape (29,)
        The rings are ten of 3 m.

    Raises
    ------
    DescriptorError
        If the scan's points have no intensities.
    """
    if not len(scan):
        return np.zeros(N_QUANTILES + 2 * N_RINGS)
    if scan.intensities is None:
        raise DescriptorError(
            f"the points of scan {scan.stamp} have no intensity to be described by: leave "
            f"`intensity` out of `descriptor`"
        )
    deciles = np.arange(1, N_QUANTILES + 1) / (N_QUANTILES + 1)
    rings = (np.hypot(scan.points[:, 0], scan.points[:, 1]) / RING).astype(np.intp)
    inside = rings < N_RINGS
    rings, values = rings[inside], scan.intensities[inside].astype(np.float64)
    n = np.maximum(np.bincount(rings, minlength=N_RINGS), 1)
    mean = np.bincount(rings, values, N_RINGS) / n
    variance = np.bincount(rings, (values - mean[rings]) ** 2, N_RINGS) / n
    return np.concatenate([np.quantile(scan.intensities, deciles), mean, np.sqrt(variance)])
