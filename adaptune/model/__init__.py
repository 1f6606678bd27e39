"""The error model: from the descriptor of a scan to the parameter set with the least error."""

from adaptune.model.error_model import ErrorModel, ModelError
from adaptune.model.rules import PairedExpectedRatio, PairedSettings, Rule, TrainingData
from adaptune.model.weights import BankRule, BankSettings

__all__ = [
    "BankRule",
    "BankSettings",
    "ErrorModel",
    "ModelError",
    "PairedExpectedRatio",
    "PairedSettings",
    "Rule",
    "TrainingData",
]
