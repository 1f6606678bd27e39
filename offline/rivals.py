"""Rivals of what is driven: what a user could have without adapting."""

import numpy as np

from adaptune.model.base import complementary
from adaptune.study.driven import BEST_DEFAULT, EQUAL_COST
from offline.labelled import LabelledData
from offline.tuning import Policy


def driven_cost(data: LabelledData, policy: Policy, fixed: int) -> float:
    """Milliseconds of CPU time a scan that a policy costs; NaN if it is unknown.

    Parameters
    ----------
    data
        With the costs of its sets.
    policy
        What is driven.
    fixed
        Trial number of the fixed set.
    """
    if data.costs is None:
        return np.nan
    if policy.bank.adapt:
        return data.costs.adaptive(policy.members)
    if policy.one_set.adapt:
        of_rule, _ = data.training_data()
        few = complementary(of_rule, policy.one_set.n_sets or len(data.sets))
        return max(data.costs.adaptive([trial]) for trial in few)
    return data.costs.alone(fixed)


def rivals(data: LabelledData, cost: float) -> dict[str, int]:
    """Trial numbers of the rivals that there are.

    `BEST_DEFAULT` is the odometry that does best with its own parameters, where there are several;
    `EQUAL_COST` the best of all sets that alone cost no more than what is driven.

    Parameters
    ----------
    data
        On which they are chosen.
    cost
        Milliseconds of CPU time a scan of what is driven; NaN if it is unknown.
    """
    found = {}
    bounds = data.bounds()
    defaults = [trial for trial in data.sets.defaults if np.isfinite(bounds[trial])]
    if len(data.sets.space.baselines) > 1 and defaults:
        found[BEST_DEFAULT] = data.best(defaults)
    if np.isfinite(cost):
        found[EQUAL_COST] = data.best(data.within(cost))
    return found
