"""The error model: from what a scan looks like to the parameter set with the least error."""

from adaptune.model.base import Rule, Selection, TrainingData
from adaptune.model.file import ErrorModel, ModelError
from adaptune.model.knn import NearestNeighbours, ProductKNeighborsRegressor
from adaptune.model.paired import PairedExpectedRatio
from adaptune.model.portfolio import portfolio, restrict

RULES: dict[str, type[Rule]] = {"paired": PairedExpectedRatio, "paper": NearestNeighbours}
"""Selection rules by name; the first is the default."""

__all__ = [
    "RULES",
    "ErrorModel",
    "ModelError",
    "NearestNeighbours",
    "PairedExpectedRatio",
    "ProductKNeighborsRegressor",
    "Rule",
    "Selection",
    "TrainingData",
    "portfolio",
    "restrict",
]
