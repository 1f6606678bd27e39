"""The selection rules by name: adaptune's own, and the user's."""

from collections.abc import Callable, Collection
from textwrap import shorten
from typing import Any

from adaptune._system.strict import Plugins
from adaptune.errors import AdaptuneError, in_a_line
from adaptune.model.rules import NOTHING, Evidence, Rule
from adaptune.space import ParameterSets, Selection

RULES = {
    "adaptive": "adaptune.model.weights:BankRule",
    "standby": "adaptune.model.weights:StandbyRule",
    "paper": "adaptune.model.knn:NearestNeighbours",
}
"""Where the classes are, as ``module:Class``; the first is the default."""
ADAPTIVE, STANDBY = tuple(RULES)[:2]
ENTRY_POINTS = "adaptune.rules"
"""Group in which other packages announce their rules, each by its name."""


class RuleError(AdaptuneError):
    """A selection rule that does not exist, or is none."""


def rule_class(name: str, also: Collection[str] = ()) -> type[Rule]:
    """Class of a selection rule: one of `RULES`, an announced one, or ``module:Class``.

    A `RuleError` says why there is none, and names `also` modes that are no rules.
    """
    classes = Plugins("mode", RULES | dict.fromkeys(also, ""), RuleError, ENTRY_POINTS)
    return classes.derived(name, Rule, "adaptune.model.Rule")


def call_user_code(method: Callable[..., Any], *given: Any) -> Any:
    """What a method of a rule returns; a `RuleError` says what goes wrong in it."""
    try:
        return method(*given)
    except AdaptuneError:
        raise
    except Exception as error:
        raise RuleError(f"{method.__qualname__}: {in_a_line(error)}") from error


def selected(
    rule: Rule, sets: ParameterSets, feature: Any, evidence: Evidence = NOTHING, members: Any = None
) -> Selection:
    """What a rule selects; a `RuleError` if that is none of the sets, or weighs other members."""
    found: Selection = call_user_code(rule.select, feature, evidence)
    sound = isinstance(found, Selection) and found.trial in sets
    sound = sound and found.parameters == sets[found.trial]
    weighs = {*(found.weights or ())} if sound and members is not None else set()
    if not sound or (weighs and weighs != {*members}):
        what = f"{rule.select.__qualname__}: returns {shorten(repr(found), 120)}"
        raise RuleError(f"{what}; return Selection(trial, data.sets[trial])")
    return found
