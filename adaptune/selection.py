"""What is chosen for a scan, and what an odometry or a bank applies."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from adaptune.space import ParameterSet


class Selection(NamedTuple):
    """A parameter set, or in a bank the weights of its members.

    Attributes
    ----------
    trial : int
        Number of the set's trial; in a bank that of the member with the largest weight.
    parameters : dict
        The set.
    weights : dict, optional
        In a bank, the weight of every member by its trial number. They add up to 1.
    predicted_error : float
        Percent.
    predicted_fixed : float
        Percent, the predicted error of the fixed set at this scan.
    familiarity : float
        Share of the training frames that are farther from the other training stretches than the
        scan is from all of them; NaN where the rule does not compute it.
    n_sequences : float
        Effective number of training stretches that the selection rests on: one over the sum of
        their squared weights; NaN where they have none.
    estimated_error, estimated_low, estimated_high : float
        Percent, the odometry's own error over the last metres as it was measured without ground
        truth, and its 95 % interval; NaN where nothing was measured.
    lost : bool
        Whether the last measurements say that the odometry, or the bank, has lost track.
    restart : frozenset of int
        Trial numbers of members of a bank that have lost track: they start again at its pose.
    resting : frozenset of int
        Trial numbers of members of a bank that need not work now.
    """

    trial: int
    parameters: ParameterSet
    weights: Mapping[int, float] | None = None
    predicted_error: float = math.nan
    predicted_fixed: float = math.nan
    familiarity: float = math.nan
    n_sequences: float = math.nan
    estimated_error: float = math.nan
    estimated_low: float = math.nan
    estimated_high: float = math.nan
    lost: bool = False
    restart: frozenset[int] = frozenset()
    resting: frozenset[int] = frozenset()
