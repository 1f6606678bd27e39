"""The error model: from the descriptor of a scan to the parameter set with the least error."""

from adaptune.errors import nearest
from adaptune.model.error_model import ErrorModel, ModelError
from adaptune.model.rules import PairedExpectedRatio, PairedSettings, Rule, TrainingData
from adaptune.model.weights import BankRule, BankSettings

RULES = ("adaptive", "paper")
"""Names of the selection rules; the first is the default."""


def make_rule(name: str, settings: PairedSettings) -> Rule:
    """Make a selection rule for a single odometry; `paper` has no settings.

    Raises
    ------
    ModelError
        If there is no such rule.
    """
    if name not in RULES:
        raise ModelError(f"there is no selection rule {name!r}: {nearest(name, RULES)}")
    if name == "paper":
        from adaptune.model.knn import NearestNeighbours  # compiled code, which few need

        return NearestNeighbours()
    return PairedExpectedRatio(settings)


__all__ = [
    "RULES",
    "BankRule",
    "BankSettings",
    "ErrorModel",
    "ModelError",
    "PairedExpectedRatio",
    "PairedSettings",
    "Rule",
    "TrainingData",
    "make_rule",
]
