import numpy as np

from adaptune.report.chart import Axis, on_axis, parameter_axis
from adaptune.space import Categorical, Float, Integer

KERNEL = Categorical(choices=("none", 1, True), baseline=1)


def test_axes_have_the_scale_of_the_range_or_names():
    distance = Float(low=1.0, high=10.0, baseline=4.0, log=True)
    assert parameter_axis("distance", distance) == Axis("distance", log=True)
    assert parameter_axis("points", Integer(low=1, high=9, baseline=4)) == Axis("points")
    assert parameter_axis("kernel", KERNEL).names == ("none", "1", "True")


def test_values_have_their_place():
    np.testing.assert_array_equal(on_axis([True, None, "none"], KERNEL), [2.0, np.nan, 0.0])
    np.testing.assert_array_equal(
        on_axis([3, None], Integer(low=1, high=9, baseline=4)), [3.0, np.nan]
    )
