"""Axes of parameters: their unit, their scale, and their categories."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.charts.chart import Axis
from adaptune.space import Categorical, Float, Integer, label

Parameter = Float | Integer | Categorical


def parameter_axis(name: str, parameter: Parameter) -> Axis:
    """The axis of a parameter: logarithmic as its range is, or with the names of its choices."""
    if isinstance(parameter, Categorical):
        return Axis(label(name, parameter), names=tuple(map(str, parameter.choices)))
    return Axis(label(name, parameter), log=parameter.log)


def on_axis(values: Sequence[Any], parameter: Parameter) -> NDArray[np.float64]:
    """Where values are on this axis, of shape (n,); NaN for None.

    Parameters
    ----------
    values
        Values of the parameter; None where a set has none.
    parameter
        The parameter.
    """
    at = parameter.index if isinstance(parameter, Categorical) else float
    return np.array([np.nan if value is None else at(value) for value in values], np.float64)
