"""The error model: from what a scan looks like to the parameter set with the least error."""

from collections.abc import Callable

from adaptune.model.base import Rule, Selection, TrainingData
from adaptune.model.file import ErrorModel, ModelError
from adaptune.model.fusion import PairedFusion
from adaptune.model.knn import NearestNeighbours, ProductKNeighborsRegressor
from adaptune.model.paired import PairedExpectedRatio, Settings

RULES: dict[str, Callable[[Settings, float], Rule]] = {
    "paired": PairedExpectedRatio,
    "paper": lambda *_: NearestNeighbours(),
}
"""By name, how to make a selection rule of the settings it may heed and of the price of a switch.

The first is the default.
"""

__all__ = [
    "RULES",
    "ErrorModel",
    "ModelError",
    "NearestNeighbours",
    "PairedExpectedRatio",
    "PairedFusion",
    "ProductKNeighborsRegressor",
    "Rule",
    "Selection",
    "Settings",
    "TrainingData",
]
