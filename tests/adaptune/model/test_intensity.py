"""Deciles, and means and deviations by ring."""

import numpy as np
import pytest

from adaptune.model.descriptor import DescriptorError
from adaptune.model.intensity import intensity
from adaptune.recording import Scan


def test_deciles_and_rings():
    # Ten points in the first ring, two in the third, one beyond all.
    ranges = np.concatenate([np.linspace(0.5, 2.5, 10), [7.0, 8.0], [31.0]])
    points = np.column_stack([ranges, np.zeros((13, 2))]).astype(np.float32)
    values = np.concatenate([np.arange(10), [50.0, 70.0], [255.0]]).astype(np.float32)
    found = intensity(Scan(0, points, intensities=values))
    np.testing.assert_allclose(found[:9], np.quantile(values, np.arange(0.1, 0.95, 0.1)))
    np.testing.assert_allclose(found[9:19], [4.5, 0, 60, *7 * [0]])
    np.testing.assert_allclose(found[19:], [np.arange(10).std(), 0, 10, *7 * [0]])


def test_points_without_intensities():
    with pytest.raises(DescriptorError, match=r"scan 7 have no intensity.*leave `intensity` out"):
        intensity(Scan(7, np.ones((3, 3), np.float32)))
