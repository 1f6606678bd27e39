"""The error model: from the descriptor of a scan to the parameter set with the least error."""

from adaptune.model.error_model import ErrorModel, ModelError
from adaptune.model.rules import FixedSet, Rule, TrainingData
from adaptune.model.weights import BankRule, BankSettings

__all__ = [
    "BankRule",
    "BankSettings",
    "ErrorModel",
    "FixedSet",
    "ModelError",
    "Rule",
    "TrainingData",
]
